"""Pictures as files: what the scanner showed, frames of a run, and its animation."""

from pathlib import Path

import numpy as np
from PIL import Image

from render.viewer import View

ANIMATION_FPS = 15
ANIMATION_WIDTH = 960
ANIMATION_QUALITY = 80


def with_square_pixels(picture: np.ndarray, width_mm: float, depth_mm: float) -> Image.Image:
    """A picture of a plane with square pixels, as long on its longer side as it was sampled."""
    scale = max(picture.shape) / max(width_mm, depth_mm)
    size = max(1, round(width_mm * scale)), max(1, round(depth_mm * scale))
    return Image.fromarray(picture).resize(size, Image.Resampling.BILINEAR)


def side_by_side(view: View) -> Image.Image:
    """The pictures of a view in a row, with square pixels."""
    pictures = [
        with_square_pixels(picture, view.width_mm, view.depth_mm) for picture in view.pictures.values()
    ]
    row = np.concatenate([np.asarray(picture) for picture in pictures], axis=1)
    return Image.fromarray(row)


def empty_folder(folder: Path) -> Path:
    """A folder without the pictures of an earlier run."""
    folder.mkdir(parents=True, exist_ok=True)
    for picture in folder.glob("[0-9]*.png"):
        picture.unlink()
    return folder


def scaled_down(picture: Image.Image) -> Image.Image:
    """A picture no wider than the animation."""
    width = min(ANIMATION_WIDTH, picture.width)
    return picture.resize((width, round(picture.height * width / picture.width)), Image.Resampling.LANCZOS)


def save_animation(pictures: list[Image.Image], path: Path) -> None:
    """Write an animated WebP that repeats: in all colours, where a GIF has 256, and a third of its size."""
    first, *others = [picture.convert("RGB") for picture in pictures]
    first.save(
        path,
        save_all=True,
        append_images=others,
        duration=round(1000 / ANIMATION_FPS),
        loop=0,
        quality=ANIMATION_QUALITY,
    )
