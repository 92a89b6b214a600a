"""The command ``study features``: the cost of each feature of a scene."""

from pathlib import Path
from typing import Any

import click
from matplotlib.figure import Figure
from tqdm import tqdm

from rehearsal.commands.command_line import arch_option, load_patient, make_folder, start_taichi
from rehearsal.configuration import PRESETS
from scenes.scene import PAPER
from scenes.tissue import USUAL
from studies.study_options import out_option, scene_argument
from studies.study_results import text_table, write_results

MEASURED = ("ms", "mb", "kernels", "launches")
COLUMNS = ("model", "feature", *(f"{name}_{state}" for name in MEASURED for state in ("on", "off")))
HEADERS = ("model", "feature", "ms with", "without", "adds", "MB", "kernels", "launches")
FORMATS = ("", "", ".3f", ".3f", "+.3f", "+.2f", "+g", "+g")
FRAME = "frame"
UNITS = {"ms": "time (ms)", "mb": "memory: fields on the device (MB)"}


@click.command()
@scene_argument(PAPER)
@out_option
@click.option(
    "--quick",
    is_flag=True,
    help="Neo-Hookean alone, coarse, not in turn, no kernels counted: in less than a minute.",
)
@arch_option
def features(scene: Path, out: Path, quick: bool, arch: str) -> None:
    """Measure what each feature of SCENE costs.

    In time, memory and kernels: the same press with it and without, in turn.
    """
    make_folder(out)
    loaded, anatomy = load_patient(scene)
    used = start_taichi(arch)
    from studies.performance import feature_costs

    models = [USUAL] if quick else list(feature_costs.FEATURES)
    rows: list[dict[str, Any]] = []
    total = sum(len(feature_costs.FEATURES[model]) for model in models) + 1
    with tqdm(total=total, desc="features", unit="feature") as bar:
        for model in models:
            preset = PRESETS[model]["fast" if quick else "balanced"]
            body = feature_costs.body_of(loaded, anatomy, model, preset.size_mm)
            found = feature_costs.of_steps(body, feature_costs.FEATURES[model], used, quick, bar.update)
            rows += [dict(model=model) | row for row in found]
        rows += [dict(model=FRAME) | row for row in feature_costs.of_frame(loaded, anatomy, used)]
        bar.update()
    rows = [{name: row[name] for name in COLUMNS} for row in rows]
    write_results(out, "features", dict(arch=used, features=rows), table(rows), rows, figure_of(rows))


def _added(row: dict[str, Any], name: str) -> float | None:
    on = row[f"{name}_on"]
    return None if on is None else on - row[f"{name}_off"]


def table(rows: list[dict[str, Any]]) -> str:
    """What each feature adds: time of a step or of a part of a frame, memory, parallel kernels and their launches."""
    lines = [
        [row["model"], row["feature"], row["ms_on"], row["ms_off"], *(_added(row, name) for name in MEASURED)]
        for row in rows
    ]
    return text_table(HEADERS, lines, FORMATS)


def figure_of(rows: list[dict[str, Any]]) -> Figure:
    """What features add to a step, and below it what the parts of a frame take."""
    parts = {
        "A time step: with each feature, less without it": [row for row in rows if row["model"] != FRAME],
        "A frame: each part, and all that it needs, by itself": [
            row for row in rows if row["model"] == FRAME
        ],
    }
    figure = Figure(figsize=(12, 0.34 * len(rows) + 3), layout="constrained")
    heights = [len(part) + 3 for part in parts.values()]
    halves = figure.subfigures(2, 1, squeeze=False, height_ratios=heights)[:, 0]
    for half, (title, part) in zip(halves, parts.items(), strict=True):
        half.suptitle(title)
        _bars(half.subplots(1, 2, sharey=True), part)
    return figure


def _bars(panels: Any, rows: list[dict[str, Any]]) -> None:
    names = [
        row["feature"] if row["model"] == FRAME else f"{row['feature']}  ({row['model']})" for row in rows
    ]
    models = list(dict.fromkeys(row["model"] for row in rows))
    colours = ["C2" if row["model"] == FRAME else f"C{models.index(row['model'])}" for row in rows]
    for axes, (name, unit) in zip(panels, UNITS.items(), strict=True):
        added = [_added(row, name) or 0.0 for row in rows]
        axes.barh(range(len(rows)), added, color=colours)
        for y, value in enumerate(added):
            axes.annotate(f" {value:.2f}", (max(value, 0.0), y), va="center", fontsize=8)
        axes.set_xlabel(unit)
        axes.axvline(0.0, color="0.4", linewidth=0.8)
        axes.grid(alpha=0.3, axis="x")
        axes.margins(x=0.12)
    panels[0].set_yticks(range(len(rows)), names)
    panels[0].invert_yaxis()
