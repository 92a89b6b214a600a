"""The still pictures of a page, as PNG: the parts in 3D for print, and slices of the CT."""

import io
from collections.abc import Mapping

import numpy as np
import SimpleITK as sitk
import trimesh
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image

from rehearsal.page.rest_model import KIDNEY, SCORE, SPECIMEN, TRANSLUCENT, TUMOUR, ModelPart
from rehearsal.resection.resection_page import draw_compass, draw_faces
from scenes.anatomy import LoadedAnatomy
from scenes.ct_slices import COLOUR, VIEWS, draw_slice
from scenes.volumes.voxel_grid import VoxelGrid

DPI = 110
# What is shown of the CT around the organ.
AROUND_MM = 20.0
DARK = "#101014"
CUT = "cut"
CUT_COLOUR = "#58bcfe"
SHOWN_NAMES = {"organ": "kidney", "urine": "collecting system", "vessel": "vessels", CUT: "cut"}


def png(figure: Figure) -> bytes:
    """A figure as PNG, without metadata."""
    FigureCanvasAgg(figure)
    buffer = io.BytesIO()
    figure.savefig(
        buffer, format="png", dpi=DPI, facecolor=figure.get_facecolor(), metadata={"Software": None}
    )
    return buffer.getvalue()


def image_png(image: Image.Image) -> bytes:
    """An image as PNG."""
    buffer = io.BytesIO()
    image.save(buffer, format="png", optimize=True)
    return buffer.getvalue()


def view_axes(eye: np.ndarray) -> np.ndarray:
    """Rows (3, 3) in LPS: right, up, and towards an eye in a direction (3,); the head is up, or of a view
    along the body the front.
    """
    toward = eye / np.linalg.norm(eye)
    up = np.array([0.0, 0.0, 1.0]) if abs(toward[2]) < 0.95 else np.array([0.0, -1.0, 0.0])
    up = up - (up @ toward) * toward
    up /= np.linalg.norm(up)
    return np.stack([np.cross(up, toward), up, toward])


def draw_model(parts: Mapping[str, ModelPart], eye: np.ndarray) -> bytes:
    """Draw the kidney from the direction of an eye (3,), and beside it the specimen from below, or else the
    kidney from the front.
    """
    figure = Figure(figsize=(9.0, 4.1), facecolor="white")
    FigureCanvasAgg(figure)
    kidney = {name: part for name, part in parts.items() if name in (KIDNEY, TUMOUR, SCORE)}
    if SPECIMEN in parts:
        second = "specimen, resection surface", {SPECIMEN: parts[SPECIMEN]}, -eye
    else:
        second = "kidney from the front", kidney, np.array([0.0, -1.0, 0.0])
    first = "kidney, seen from above the score" if SCORE in parts else "kidney, seen from the tumour's side"
    first = first if SCORE in parts or TUMOUR in parts else "kidney from the side"
    for place, (title, shown, towards) in enumerate(((first, kidney, eye), second)):
        seen = view_axes(towards)
        axes = figure.add_axes((0.5 * place, 0.08, 0.5, 0.82), projection="3d")
        faces = np.concatenate([part.surface.triangles for part in shown.values()])
        placed = faces @ seen.T
        extent_mm = np.ptp(placed.reshape(-1, 3), axis=0)[:2].max()
        draw_faces(axes, placed, _colours(shown, SPECIMEN in parts), f"{title}, {extent_mm:.0f} mm")
        draw_compass(figure.add_axes((0.01 + 0.5 * place, 0.1, 0.08, 0.17)), seen)
    return png(figure)


def _colours(parts: Mapping[str, ModelPart], is_cut: bool) -> np.ndarray:
    """Colours (f, 3) of the faces of parts, or (f, 4) where a kidney must show the tumour in it."""
    colours = np.concatenate([part.colours for part in parts.values()])
    if is_cut or TUMOUR not in parts:
        return colours
    opacity = [
        np.full(len(part.colours), TRANSLUCENT if name == KIDNEY else 1.0) for name, part in parts.items()
    ]
    return np.column_stack([colours, np.concatenate(opacity)])


def draw_ct(loaded: LoadedAnatomy, resection: trimesh.Trimesh | None) -> bytes | None:
    """Draw slices of the CT through the tumour's middle, or else the organ's, with the outlines of the parts
    and of a resection surface (LPS, mm); None without a CT.
    """
    if loaded.ct is None:
        return None
    surfaces = {"organ": loaded.organ, **loaded.parts}
    surfaces |= {} if loaded.tumour is None else {"tumour": loaded.tumour}
    surfaces |= {} if resection is None else {CUT: resection}
    middle = (loaded.tumour or loaded.organ).bounds.mean(axis=0)
    low, high = loaded.organ.bounds + [[-AROUND_MM], [AROUND_MM]]
    image = _image(loaded.ct.voxels, loaded.ct.index_from_mm)
    figure = Figure(figsize=(11.0, 4.3), facecolor=DARK)
    grid = figure.add_gridspec(1, 3, wspace=0.06, left=0.02, right=0.98, top=0.92, bottom=0.09)
    for number, view in enumerate(VIEWS):
        axes = figure.add_subplot(grid[0, number])
        draw_slice(axes, view, image, surfaces, middle, COLOUR | {CUT: CUT_COLOUR}, np.stack([low, high]))
    lines = [
        Line2D([], [], color=(COLOUR | {CUT: CUT_COLOUR})[name], label=SHOWN_NAMES.get(name, name))
        for name in surfaces
    ]
    figure.legend(
        handles=lines, loc="lower center", ncol=len(lines), frameon=False, labelcolor="white", fontsize=11
    )
    return png(figure)


def _image(voxels: np.ndarray, index_from_mm: np.ndarray) -> sitk.Image:
    """Voxels (x, y, z) as an image."""
    return VoxelGrid.of_transform(index_from_mm, voxels.shape).image(voxels.transpose(2, 1, 0))
