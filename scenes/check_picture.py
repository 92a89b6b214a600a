"""The checking picture of an import: three slices with outlines, the surfaces, orientation letters, what was found."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import SimpleITK as sitk
import trimesh
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from scenes.facts import told
from scenes.patient import Patient

BACKGROUND = "#101014"
PIXEL_MM = 0.5
WINDOW_HU, LEVEL_HU = 400.0, 50.0
COLOUR = {
    "organ": "#ff8c69",
    "tumour": "#ffe14d",
    "cyst": "#4dd2ff",
    "urine": "#b6ff6b",
    "vessel": "#ff3b5c",
    "support": "#9a9a9a",
}
WORD = {"organ": "kidney", "urine": "collecting system", "vessel": "vessels"}
TEXT_WIDTH = 92
LIGHT = np.array([-0.4, -0.8, 0.45])  # from the front, the patient's right and above


@dataclass(frozen=True)
class View:
    """A cut as a radiologist sees it: where right and down of the picture point in the patient, and the letters there."""

    name: str
    right: tuple[int, int, int]
    down: tuple[int, int, int]
    letters: tuple[str, str, str, str]  # left, right, top, bottom


VIEWS = (
    View("axial, from the feet", (1, 0, 0), (0, 1, 0), ("R", "L", "A", "P")),
    View("coronal, from the front", (1, 0, 0), (0, 0, -1), ("R", "L", "S", "I")),
    View("sagittal, from the left", (0, 1, 0), (0, 0, -1), ("A", "P", "S", "I")),
)


def draw_check(patient: Patient, rows: list[tuple[str, str]], folder: Path) -> None:
    """Draw check.png into a folder: cuts through the tumour, or the organ where there is none, and all that was found."""
    figure = Figure(figsize=(13, 9.6), facecolor=BACKGROUND)
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 3, hspace=0.08, wspace=0.06)
    grid.update(left=0.03, right=0.97, top=0.92, bottom=0.02)
    figure.suptitle(
        f"{patient.side.upper()} KIDNEY{' (DRAFT, grown from a seed)' if patient.draft else ''}: is this the side, the organ and the way up that you expect?",
        color="white",
        fontsize=15,
    )
    surfaces = {"organ": patient.organ, **patient.parts}
    middle = (patient.tumour or patient.organ).bounds.mean(axis=0)
    for n, view in enumerate(VIEWS):
        _draw_cut(figure.add_subplot(grid[0, n]), view, patient, surfaces, middle)
    _draw_surfaces(figure.add_subplot(grid[1, 0], projection="3d", facecolor=BACKGROUND), surfaces)
    words = figure.add_subplot(grid[1, 1:])
    words.axis("off")
    _draw_words(words, rows, [*surfaces, "support"])
    figure.savefig(
        folder / "check.png", dpi=100, facecolor=figure.get_facecolor(), metadata={"Software": None}
    )


def _draw_cut(
    axes: Axes, view: View, patient: Patient, surfaces: dict[str, trimesh.Trimesh], middle: np.ndarray
) -> None:
    right, down = np.array(view.right, float), np.array(view.down, float)
    low, high = _bounds(patient.ct)
    spans = [sorted((low @ axis, high @ axis)) for axis in (right, down)]
    picture = _cut(patient.ct, right, down, spans, middle)
    black = LEVEL_HU - WINDOW_HU / 2
    extent = (*spans[0], spans[1][1], spans[1][0])
    axes.imshow(
        picture, cmap="gray", vmin=black, vmax=black + WINDOW_HU, extent=extent, interpolation="bilinear"
    )
    for name, surface in {"support": patient.support, **surfaces}.items():
        section = surface.section(np.cross(right, down), middle)
        for line in [] if section is None else section.discrete:
            axes.plot(
                line @ right, line @ down, color=COLOUR[name], linewidth=1.4 if name != "support" else 0.8
            )
    axes.set(xlim=extent[:2], ylim=extent[2:], xticks=[], yticks=[])
    axes.set_title(view.name, color="white", fontsize=11)
    for letter, place in zip(view.letters, ((0.03, 0.5), (0.97, 0.5), (0.5, 0.97), (0.5, 0.03)), strict=True):
        axes.text(
            *place,
            letter,
            transform=axes.transAxes,
            color="white",
            fontsize=17,
            weight="bold",
            ha="center",
            va="center",
        )


def _bounds(image: sitk.Image) -> tuple[np.ndarray, np.ndarray]:
    size = image.GetSize()
    corners = [
        image.TransformIndexToPhysicalPoint(
            [n if far else 0 for n, far in zip(np.subtract(size, 1).tolist(), ends, strict=True)]
        )
        for ends in np.ndindex(2, 2, 2)
    ]
    return np.min(corners, axis=0), np.max(corners, axis=0)


def _cut(
    image: sitk.Image, right: np.ndarray, down: np.ndarray, spans: list[list[float]], middle: np.ndarray
) -> np.ndarray:
    """HU on a plane through the middle, across two spans [mm]."""
    across = np.cross(right, down)
    origin = right * spans[0][0] + down * spans[1][0] + across * (middle @ across)
    size = [int((high - low) / PIXEL_MM) + 1 for low, high in spans]
    direction = np.column_stack([right, down, across])
    cut = sitk.Resample(
        image,
        [*size, 1],
        sitk.Transform(),
        sitk.sitkLinear,
        origin.tolist(),
        [PIXEL_MM] * 3,
        direction.ravel().tolist(),
        -1000.0,
    )
    return sitk.GetArrayFromImage(cut)[0]


def _draw_surfaces(axes, surfaces: dict[str, trimesh.Trimesh]) -> None:
    """The surfaces from the front, a little from the patient's right and above."""
    low, high = (
        np.min([s.bounds[0] for s in surfaces.values()], axis=0),
        np.max([s.bounds[1] for s in surfaces.values()], axis=0),
    )
    light = LIGHT / np.linalg.norm(LIGHT)
    for name, surface in reversed(surfaces.items()):
        shade = 0.35 + 0.65 * np.clip(surface.face_normals @ light, 0, 1)
        colour = np.array([int(COLOUR[name][n : n + 2], 16) / 255 for n in (1, 3, 5)])
        faces = np.column_stack(
            [
                shade[:, None] * colour,
                np.full(len(shade), 0.45 if name == "organ" and len(surfaces) > 1 else 1.0),
            ]
        )
        axes.add_collection3d(
            Poly3DCollection(surface.triangles, facecolors=faces, edgecolors=faces, linewidths=0.2)
        )
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=1.1)
    axes.set_proj_type("ortho")
    axes.view_init(elev=12, azim=-105)
    axes.set_axis_off()
    axes.set_title("surface, from the front", color="white", fontsize=11, y=1.06)
    x, y, z = (low + high) / 2
    gap = 0.09 * (high - low).max()
    for letter, place in {
        "R": (low[0] - gap, y, z),
        "L": (high[0] + gap, y, z),
        "S": (x, y, high[2] + gap),
        "I": (x, y, low[2] - gap),
    }.items():
        axes.text(*place, letter, color="white", fontsize=15, weight="bold", ha="center", va="center")


def _draw_words(axes: Axes, rows: list[tuple[str, str]], shown: list[str]) -> None:
    lines = []
    for word, line in rows:
        wrapped = textwrap.wrap(line, TEXT_WIDTH - 11) or [""]
        lines += [(word, wrapped[0]), *(("", more) for more in wrapped[1:])]
    axes.text(
        0.03,
        0.9,
        told(lines),
        color="white",
        family="monospace",
        fontsize=10.5,
        va="top",
        transform=axes.transAxes,
    )
    for n, name in enumerate(shown):
        place = 0.03 + 0.3 * (n % 3), 0.12 - 0.06 * (n // 3)
        axes.text(
            *place,
            WORD.get(name, name),
            color=COLOUR[name],
            fontsize=12,
            weight="bold",
            transform=axes.transAxes,
        )
