"""Pictures that the user asks for, in the folder of a rehearsal."""

from pathlib import Path

import click
import numpy as np
from PIL import Image

from render.pictures import in_proportion
from render.viewer import View
from ultrasound.array import Probe
from ultrasound.dicom_image import save_dicom
from ultrasound.scanner import ECHO


def save_screenshot(picture: np.ndarray, out: Path) -> None:
    """Save a picture under the next free number, and say where."""
    number = 1 + max([int(path.stem[-3:]) for path in out.glob("screenshot-[0-9][0-9][0-9].png")], default=0)
    path = out / f"screenshot-{number:03d}.png"
    Image.fromarray(picture).save(path)
    click.echo(f"Saved {path}")


def save_pictures(view: View, probe: Probe, out: Path) -> None:
    """Save what the scanner shows as PNG, an echo as DICOM too, under the next free number, and say where."""
    number = 1 + max([int(path.stem[:3]) for path in out.glob("[0-9][0-9][0-9]-*.png")], default=0)
    for name, picture in view.pictures.items():
        path = out / f"{number:03d}-{name.lower()}.png"
        image = in_proportion(picture, view.width_mm, view.depth_mm)
        image.save(path)
        spacing = view.depth_mm / image.height, view.width_mm / image.width
        if name == ECHO:
            save_dicom(path.with_suffix(".dcm"), np.asarray(image), spacing, probe)
        click.echo(f"Saved {path}{' and .dcm' if name == ECHO else ''}")
