"""The command ``study echo``: the B-mode image of virtual test objects beside SIMUS."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click
import numpy as np

from rehearsal.commands.command_line import make_folder, start_taichi
from studies.echo.echo_rows import CYST_RADIUS_MM, DEPTHS_MM, LEVEL_BAR_DB, SHIFT_BAR, WIDTH_BAR, Row, rows
from studies.echo.simus_beam import pymust
from studies.study_options import out_option
from studies.study_results import finish_axes, table_of, write_results

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLUMNS = (
    ("quantity", "{name}"),
    ("ours", "{ours:.3g}"),
    ("reference", "{reference:.3g}"),
    ("unit", "{unit}"),
    ("within", "{within}"),
    ("if not, why", "{reason}"),
)
QUANTITIES = {
    "lateral width": "Width of a point [mm]",
    "elevational travel": "Travel to half of speckle correlation [mm]",
    "interface": "Tilted interface [dB]",
    "cyst": f"Cyst of {2 * CYST_RADIUS_MM:g} mm [dB]",
}


@click.command()
@out_option
def echo(out: Path) -> None:
    """Compare the B-mode image with an independent wave simulator.

    Virtual test objects are imaged with each included probe, and the same arrays are simulated by SIMUS
    (package pymust). Two minutes.
    """
    pymust()
    make_folder(out)
    backend = start_taichi("cpu")
    found = list(rows())
    described = [_described(row) for row in found]
    outside = sum(not row.is_within for row in found)
    text = (
        f"{table_of(COLUMNS, described)}\n\n{len(found) - outside} of {len(found)} within "
        f"{100 * WIDTH_BAR:g} % "
        f"(lengths) or {LEVEL_BAR_DB:g} dB (levels) of SIMUS, or {100 * SHIFT_BAR:g} % of the Doppler "
        "equation"
    )
    report = dict(
        backend=backend,
        length_bar=WIDTH_BAR,
        level_bar_db=LEVEL_BAR_DB,
        shift_bar=SHIFT_BAR,
        rows=[asdict(row) | {"within": row.is_within} for row in found],
    )
    write_results(out, "echo", report, text, described, figure_of(found))


def _described(row: Row) -> dict[str, object]:
    return asdict(row) | {
        "within": "yes" if row.is_within else "no",
        "reason": "" if row.is_within else row.reason,
    }


def figure_of(found: list[Row]) -> "Figure":
    """Ours against the reference, a panel for each kind of quantity."""
    from matplotlib.figure import Figure

    figure = Figure((11, 10), layout="constrained")
    for axes, (part, title) in zip(figure.subplots(2, 2).flat, QUANTITIES.items(), strict=True):
        chosen = [row for row in found if part in row.name]
        if not chosen:
            continue
        reference = np.array([row.reference for row in chosen])
        for name in [*DEPTHS_MM]:
            own = [row for row in chosen if row.name.startswith(name)]
            if own:
                axes.plot([row.reference for row in own], [row.ours for row in own], "o", label=name)
        ends = np.array([reference.min(), reference.max()])
        bar = LEVEL_BAR_DB if "dB" in title else WIDTH_BAR * ends
        axes.plot(ends, ends, color="grey", lw=0.8)
        axes.fill_between(ends, ends - bar, ends + bar, color="grey", alpha=0.2, lw=0)
        finish_axes(axes, dict(fontsize=8), title=title, xlabel="SIMUS", ylabel="Nephron")
    return figure
