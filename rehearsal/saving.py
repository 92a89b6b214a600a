"""Pictures that the user asks for, in the folder of a rehearsal."""

from pathlib import Path

import click
import numpy as np
import trimesh
from PIL import Image

from rehearsal.image_files import save_picture, save_pictures
from rehearsal.numbered_files import next_number
from rehearsal.rehearsal import Rehearsal
from render.viewer import View
from scenes.surface_files import save_surface
from sim.fields import array_of
from ultrasound.probe import Probe
from ultrasound.scanner import B_MODE

SCREENSHOT, PICTURE = r"screenshot-([0-9]{3,9})\.png", r"([0-9]{3,9})-.*\.png"


def save_screenshot(picture: np.ndarray, out: Path) -> None:
    """Save a picture under the next free number, and say where."""
    path = out / f"screenshot-{next_number(out, SCREENSHOT):03d}.png"
    save_picture(Image.fromarray(picture), path)
    click.echo(f"Saved {path}")


def save_view(view: View, probe: Probe, out: Path) -> str:
    """Save what the scanner shows as PNG, an echo as DICOM too, under the next free number, and say where; how their names begin."""
    begin = out / f"{next_number(out, PICTURE):03d}"
    for saved in save_pictures(view.pictures, view.width_mm, view.depth_mm, probe, begin):
        click.echo(f"Saved {saved.path}{' and .dcm' if saved.kind == B_MODE else ''}")
    return f"{begin.name}-"


def save_surfaces(rehearsal: Rehearsal, out: Path, begin: str = "") -> None:
    """Save organ and tumour as they lie (PLY, mm, LPS), and say where; their vertices are those of the surfaces at rest, in order."""
    lying = {"organ": (rehearsal.organ, array_of(rehearsal.organ_skin.vertices))}
    if rehearsal.tumour is not None:
        lying["tumour"] = rehearsal.tumour, rehearsal.tumour_vertices()
    for name, (rest, vertices) in lying.items():
        path = out / f"{begin}{name}.ply"
        save_surface(trimesh.Trimesh(vertices + rehearsal.origin, rest.faces, process=False), path)
        click.echo(f"Saved {path}")
