"""The messages to the user: in their box under the 3D view, and all of them as a page."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from PIL import Image, ImageDraw

from render.text import font, wrapped
from render.ultrasound_panel import ALERT, LINE, QUIET, TEXT
from render.window_layout import MESSAGE_LINES, MESSAGE_PITCH, WindowLayout

LETTERS_PX, LEAST_PX, LEAST_SMALL_PX, PAGE_PX, BESIDE_PX = 15, 14, 11, 15, 12
STRIP, PAGE = (17, 20, 24), (22, 26, 31)
TITLE, EMPTY = "Messages of this session, the newest first", "There were none yet."


@lru_cache(maxsize=8)
def message_lines(layout: WindowLayout, messages: tuple[str, ...]) -> tuple[list[str], int]:
    """The lines of messages, and the size of their letters [pixels]: smaller where they need more room; of
    what is longer still the last lines are left out.
    """
    room, lines = layout.messages.width - 2 * layout.px(BESIDE_PX), list[str]()
    # A window that is smaller than FULL_SIZE has no room for larger letters.
    least = LEAST_PX if layout.scale >= 1 else LEAST_SMALL_PX
    for size in range(LETTERS_PX, least - 1, -1):
        lines = [line for text in messages for line in wrapped(text, layout.px(size), room)]
        if len(lines) <= MESSAGE_LINES:
            return lines, layout.px(size)
    return [*lines[: MESSAGE_LINES - 1], lines[MESSAGE_LINES - 1] + " ..."], layout.px(least)


def message_image(layout: WindowLayout, messages: tuple[str, ...], hint: str = "") -> np.ndarray:
    """The box of messages, or without any of the lines of a hint, uint8, shape of layout.messages."""
    box = layout.messages
    image = Image.new("RGB", (box.width, box.height), STRIP)
    draw, colour = ImageDraw.Draw(image), ALERT if messages else TEXT
    lines, size = message_lines(layout, messages or tuple(hint.split("\n")))
    for place, line in enumerate(lines):
        middle = layout.px(MESSAGE_PITCH) * (place + 0.5) + layout.figures_pad / 2
        draw.text((layout.px(BESIDE_PX), middle), line, font=font(size), fill=colour, anchor="lm")
    return np.asarray(image)


def log_image(layout: WindowLayout, log: Sequence[tuple[str, str]]) -> np.ndarray:
    """The page of messages, each with its time, uint8, shape (height, width, 3): the newest first, as many as
    fit.
    """
    box, px = layout.whole, layout.px
    image = Image.new("RGB", (box.width, box.height), PAGE)
    draw, size, pitch = ImageDraw.Draw(image), px(PAGE_PX), px(MESSAGE_PITCH)
    draw.text((px(16), px(24)), TITLE, font=font(px(17)), fill=TEXT, anchor="lm")
    draw.line([(px(16), px(42)), (box.width - px(16), px(42))], fill=LINE)
    left, y = px(80), px(58)
    for time, text in [*reversed(log)] or [("", EMPTY)]:
        lines = wrapped(text, size, box.width - left - px(16))
        if y + pitch * len(lines) > box.height:
            break
        draw.text((left - px(12), y), time, font=font(size), fill=QUIET, anchor="rm")
        for line in lines:
            draw.text((left, y), line, font=font(size), fill=TEXT, anchor="lm")
            y += pitch
    return np.asarray(image)
