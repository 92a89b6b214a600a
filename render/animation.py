"""Images as files: square pixels, images side by side, animation."""

from pathlib import Path

import numpy as np
from PIL import Image

from render.viewer import View

ANIMATION_FPS = 15
ANIMATION_WIDTH = 960
ANIMATION_QUALITY = 80


def with_square_pixels(picture: np.ndarray, width_mm: float, depth_mm: float) -> Image.Image:
    """An image of a plane with square pixels; the longer side keeps its number of pixels."""
    scale = max(picture.shape[:2]) / max(width_mm, depth_mm)
    size = max(1, round(width_mm * scale)), max(1, round(depth_mm * scale))
    return Image.fromarray(picture).resize(size, Image.Resampling.BILINEAR)


def side_by_side(view: View) -> Image.Image:
    """The images of a view in a row, with square pixels."""
    pictures = [with_square_pixels(picture, view.width_mm, view.depth_mm) for picture in view.shown.values()]
    mode = "L" if view.doppler is None else "RGB"
    row = np.concatenate([np.asarray(picture.convert(mode)) for picture in pictures], axis=1)
    return Image.fromarray(row)


def empty_folder(folder: Path) -> Path:
    """Create a folder, or delete the numbered images of an earlier run in it."""
    folder.mkdir(parents=True, exist_ok=True)
    for picture in folder.glob("[0-9]*.png"):
        picture.unlink()
    return folder


def scaled_down(picture: Image.Image) -> Image.Image:
    """An image no wider than the animation."""
    width = min(ANIMATION_WIDTH, picture.width)
    return picture.resize((width, round(picture.height * width / picture.width)), Image.Resampling.LANCZOS)


def save_animation(pictures: list[Image.Image], path: Path) -> None:
    """Write an endless animated WebP: full colour, and a third of the size of a GIF."""
    first, *others = [picture.convert("RGB") for picture in pictures]
    first.save(
        path,
        save_all=True,
        append_images=others,
        duration=round(1000 / ANIMATION_FPS),
        loop=0,
        quality=ANIMATION_QUALITY,
    )
