"""The picture of ``study soak``: what would grow if anything did, minute by minute."""

from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from rehearsal.result_files import save_figure

DPI = 130
SHOWN = (
    ("shape_mm", "shape: mean distance from the first rest,\nmoved and turned to fit (mm)"),
    (
        "moved_mm",
        "place: mean distance from the first rest (mm);\nfriction alone holds the kidney where it was pushed",
    ),
    ("memory_mb", "memory of the process since the first minute (MB)"),
    ("ms_median", "time of a step (ms)"),
)
# Growth that is less than so much is drawn as none.
LEAST_MB = 10.0


def draw(runs: list[dict[str, Any]], path: Path) -> None:
    """Write the picture."""
    figure = Figure(figsize=(11, 7), layout="constrained")
    panels = figure.subplots(2, 2, sharex=True)
    for axes, (name, label) in zip(panels.ravel(), SHOWN, strict=True):
        for run in runs:
            rows = run["minutes"]
            begins = rows[0][name] if name == "memory_mb" else 0.0
            at = [row["minute"] for row in rows]
            axes.plot(at, [row[name] - begins for row in rows], marker=".", label=run["model"])
        axes.set_title(label, fontsize=10)
        axes.grid(alpha=0.3)
        low, high = axes.get_ylim()
        if name == "memory_mb":
            axes.set_ylim(min(low, -LEAST_MB), max(high, LEAST_MB))
        else:
            axes.set_ylim(0, 1.05 * high)
    for axes in panels[1]:
        axes.set_xlabel("simulated minutes, each of presses and drags by chance and a rest")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=len(runs))
    figure.suptitle("An hour of rehearsal" if len(runs[0]["minutes"]) == 60 else "Rehearsal without end")
    save_figure(figure, path, dpi=DPI)
