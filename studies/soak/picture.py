"""The picture of ``study soak``: what would grow if anything did, minute by minute."""

from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from studies.results import save_figure

DPI = 130
SHOWN = (
    ("shape_mm", "shape from the first rest (mm)"),
    ("moved_mm", "place on the support from the first (mm)"),
    ("memory_mb", "memory of the process (MB)"),
    ("ms_median", "time of a step (ms)"),
)


def draw(runs: list[dict[str, Any]], path: Path) -> None:
    """Write the picture."""
    figure = Figure(figsize=(11, 7), layout="constrained")
    panels = figure.subplots(2, 2, sharex=True)
    for axes, (name, label) in zip(panels.ravel(), SHOWN, strict=True):
        for run in runs:
            at = [row["minute"] for row in run["minutes"]]
            axes.plot(at, [row[name] for row in run["minutes"]], marker=".", label=run["model"])
        axes.set_title(label, fontsize=10)
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    for axes in panels[1]:
        axes.set_xlabel("simulated minutes")
    panels[0, 0].legend()
    figure.suptitle("An hour of rehearsal" if len(runs[0]["minutes"]) == 60 else "Rehearsal without end")
    save_figure(figure, path, dpi=DPI)
