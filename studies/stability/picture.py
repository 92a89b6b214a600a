"""The heat map of ``study stability``: each case a field, by how far it ended from rest."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from studies.results import save_figure

DPI = 130
LEAST_MM, MOST_MM = 0.01, 100.0
MARKS = {
    "put back": ("o", "none", "orange"),
    "whole, elsewhere": (".", "white", "white"),
    "not finite": ("X", "red", "red"),
}


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Write the picture."""
    models = list(dict.fromkeys(row["model"] for row in rows))
    kinds = list(dict.fromkeys(row["kind"] for row in rows))
    most = max(
        sum(row["kind"] == kind and row["model"] == model for row in rows)
        for kind in kinds
        for model in models
    )
    size = max(9.0, 0.26 * most + 4), 0.3 * len(kinds) * len(models) + 2
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(len(models), squeeze=False)[:, 0]
    shown = None
    for axes, model in zip(panels, models, strict=True):
        shown = _map(axes, [row for row in rows if row["model"] == model], model)
    if shown is not None:
        figure.colorbar(shown, ax=list(panels), label="distance from rest after release (mm)", shrink=0.6)
    save_figure(figure, path, dpi=DPI)


def _map(axes: Axes, rows: list[dict[str, Any]], model: str):
    kinds = list(dict.fromkeys(row["kind"] for row in rows))
    wide = max(sum(row["kind"] == kind for row in rows) for kind in kinds)
    error = np.full((len(kinds), wide), np.nan)
    at: dict[str, list[tuple[int, int]]] = {mark: [] for mark in MARKS}
    for y, kind in enumerate(kinds):
        for x, row in enumerate(row for row in rows if row["kind"] == kind):
            error[y, x] = np.clip(row["rest_error_mm"] or 0.0, LEAST_MM, MOST_MM)
            for mark in _marks(row):
                at[mark].append((x, y))
    shown = axes.imshow(error, norm=LogNorm(LEAST_MM, MOST_MM), cmap="viridis", aspect="auto")
    for mark, places in at.items():
        symbol, face, edge = MARKS[mark]
        if places:
            across, down = zip(*places, strict=True)
            axes.scatter(
                across,
                down,
                marker=symbol,
                s=34,
                facecolors=face,
                edgecolors=edge,
                label=mark,
                linewidths=1.0,
            )
    axes.set_yticks(range(len(kinds)), kinds)
    axes.set_xticks([])
    axes.set_title(f"{model}: {len(rows)} cases, each a field", fontsize=11)
    if any(at.values()):
        axes.legend(loc="lower right", fontsize=8, facecolor="0.8")
    return shown


def _marks(row: dict[str, Any]) -> list[str]:
    marks = [] if row["finite"] else ["not finite"]
    if row["fallback"]:
        marks.append("put back")
    if not row["recovered"] and row["shape_error_mm"] is not None and row["shape_error_mm"] <= 0.1:
        marks.append("whole, elsewhere")
    return marks
