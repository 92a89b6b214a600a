"""The full-window image behind the 3D view; each frame redraws only what changed."""

import time

import numpy as np

from render import window_frame
from render.keys import Keys
from render.ultrasound_panel import (
    FIGURE_PX,
    OUTLINE,
    OUTLINE_AT_REST,
    draw_caliper,
    draw_note,
    draw_segments,
    image_boxes,
    paste_image,
    to_plane,
)
from render.viewer import View
from render.window_layout import Rect, WindowLayout

READOUT_PERIOD_S = 0.25

# Read-outs, findings, the finding above its limit, clock and pace.
Figures = tuple[dict[str, str], dict[str, str], str, str, str]


def backdrop_parts(view: View) -> tuple:
    """Return what the backdrop of a view depends on."""
    plane = view.width_mm, view.depth_mm, view.above_mm, view.focus_mm, view.marked_side
    return *plane, tuple(view.images), view.captions, view.title, view.status, view.outline_mm is not None


class BackgroundImage:
    """``pixels`` uint8 (width, height, 4) as GGUI wants them: columns first, bottom up."""

    def __init__(self, layout: WindowLayout, keys: Keys | None = None) -> None:
        self.layout, self.keys = layout, keys or Keys()
        self.pixels = np.full((layout.width, layout.height, 4), 255, dtype=np.uint8)
        # The same memory as rows, top down, for drawing.
        self._rows = self.pixels.transpose(1, 0, 2)[::-1]
        self._view: View | None = None
        self._backdrop: tuple = ()
        self._shows_help = False
        self._axes: np.ndarray | None = None
        self._figures: Figures | None = None
        self._figures_at = 0.0

    def compose(self, view: View, axes: np.ndarray, slow_figures: bool = False) -> None:
        """Draw a view, with the compass for a camera's axes (3, 3): right, up and ahead, in patient coordinates.

        With ``slow_figures``, figures change only every READOUT_PERIOD_S, so that they can be read.
        """
        findings = window_frame.first_of(view.findings, self.layout.most_findings)
        backdrop = *backdrop_parts(view), len(findings)
        if self._shows_help or self._backdrop != backdrop:
            self._rows[:, :, :3] = window_frame.backdrop(self.layout, view, self.keys.of["help"])
            self._figures, self._axes, self._shows_help = None, None, False
        self._view, self._backdrop = view, backdrop
        for (name, image), box in zip(view.images.items(), image_boxes(self.layout, view), strict=True):
            paste_image(self._rows, box, image)
            self._draw_over(view, name, box)
        figures = dict(view.readouts), findings, view.alert, view.clock, view.pace
        self._compose_figures(figures, slow_figures)
        if self._axes is None or not np.array_equal(axes, self._axes):
            self._put(self.layout.compass, window_frame.compass_image(self.layout, axes))
            self._axes = axes

    def show_help(self) -> None:
        """Draw the list of all keys over everything, until the next ``compose``."""
        if not self._shows_help:
            self._put(self.layout.whole, window_frame.help_image(self.layout, self.keys.lines()))
            self._shows_help = True

    def _draw_over(self, view: View, name: str, box: Rect) -> None:
        """Draw outlines, note and caliper over an image."""
        if view.outline_before_mm is not None:
            draw_segments(self._rows, view, box, view.outline_before_mm, OUTLINE_AT_REST)
        if view.outline_mm is not None:
            draw_segments(self._rows, view, box, view.outline_mm, OUTLINE)
        if note := view.notes.get(name):
            draw_note(self._rows, self.layout, box, note)
        draw_caliper(self._rows, view, box, self.layout.px(FIGURE_PX))

    def _compose_figures(self, figures: Figures, slow: bool) -> None:
        now = time.perf_counter()
        waits = slow and now - self._figures_at < READOUT_PERIOD_S
        if self._figures is not None and (waits or figures == self._figures):
            return
        readouts, findings, alert, clock, pace = figures
        box = window_frame.clock_box(self.layout, self.keys.of["help"])
        self._put(box, window_frame.clock_image(self.layout, box, clock, pace))
        self._put(self.layout.readouts, window_frame.readout_image(self.layout, readouts))
        if findings:
            box = self.layout.findings(len(findings))
            self._put(box, window_frame.findings_image(self.layout, findings, alert))
        self._figures, self._figures_at = figures, now

    def _put(self, box: Rect, image: np.ndarray) -> None:
        self._rows[box.slices][..., :3] = image

    def plane_point_at(self, column: float, row: float) -> tuple[float, float] | None:
        """Return the point of the image plane [mm] at a pixel of one of the images, None elsewhere."""
        if self._view is None or self._shows_help:
            return None
        hit = (box for box in image_boxes(self.layout, self._view) if box.contains(column, row))
        return next((to_plane(self._view, box, column, row) for box in hit), None)
