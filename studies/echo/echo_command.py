"""The command ``study echo``: the B-mode image of virtual test objects beside SIMUS."""

from dataclasses import asdict
from typing import TYPE_CHECKING

import numpy as np

from studies.echo.echo_rows import CYST_RADIUS_MM, LEVEL_BAR_DB, SHIFT_BAR, WIDTH_BAR, Row, rows
from studies.echo.simus_beam import pymust
from studies.study import Results, Study, study_command
from studies.tables_and_panels import curves_by, draw_panel, panels_of, table_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLUMNS = {
    "quantity": "{name}",
    "ours": "{ours:.3g}",
    "reference": "{reference:.3g}",
    "unit": "{unit}",
    "within": "{within}",
    "if not, why": "{reason}",
}
QUANTITIES = {
    "lateral width": "Width of a point [mm]",
    "elevational travel": "Travel to half of speckle correlation [mm]",
    "interface": "Tilted interface [dB]",
    "cyst": f"Cyst of {2 * CYST_RADIUS_MM:g} mm [dB]",
}


@study_command("echo", arch="cpu")
def echo(study: Study) -> Results:
    """Compare the B-mode image with an independent wave simulator.

    Virtual test objects are imaged with each included probe, and the same arrays are simulated by SIMUS
    (package pymust). Two minutes.
    """
    pymust()
    compared = list(rows())
    described = [_described(row) for row in compared]
    within = sum(row.is_within for row in compared)
    text = (
        f"{table_of(COLUMNS, described)}\n\n{within} of {len(compared)} within {100 * WIDTH_BAR:g} % "
        f"(lengths) or {LEVEL_BAR_DB:g} dB (levels) of SIMUS, or {100 * SHIFT_BAR:g} % of the Doppler "
        "equation"
    )
    report = dict(
        backend=study.backend,
        length_bar=WIDTH_BAR,
        level_bar_db=LEVEL_BAR_DB,
        shift_bar=SHIFT_BAR,
        rows=[asdict(row) | {"within": row.is_within} for row in compared],
    )
    return Results(report, text, described, figure_of(compared))


def _described(row: Row) -> dict[str, object]:
    return asdict(row) | {
        "within": "yes" if row.is_within else "no",
        "reason": "" if row.is_within else row.reason,
    }


def figure_of(compared: list[Row]) -> "Figure":
    """Ours against the reference, a panel for each kind of quantity."""
    figure, panels = panels_of((11, 10), 2, 2)
    for axes, (part, title) in zip(panels.flat, QUANTITIES.items(), strict=True):
        chosen = [asdict(row) | {"probe": row.name.split(",")[0]} for row in compared if part in row.name]
        if not chosen:
            continue
        curves = curves_by(chosen, "reference", "ours", "probe", "o")
        reference = [row["reference"] for row in chosen]
        ends = np.array([min(reference), max(reference)])
        bar = LEVEL_BAR_DB if "dB" in title else WIDTH_BAR * ends
        axes.plot(ends, ends, color="grey", lw=0.8)
        axes.fill_between(ends, ends - bar, ends + bar, color="grey", alpha=0.2, lw=0)
        draw_panel(axes, curves, dict(fontsize=8), title=title, xlabel="SIMUS", ylabel="Nephron")
    return figure
