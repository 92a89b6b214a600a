"""The full-window image behind the 3D view; each frame redraws only what changed."""

import time

import numpy as np

from render import window_frame
from render.compass import compass_picture
from render.keys import Keys
from render.ultrasound_panel import (
    FIGURE_PX,
    OUTLINE,
    OUTLINE_AT_REST,
    Panel,
    draw_caliper,
    draw_note,
    draw_segments,
    paste_picture,
)
from render.viewer import View
from render.window_layout import Rect, WindowLayout

READOUT_PERIOD_S = 0.25

# Read-outs, findings, the finding above its limit, clock and pace.
Figures = tuple[dict[str, str], dict[str, str], str, str, str]


def panel_of(view: View) -> Panel:
    """Return the panel of a view."""
    return Panel(
        tuple(view.pictures),
        view.width_mm,
        view.depth_mm,
        view.above_mm,
        view.focus_mm,
        view.captions,
        view.title,
        view.status,
        view.marked_side,
        view.outline_mm is not None,
    )


class BackgroundImage:
    """``pixels`` uint8 (width, height, 4) as GGUI wants them: columns first, bottom up."""

    def __init__(self, layout: WindowLayout, keys: Keys | None = None) -> None:
        self.layout, self.keys = layout, keys or Keys()
        self.pixels = np.full((layout.width, layout.height, 4), 255, dtype=np.uint8)
        # The same memory as rows, top down, for drawing.
        self._rows = self.pixels.transpose(1, 0, 2)[::-1]
        self.panel: Panel | None = None
        self._findings_shown = 0
        self._shows_help = False
        self._axes: np.ndarray | None = None
        self._figures: Figures | None = None
        self._figures_at = 0.0

    def compose(self, view: View, axes: np.ndarray, slow_figures: bool = False) -> None:
        """Draw a view, with the compass for a camera's axes (3, 3): right, up and ahead, in patient coordinates.

        With ``slow_figures``, figures change only every READOUT_PERIOD_S, so that they can be read.
        """
        panel, findings = panel_of(view), window_frame.first_of(view.findings, self.layout.most_findings)
        if self._shows_help or (self.panel, self._findings_shown) != (panel, len(findings)):
            self._rows[:, :, :3] = window_frame.backdrop(self.layout, panel, self.keys.of["help"])
            self.panel, self._findings_shown = panel, len(findings)
            self._figures, self._axes, self._shows_help = None, None, False
        for (name, picture), box in zip(view.pictures.items(), panel.boxes(self.layout), strict=True):
            paste_picture(self._rows, box, picture)
            self._draw_over(view, panel, name, box)
        figures = dict(view.readouts), findings, view.alert, view.clock, view.pace
        self._compose_figures(figures, slow_figures)
        if self._axes is None or not np.array_equal(axes, self._axes):
            self._put(self.layout.compass, compass_picture(self.layout, axes))
            self._axes = axes

    def show_help(self) -> None:
        """Draw the list of all keys over everything, until the next ``compose``."""
        if not self._shows_help:
            self._put(self.layout.whole, window_frame.help_picture(self.layout, self.keys.lines()))
            self._shows_help = True

    def _draw_over(self, view: View, panel: Panel, name: str, box: Rect) -> None:
        """Draw outlines, note and caliper over an image."""
        if view.outline_before_mm is not None:
            draw_segments(self._rows, panel, box, view.outline_before_mm, OUTLINE_AT_REST)
        if view.outline_mm is not None:
            draw_segments(self._rows, panel, box, view.outline_mm, OUTLINE)
        if note := view.notes.get(name):
            draw_note(self._rows, self.layout, box, note)
        draw_caliper(self._rows, panel, box, view.caliper_mm, view.caliper, self.layout.px(FIGURE_PX))

    def _compose_figures(self, figures: Figures, slow: bool) -> None:
        now = time.perf_counter()
        waits = slow and now - self._figures_at < READOUT_PERIOD_S
        if self._figures is not None and (waits or figures == self._figures):
            return
        readouts, findings, alert, clock, pace = figures
        box = window_frame.clock_box(self.layout, self.keys.of["help"])
        self._put(box, window_frame.clock_picture(self.layout, box, clock, pace))
        self._put(self.layout.readouts, window_frame.readout_picture(self.layout, readouts))
        if findings:
            box = self.layout.findings(len(findings))
            self._put(box, window_frame.findings_picture(self.layout, findings, alert))
        self._figures, self._figures_at = figures, now

    def _put(self, box: Rect, picture: np.ndarray) -> None:
        rows, columns = box.slices
        self._rows[rows, columns, :3] = picture

    def plane_point_at(self, column: float, row: float) -> tuple[float, float] | None:
        """Return the point of the image plane [mm] at a pixel of one of the images, None elsewhere."""
        if self.panel is None or self._shows_help:
            return None
        boxes = self.panel.boxes(self.layout)
        hit = (box for box in boxes if box.contains(column, row))
        return next((self.panel.to_plane(box, column, row) for box in hit), None)
