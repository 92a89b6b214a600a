"""The sheet of a patient and a probe: of each standard plane the CT, its labels, the classes of its voxels
and the B-mode image.
"""

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from scenes.atomic_files import atomic_write
from studies.patient_images.patient_image_scans import ImagedPatient, PlaneScan
from studies.patient_images.patient_truth import pixel_places
from ultrasound.acoustics import TissueVoxels
from ultrasound.scanned_anatomy import ScannedAnatomy

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 100
# Width of an image on the sheet [pixels]: a sector is wider than it shows.
COLUMN_PIXELS, SECTOR_PIXELS = 310, 480
TITLE_PIXELS, LEGEND_PIXELS = 70, 60
# More grey values would make the file of a sheet larger than 1.5 MB.
GREY_VALUES = 96
COLOURS = {
    "gas": (0, 0, 0),
    "fat": (232, 212, 100),
    "fascia": (255, 255, 255),
    "soft-tissue": (150, 150, 170),
    "muscle": (160, 70, 70),
    "perimysium": (220, 150, 150),
    "liver": (120, 60, 20),
    "spleen": (150, 80, 160),
    "bowel": (120, 160, 90),
    "bone": (0, 90, 110),
    "metal": (0, 255, 255),
    "fluid": (90, 180, 255),
    "kidney": (230, 150, 120),
    "cortex": (230, 150, 120),
    "medulla": (185, 95, 60),
    "arcuate": (255, 190, 190),
    "sinus": (255, 245, 190),
    "urine": (40, 200, 220),
    "stone": (255, 0, 255),
    "vessel": (110, 110, 255),
    "artery": (255, 0, 0),
    "vein": (0, 0, 255),
    "tumour": (0, 170, 0),
    "pseudocapsule": (0, 90, 0),
    "necrosis": (130, 220, 120),
    "cyst": (0, 130, 130),
}
UNCLASSIFIED = 70, 70, 70


def write_sheet(patient: ImagedPatient, scans: Sequence[PlaneScan], title: str, path: Path) -> None:
    """Write the sheet of the planes of one patient and one probe. Raises OSError."""
    drawn = BytesIO()
    sheet_figure(patient, scans, title).savefig(drawn, dpi=DPI)
    sheet = Image.open(drawn).convert("RGB").quantize(palette=_palette(), dither=Image.Dither.NONE)
    with atomic_write(path) as partial:
        sheet.save(partial, "PNG", optimize=True)


def sheet_figure(patient: ImagedPatient, scans: Sequence[PlaneScan], title: str) -> "Figure":
    """The sheet as a figure: a column for each plane; rows for CT, labels, classes and B-mode image."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    probe = scans[0].probe
    column = COLUMN_PIXELS if probe.sector is None else SECTOR_PIXELS
    width, depth, _ = probe.extent_mm
    size = len(scans) * column, 4 * column * depth / width + TITLE_PIXELS + LEGEND_PIXELS
    figure = Figure((size[0] / DPI, size[1] / DPI))
    axes = figure.subplots(4, len(scans), squeeze=False)
    figure.subplots_adjust(0, LEGEND_PIXELS / size[1], 1, 1 - TITLE_PIXELS / size[1], 0.02, 0.02)
    shown: set[str] = set()
    for scan, column_axes in zip(scans, axes.T, strict=True):
        # What is labelled, and all that is classified besides.
        labels, classes = (_names_at(voxels, scan) for voxels in (patient.anatomy, patient.anatomy.voxels))
        shown |= set(np.unique(classes))
        for image, panel in zip((scan.ct, scan.ct, coloured(classes), scan.b_mode), column_axes, strict=True):
            panel.imshow(image, cmap="gray", vmin=0, vmax=255, aspect="auto", interpolation="bilinear")
            panel.axis("off")
        for name in set(np.unique(labels)) - {""}:
            column_axes[1].contour(labels == name, [0.5], colors=[_hex(name)], linewidths=1)
        column_axes[0].set_title(scan.name, fontsize=10)
    figure.suptitle(title, fontsize=13, y=1 - 0.2 * TITLE_PIXELS / size[1])
    patches = [Patch(facecolor=_hex(name), edgecolor="grey", label=name) for name in COLOURS if name in shown]
    figure.legend(handles=patches, loc="lower center", ncols=len(patches), fontsize=10, frameon=False)
    return figure


def coloured(names: np.ndarray) -> np.ndarray:
    """Colours (rows, columns, 3) uint8 of the names of tissues (rows, columns)."""
    known, index = np.unique(names, return_inverse=True)
    return np.array([COLOURS.get(name, UNCLASSIFIED) for name in known], np.uint8)[index.reshape(names.shape)]


def _hex(name: str) -> str:
    return "#" + bytes(COLOURS.get(name, UNCLASSIFIED)).hex()


def _palette() -> Image.Image:
    """An image with the palette of a sheet: grey values, and the colours of the classes."""
    greys = np.linspace(0, 255, GREY_VALUES).round().astype(int)
    palette = Image.new("P", (1, 1))
    palette.putpalette(
        [*np.repeat(greys, 3).tolist(), *(channel for colour in COLOURS.values() for channel in colour)]
    )
    return palette


def _names_at(voxels: TissueVoxels | ScannedAnatomy, scan: PlaneScan) -> np.ndarray:
    """Tissues (rows, columns) of the voxels that the pixels of a scan are in, "" where there is none."""
    world = pixel_places(scan.probe, scan.b_mode.shape) @ scan.pose[:3, :2].T + scan.pose[:3, 3]
    from_mm, labels = voxels.index_from_mm, voxels.labels
    assert labels is not None
    at = np.rint(world @ from_mm[:3, :3].T + from_mm[:3, 3]).astype(int)
    inside = ((at >= 0) & (at < labels.shape)).all(axis=-1)
    values = np.zeros(inside.shape, int)
    values[inside] = labels[tuple(at[inside].T)]
    known, index = np.unique(values, return_inverse=True)
    return np.array([voxels.tissues.get(int(value), "") for value in known])[index.reshape(values.shape)]
