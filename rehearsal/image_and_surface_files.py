"""Files of images (PNG; B-mode as DICOM too) and surfaces (PLY) from a rehearsal or a scan."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np
import trimesh
from PIL import Image

from rehearsal.deformed_anatomy import DeformedAnatomy
from rehearsal.resection.score_line import LEAST_MARKS, ResectionError, save_score, score_line
from rehearsal.result_files import next_number
from render.animation import with_square_pixels
from render.viewer import View
from scenes.atomic_files import atomic_write
from scenes.surfaces import save_surface
from ultrasound.probe import Probe
from ultrasound.scanner import B_MODE, DOPPLER

SCREENSHOT, IMAGE = r"screenshot-([0-9]{3,9})\.png", r"([0-9]{3,9})-.*\.png"


@dataclass(frozen=True)
class SavedImage:
    """An image file: its kind ("B-mode", "CT"), its shape (rows, columns), and the spacing of rows and
    columns.
    """

    kind: str
    path: Path
    shape: tuple[int, int]
    spacing_mm: tuple[float, float]


def save_image_file(image: Image.Image, path: Path) -> None:
    """Write an image in the format of its suffix, as an atomic write. Raises OSError."""
    with atomic_write(path) as partial:
        image.save(partial)


def save_images(
    images: Mapping[str, np.ndarray],
    width_mm: float,
    depth_mm: float,
    probe: Probe,
    prefix: Path,
    dicom: bool = True,
) -> list[SavedImage]:
    """Write images (rows, columns), or (rows, columns, 3) of Doppler, by kind, with square pixels, to
    files that share a prefix. Raises OSError.
    """
    # A quarter of a second, which the start of a rehearsal does not need.
    from ultrasound.dicom_image import save_dicom

    saved = []
    for kind, grey in images.items():
        image = with_square_pixels(grey, width_mm, depth_mm)
        path = prefix.with_name(f"{prefix.name}-{kind.lower()}.png")
        save_image_file(image, path)
        spacing_mm = depth_mm / image.height, width_mm / image.width
        if dicom and kind in (B_MODE, DOPPLER):
            with atomic_write(path.with_suffix(".dcm")) as partial:
                save_dicom(partial, np.asarray(image), spacing_mm, probe)
        saved.append(SavedImage(kind, path, (image.height, image.width), spacing_mm))
    return saved


def save_screenshot(image: np.ndarray, out: Path) -> None:
    """Write an image of the window under the next free number, and print its path."""
    path = out / f"screenshot-{next_number(out, SCREENSHOT):03d}.png"
    save_image_file(Image.fromarray(image), path)
    click.echo(f"Saved {path}")


def save_view(view: View, probe: Probe, out: Path) -> str:
    """Write the images of a view under the next free number, and print their paths; return the prefix of
    their names.
    """
    prefix = out / f"{next_number(out, IMAGE):03d}"
    shown = view.images if view.doppler is None else view.images | {DOPPLER: view.doppler}
    for saved in save_images(shown, view.width_mm, view.depth_mm, probe, prefix):
        click.echo(f"Saved {saved.path}{' and .dcm' if saved.kind in (B_MODE, DOPPLER) else ''}")
    return f"{prefix.name}-"


def save_surfaces(anatomy: DeformedAnatomy, out: Path, prefix: str = "") -> None:
    """Write organ, tumour, and a specimen as it was cut (PLY, mm, LPS), and the score in the CT, and print
    the paths.

    Vertices are in the order of the rest surfaces; the organ's are followed by the midpoints of its edges.
    """
    fine, vertices = anatomy.fine_organ()
    deformed = {"organ": (fine.faces, vertices)}
    if anatomy.tumour is not None:
        deformed["tumour"] = anatomy.tumour.faces, anatomy.tumour_vertices
    if anatomy.cut is not None:
        specimen = anatomy.cut.specimen
        deformed["specimen"] = specimen.faces, anatomy.carried_then(specimen.vertices)
    marks = anatomy.frame.resection.points()
    # A line that cannot be drawn was refused in words already.
    with suppress(ResectionError):
        if len(marks) >= LEAST_MARKS:
            line = score_line(anatomy.case.organ, marks)
            click.echo(f"Saved {save_score(anatomy.case, line, out, prefix)}")
    for name, (faces, vertices) in deformed.items():
        path = out / f"{prefix}{name}.ply"
        save_surface(trimesh.Trimesh(vertices + anatomy.case.origin, faces, process=False), path)
        click.echo(f"Saved {path}")
