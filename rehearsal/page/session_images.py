"""The images of a session that its page shows: those that the user exported, or the last ones."""

from collections import deque
from dataclasses import replace

import numpy as np
from PIL import Image

from rehearsal.deformed_anatomy import DeformedAnatomy
from rehearsal.loop.timeline import periods
from rehearsal.measurements.live_measurements import MEASURE_S
from render.ultrasound_panel import OUTLINE, RESECTION_LINE, draw_segments
from render.viewer import View
from render.window_layout import Rect
from ultrasound.scanner import B_MODE

MOST_EXPORTED = 4
# Height of a drawn image; its lines are so wide.
HEIGHT_PX, LINE_PX = 640, 2
BEFORE, AFTER, LAST = "before the cut", "after the cut", "last image"


class SessionImages:
    """Keeps the views of a session: the last ones of those exported, and the last with contact, before and
    after a cut.
    """

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Begin another session."""
        self._exported: deque[tuple[str, View]] = deque(maxlen=MOST_EXPORTED)
        self._last: dict[bool, View] = {}
        # The period and whether there was a cut.
        self._at: tuple[int, bool] | None = None

    def export(self, name: str, view: View) -> None:
        """Keep an exported view, by the name of its files."""
        if B_MODE in view.images:
            self._exported.append((f"exported {name}", view))

    def observe(self, view: View, anatomy: DeformedAnatomy) -> None:
        """Keep the view of an anatomy, with the outline of its tumour, if it shows tissue: four times a
        second, and at once after a cut.
        """
        due = periods(anatomy.frame.time_s, MEASURE_S), anatomy.cut is not None
        if due != self._at and B_MODE in view.images and B_MODE not in view.notes:
            self._at = due
            self._last[due[1]] = replace(view, outline_mm=anatomy.tumour_outline())

    def captioned(self, has_cut: bool) -> list[tuple[str, Image.Image]]:
        """The images to show, each with its caption; ``has_cut``: at the end of the session."""
        chosen = list(self._exported)
        if not chosen:
            names = {False: BEFORE if has_cut else LAST, True: AFTER}
            # Of a cut that was undone there is no image.
            chosen = [(names[cut], view) for cut, view in sorted(self._last.items()) if has_cut or not cut]
        return [(caption(name, view), drawn(view)) for name, view in chosen]


def caption(name: str, view: View) -> str:
    """What an image is, its size, and what its lines are."""
    lines = {"yellow: tumour": view.outline_mm, "blue: coming cut": view.resection_mm}
    shown = [text for text, segments_mm in lines.items() if segments_mm is not None and len(segments_mm)]
    return "; ".join([f"{B_MODE}, {name}, {view.width_mm:.0f} x {view.depth_mm:.0f} mm", *shown])


def drawn(view: View) -> Image.Image:
    """The B-mode image of a view, with Doppler and the lines that the view has, in square pixels."""
    box = Rect(0, 0, round(HEIGHT_PX * view.width_mm / view.depth_mm), HEIGHT_PX)
    image = Image.fromarray(view.shown[B_MODE]).convert("RGB")
    page = np.array(image.resize((box.width, box.height), Image.Resampling.BILINEAR))
    for segments_mm, colour in ((view.outline_mm, OUTLINE), (view.resection_mm, RESECTION_LINE)):
        if segments_mm is not None:
            draw_segments(page, view, box, segments_mm, colour, LINE_PX)
    return Image.fromarray(page)
