"""Where each part of the window lies. Pixels count from the top left; lengths below are those of a window of 1280 x 720."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

PANEL_SHARE = 0.37
TITLE_HEIGHT = 42
STRIP_HEIGHT, READOUT_SHARE = 184, 0.19
HEADER_HEIGHT, FOOTER_HEIGHT = 74, 34
RULER_WIDTH, WEDGE_WIDTH, PICTURE_GAP, NAME_HEIGHT = 46, 34, 10, 26
ASIDE_WIDTH = 186
FINDINGS_GAP, FINDINGS_WIDTH, FINDINGS_HEIGHT = 10, 178, 190
# Texts grow with the window; Dear ImGui's sliders, and so the strip that holds them, cannot.
FULL_SIZE, LEAST_SCALE, MOST_SCALE = (1280, 720), 0.8, 4.0
# How much larger pictures one under the other must be than side by side.
BELOW_FROM = 1.2


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
    def scale(self) -> float:
        """How large texts and what is measured by them are, 1 in a window of FULL_SIZE."""
        share = min(self.width / FULL_SIZE[0], self.height / FULL_SIZE[1])
        return float(np.clip(share, LEAST_SCALE, MOST_SCALE))

    def px(self, pixels: float) -> int:
        """Pixels in this window of so many in one of FULL_SIZE."""
        return round(self.scale * pixels)

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
        return Rect(0, 0, self.panel.left, self.px(TITLE_HEIGHT))

    @property
    def scene(self) -> Rect:
        """The 3D view."""
        top = self.title.bottom
        return Rect(0, top, self.panel.left, self.strip.top - top)

    @property
    def readouts(self) -> Rect:
        width = round(self.strip.width * READOUT_SHARE)
        return Rect(self.strip.right - width, self.strip.top, width, self.strip.height)

    @property
    def findings(self) -> Rect:
        """What the surgeon looks for, over the 3D view's corner."""
        gap, width, height = self.px(FINDINGS_GAP), self.px(FINDINGS_WIDTH), self.px(FINDINGS_HEIGHT)
        return Rect(gap, self.title.bottom + gap, width, height)

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
        width, height = self.scene.width - 24, min(self.px(430), self.scene.height - 24)
        return Rect(
            (self.scene.width - width) // 2, self.scene.top + (self.scene.height - height) // 2, width, height
        )

    def picture_boxes(self, count: int, width_mm: float, depth_mm: float, aside_px: int = 0) -> list[Rect]:
        """The largest boxes in the panel with the shape of the image plane, side by side or one under the other.

        Ruler, texts and what is aside are left free. Raises ValueError unless both lengths are positive.
        """
        if not (width_mm > 0 and depth_mm > 0):
            raise ValueError(f"image plane of {width_mm} x {depth_mm} mm: both lengths must be positive")
        ruler, gap, between = self.px(RULER_WIDTH), self.px(PICTURE_GAP), self.px(NAME_HEIGHT)
        header = self.px(HEADER_HEIGHT)
        room_x = self.panel.width - ruler - self.px(WEDGE_WIDTH) - aside_px
        room_y = self.panel.height - header - self.px(FOOTER_HEIGHT)
        beside = min((room_x - (count - 1) * gap) / count / width_mm, room_y / depth_mm)
        below = min(room_x / width_mm, (room_y - (count - 1) * between) / count / depth_mm)
        # Places at one depth are easier to compare where they are at one height.
        rows = count if below > BELOW_FROM * beside else 1
        columns, scale = count // rows, below if rows > 1 else beside
        width, height = max(1, round(width_mm * scale)), max(1, round(depth_mm * scale))
        left = self.panel.left + ruler + (room_x - columns * width - (columns - 1) * gap) // 2
        return [
            Rect(left + i * (width + gap), header + j * (height + between), width, height)
            for j in range(rows)
            for i in range(columns)
        ]

    def aside(self, heights: list[int]) -> list[Rect]:
        """Boxes of the scanner's sliders, one under the other at the panel's right edge."""
        tops = np.cumsum([self.px(HEADER_HEIGHT), *(height + 6 for height in heights[:-1])])
        left = self.panel.right - ASIDE_WIDTH
        return [Rect(left, int(top), ASIDE_WIDTH - 8, h) for top, h in zip(tops, heights, strict=True)]

    def window_coordinates(self, rect: Rect) -> tuple[float, float, float, float]:
        """Left, bottom, right, top with (0, 0) at the bottom left and (1, 1) at the top right of the window."""
        return (
            rect.left / self.width,
            1 - rect.bottom / self.height,
            rect.right / self.width,
            1 - rect.top / self.height,
        )
