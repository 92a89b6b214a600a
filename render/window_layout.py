"""Layout of the window. Pixels count from the top left; lengths below are those of a window of 1280 x 720."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

# The images have this fraction of the window's width, and the 3D view beside them still has room for the
# read-outs below it.
PANEL_SHARE = 0.43
TITLE_HEIGHT, CLOCK_WIDTH = 42, 150
ENGINEER_HEIGHT, STRIP_GAP, READOUT_WIDTH = 184, 4, 134
MESSAGE_LINES, MESSAGE_PITCH = 3, 20
TOOL_ROWS, TOOL_HEIGHT, TOOL_GAP = 2, 28, 6
HEADER_HEIGHT, FOOTER_HEIGHT = 74, 52
STATUS_MIDDLE, STATUS_HEIGHT = 43, 18
RULER_WIDTH, WEDGE_WIDTH, IMAGE_GAP, NAME_HEIGHT = 42, 33, 10, 26
SCANNER_GAP = 6
FINDINGS_GAP, FIGURE_HEIGHT, FIGURES_PAD = 10, 21, 7
# The second is in a window that is smaller than FULL_SIZE, beside its sliders.
FINDINGS_WIDTH, SMALL_FINDINGS_WIDTH = 204, 178
COMPASS_SIZE, SIGN_HEIGHT = 92, 22
# Warnings cover at most this share of the 3D view.
MOST_WARNED = 0.4
# A narrower strip shows no read-outs, so that the labels of its sliders fit.
STRIP_WITH_READOUTS = 712
# Texts scale with the window; Dear ImGui's sliders do not.
FULL_SIZE, LEAST_SCALE, MOST_SCALE = (1280, 720), 0.8, 4.0
# How much larger images must be one under the other to be preferred to side by side.
BELOW_FROM = 1.2
# Where images side by side would leave height empty, the others are smaller than the first, by this share.
OTHERS_SHARE = 0.5


class Rect(NamedTuple):
    """Pixels: left, top, width, height."""

    left: int
    top: int
    width: int
    height: int

    def widened(self, by: int) -> "Rect":
        """The box with so many pixels around it."""
        return Rect(self.left - by, self.top - by, self.width + 2 * by, self.height + 2 * by)

    @property
    def right(self) -> int:
        return self.left + self.width

    @property
    def bottom(self) -> int:
        return self.top + self.height

    def contains(self, column: float, row: float) -> bool:
        """Whether a pixel is inside."""
        return self.left <= column < self.right and self.top <= row < self.bottom

    @property
    def slices(self) -> tuple[slice, slice]:
        """Rows and columns, to index an image."""
        return slice(self.top, self.bottom), slice(self.left, self.right)


@dataclass(frozen=True)
class WindowLayout:
    """The boxes of all parts of a window of width x height pixels, also of those for an engineer where
    ``has_engineer``.
    """

    width: int
    height: int
    has_engineer: bool = False

    @cached_property
    def scale(self) -> float:
        """Scale of texts and what depends on them, 1 in a window of FULL_SIZE."""
        share = min(self.width / FULL_SIZE[0], self.height / FULL_SIZE[1])
        return min(max(share, LEAST_SCALE), MOST_SCALE)

    def px(self, pixels: float) -> int:
        """A length in this window of one in a window of FULL_SIZE [pixels]."""
        return round(self.scale * pixels)

    @property
    def line_width(self) -> int:
        """The width of a line over an image [pixels]."""
        return max(1, self.px(1))

    @property
    def figures_pad(self) -> int:
        """The space above and below figures in their box."""
        return self.px(FIGURES_PAD)

    @property
    def panel(self) -> Rect:
        width = round(self.width * PANEL_SHARE)
        return Rect(self.width - width, 0, width, self.height)

    @property
    def status(self) -> Rect:
        """The status over the images."""
        margin, height = self.px(16), self.px(STATUS_HEIGHT)
        top = self.px(STATUS_MIDDLE) - height // 2
        return Rect(self.panel.left + margin, top, self.panel.width - 2 * margin, height)

    @property
    def strip(self) -> Rect:
        """Messages, tools, and an engineer's sliders and read-outs, beneath the 3D view."""
        top = self.messages.top - 1
        return Rect(0, top, self.panel.left, self.height - top)

    @property
    def messages(self) -> Rect:
        """The messages, in the upper part of the strip."""
        height = MESSAGE_LINES * self.px(MESSAGE_PITCH) + self.figures_pad
        return Rect(0, self.tools.top - height, self.panel.left, height)

    @property
    def tools(self) -> Rect:
        """The rows of a phase's tools."""
        height = TOOL_ROWS * self.px(TOOL_HEIGHT + TOOL_GAP) + self.px(TOOL_GAP)
        return Rect(0, self.engineer.top - height, self.panel.left, height)

    def tool_row(self, number: int) -> Rect:
        """A row of tools."""
        gap, height = self.px(TOOL_GAP), self.px(TOOL_HEIGHT)
        top = self.tools.top + number * self.px(TOOL_HEIGHT + TOOL_GAP)
        return Rect(gap, top, self.tools.width - 2 * gap, height)

    @property
    def engineer(self) -> Rect:
        """An engineer's sliders and read-outs, in the lowest part of the strip."""
        height = min(max(ENGINEER_HEIGHT, self.px(ENGINEER_HEIGHT)), self.height // 3)
        height *= self.has_engineer
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
    def clear(self) -> Rect:
        """The part of the 3D view beside the findings: the organ is in its centre."""
        left = self.findings(0).right
        return Rect(left, self.scene.top, self.scene.right - left, self.scene.height)

    @property
    def readouts(self) -> Rect:
        is_wide = self.has_engineer and self.strip.width >= STRIP_WITH_READOUTS
        width = self.px(READOUT_WIDTH) if is_wide else 0
        return Rect(self.engineer.right - width, self.engineer.top, width, self.engineer.height)

    @property
    def compass(self) -> Rect:
        """The compass of patient axes, in the 3D view's lower left corner."""
        gap, size = self.px(FINDINGS_GAP), self.px(COMPASS_SIZE)
        return Rect(gap, self.scene.bottom - gap - size, size, size)

    @property
    def signs(self) -> Rect:
        """The row of signs at the foot of the 3D view, beside the compass."""
        gap, height = self.px(FINDINGS_GAP), self.px(SIGN_HEIGHT)
        left = self.compass.right + gap
        return Rect(left, self.scene.bottom - gap - height, self.scene.right - gap - left, height)

    @property
    def foot(self) -> Rect:
        """The line above the signs from which a box of warnings grows upwards."""
        return self.signs._replace(top=self.signs.top - self.px(FINDINGS_GAP), height=0)

    @property
    def highest_warning(self) -> int:
        """The row above which no warning is: their box grows no higher."""
        return self.foot.bottom - int(MOST_WARNED * self.scene.height)

    @property
    def most_findings(self) -> int:
        """How many lines of findings fit."""
        room = self.compass.top - 2 * self.px(FINDINGS_GAP) - self.scene.top - 2 * self.figures_pad
        return max(0, room // self.px(FIGURE_HEIGHT))

    def findings(self, count: int) -> Rect:
        """The box of this many findings, over the 3D view's upper left corner."""
        gap, height = self.px(FINDINGS_GAP), count * self.px(FIGURE_HEIGHT) + 2 * self.figures_pad
        width = FINDINGS_WIDTH if self.scale >= 1 else SMALL_FINDINGS_WIDTH
        return Rect(gap, self.scene.top + gap, self.px(width), height)

    def sliders(self, widths: list[float]) -> list[Rect]:
        """Boxes for groups of sliders, side by side in the strip, in proportion to `widths`; none of no
        group.
        """
        if not widths:
            return []
        edges = np.concatenate([[0.0], np.cumsum(widths)]) / sum(widths) * self.slider_room(len(widths))
        gap = self.px(STRIP_GAP)
        return [
            Rect(
                round(gap * (i + 1) + edges[i]),
                self.engineer.top + gap,
                round(edges[i + 1] - edges[i]),
                min(ENGINEER_HEIGHT - 2 * STRIP_GAP, self.engineer.height - 2 * gap),
            )
            for i in range(len(widths))
        ]

    def slider_room(self, count: int) -> int:
        """The total width of this many boxes of sliders [pixels]."""
        return self.readouts.left - self.px(STRIP_GAP) * (count + 1)

    def scanner_sliders(self, sizes: list[tuple[int, int]]) -> list[Rect]:
        """Boxes of these widths and heights beside the panel: one under the other, and where there is no more
        room, in a further column.
        """
        gap = self.px(SCANNER_GAP)
        right, first, room = self.scene.right - gap, self.scene.top + gap, self.scene.height - 2 * gap
        top, boxes = first, list[Rect]()
        for width, height in sizes:
            if boxes and top + height > first + room:
                right, top = min(box.left for box in boxes) - gap, first
            boxes.append(Rect(right - width, top, width, min(height, room)))
            top += height + gap
        return boxes

    @property
    def whole(self) -> Rect:
        """The whole window."""
        return Rect(0, 0, self.width, self.height)

    def image_boxes(self, count: int, width_mm: float, depth_mm: float) -> list[Rect]:
        """The largest boxes in the panel with the shape of the image plane: side by side, the first larger
        where that leaves less empty, or one under the other.

        Raises ValueError unless both lengths are positive.
        """
        if not (width_mm > 0 and depth_mm > 0):
            raise ValueError(f"image plane of {width_mm} x {depth_mm} mm: both lengths must be positive")
        ruler, gap, between = self.px(RULER_WIDTH), self.px(IMAGE_GAP), self.px(NAME_HEIGHT)
        header = self.px(HEADER_HEIGHT)
        room_x = self.panel.width - ruler - self.px(WEDGE_WIDTH)
        room_y = self.panel.height - header - self.px(FOOTER_HEIGHT)
        beside = min((room_x - (count - 1) * gap) / count / width_mm, room_y / depth_mm)
        below = min(room_x / width_mm, (room_y - (count - 1) * between) / count / depth_mm)
        # Side by side is preferred: equal depths are then at equal heights.
        if below > BELOW_FROM * beside:
            width, height = max(1, round(width_mm * below)), max(1, round(depth_mm * below))
            left = self.panel.left + ruler + (room_x - width) // 2
            return [Rect(left, header + j * (height + between), width, height) for j in range(count)]
        shares = np.r_[1.0, np.full(count - 1, OTHERS_SHARE)]
        first = min((room_x - (count - 1) * gap) / shares.sum() / width_mm, room_y / depth_mm)
        if count > 1:
            # Where the first is as high as the panel, the others have the width that is left.
            left_over = (room_x - (count - 1) * gap) / (first * width_mm) - 1
            shares[1:] = min(1.0, left_over / (count - 1))
        # As low as the panel they have one size.
        scales = first * shares if beside * depth_mm < room_y else np.full(count, beside)
        widths, heights = (np.maximum(1, np.rint(mm * scales)).astype(int) for mm in (width_mm, depth_mm))
        lefts = np.r_[0, np.cumsum(widths[:-1] + gap)]
        lefts += self.panel.left + ruler + (room_x - lefts[-1] - widths[-1]) // 2
        return [Rect(*map(int, box)) for box in zip(lefts, [header] * count, widths, heights, strict=True)]

    def window_coordinates(self, rect: Rect) -> tuple[float, float, float, float]:
        """Left, bottom, right, top with (0, 0) at the bottom left and (1, 1) at the top right of the
        window.
        """
        return (
            rect.left / self.width,
            1 - rect.bottom / self.height,
            rect.right / self.width,
            1 - rect.top / self.height,
        )
