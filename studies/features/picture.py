"""The picture of ``study features``: what each adds to a frame, in time and in memory."""

from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from studies.results import save_figure

DPI = 130


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Write the picture."""
    figure = Figure(figsize=(12, 0.34 * len(rows) + 1.6), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    names = [f"{row['feature']}  ({row['model']})" for row in rows]
    models = list(dict.fromkeys(row["model"] for row in rows))
    colours = [f"C{models.index(row['model'])}" for row in rows]
    for axes, what, unit in zip(panels, ("ms", "mb"), ("time (ms)", "memory (MB)"), strict=True):
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
    figure.suptitle("What each feature adds; what is off adds nothing")
    save_figure(figure, path, dpi=DPI)
