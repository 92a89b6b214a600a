"""The picture of ``study freehand``: error against noise and against compression."""

import math
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from rehearsal.result_files import save_figure

DPI = 130
LABEL = {
    "noise_mm": "noise of the position, mm",
    "noise_deg": "noise of the angle, degrees",
    "calibration_mm": "calibration off by, mm",
    "calibration_deg": "calibration turned by, degrees",
    "latency_s": "latency, s (at 10 mm/s)",
    "lost": "share of pictures without a pose",
}


UNDONE = "^:"
TITLES = {
    "centroid_mm": "tumour's centroid off by, mm",
    "dice": "tumour's Dice",
    "landmarks": "landmarks off by, mm",
}


def draw(runs: list[dict[str, Any]], path: Path) -> None:
    """Write the picture: colours are patients, lines what is measured, which each half of it says for itself."""
    figure = Figure(figsize=(13, 9.5), layout="constrained")
    above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=(2, 1.1))[:, 0]
    panels = above.subplots(2, 3).ravel()
    for axes, (name, label) in zip(panels, LABEL.items(), strict=True):
        _against_noise(axes, runs, name, label)
    above.suptitle("At rest, by a tracker's errors: how far the volume is off")
    _legend(panels[0], {"landmarks": "o-", "tumour's centroid": "s--"})
    panels = below.subplots(1, 3)
    for axes, name in zip(panels, TITLES, strict=True):
        _against_compression(axes, runs, name)
    below.suptitle("Pressed in over the tumour: the part of it that was scanned")
    _legend(panels[0], {"as it is": "o-", "compression undone": UNDONE})
    colours = [Line2D([], [], color=f"C{n}", linewidth=3, label=run["patient"]) for n, run in enumerate(runs)]
    figure.legend(handles=colours, loc="outside lower center", ncols=3)
    save_figure(figure, path, dpi=DPI)


def _legend(axes: Axes, styles: dict[str, str]) -> None:
    """What the lines of all panels beside these axes are."""
    handles = [axes.plot([], [], style, color="0.3", label=name)[0] for name, style in styles.items()]
    axes.legend(handles=handles, loc="upper left", fontsize=9)


def _against_noise(axes: Axes, runs: list[dict[str, Any]], name: str, label: str) -> None:
    """Landmark error of the resting sweep, and the distance of the tumour's centroid."""
    for number, run in enumerate(runs):
        rows = [row for row in run["noise"] if row[name] or not any(row[other] for other in LABEL)]
        at = [row[name] for row in rows]
        colour = f"C{number}"
        axes.plot(at, [row["landmarks"]["mean_mm"] for row in rows], "o-", color=colour)
        if "tumour" in rows[0]:
            tumour = [(row["tumour"]["scanned_part"] or {}).get("centroid_mm", math.nan) for row in rows]
            axes.plot(at, tumour, "s--", color=colour)
    _finish(axes, label, "mm")


def _against_compression(axes: Axes, runs: list[dict[str, Any]], name: str) -> None:
    for number, run in enumerate(runs):
        for undone, style in ((False, "o-"), (True, UNDONE)):
            rows = [row for row in run["compression"] if row["undone"] == undone]
            # A press may take the tumour out of the pictures.
            rows = [
                row for row in rows if row.get("tumour", {}).get("scanned_part") and row["landmarks"]["count"]
            ]
            values = [
                row["landmarks"]["mean_mm"] if name == "landmarks" else row["tumour"]["scanned_part"][name]
                for row in rows
            ]
            axes.plot([row["depth_mm"] for row in rows], values, style, color=f"C{number}")
    _finish(axes, "probe pressed in by, mm", TITLES[name])


def _finish(axes: Axes, across: str, up: str) -> None:
    axes.set(xlabel=across, ylabel=up)
    # What is nearly nothing is not cut off by the frame.
    axes.set_ylim(bottom=-0.04 * axes.get_ylim()[1])
    axes.grid(alpha=0.3)
