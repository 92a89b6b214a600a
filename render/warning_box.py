"""The box with the warnings of an import, over the foot of the 3D view."""

from functools import lru_cache

import numpy as np
from PIL import Image, ImageDraw

from render.text import font, wrapped
from render.ultrasound_panel import ALERT, FINDINGS
from render.window_layout import FIGURE_HEIGHT, Rect, WindowLayout

LETTERS_PX = 14


def warning_rect(layout: WindowLayout, warnings: tuple[str, ...], taken: int = 0) -> Rect | None:
    """The box of some warnings, left of the pixels that are taken at the right; None without any."""
    if not warnings:
        return None
    room, pitch = _room(layout, taken), layout.px(FIGURE_HEIGHT)
    height = len(warning_lines(layout, warnings, taken)) * pitch + 2 * layout.figures_pad
    return Rect(room.left, room.bottom - height, room.width, height)


def acknowledge_rect(layout: WindowLayout, warnings: tuple[str, ...], taken: int = 0) -> Rect | None:
    """The first line of the box, which says how to acknowledge the warnings, also by a click on it; None
    without any.
    """
    box = warning_rect(layout, warnings, taken)
    return None if box is None else box._replace(height=layout.px(FIGURE_HEIGHT) + layout.figures_pad)


@lru_cache(maxsize=8)
def warning_lines(layout: WindowLayout, warnings: tuple[str, ...], taken: int = 0) -> list[str]:
    """The lines of some warnings; of very long ones the last lines are left out."""
    room = _room(layout, taken).width - 2 * layout.px(10)
    lines = [line for warning in warnings for line in wrapped(warning, layout.px(LETTERS_PX), room)]
    most = max(
        1, (layout.foot.bottom - layout.highest_warning - 2 * layout.figures_pad) // layout.px(FIGURE_HEIGHT)
    )
    return lines if len(lines) <= most else [*lines[: most - 1], "..."]


@lru_cache(maxsize=8)
def warning_image(layout: WindowLayout, warnings: tuple[str, ...], taken: int = 0) -> np.ndarray:
    """The box as an image, uint8, shape (height, width, 3). Raises ValueError without a warning."""
    box = warning_rect(layout, warnings, taken)
    if box is None:
        raise ValueError("expected one warning or more")
    image = Image.new("RGB", (box.width, box.height), FINDINGS)
    draw = ImageDraw.Draw(image)
    draw.rectangle([0, 0, box.width - 1, box.height - 1], outline=ALERT)
    for place, line in enumerate(warning_lines(layout, warnings, taken)):
        middle = layout.figures_pad + (place + 0.5) * layout.px(FIGURE_HEIGHT)
        draw.text((layout.px(10), middle), line, font=font(layout.px(LETTERS_PX)), fill=ALERT, anchor="lm")
    return np.asarray(image)


def _room(layout: WindowLayout, taken: int) -> Rect:
    return layout.foot._replace(width=layout.foot.width - taken)
