"""The picture around the 3D view: backdrop, title, help and read-outs; the ultrasound panel is panel.py's. NumPy and Pillow.

A picture is uint8 with shape (height, width, 3 or more); only its first three channels are written.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from PIL import Image, ImageDraw

from render.layout import Layout, Rect
from render.panel import ALERT, LEAST_FONT_PX, LINE, MARK, QUIET, TEXT, Panel, draw_panel, font

BACKDROP_TOP, BACKDROP_FOOT = (30, 35, 42), (13, 15, 19)
STRIP, FINDINGS = (17, 20, 24), (20, 24, 29)
HELP_COLUMNS, HELP_GAP_PX, FIGURES_GAP_PX = 2, 36, 20


def backdrop(
    layout: Layout,
    panel: Panel,
    help_lines: Iterable[tuple[str, str]] | None = None,
    help_key: str = "H",
) -> np.ndarray:
    """All that stays the same from frame to frame, uint8, shape (height, width, 3); the help is drawn if given."""
    fade = np.linspace(0, 1, layout.scene.height)[:, None]
    rows = (1 - fade) * np.array(BACKDROP_TOP) + fade * np.array(BACKDROP_FOOT)
    picture = np.empty((layout.height, layout.width, 3), dtype=np.uint8)
    picture[:] = STRIP
    picture[layout.scene.slices] = np.round(rows).astype(np.uint8)[:, None]
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image)
    _draw_title(draw, layout, panel, help_key)
    draw_panel(draw, layout, panel)
    for y in (layout.title.bottom - 1, layout.strip.top):
        draw.line([(0, y), (layout.strip.right, y)], fill=LINE)
    if help_lines is not None:
        _draw_help(draw, layout, list(help_lines))
    return np.array(image)


def _draw_title(draw: ImageDraw.ImageDraw, layout: Layout, panel: Panel, help_key: str) -> None:
    px, middle = layout.px, layout.title.height // 2
    draw.text((px(16), middle), panel.title or "Nephron", font=font(px(17)), fill=TEXT, anchor="lm")
    right = layout.scene.right - px(16)
    draw.text((right, middle), f"{help_key}  all keys", font=font(px(14)), fill=TEXT, anchor="rm")


def _draw_help(draw: ImageDraw.ImageDraw, layout: Layout, lines: list[tuple[str, str]]) -> None:
    box, px = layout.help, layout.px
    corners = [box.left, box.top, box.right - 1, box.bottom - 1]
    draw.rounded_rectangle(corners, radius=px(8), fill=(22, 26, 31), outline=LINE)
    rows = max(1, -(-len(lines) // HELP_COLUMNS))
    pitch = (box.height - px(28)) / rows
    width = box.width // HELP_COLUMNS
    size = help_size(lines, width - px(HELP_GAP_PX), int(min(0.75 * pitch, px(16))))
    key_width = max(font(size).getlength(key) for key, _ in lines)
    for i, (key, text) in enumerate(lines):
        y = box.top + px(14) + (i % rows + 0.5) * pitch
        x = box.left + px(12) + i // rows * width + key_width
        draw.text((x, y), key, font=font(size), fill=MARK, anchor="rm")
        draw.text((x + px(12), y), text, font=font(size), fill=TEXT, anchor="lm")


def help_size(lines: Iterable[tuple[str, str]], width: int, most: int) -> int:
    """The largest size of font, up to the most, at which the longest key and the longest text fit side by side."""
    keys, texts = zip(*lines, strict=True)
    for size in range(most, LEAST_FONT_PX, -1):
        longest = [max(font(size).getlength(each) for each in column) for column in (keys, texts)]
        if sum(longest) <= width:
            return size
    return LEAST_FONT_PX


def readout_picture(layout: Layout, readouts: Mapping[str, str]) -> np.ndarray:
    """Names and values, one line each, uint8, shape of layout.readouts."""
    box = layout.readouts
    image = Image.new("RGB", (box.width, box.height), STRIP)
    draw = ImageDraw.Draw(image)
    draw.line([(0, 0), (box.width, 0)], fill=LINE)
    pitch = min(layout.px(21), (box.height - 14) / max(1, len(readouts)))
    _draw_figures(draw, box, readouts, "", pitch)
    return np.asarray(image)


def findings_picture(layout: Layout, findings: Mapping[str, str], alert: str = "") -> np.ndarray:
    """Names and values, uint8, shape of layout.findings; the one that ``alert`` names stands out."""
    box = layout.findings
    image = Image.new("RGB", (box.width, box.height), FINDINGS)
    draw = ImageDraw.Draw(image)
    draw.rectangle([0, 0, box.width - 1, box.height - 1], outline=ALERT if alert else LINE)
    _draw_figures(draw, box, findings, alert, (box.height - 14) / max(8, len(findings)))
    return np.asarray(image)


def _draw_figures(
    draw: ImageDraw.ImageDraw, box: Rect, figures: Mapping[str, str], alert: str, pitch: float
) -> None:
    size = figures_size(figures, box.width - FIGURES_GAP_PX, int(0.68 * pitch))
    for i, (name, value) in enumerate(figures.items()):
        y = 7 + (i + 0.5) * pitch
        colours = (ALERT, ALERT) if name == alert else (QUIET, TEXT)
        draw.text((8, y), name, font=font(size), fill=colours[0], anchor="lm")
        draw.text((box.width - 12, y), value, font=font(size), fill=colours[1], anchor="rm")


def figures_size(figures: Mapping[str, str], width: int, most: int) -> int:
    """The largest size of font, up to the most, at which each name fits beside its value."""
    for size in range(most, LEAST_FONT_PX, -1):
        if all(font(size).getlength(f"{name}  {value}") <= width for name, value in figures.items()):
            return size
    return LEAST_FONT_PX
