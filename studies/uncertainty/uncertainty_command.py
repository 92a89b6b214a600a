"""The command ``study uncertainty``: how far a press depends on what is not known of the patient's tissue.

Its parameters are sampled; the outcomes give bands, and by Sobol's indices (SALib) what matters most.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np
from matplotlib.figure import Figure
from SALib.analyze import sobol as sobol_indices
from SALib.sample import sobol as sobol_sample

from rehearsal.commands.command_line import CommandError
from rehearsal.configuration import PRESETS, scene_of
from scenes.anatomy import fingerprint
from scenes.scene import EMBEDDED
from scenes.tissue import USUAL
from studies.study import Results, Study, study_command
from studies.tables_and_panels import draw_panel, panels_of, table_of
from studies.uncertainty.unknowns import (
    QUANTITIES,
    PressProblem,
    Unknown,
    press_outcome,
    unknowns_of,
    with_all_parts,
)
from version import VERSION

SEED = 20161130
BAND = (5.0, 50.0, 95.0)
POSITION = "tumour_position_mm"
# Quantities whose 90 % band is narrower than this, in mm or N, depend on nothing that matters.
LEAST_BAND = 0.05


def samples_of(unknowns: Sequence[Unknown], base: int) -> list[dict[str, float]]:
    """Quasi-random values (Saltelli's scheme, Sobol's sequence): ``base`` times the parameters and two."""
    shares = sobol_sample.sample(_problem(unknowns), base, calc_second_order=False, seed=SEED)
    return [
        {unknown.name: float(unknown.value(share)) for unknown, share in zip(unknowns, row, strict=True)}
        for row in shares
    ]


def bands_of(outcomes: np.ndarray) -> list[dict[str, Any]]:
    """At each depth the 5th, 50th and 95th percentile of each quantity, of outcomes (samples, depths, 9)."""
    rows = []
    for depth in range(outcomes.shape[1]):
        values = outcomes[:, depth]
        known = {name: values[:, n] for n, name in enumerate(QUANTITIES) if np.isfinite(values[:, n]).all()}
        centroid = values[:, len(QUANTITIES) :]
        if np.isfinite(centroid).all():
            known[POSITION] = np.linalg.norm(centroid - np.median(centroid, axis=0), axis=1)
        rows.append({name: _band(column) for name, column in known.items()})
    return rows


def _band(values: np.ndarray) -> dict[str, float]:
    low, median, high = np.percentile(values, BAND)
    return dict(low=round(low, 4), median=round(median, 4), high=round(high, 4))


def indices_of(unknowns: Sequence[Unknown], outcomes: np.ndarray) -> dict[str, dict[str, dict[str, float]]]:
    """Total Sobol indices of each quantity at the greatest depth, by parameter, with 95 % confidence."""
    indices = {}
    for n, name in enumerate(QUANTITIES):
        values = outcomes[:, -1, n]
        if not np.isfinite(values).all() or np.ptp(np.percentile(values, BAND)) < LEAST_BAND:
            continue
        result = sobol_indices.analyze(
            _problem(unknowns), values, calc_second_order=False, print_to_console=False, seed=SEED
        )
        indices[name] = {
            unknown.name: dict(total=round(float(total), 4), confidence=round(float(confidence), 4))
            for unknown, total, confidence in zip(unknowns, result["ST"], result["ST_conf"], strict=True)
        }
    return indices


def _problem(unknowns: Sequence[Unknown]) -> dict[str, Any]:
    return dict(
        num_vars=len(unknowns),
        names=[unknown.name for unknown in unknowns],
        bounds=[[0.0, 1.0]] * len(unknowns),
    )


QUALITY = "fast"
COLUMNS = (
    ("quantity", "{name}"),
    ("5 %", "{low:.2f}"),
    ("median", "{median:.2f}"),
    ("95 %", "{high:.2f}"),
    ("depends most on", "{first}"),
    ("index", "{first_index:.2f}"),
    ("next", "{second}"),
    ("index", "{second_index:.2f}"),
)
WORDS = {
    "tumour_shift_mm": "tumour shift, mm",
    "to_tumour_mm": "face to tumour, mm",
    "tumour_depth_mm": "tumour depth, mm",
    "margin_mm": "margin in the image, mm",
    "force_n": "force on the probe, N",
    "compression_mm": "compression, mm",
    "tumour_position_mm": "tumour from its median place, mm",
}
# Of the tumour, from the middle of the organ at rest (LPS).
CENTROID = ("tumour_x_mm", "tumour_y_mm", "tumour_z_mm")


def _power_of_two(context: click.Context, parameter: click.Parameter, value: int) -> int:
    if value < 2 or value & (value - 1):
        raise click.BadParameter(f"{value}: expected a power of two, such as 16, 32 or 64")
    return value


@study_command(
    "uncertainty",
    click.option(
        "--samples",
        type=int,
        default=32,
        show_default=True,
        callback=_power_of_two,
        help="Base of the quasi-random sample, a power of two; the presses are this times the number of "
        "parameters and two.",
    ),
    scene=EMBEDDED,
    has_workers=True,
)
def uncertainty(study: Study, samples: int) -> Results:
    """Estimate how far SCENE's press depends on what is not known of the tissue.

    Stiffness of kidney and parts, attachment and friction vary over the ranges of
    scenes/mechanical_tissues.toml.
    """
    loaded, anatomy = study.scene
    if loaded.tissue.model != USUAL:
        raise CommandError(f"{loaded.tissue.model} has no material to vary: expected a scene of {USUAL}")
    varied = with_all_parts(scene_of(loaded, PRESETS[USUAL][QUALITY]), anatomy)
    unknowns = unknowns_of(varied, anatomy)
    name = fingerprint(anatomy)
    digest = hashlib.sha256((varied.model_dump_json() + name).encode()).hexdigest()
    tried = samples_of(unknowns, samples)
    with study.workers() as workers:
        problem = workers.share(PressProblem(varied, replace(anatomy, ct=None, labels=None), digest))
        presses = workers.map(press_outcome, [(problem, values) for values in tried])
        outcomes = np.array(list(study.progress(len(tried), "press", presses)))
    figures = report_of(outcomes, unknowns, tuple(varied.press.indentations_mm))
    report = figures | dict(
        nephron_uncertainty=1,
        version=VERSION,
        anatomy=name,
        quality=QUALITY,
        cell_mm=varied.tissue.size_mm,
        samples=len(tried),
    )
    rows = [values | _flat(outcome) for values, outcome in zip(tried, outcomes, strict=True)]
    return Results(report, f"{table(report)}\n\n{_in_window(study.out)}", rows, figure_of(report))


def _in_window(out: Path) -> str:
    file = out / "uncertainty.json"
    return f'To see the bands in the window, name {file} as "uncertainty" in the scene.'


def report_of(outcomes: np.ndarray, unknowns: list[Unknown], depths_mm: tuple[float, ...]) -> dict[str, Any]:
    """The figures of uncertainty.json, of outcomes (samples, depths, 9)."""
    return dict(
        indentations_mm=list(depths_mm),
        parameters=[
            {name: getattr(unknown, name) for name in ("name", "unit", "low", "typical", "high")}
            for unknown in unknowns
        ],
        bands=bands_of(outcomes),
        sobol_total=indices_of(unknowns, outcomes),
    )


def _flat(outcome: np.ndarray) -> dict[str, float]:
    names = *QUANTITIES, *CENTROID
    return {f"{name} (deepest)": float(value) for name, value in zip(names, outcome[-1], strict=True)}


def table(report: dict[str, Any]) -> str:
    """The bands at the greatest depth, and the two parameters that each quantity depends on most."""
    rows = []
    for name, band in report["bands"][-1].items():
        indices = report["sobol_total"].get(name, {})
        ranked = sorted(indices, key=lambda parameter: -indices[parameter]["total"])
        row = band | dict(name=WORDS[name], first="", first_index=None, second="", second_index=None)
        for place, parameter in zip(("first", "second"), ranked, strict=False):
            row |= {place: parameter, f"{place}_index": indices[parameter]["total"]}
        rows.append(row)
    ranges = [
        f"  {parameter['name']:<16} {parameter['low']:g} to {parameter['high']:g} {parameter['unit']}"
        for parameter in report["parameters"]
    ]
    head = f"At {report['indentations_mm'][-1]:g} mm, over {report['samples']} presses:"
    return "\n".join([head, table_of(COLUMNS, rows), "", "Varied:", *ranges])


def figure_of(report: dict[str, Any]) -> Figure:
    """The bands over the depth, and the total indices."""
    wanted = ("tumour_shift_mm", "to_tumour_mm", "margin_mm", "force_n")
    shown = [name for name in wanted if name in report["sobol_total"]]
    figure, panels = panels_of((11, 7), 2, max(len(shown), 1))
    for (above, below), name in zip(panels.T, shown, strict=False):
        bands = [row[name] for row in report["bands"] if name in row]
        depths = report["indentations_mm"][-len(bands) :]
        low, middle, high = ([band[key] for band in bands] for key in ("low", "median", "high"))
        above.fill_between(depths, low, high, alpha=0.25, label="90 % band")
        above.plot(depths, middle, marker=".", label="median")
        draw_panel(above, legend={}, title=WORDS[name], xlabel="indentation, mm")
        indices = report["sobol_total"][name]
        totals, errors = ([index[key] for index in indices.values()] for key in ("total", "confidence"))
        below.barh(list(indices), totals, xerr=errors)
        draw_panel(below, grid="x", xlabel="total Sobol index at full depth", xlim=(0, None))
    figure.suptitle("What is not known of the tissue, and what it changes")
    return figure
