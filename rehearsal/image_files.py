"""What a scanner shows, as files: PNG with square pixels, an echo as DICOM too."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from render.animation import with_square_pixels
from scenes.atomic_files import whole
from ultrasound.dicom_image import save_dicom
from ultrasound.probe import Probe
from ultrasound.scanner import B_MODE


@dataclass(frozen=True)
class SavedPicture:
    """A picture of a kind as it was written: ``shape`` (rows, columns) and how far those are apart."""

    kind: str
    path: Path
    shape: tuple[int, int]
    spacing_mm: tuple[float, float]


def save_picture(picture: Image.Image, path: Path) -> None:
    """Write a picture in the format of its suffix, whole or not at all. Raises OSError."""
    with whole(path) as partial:
        picture.save(partial)


def save_pictures(
    shown: Mapping[str, np.ndarray],
    width_mm: float,
    depth_mm: float,
    probe: Probe,
    begin: Path,
    dicom: bool = True,
) -> list[SavedPicture]:
    """Write what a probe shows (rows, columns) by kind, as wide and deep as said, under names that begin alike. Raises OSError."""
    saved = []
    for kind, grey in shown.items():
        picture = with_square_pixels(grey, width_mm, depth_mm)
        path = begin.with_name(f"{begin.name}-{kind.lower()}.png")
        save_picture(picture, path)
        spacing_mm = depth_mm / picture.height, width_mm / picture.width
        if dicom and kind == B_MODE:
            with whole(path.with_suffix(".dcm")) as partial:
                save_dicom(partial, np.asarray(picture), spacing_mm, probe)
        saved.append(SavedPicture(kind, path, (picture.height, picture.width), spacing_mm))
    return saved
