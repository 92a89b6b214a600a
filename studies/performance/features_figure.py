"""The picture of ``study features``: what each adds to a frame, in time and in memory."""

from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from rehearsal.result_files import save_figure

DPI = 130


FRAME = "frame"
TITLES = (
    "A time step: with each feature less without it",
    "A frame: each piece, and all that it needs, by itself",
)
UNITS = {"ms": "time (ms)", "mb": "memory: fields on the device (MB)"}


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Write the picture: what features add to a step, and under it what the pieces of a frame take."""
    parts = [row for row in rows if row["model"] != FRAME], [row for row in rows if row["model"] == FRAME]
    figure = Figure(figsize=(12, 0.34 * len(rows) + 3), layout="constrained")
    heights = [len(part) + 3 for part in parts]
    halves = figure.subfigures(2, 1, squeeze=False, height_ratios=heights)[:, 0]
    for half, part, title in zip(halves, parts, TITLES, strict=True):
        half.suptitle(title)
        _bars(half.subplots(1, 2, sharey=True), part)
    save_figure(figure, path, dpi=DPI)


def _bars(panels: Any, rows: list[dict[str, Any]]) -> None:
    names = [
        row["feature"] if row["model"] == FRAME else f"{row['feature']}  ({row['model']})" for row in rows
    ]
    models = list(dict.fromkeys(row["model"] for row in rows))
    colours = ["C2" if row["model"] == FRAME else f"C{models.index(row['model'])}" for row in rows]
    for axes, (what, unit) in zip(panels, UNITS.items(), strict=True):
        added = [row[f"{what}_on"] - row[f"{what}_off"] for row in rows]
        axes.barh(range(len(rows)), added, color=colours)
        for y, value in enumerate(added):
            axes.annotate(f" {value:.2f}", (max(value, 0.0), y), va="center", fontsize=8)
        axes.set_xlabel(unit)
        axes.axvline(0.0, color="0.4", linewidth=0.8)
        axes.grid(alpha=0.3, axis="x")
        axes.margins(x=0.12)
    panels[0].set_yticks(range(len(rows)), names)
    panels[0].invert_yaxis()
