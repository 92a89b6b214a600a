"""A table over the 3D view."""

import textwrap
from functools import lru_cache

import numpy as np
from PIL import Image, ImageDraw

from render.text import font
from render.ultrasound_panel import FINDINGS, LINE, MARK, QUIET, TEXT
from render.viewer import TextTable
from render.window_layout import Rect, WindowLayout

LETTERS_PX, TITLE_PX, LINE_PX, ROW_PX, PAD_PX, GAP_PX = 14, 16, 17, 26, 10, 8
# Headings are wrapped at so many letters.
HEADING_LETTERS = 11
MARKED = (58, 66, 76)
EARLIER = "{} earlier ones are not shown"


def table_rect(layout: WindowLayout, table: TextTable | None) -> Rect | None:
    """The box of a table, over the top of the 3D view in its whole width; None without one."""
    if table is None:
        return None
    gap = layout.px(PAD_PX)
    rows = min(len(table.rows), _most_rows(layout, table))
    height = _head_height(layout, table) + rows * layout.px(ROW_PX) + layout.px(PAD_PX)
    return Rect(gap, layout.scene.top + gap, layout.scene.width - 2 * gap, height)


@lru_cache(maxsize=4)
def table_image(layout: WindowLayout, table: TextTable) -> np.ndarray:
    """A table as an image, uint8, shape (height, width, 3) of its box; of more rows than fit, the last."""
    box, px = table_rect(layout, table), layout.px
    if box is None:
        raise ValueError("expected a table")
    image = Image.new("RGB", (box.width, box.height), FINDINGS)
    draw, letters, pad = ImageDraw.Draw(image), font(px(LETTERS_PX)), px(PAD_PX)
    draw.rectangle([0, 0, box.width - 1, box.height - 1], outline=LINE)
    draw.text((pad, pad), _title(layout, table), font=font(px(TITLE_PX)), fill=TEXT)
    first = max(0, len(table.rows) - _most_rows(layout, table))
    rights = _right_edges(layout, table, box.width)
    top = _head_height(layout, table)
    for heading, right in zip(_headings(table), rights, strict=True):
        for count, line in enumerate(reversed(heading)):
            y = top - px(GAP_PX) - (count + 0.5) * px(LINE_PX)
            draw.text((right, y), line, font=letters, fill=QUIET, anchor="rm")
    draw.line([(pad, top - 1), (box.width - pad, top - 1)], fill=LINE)
    for place, row in enumerate(table.rows[first:]):
        y = top + place * px(ROW_PX)
        is_marked = first + place == table.marked
        if is_marked:
            draw.rectangle([1, y, box.width - 2, y + px(ROW_PX) - 1], fill=MARKED)
            draw.rectangle([1, y, px(4), y + px(ROW_PX) - 1], fill=MARK)
        for text, right in zip(row, rights, strict=True):
            at = right, y + px(ROW_PX) / 2
            draw.text(at, text, font=letters, fill=MARK if is_marked else TEXT, anchor="rm")
    return np.asarray(image)


def _title(layout: WindowLayout, table: TextTable) -> str:
    hidden = len(table.rows) - _most_rows(layout, table)
    return f"{table.title}; {EARLIER.format(hidden)}" if hidden > 0 else table.title


def _headings(table: TextTable) -> list[list[str]]:
    return [textwrap.wrap(heading, HEADING_LETTERS, break_long_words=False) for heading in table.headings]


def _head_height(layout: WindowLayout, table: TextTable) -> int:
    """Title and headings."""
    lines = max(map(len, _headings(table)))
    px = layout.px
    return px(PAD_PX) + px(TITLE_PX) + px(GAP_PX) + lines * px(LINE_PX) + px(GAP_PX)


def _most_rows(layout: WindowLayout, table: TextTable) -> int:
    """How many rows fit above the compass."""
    room = layout.compass.top - layout.scene.top - 3 * layout.px(PAD_PX) - _head_height(layout, table)
    return max(1, room // layout.px(ROW_PX))


def _right_edges(layout: WindowLayout, table: TextTable, width: int) -> list[float]:
    """Where each column ends: what the texts leave of the width is shared between the columns."""
    letters = font(layout.px(LETTERS_PX))
    widths = [
        max(letters.getlength(text) for text in (*lines, *(row[place] for row in table.rows)))
        for place, lines in enumerate(_headings(table))
    ]
    between = (width - 2 * layout.px(PAD_PX) - sum(widths)) / max(1, len(widths) - 1)
    ends = np.cumsum(widths) + between * np.arange(len(widths)) + layout.px(PAD_PX)
    return ends.tolist()
