"""The summary of an import, and its check image: slices with outlines, the surfaces, orientation letters,
the summary.
"""

import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import SimpleITK as sitk
import trimesh
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from scipy.spatial.distance import pdist
from skimage.color import rgb2lab

from scenes.ct_slices import COLOUR, LETTER, VIEWS, SliceView, draw_slice
from scenes.patient_space import in_words
from scenes.patients.organ_selection import HILAR
from scenes.patients.part_surfaces import PARTS, PEDICLE_MM
from scenes.patients.patient_import import Patient
from scenes.patients.patient_position import LYING
from scenes.patients.readers.label_maps import Colour
from scenes.tumour_complexity import Complexity
from scenes.volumes.voxel_grid import VoxelGrid

BACKGROUND, WARNING = "#101014", "#ffb000"
WORD = {"organ": "kidney", "urine": "collecting system", "vessel": "vessels"}
LEAST_BRIGHT = 0.85
# Of two colours, in CIELAB: well above what side by side lines need.
LEAST_DIFFERENCE = 20.0
# Letters in a line of the largest text, its sizes [points], and lines times size that fit above the names of
# the colours.
TEXT_WIDTH = 56
TEXT_POINTS = (8.5, 8.0, 7.5, 7.0, 6.5, 6.0, 5.5, 5.0)
TEXT_HEIGHT = 188.0
LIGHT = np.array([-0.4, -0.8, 0.45])  # from the front, the patient's right and above
# View azimuth [degrees], and the signs of the light's direction.
AZIMUTH = {"from the front": (-105, np.ones(3)), "from behind": (75, np.array([-1.0, -1.0, 1.0]))}
# The overview has a panel where it is this many times as wide as the CT around the organ.
LEAST_WIDER = 1.2
DRAFT = "made by region growing from a seed, drawn by nobody: check every outline in check.png"


OVERVIEW = SliceView("coronal, full width", (1, 0, 0), (0, 0, -1), ("R", "L", "S", "I"))


def summary_rows(patient: Patient, complexity: Complexity | None = None) -> list[tuple[str, str]]:
    """The summary for the terminal and the check image: a title and a line each, without names, dates or
    paths.
    """
    volumes = patient.volumes_ml
    size = " x ".join(str(n) for n in patient.ct.GetSize())
    spacing = " x ".join(f"{s:.2f}" for s in patient.source.spacing)
    extent = " x ".join(f"{e:.0f}" for e in patient.organ.extents)
    surface_ml = patient.organ.volume / 1000
    rows = [("DRAFT", DRAFT)] if patient.draft else []
    rows += [("WARNING", line) for line in patient.warnings]
    if patient.space:
        rows.append(
            ("space", f"{patient.space}, as given, of files that do not name it: {in_words(patient.space)}")
        )
    rows.append(("organ", f"{patient.side} kidney, {volumes['organ']:.1f} ml (surface {surface_ml:.1f})"))
    rows.append(("extent", f"{extent} mm (right-left x front-back x foot-head)"))
    rows.append(("length", f"{patient.length_mm:.0f} mm from pole to pole, without tumours and cysts"))
    rows.append(("surface", f"{len(patient.organ.faces)} faces, watertight"))
    for tissue, name in PARTS.items():
        word = name.replace("-system", "")
        if tissue in patient.parts:
            where = f", as labelled, {PEDICLE_MM:g} mm from the organ at most" if tissue in HILAR else ""
            rows.append((word, f"{volumes[tissue]:.1f} ml, {len(patient.parts[tissue].faces)} faces{where}"))
        elif tissue == "tumour":
            rows.append((word, "none labelled as one"))
    rows += [] if complexity is None else complexity.rows()
    rows.append(("support", f"{len(patient.support.faces)} faces, for a patient {LYING[patient.position]}"))
    rows.append(("CT", f"{size} voxels of {spacing} mm"))
    return rows + [("note", note) for note in patient.notes]


def as_table(rows: list[tuple[str, str]]) -> str:
    """Rows as lines of text."""
    return "\n".join(f"{word:<11}{line}" for word, line in rows)


def draw_check(patient: Patient, rows: list[tuple[str, str]], folder: Path) -> None:
    """Draw check.png into a folder: slices through the tumour, or else the organ, the surfaces and the
    summary.
    """
    figure = Figure(figsize=(13, 9.6), facecolor=BACKGROUND)
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 3, hspace=0.08, wspace=0.06)
    grid.update(left=0.03, right=0.97, top=0.92, bottom=0.02)
    draft = " (DRAFT, region growing from a seed)" if patient.draft else ""
    question = "are the side, the organ and the orientation correct?"
    colour = "white"
    if patient.warnings:
        question, colour = "read the WARNING, and compare with the patient", WARNING
    figure.suptitle(f"{patient.side.upper()} KIDNEY{draft}: {question}", color=colour, fontsize=15)
    colours = colours_of(patient)
    surfaces = {"organ": patient.organ, **patient.parts}
    middle = (patient.tumour or patient.organ).bounds.mean(axis=0)
    around = {"support": patient.support, **surfaces}
    for n, view in enumerate(VIEWS):
        draw_slice(figure.add_subplot(grid[0, n]), view, patient.ct, around, middle, colours)
    _draw_surfaces(_solid(figure, grid[1, 0]), "from the front", surfaces, colours)
    if is_wider(patient.overview, patient.ct):
        draw_slice(figure.add_subplot(grid[1, 1]), OVERVIEW, patient.overview, surfaces, middle, colours)
    else:
        _draw_surfaces(_solid(figure, grid[1, 1]), "from behind", surfaces, colours)
    words = figure.add_subplot(grid[1, 2])
    words.axis("off")
    _draw_words(words, rows, {name: colours[name] for name in [*surfaces, "support"]})
    figure.savefig(
        folder / "check.png", dpi=100, facecolor=figure.get_facecolor(), metadata={"Software": None}
    )


def colours_of(patient: Patient) -> dict[str, Colour]:
    """Colours of organ, parts and support: those of the label files, brightened for the dark background.

    Where two of these look alike, none of them is used.
    """
    usual = {name: to_rgb(colour) for name, colour in COLOUR.items()}
    own = usual | {name: _bright(colour) for name, colour in patient.colours.items()}
    shown = rgb2lab([[own[name] for name in ("organ", *patient.parts, "support")]])[0]
    return own if pdist(shown).min() >= LEAST_DIFFERENCE else usual


def _bright(colour: Colour) -> Colour:
    if max(colour) < 1e-3:
        return LEAST_BRIGHT, LEAST_BRIGHT, LEAST_BRIGHT
    scale = max(1.0, LEAST_BRIGHT / max(colour))
    return colour[0] * scale, colour[1] * scale, colour[2] * scale


def is_wider(overview: sitk.Image, ct: sitk.Image) -> bool:
    """Whether the overview shows more of the body's width than the cropped CT."""
    width_mm, shown_mm = (
        np.ptp([corner[0] for corner in VoxelGrid.of(image).bounds()]) for image in (overview, ct)
    )
    return bool(width_mm > LEAST_WIDER * shown_mm)


def _solid(figure: Figure, place: Any) -> Any:
    return figure.add_subplot(place, projection="3d", facecolor=BACKGROUND)


def _draw_surfaces(
    axes: Any, view: str, surfaces: dict[str, trimesh.Trimesh], colours: dict[str, Colour]
) -> None:
    """The surfaces, from the front or from behind."""
    azimuth_deg, towards = AZIMUTH[view]
    corners = np.concatenate([surface.bounds for surface in surfaces.values()])
    low, high = corners.min(axis=0), corners.max(axis=0)
    light = towards * LIGHT / np.linalg.norm(LIGHT)
    for name, surface in reversed(surfaces.items()):
        shade = 0.35 + 0.65 * np.clip(surface.face_normals @ light, 0, 1)
        opacity = 0.45 if name == "organ" and len(surfaces) > 1 else 1.0
        faces = np.column_stack([shade[:, None] * np.array(colours[name]), np.full(len(shade), opacity)])
        axes.add_collection3d(
            Poly3DCollection(surface.triangles, facecolors=faces, edgecolors=faces, linewidths=0.2)
        )
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=1.1)
    axes.set_proj_type("ortho")
    axes.view_init(elev=12, azim=azimuth_deg)
    axes.set_axis_off()
    axes.set_title(f"surface, {view}", color="white", fontsize=11, y=1.12)
    x, y, z = (low + high) / 2
    gap = 0.09 * (high - low).max()
    for letter, place in {
        "R": (low[0] - gap, y, z),
        "L": (high[0] + gap, y, z),
        "S": (x, y, high[2] + gap),
        "I": (x, y, low[2] - gap),
    }.items():
        axes.text(*place, letter, fontsize=15, **LETTER)


def _draw_words(axes: Axes, rows: list[tuple[str, str]], shown: dict[str, Colour]) -> None:
    place: dict[str, Any] = dict(transform=axes.transAxes)
    text, points = _fitted(rows)
    axes.text(0.0, 1.0, text, color="white", family="monospace", fontsize=points, va="top", **place)
    for n, (name, colour) in enumerate(shown.items()):
        left, low = 0.5 * (n % 2), 0.12 - 0.055 * (n // 2)
        axes.text(left, low, WORD.get(name, name), color=colour, fontsize=11, weight="bold", **place)


def _fitted(rows: list[tuple[str, str]]) -> tuple[str, float]:
    """The rows as text, and the largest font size [points] at which it fits above the names of the
    colours.
    """
    for points in TEXT_POINTS:
        width = round(TEXT_WIDTH * TEXT_POINTS[0] / points)
        lines = []
        for word, line in rows:
            wrapped = textwrap.wrap(line, width - 11) or [""]
            lines += [(word, wrapped[0]), *(("", more) for more in wrapped[1:])]
        if len(lines) * points <= TEXT_HEIGHT:
            break
    return as_table(lines), points
