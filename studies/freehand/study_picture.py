"""The picture of ``study freehand``: error against noise and against compression."""

import math
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.results import save_figure

DPI = 130
LABEL = {
    "noise_mm": "noise of the position, mm",
    "noise_deg": "noise of the angle, degrees",
    "calibration_mm": "calibration off by, mm",
    "calibration_deg": "calibration turned by, degrees",
    "latency_s": "latency, s (at 10 mm/s)",
    "lost": "share of pictures without a pose",
}


def draw(runs: list[dict[str, Any]], path: Path) -> None:
    """Write the picture."""
    figure = Figure(figsize=(13, 9.5), layout="constrained")
    panels = figure.subplots(3, 3).ravel()
    for axes, (name, label) in zip(panels, LABEL.items(), strict=False):
        _against_noise(axes, runs, name, label)
    for axes, figure_name in zip(panels[6:], ("centroid_mm", "dice", "landmarks"), strict=True):
        _against_compression(axes, runs, figure_name)
    figure.legend(*panels[6].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
    figure.suptitle("Volumes of tracked sweeps against the truth")
    save_figure(figure, path, dpi=DPI)


def _against_noise(axes: Axes, runs: list[dict[str, Any]], name: str, label: str) -> None:
    """Landmark error of the resting sweep, and the distance of the tumour's centroid."""
    for number, run in enumerate(runs):
        rows = [row for row in run["noise"] if row[name] or not any(row[other] for other in LABEL)]
        at = [row[name] for row in rows]
        colour = f"C{number}"
        axes.plot(at, [row["landmarks"]["mean_mm"] for row in rows], "o-", color=colour, label=run["patient"])
        if "tumour" in rows[0]:
            tumour = [(row["tumour"]["scanned_part"] or {}).get("centroid_mm", math.nan) for row in rows]
            axes.plot(at, tumour, "s--", color=colour, alpha=0.6)
    axes.set_xlabel(label)
    axes.set_ylabel("mm")
    axes.set_title("landmarks (line), tumour's centroid (dashed)", fontsize=9)
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)


def _against_compression(axes: Axes, runs: list[dict[str, Any]], name: str) -> None:
    titles = {"centroid_mm": "tumour's centroid, mm", "dice": "tumour's Dice", "landmarks": "landmarks, mm"}
    for number, run in enumerate(runs):
        for undone, style in ((False, "o-"), (True, "s--")):
            rows = [row for row in run["compression"] if row["undone"] == undone]
            # A press may take the tumour out of the pictures.
            rows = [
                row for row in rows if row.get("tumour", {}).get("scanned_part") and row["landmarks"]["count"]
            ]
            values = [
                row["landmarks"]["mean_mm"] if name == "landmarks" else row["tumour"]["scanned_part"][name]
                for row in rows
            ]
            label = f"{run['patient']}{', undone' if undone else ''}"
            axes.plot([row["depth_mm"] for row in rows], values, style, color=f"C{number}", label=label)
    axes.set_xlabel("probe pressed in by, mm")
    axes.set_title(titles[name] + ", of the part scanned", fontsize=9)
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
