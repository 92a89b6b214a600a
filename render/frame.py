"""The picture around the 3D view: ultrasound panel, ruler, texts. NumPy and Pillow, no GPU, no window.

Pixels count from the top left. A picture is uint8 with shape (height, width, 3 or more); only its first three
channels are written.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

BACKDROP_TOP, BACKDROP_FOOT = (30, 35, 42), (13, 15, 19)
PANEL = (8, 9, 11)
STRIP = (17, 20, 24)
LINE = (44, 50, 58)
TEXT, QUIET = (222, 227, 232), (132, 142, 153)
MARK = (64, 196, 255)
ALERT = (255, 176, 46)

PANEL_SHARE = 0.37
TITLE_HEIGHT = 42
STRIP_HEIGHT, READOUT_SHARE = 136, 0.19
HEADER_HEIGHT, FOOTER_HEIGHT = 66, 34
RULER_WIDTH, WEDGE_WIDTH = 46, 34


class Rect(NamedTuple):
    """Pixels: left, top, width, height."""

    left: int
    top: int
    width: int
    height: int

    @property
    def right(self) -> int:
        return self.left + self.width

    @property
    def bottom(self) -> int:
        return self.top + self.height

    @property
    def slices(self) -> tuple[slice, slice]:
        """Rows and columns, to index a picture."""
        return slice(self.top, self.bottom), slice(self.left, self.right)


@dataclass(frozen=True)
class Layout:
    """Where each part of the window lies, for a window of width x height pixels."""

    width: int
    height: int

    @property
    def panel(self) -> Rect:
        width = round(self.width * PANEL_SHARE)
        return Rect(self.width - width, 0, width, self.height)

    @property
    def strip(self) -> Rect:
        """Sliders and read-outs, beneath the 3D view."""
        height = min(STRIP_HEIGHT, self.height // 3)
        return Rect(0, self.height - height, self.panel.left, height)

    @property
    def title(self) -> Rect:
        return Rect(0, 0, self.panel.left, TITLE_HEIGHT)

    @property
    def scene(self) -> Rect:
        """The 3D view."""
        return Rect(0, TITLE_HEIGHT, self.panel.left, self.strip.top - TITLE_HEIGHT)

    @property
    def readouts(self) -> Rect:
        width = round(self.strip.width * READOUT_SHARE)
        return Rect(self.strip.right - width, self.strip.top, width, self.strip.height)

    def sliders(self, widths: list[float]) -> list[Rect]:
        """Boxes for groups of sliders, side by side in the strip; `widths` share out the room."""
        gap = 6
        room = self.readouts.left - gap * (len(widths) + 1)
        edges = np.concatenate([[0.0], np.cumsum(widths)]) / sum(widths) * room
        return [
            Rect(
                round(gap * (i + 1) + edges[i]),
                self.strip.top + gap,
                round(edges[i + 1] - edges[i]),
                self.strip.height - 2 * gap,
            )
            for i in range(len(widths))
        ]

    @property
    def help(self) -> Rect:
        width, height = min(560, self.scene.width - 24), min(446, self.scene.height - 24)
        return Rect(
            (self.scene.width - width) // 2, self.scene.top + (self.scene.height - height) // 2, width, height
        )

    def picture_box(self, width_mm: float, depth_mm: float) -> Rect:
        """The largest box in the panel with the shape of the image plane, ruler and texts left free.

        Raises ValueError unless both lengths are positive.
        """
        if not (width_mm > 0 and depth_mm > 0):
            raise ValueError(f"image plane of {width_mm} x {depth_mm} mm: both lengths must be positive")
        room_x = self.panel.width - RULER_WIDTH - WEDGE_WIDTH
        room_y = self.panel.height - HEADER_HEIGHT - FOOTER_HEIGHT
        scale = min(room_x / width_mm, room_y / depth_mm)
        width, height = max(1, round(width_mm * scale)), max(1, round(depth_mm * scale))
        return Rect(self.panel.left + RULER_WIDTH + (room_x - width) // 2, HEADER_HEIGHT, width, height)

    def window_coordinates(self, rect: Rect) -> tuple[float, float, float, float]:
        """Left, bottom, right, top with (0, 0) at the bottom left and (1, 1) at the top right of the window."""
        return (
            rect.left / self.width,
            1 - rect.bottom / self.height,
            rect.right / self.width,
            1 - rect.top / self.height,
        )


@dataclass(frozen=True)
class Panel:
    """What the panel says around the slice. All of it stays the same for many frames."""

    width_mm: float
    depth_mm: float
    window_hu: float
    level_hu: float
    title: str = ""
    status: str = ""
    marked_side: str = "right"


@lru_cache(maxsize=16)
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size=size)


def ruler_ticks(depth_mm: float, box: Rect) -> list[tuple[int, int | None]]:
    """Ticks every 5 mm of depth: (row in pixels, whole centimetres or None between them)."""
    ticks = []
    for half_cm in range(int(depth_mm / 5.0 + 1e-9) + 1):
        row = box.top + round(half_cm * 5.0 / depth_mm * (box.height - 1))
        ticks.append((row, half_cm // 2 if half_cm % 2 == 0 else None))
    return ticks


def marker_centre(box: Rect, marked_side: str) -> tuple[int, int]:
    """Centre (x, y) of the marker dot, above the picture at its marked side. Raises ValueError for another side."""
    if marked_side not in ("left", "right"):
        raise ValueError(f"marked_side is {marked_side!r}: it must be 'left' or 'right'")
    return (box.left + 9 if marked_side == "left" else box.right - 10), box.top - 12


def paste_slice(picture: np.ndarray, box: Rect, slice_image: np.ndarray) -> None:
    """Put the slice, uint8 (rows, columns), into its box; a slice of the box's own size is not resampled."""
    if slice_image.shape != (box.height, box.width):
        resized = Image.fromarray(slice_image).resize((box.width, box.height), Image.Resampling.BILINEAR)
        slice_image = np.asarray(resized)
    rows, columns = box.slices
    for channel in range(3):
        picture[rows, columns, channel] = slice_image


def backdrop(layout: Layout, panel: Panel, help_lines: Iterable[tuple[str, str]] | None = None) -> np.ndarray:
    """All that stays the same from frame to frame, uint8, shape (height, width, 3); the help is drawn if given."""
    fade = np.linspace(0, 1, layout.scene.height)[:, None]
    rows = (1 - fade) * np.array(BACKDROP_TOP) + fade * np.array(BACKDROP_FOOT)
    picture = np.empty((layout.height, layout.width, 3), dtype=np.uint8)
    picture[:] = STRIP
    picture[layout.scene.slices] = np.round(rows).astype(np.uint8)[:, None]
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image)
    _draw_title(draw, layout, panel)
    _draw_panel(draw, layout, panel)
    for y in (layout.title.bottom - 1, layout.strip.top):
        draw.line([(0, y), (layout.strip.right, y)], fill=LINE)
    if help_lines is not None:
        _draw_help(draw, layout.help, list(help_lines))
    return np.array(image)


def _draw_title(draw: ImageDraw.ImageDraw, layout: Layout, panel: Panel) -> None:
    draw.text((16, 12), panel.title or "Nephron", font=_font(17), fill=TEXT)
    draw.text((layout.scene.right - 16, 15), "H  all keys", font=_font(13), fill=QUIET, anchor="ra")


def _draw_panel(draw: ImageDraw.ImageDraw, layout: Layout, panel: Panel) -> None:
    area, box = layout.panel, layout.picture_box(panel.width_mm, panel.depth_mm)
    draw.rectangle([area.left, area.top, area.right, area.bottom], fill=PANEL)
    draw.line([(area.left, 0), (area.left, area.bottom)], fill=LINE)
    draw.text((area.left + 16, 12), "Transducer view (CT)", font=_font(17), fill=TEXT)
    window = f"W {panel.window_hu:.0f}   L {panel.level_hu:.0f} HU"
    draw.text(
        (area.right - 16, 13), f"Depth {panel.depth_mm / 10:.1f} cm", font=_font(14), fill=TEXT, anchor="ra"
    )
    draw.text((area.left + 16, area.bottom - 25), window, font=_font(14), fill=QUIET)
    width = f"{panel.width_mm:.0f} x {panel.depth_mm:.0f} mm"
    draw.text((area.right - 16, area.bottom - 25), width, font=_font(14), fill=QUIET, anchor="ra")
    _draw_ruler(draw, panel.depth_mm, box)
    _draw_wedge(draw, box)
    x, y = marker_centre(box, panel.marked_side)
    draw.ellipse([x - 6, y - 6, x + 6, y + 6], fill=MARK)
    if panel.status:
        centre = (box.left + box.right) // 2
        draw.text((centre, box.top - 12), panel.status, font=_font(17), fill=ALERT, anchor="mm")


def _draw_ruler(draw: ImageDraw.ImageDraw, depth_mm: float, box: Rect) -> None:
    x = box.left - 6
    for row, centimetres in ruler_ticks(depth_mm, box):
        length = 5 if centimetres is None else 10
        draw.line([(x - length, row), (x, row)], fill=QUIET if centimetres is None else TEXT)
        if centimetres:
            draw.text((x - 15, row), str(centimetres), font=_font(13), fill=TEXT, anchor="rm")
        elif centimetres == 0:
            draw.text((x - 15, row), "cm", font=_font(12), fill=QUIET, anchor="rm")


def _draw_wedge(draw: ImageDraw.ImageDraw, box: Rect) -> None:
    """The grey scale, white at the top, as a scanner shows it beside its picture."""
    height = min(128, box.height)
    for i in range(height):
        grey = 255 - i * 255 // max(1, height - 1)
        draw.line([(box.right + 12, box.top + i), (box.right + 19, box.top + i)], fill=(grey, grey, grey))


def _draw_help(draw: ImageDraw.ImageDraw, box: Rect, lines: list[tuple[str, str]]) -> None:
    draw.rounded_rectangle(
        [box.left, box.top, box.right - 1, box.bottom - 1], radius=8, fill=(22, 26, 31), outline=LINE
    )
    pitch = (box.height - 28) / max(1, len(lines))
    size = int(np.clip(pitch * 0.68, 9, 15))
    for i, (key, text) in enumerate(lines):
        y = box.top + 14 + (i + 0.5) * pitch
        draw.text((box.left + 176, y), key, font=_font(size), fill=MARK, anchor="rm")
        draw.text((box.left + 196, y), text, font=_font(size), fill=TEXT, anchor="lm")


def readout_picture(layout: Layout, readouts: Mapping[str, str]) -> np.ndarray:
    """Names and values, one line each, uint8, shape of layout.readouts."""
    box = layout.readouts
    image = Image.new("RGB", (box.width, box.height), STRIP)
    draw = ImageDraw.Draw(image)
    draw.line([(0, 0), (box.width, 0)], fill=LINE)
    pitch = min(21.0, (box.height - 14) / max(1, len(readouts)))
    for i, (name, value) in enumerate(readouts.items()):
        y = 7 + (i + 0.5) * pitch
        draw.text((8, y), name, font=_font(13), fill=QUIET, anchor="lm")
        draw.text((box.width - 14, y), value, font=_font(14), fill=TEXT, anchor="rm")
    return np.asarray(image)
