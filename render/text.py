"""Texts in images: font, fitting size, and text over images that change every frame. Pillow."""

from collections.abc import Iterable
from functools import lru_cache

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from render.window_layout import Rect

LEAST_FONT_PX = 8
# Separates the parts of a line; of a long one the last parts are left out.
SEPARATOR = "   "
# How much a text dims the image behind it, and how far around it [pixels].
PLATE, PLATE_PX = 0.35, 4


@lru_cache(maxsize=64)
def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """The font of all texts."""
    return ImageFont.load_default(size=size)


def fitting_size(rows: Iterable[tuple[str, ...]], width: int, most: int) -> int:
    """The largest font size, up to ``most``, at which the longest texts of all columns fit beside each
    other.
    """
    columns = list(zip(*rows, strict=True))
    for size in range(most, LEAST_FONT_PX, -1):
        if sum(max(map(font(size).getlength, column)) for column in columns) <= width:
            return size
    return LEAST_FONT_PX


def shortened(text: str, size: int, width: int) -> str:
    """A line without the last parts, and a single part without the end, that do not fit."""
    parts = text.split(SEPARATOR)
    while len(parts) > 1 and font(size).getlength(SEPARATOR.join(parts)) > width:
        parts.pop()
    line = SEPARATOR.join(parts)
    if font(size).getlength(line) <= width:
        return line
    while line and font(size).getlength(line + "...") > width:
        line = line[:-1]
    return line.rstrip() + "..."


def wrapped(text: str, size: int, width: int) -> list[str]:
    """The lines of a text that are no wider than so many pixels; a longer word has a line of its own."""
    lines, line = list[str](), ""
    for word in text.split():
        longer = f"{line} {word}".strip()
        if line and font(size).getlength(longer) > width:
            lines.append(line)
            longer = word
        line = longer
    return [*lines, line]


@lru_cache(maxsize=64)
def _coverage(text: str, size: int) -> np.ndarray:
    """The covered fraction of each pixel of a text, (rows, columns, 1), with a border."""
    left, top, right, bottom = ImageDraw.Draw(Image.new("L", (1, 1))).textbbox((0, 0), text, font=font(size))
    image = Image.new("L", (int(right - left) + 2 * PLATE_PX, int(bottom - top) + 2 * PLATE_PX))
    ImageDraw.Draw(image).text((PLATE_PX - left, PLATE_PX - top), text, fill=255, font=font(size))
    return np.asarray(image, np.float32)[..., None] / 255


def written_size(text: str, size: int) -> tuple[int, int]:
    """Width and height of a text as ``write`` draws it [pixels]."""
    rows, columns, _ = _coverage(text, size).shape
    return columns, rows


def write(page: np.ndarray, box: Rect, centre: tuple[float, float], text: str, size: int, colour) -> None:
    """Write over an image (rows, columns, 3 or more), centred at (x, y) or shifted into a box.

    A text larger than the box is left out.
    """
    covered = _coverage(text, size)
    rows, columns, _ = covered.shape
    if rows > box.height or columns > box.width:
        return
    left = int(np.clip(round(centre[0] - columns / 2), box.left, box.right - columns))
    top = int(np.clip(round(centre[1] - rows / 2), box.top, box.bottom - rows))
    part = page[top : top + rows, left : left + columns, :3]
    part[:] = PLATE * (1 - covered) * part + covered * np.array(colour, np.float32)
