"""The full-window picture that lies behind the 3D view, kept up to date with as little drawing as a frame needs."""

import time

import numpy as np

from render import frame
from render.keys import Keys
from render.layout import ASIDE_WIDTH, Layout
from render.panel import BEFORE, CALLIPER, OUTLINE, Panel, calliper_segments, draw_segments, paste_picture
from render.viewer import Settings, View

READOUT_PERIOD_S = 0.25

Figures = tuple[dict[str, str], dict[str, str], str]


def panel_of(view: View, settings: Settings) -> Panel:
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
        ASIDE_WIDTH if settings.show_scanner else 0,
    )


class Page:
    """``pixels`` uint8 (width, height, 4) as GGUI wants them: columns first, bottom up."""

    def __init__(self, layout: Layout, keys: Keys | None = None) -> None:
        self.layout, self.keys = layout, keys or Keys()
        self.pixels = np.full((layout.width, layout.height, 4), 255, dtype=np.uint8)
        # frame.py and panel.py write rows, top down, through this view of the memory.
        self._page = self.pixels.transpose(1, 0, 2)[::-1]
        self.panel: Panel | None = None
        self._help_shown = False
        self._figures: Figures | None = None
        self._figures_at = 0.0

    def compose(
        self, view: View, settings: Settings, help_shown: bool = False, patient: bool = False
    ) -> None:
        """Put a view on the page. A ``patient`` one lets read-outs stand long enough to be read."""
        panel = panel_of(view, settings)
        if (self.panel, self._help_shown) != (panel, help_shown):
            lines = self.keys.lines() if help_shown else None
            self._page[:, :, :3] = frame.backdrop(self.layout, panel, lines, self.keys.of["help"])
            self.panel, self._help_shown, self._figures = panel, help_shown, None
        for box, picture in zip(panel.boxes(self.layout), view.pictures.values(), strict=True):
            paste_picture(self._page, box, picture)
            if view.outline_before_mm is not None:
                draw_segments(self._page, panel, box, view.outline_before_mm, BEFORE)
            if view.outline_mm is not None:
                draw_segments(self._page, panel, box, view.outline_mm, OUTLINE)
            draw_segments(self._page, panel, box, calliper_segments(panel, box, view.calliper_mm), CALLIPER)
        self._compose_figures((dict(view.readouts), dict(view.findings), view.alert), patient)

    def _compose_figures(self, figures: Figures, patient: bool) -> None:
        now = time.perf_counter()
        # On a screen, figures that change every frame cannot be read; a kept picture shows its own frame's figures.
        waits = patient and now - self._figures_at < READOUT_PERIOD_S
        if self._figures is not None and (waits or figures == self._figures):
            return
        readouts, findings, alert = figures
        rows, columns = self.layout.readouts.slices
        self._page[rows, columns, :3] = frame.readout_picture(self.layout, readouts)
        if findings and not self._help_shown:
            rows, columns = self.layout.findings.slices
            self._page[rows, columns, :3] = frame.findings_picture(self.layout, findings, alert)
        self._figures, self._figures_at = figures, now

    def place_at(self, column: float, row: float) -> tuple[float, float] | None:
        """The place on the image plane [mm] that a pixel of one of the pictures shows."""
        for box in self.panel.boxes(self.layout) if self.panel else []:
            if box.left <= column < box.right and box.top <= row < box.bottom:
                return self.panel.to_plane(box, column, row) if self.panel else None
        return None
