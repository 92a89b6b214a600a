"""The picture of ``study trade``: every point by its time and its error, the front, the presets and the paper's."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rehearsal.result_files import save_figure
from rehearsal.speed_accuracy.pareto_front import preset_of, setup_of_row
from studies.performance.tradeoff_settings import PAPER

DPI = 130
FRAME_MS = 1000 / 60


def draw(points: list[dict[str, Any]], path: Path) -> None:
    """Write the picture."""
    points = [point for point in points if point["error_mean_mm"] is not None]
    figure = Figure(figsize=(11, 7), layout="constrained")
    axes = figure.subplots()
    for model in sorted({point["model"] for point in points}):
        _model(axes, [point for point in points if point["model"] == model], model)
    front = sorted((point for point in points if point["pareto"]), key=lambda point: point["ms_median"])
    ms, error = [p["ms_median"] for p in front], [p["error_mean_mm"] for p in front]
    axes.plot(ms, error, color="black", linewidth=1.2, label="Pareto front", drawstyle="steps-post")
    axes.axvline(FRAME_MS, color="0.5", linestyle="--", linewidth=0.8)
    axes.annotate(" a frame at 60 Hz", (FRAME_MS, axes.get_ylim()[1]), color="0.4", va="top")
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="time of a step (ms, median)",
        ylabel="mean error of the beads (mm)",
    )
    axes.set_title("What speed costs in accuracy")
    axes.grid(alpha=0.3, which="both")
    axes.legend(loc="center right")
    save_figure(figure, path, dpi=DPI)


def _model(axes: Axes, points: list[dict[str, Any]], model: str) -> None:
    size = np.array([point["cell_mm"] or point["radius_mm"] for point in points])
    axes.scatter(
        [point["ms_median"] for point in points],
        [point["error_mean_mm"] for point in points],
        s=7 * size,
        alpha=0.55,
        label=f"{model} (area: size of cells or particles)",
    )
    papers = [point for point in points if setup_of_row(point) in PAPER]
    for k, point in enumerate(papers):
        at = (point["ms_median"], point["error_mean_mm"])
        label = "the paper's radii (mm), with its best stiffness" if k == 0 else None
        axes.scatter(*at, marker="x", color="tab:red", zorder=3, label=label)
        text = f"{point['radius_mm']:g}"
        axes.annotate(
            text, at, xytext=(0, 6), textcoords="offset points", fontsize=9, color="tab:red", ha="center"
        )
    for point in points:
        name = preset_of(setup_of_row(point))
        # Shape matching's are the paper's particles, of which the finer are not the truer.
        if name and point["pareto"]:
            at = (point["ms_median"], point["error_mean_mm"])
            axes.scatter(*at, marker="D", facecolors="none", edgecolors="black", zorder=3)
            axes.annotate(
                name, at, xytext=(0, -15), textcoords="offset points", fontsize=10, weight="bold", ha="center"
            )
