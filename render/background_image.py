"""The full-window picture that lies behind the 3D view, kept up to date with as little drawing as a frame needs."""

import time

import numpy as np

from render import window_frame
from render.compass import compass_picture
from render.keys import Keys
from render.ultrasound_panel import (
    BEFORE,
    FIGURE_PX,
    OUTLINE,
    Panel,
    draw_caliper,
    draw_note,
    draw_segments,
    paste_picture,
)
from render.viewer import View
from render.window_layout import Rect, WindowLayout

READOUT_PERIOD_S = 0.25

# Read-outs, findings, which of them is too much, clock and pace.
Figures = tuple[dict[str, str], dict[str, str], str, str, str]


def panel_of(view: View) -> Panel:
    """What the panel says of a view."""
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
        # window_frame.py and panel.py write rows, top down, through this view of the memory.
        self._page = self.pixels.transpose(1, 0, 2)[::-1]
        self.panel: Panel | None = None
        self._findings_shown = 0
        self._helps = False
        self._axes: np.ndarray | None = None
        self._figures: Figures | None = None
        self._figures_at = 0.0

    def compose(self, view: View, axes: np.ndarray, patient: bool = False) -> None:
        """Put a view on the page, and which way the patient lies for a camera's axes (3, 3): right, up and ahead, in the patient.

        A ``patient`` one lets read-outs stand long enough to be read.
        """
        panel, findings = panel_of(view), window_frame.first_of(view.findings, self.layout.most_findings)
        if self._helps or (self.panel, self._findings_shown) != (panel, len(findings)):
            self._page[:, :, :3] = window_frame.backdrop(self.layout, panel, self.keys.of["help"])
            self.panel, self._findings_shown = panel, len(findings)
            self._figures, self._axes, self._helps = None, None, False
        for (name, picture), box in zip(view.pictures.items(), panel.boxes(self.layout), strict=True):
            paste_picture(self._page, box, picture)
            self._draw_over(view, panel, name, box)
        figures = dict(view.readouts), findings, view.alert, view.clock, view.pace
        self._compose_figures(figures, patient)
        if self._axes is None or not np.array_equal(axes, self._axes):
            self._put(self.layout.compass, compass_picture(self.layout, axes))
            self._axes = axes

    def show_help(self) -> None:
        """Put the list of all keys over the page, until it is composed anew."""
        if not self._helps:
            self._put(self.layout.whole, window_frame.help_picture(self.layout, self.keys.lines()))
            self._helps = True

    def _draw_over(self, view: View, panel: Panel, name: str, box: Rect) -> None:
        """Outlines, caliper and what is written in a picture."""
        if view.outline_before_mm is not None:
            draw_segments(self._page, panel, box, view.outline_before_mm, BEFORE)
        if view.outline_mm is not None:
            draw_segments(self._page, panel, box, view.outline_mm, OUTLINE)
        if note := view.notes.get(name):
            draw_note(self._page, self.layout, box, note)
        draw_caliper(self._page, panel, box, view.caliper_mm, view.caliper, self.layout.px(FIGURE_PX))

    def _compose_figures(self, figures: Figures, patient: bool) -> None:
        now = time.perf_counter()
        # On a screen, figures that change every frame cannot be read; a kept picture shows its own frame's figures.
        waits = patient and now - self._figures_at < READOUT_PERIOD_S
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
        self._page[rows, columns, :3] = picture

    def place_at(self, column: float, row: float) -> tuple[float, float] | None:
        """The place on the image plane [mm] that a pixel of one of the pictures shows."""
        if self.panel is None or self._helps:
            return None
        boxes = self.panel.boxes(self.layout)
        hit = (box for box in boxes if box.holds(column, row))
        return next((self.panel.to_plane(box, column, row) for box in hit), None)
