"""What the window shows of a resection: the score, the resection surface that a cut would have now, and their figures."""

import numpy as np

from rehearsal.rehearsal import Rehearsal
from rehearsal.resection.cut import Cut, CutSettings, cut_organ
from rehearsal.resection.operation import LEAST_SEEN, IsSeen, distance_to_tumour
from rehearsal.resection.resection_plan import ResectionPlan
from rehearsal.resection.score_line import ResectionError
from render.viewer import Score, Settings
from sim.fields import array_of
from sim.neo_hookean import NeoHookean
from sim.skinning import Skin
from ultrasound.crater import Filling
from ultrasound.scanner import plane_section

# A line that is nearer to the tumour than the margin by no more than this is not warned of.
TOLERANCE_MM = 0.5
# Period of what the images have shown: a coming cut takes longer than a frame.
SEEN_S = 0.5


def cut_settings(settings: Settings) -> CutSettings:
    """How the sliders say that the next cut is made."""
    depth_mm = float(settings.cut_depth_mm) or None
    filling: Filling = "air" if settings.air_in_crater else "fluid"
    return CutSettings(settings.technique, float(settings.margin_mm), depth_mm, filling)


class ResectionView:
    """The score and the coming resection surface of a rehearsal.

    ``plan`` is what is to be followed, if anything. ``fault`` says why a cut is not possible now; ``tumour_mm`` (k,) are the distances of the score's points from the
    tumour's outline, ``seen_share`` is the share of the tumour's surface that the images have shown.
    """

    def __init__(self, rehearsal: Rehearsal, plan: ResectionPlan | None = None) -> None:
        self.rehearsal, self.plan = rehearsal, plan
        self._plan_skin: Skin | None = None
        if plan is not None:
            line = np.array(plan.best.line_mm) - rehearsal.origin
            self._plan_skin = Skin(rehearsal.model.carrier, line)
        self.fault = ""
        self.tumour_mm = np.zeros(0)
        self.seen_share = 1.0
        self._planned: Cut | None = None
        # Nodes and weights of the vertices of the coming specimen. Not a skin, of which there would be one for each change.
        self._carried_by: tuple[np.ndarray, np.ndarray] = np.zeros((0, 8), int), np.zeros((0, 8))
        self._of: tuple[object, ...] = ()
        self._seen = b""

    def update(self, settings: CutSettings, is_seen: IsSeen, time_s: float) -> None:
        """Follow the marks and the settings, and twice a second [s] what the images have shown of the tumour."""
        resection, tumour = self.rehearsal.resection, self.rehearsal.whole_tumour
        if not resection.marks and not self._of:
            return
        points = np.zeros((0, 3)) if tumour is None else np.asarray(tumour.vertices)
        of = resection.marks, resection.cut is None, settings, int(time_s / SEEN_S)
        if of == self._of:
            return
        seen = is_seen(points)
        self.seen_share = float(seen.mean()) if len(seen) else 1.0
        has_news = of[:3] != self._of[:3] or seen.tobytes() != self._seen
        self._of, self._seen = of, seen.tobytes()
        if not has_news:
            return
        self.fault, self._planned = self.rehearsal.score_fault, None
        self.tumour_mm = distance_to_tumour(self.rehearsal.score, tumour)
        line, model = self.rehearsal.score, self.rehearsal.model
        if line is None or resection.cut is not None or not isinstance(model, NeoHookean):
            return
        try:
            self._planned = cut_organ(self.rehearsal.whole_organ, line, settings, points[seen])
            self._carried_by = model.lattice.interpolation(self._planned.specimen.vertices)
        except ResectionError as error:
            self.fault = str(error)

    def section(self, plane_from_world: np.ndarray) -> np.ndarray | None:
        """The coming resection surface on an image plane: segments (n, 2, 2) [mm]; None without one."""
        planned, model = self._planned, self.rehearsal.model
        if planned is None or not isinstance(model, NeoHookean):
            return None
        moved = model.lattice.displacement(self._carried_by, array_of(model.body.position))
        faces = np.asarray(planned.specimen.faces)[planned.on_specimen]
        return plane_section(planned.specimen.vertices + moved, faces, plane_from_world)

    def score(self, margin_mm: float) -> Score | None:
        """The score and the planned one as they lie now, None without either; a part is near where its margin is smaller than asked."""
        if not self.rehearsal.resection.marks and self._plan_skin is None:
            return None
        planned = np.zeros((0, 3))
        if self._plan_skin is not None and self.rehearsal.cut is None:
            self._plan_skin.update()
            planned = array_of(self._plan_skin.vertices).astype(float)
        line, marks = self.rehearsal.score_points()
        near = self.tumour_mm < margin_mm - TOLERANCE_MM if len(self.tumour_mm) else np.zeros(len(line), bool)
        return Score(line, marks, near, planned)

    def status(self, settings: CutSettings) -> str:
        """The text over the images while scoring; empty before the first mark and after the cut."""
        count = len(self.rehearsal.resection.marks)
        if count == 0 or self.rehearsal.cut is not None:
            return ""
        line = self.rehearsal.score
        # Warnings first: of what is too long for the panel, the last is not shown.
        parts = []
        if self.fault:
            # The reason; what to do about it is said where a cut is refused.
            parts.append(self.fault.partition(";")[0])
        if settings.depth_mm is None and self.seen_share < LEAST_SEEN:
            parts.append(f"tumour surface seen {100 * self.seen_share:.0f} %")
        if len(self.tumour_mm) and self.tumour_mm.min() < settings.margin_mm - TOLERANCE_MM:
            parts.append(f"red: {self.tumour_mm.min():.1f} of {settings.margin_mm:.0f} mm margin")
        parts.append(f"SCORE {count} marks" + ("" if line is None else f" {line.length_mm:.0f} mm"))
        parts.append(settings.technique)
        return "   ".join(parts)
