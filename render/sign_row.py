"""Signs for the states of the machine: small plates in a row at the foot of the 3D view, and what the one
under the mouse means.
"""

import re
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from PIL import Image, ImageDraw

from render.text import font, wrapped
from render.ultrasound_panel import FINDINGS, LINE, QUIET, RECORDING, TEXT
from render.viewer import Sign
from render.window_layout import Rect, WindowLayout

LETTERS_PX, AROUND_PX, GAP_PX, DOT_PX, LINE_PX = 12, 7, 6, 9, 17
MEANING_WIDTH = 420


def sign_boxes(layout: WindowLayout, signs: Sequence[Sign], taken: int = 0) -> list[Rect]:
    """The boxes of the signs, left of the pixels that are taken at the right; of too many the last have
    none.
    """
    row, boxes = layout.signs, list[Rect]()
    left = row.left
    for sign in signs:
        width = _width(layout, sign)
        if left + width > row.right - taken:
            break
        boxes.append(Rect(left, row.top, width, row.height))
        left += width + layout.px(GAP_PX)
    return boxes


@lru_cache(maxsize=16)
def sign_image(layout: WindowLayout, sign: Sign) -> np.ndarray:
    """A sign, uint8, shape (height, width, 3) of its box."""
    px, height, width = layout.px, layout.signs.height, _width(layout, sign)
    image = Image.new("RGB", (width, height), FINDINGS)
    draw = ImageDraw.Draw(image)
    draw.rectangle([0, 0, width - 1, height - 1], outline=LINE)
    left, middle = px(AROUND_PX), height / 2
    if sign.is_recording:
        around = [left, middle - px(DOT_PX) / 2, left + px(DOT_PX), middle + px(DOT_PX) / 2]
        draw.ellipse(around, fill=RECORDING)
        left += px(DOT_PX + GAP_PX)
    draw.text((left, middle), sign.text, font=font(px(LETTERS_PX)), fill=TEXT, anchor="lm")
    return np.asarray(image)


def sign_at(
    layout: WindowLayout, signs: Sequence[Sign], place: tuple[float, float] | None, taken: int = 0
) -> Sign | None:
    """The sign at a column and row, None without one."""
    if place is None:
        return None
    boxes = zip(signs, sign_boxes(layout, signs, taken), strict=False)
    return next((sign for sign, box in boxes if box.contains(*place)), None)


def meaning_rect(layout: WindowLayout, sign: Sign) -> Rect:
    """The box of what a sign means, above the row of signs."""
    lines, px, row = _lines(layout, sign), layout.px, layout.signs
    width = max(int(font(px(LETTERS_PX)).getlength(line)) for line in lines) + 2 * px(AROUND_PX) + 1
    height = len(lines) * px(LINE_PX) + 2 * px(GAP_PX)
    return Rect(row.left, row.top - px(GAP_PX) - height, width, height)


@lru_cache(maxsize=8)
def meaning_image(layout: WindowLayout, sign: Sign) -> np.ndarray:
    """What a sign means, uint8, shape (height, width, 3) of its box."""
    box, px = meaning_rect(layout, sign), layout.px
    image = Image.new("RGB", (box.width, box.height), FINDINGS)
    draw = ImageDraw.Draw(image)
    draw.rectangle([0, 0, box.width - 1, box.height - 1], outline=QUIET)
    for place, line in enumerate(_lines(layout, sign)):
        y = px(GAP_PX) + (place + 0.5) * px(LINE_PX)
        draw.text((px(AROUND_PX), y), line, font=font(px(LETTERS_PX)), fill=TEXT, anchor="lm")
    return np.asarray(image)


def _lines(layout: WindowLayout, sign: Sign) -> list[str]:
    room = min(layout.px(MEANING_WIDTH), layout.signs.width) - 2 * layout.px(AROUND_PX)
    return wrapped(sign.meaning, layout.px(LETTERS_PX), room)


def _width(layout: WindowLayout, sign: Sign) -> int:
    """The width of a sign, which does not change with each digit."""
    text = re.sub(r"\d", "0", sign.text)
    dot = layout.px(DOT_PX + GAP_PX) if sign.is_recording else 0
    return int(font(layout.px(LETTERS_PX)).getlength(text)) + 2 * layout.px(AROUND_PX) + dot + 1
