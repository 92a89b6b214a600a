"""Slices of a CT in radiological convention, with the outlines of surfaces, a scale bar and orientation
letters.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import SimpleITK as sitk
import trimesh
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patheffects import withStroke
from matplotlib.typing import ColorType

from scenes.volumes.lazy_volume import AIR_HU
from scenes.volumes.voxel_grid import VoxelGrid

PIXEL_MM = 0.5
WINDOW_HU, LEVEL_HU = 400.0, 50.0
COLOUR = {
    "organ": "#ff8767",
    "tumour": "#ffe14d",
    "cyst": "#4dd2ff",
    "urine": "#bdff85",
    "sinus": "#d57ec3",
    "vessel": "#e21b51",
    "support": "#a090ff",
}
# Lengths of the scale bar, and its largest share of the image's width: the letter is in the middle.
BARS_MM, BAR_SHARE = (50.0, 20.0), 0.4
# White with a black outline, readable on bone and on air.
LETTER: dict[str, Any] = dict(
    color="white",
    weight="bold",
    ha="center",
    va="center",
    path_effects=[withStroke(linewidth=3, foreground="black")],
)
BAR: dict[str, Any] = dict(color="white", path_effects=[withStroke(linewidth=5, foreground="black")])
# Of the axes of LPS: towards which side their numbers are positive, and negative.
SIDES = ("LR", "PA", "SI")


@dataclass(frozen=True)
class SliceView:
    """A slice in radiological convention: the image's right and down axes in LPS, and the orientation
    letters.
    """

    name: str
    right: tuple[int, int, int]
    down: tuple[int, int, int]
    letters: tuple[str, str, str, str]  # left, right, top, bottom

    def position(self, place: np.ndarray) -> str:
        """Where the slice through a place (3,) [mm] lies, as viewers of CT write it: ``S 118 mm`` is 118
        mm towards the head.
        """
        axis = int(np.argmax(np.abs(np.cross(self.right, self.down))))
        return f"{SIDES[axis][int(place[axis] < 0)]} {abs(place[axis]):.0f} mm"


VIEWS = (
    SliceView("axial, from the feet", (1, 0, 0), (0, 1, 0), ("R", "L", "A", "P")),
    SliceView("coronal, from the front", (1, 0, 0), (0, 0, -1), ("R", "L", "S", "I")),
    SliceView("sagittal, from the left", (0, 1, 0), (0, 0, -1), ("A", "P", "S", "I")),
)


def draw_slice(
    axes: Axes,
    view: SliceView,
    ct: sitk.Image,
    surfaces: Mapping[str, trimesh.Trimesh],
    middle: np.ndarray,
    colours: Mapping[str, ColorType],
    bounds_mm: np.ndarray | None = None,
) -> None:
    """Draw the slice of a CT through ``middle`` (3,) [LPS, mm] with the outlines of surfaces, open or closed.

    ``bounds_mm`` (2, 3) is the box that is shown, by default that of the CT.
    """
    right, down = np.array(view.right, float), np.array(view.down, float)
    low, high = VoxelGrid.of(ct).bounds() if bounds_mm is None else bounds_mm
    spans = [sorted((low @ axis, high @ axis)) for axis in (right, down)]
    picture = resample_plane(ct, right, down, spans, middle)
    black = LEVEL_HU - WINDOW_HU / 2
    extent = (*spans[0], spans[1][1], spans[1][0])
    axes.imshow(
        picture, cmap="gray", vmin=black, vmax=black + WINDOW_HU, extent=extent, interpolation="bilinear"
    )
    for name, surface in surfaces.items():
        lines = trimesh.intersections.mesh_plane(surface, np.cross(right, down), middle)
        seen = lines @ np.column_stack([right, down])
        axes.add_collection(LineCollection(seen, colors=[colours[name]], linewidths=1.4, capstyle="round"))
    axes.set(xlim=extent[:2], ylim=extent[2:], xticks=[], yticks=[])
    axes.set_title(f"{view.name}, {view.position(middle)}", color="white", fontsize=11)
    draw_scale_bar(axes, extent)
    for letter, place in zip(view.letters, ((0.03, 0.5), (0.97, 0.5), (0.5, 0.97), (0.5, 0.03)), strict=True):
        axes.text(*place, letter, transform=axes.transAxes, fontsize=17, **LETTER)


def draw_scale_bar(axes: Axes, extent: tuple[float, float, float, float]) -> None:
    """Draw a line of one of BARS_MM at the lower right."""
    left, right, bottom, top = extent
    length = next((mm for mm in BARS_MM if mm <= BAR_SHARE * (right - left)), BARS_MM[-1])
    end, height = right - 0.05 * (right - left), bottom - 0.05 * (bottom - top)
    axes.plot([end - length, end], [height, height], solid_capstyle="butt", linewidth=3, **BAR)
    label = dict(LETTER, va="bottom")
    axes.text(end - length / 2, height - 0.015 * (bottom - top), f"{length:g} mm", fontsize=9, **label)


def resample_plane(
    image: sitk.Image, right: np.ndarray, down: np.ndarray, spans: list[list[float]], middle: np.ndarray
) -> np.ndarray:
    """HU on a plane through ``middle``, over two spans [mm]."""
    across = np.cross(right, down)
    origin = right * spans[0][0] + down * spans[1][0] + across * (middle @ across)
    width, height = (int((high - low) / PIXEL_MM) + 1 for low, high in spans)
    axes = np.column_stack([right, down, across])
    plane = VoxelGrid((width, height, 1), np.full(3, PIXEL_MM), origin, axes)
    return plane.sampled(image, sitk.sitkLinear, AIR_HU)[0]
