"""The picture of a reconstruction: three cuts through its middle, with the outlines of what was seen."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rehearsal.reconstruction.sweep_volumes import Rebuilt
from rehearsal.result_files import save_figure

COLOUR = {"organ": "#ff8c69", "tumour": "#ffe14d"}
AXES = "xyz"


def save_picture(rebuilt: Rebuilt, path: Path) -> None:
    """Write three cuts as PNG, through the middle of the tumour, else of what was seen."""
    of = rebuilt.regions.get("tumour", rebuilt.known)
    where = np.argwhere(of if of.any() else rebuilt.known)
    middle = where.mean(axis=0).round().astype(int) if len(where) else np.array(rebuilt.box.shape) // 2
    figure = Figure(figsize=(12, 4.4), facecolor="#101014", layout="constrained")
    for axis, (across, down) in enumerate(((1, 2), (0, 2), (0, 1))):
        _draw_cut(figure.add_subplot(1, 3, axis + 1), rebuilt, axis, across, down, int(middle[axis]))
    save_figure(figure, path, dpi=110)


def _draw_cut(axes: Axes, rebuilt: Rebuilt, axis: int, across: int, down: int, index: int) -> None:
    low, high = (rebuilt.box.origin_mm + rebuilt.box.spacing_mm * np.array([[0], [1]]) * rebuilt.box.shape)[:]
    extent = (low[across], high[across], low[down], high[down])
    cut = rebuilt.grey.take(index, axis).T
    axes.imshow(cut, cmap="gray", vmin=0, vmax=255, origin="lower", extent=extent, interpolation="nearest")
    for name, region in rebuilt.regions.items():
        part = region.take(index, axis).T
        if part.any() and not part.all():
            axes.contour(part.astype(float), [0.5], colors=COLOUR[name], linewidths=0.9, extent=extent)
    place = rebuilt.box.origin_mm[axis] + rebuilt.box.spacing_mm * index
    axes.set_title(f"{AXES[axis]} = {place:.1f} mm", color="white", fontsize=10)
    axes.set_xlabel(f"{AXES[across]}, mm", color="white", fontsize=9)
    axes.set_ylabel(f"{AXES[down]}, mm", color="white", fontsize=9)
    if axis == 2:
        # As radiologists look at it: the front is up.
        axes.invert_yaxis()
    axes.tick_params(colors="white", labelsize=8)
    axes.set_facecolor("black")
