"""What the window shows of a resection: the score, the resection surface that a cut would have now, and
their figures.
"""

import numpy as np

from rehearsal.deformed_anatomy import DeformedAnatomy
from rehearsal.live_settings import LiveSettings
from rehearsal.resection.cut import Cut, CutSettings, cut_organ
from rehearsal.resection.operation import LEAST_SEEN, IsSeen, distance_to_tumour, seen_share
from rehearsal.resection.resection_plan import ResectionPlan
from rehearsal.resection.resection_state import Point
from rehearsal.resection.score_line import LEAST_MARKS, ResectionError, ScoreLine, score_line
from render.viewer import Score
from sim.fields import array_of
from sim.lattice import CellInterpolation
from sim.skinning import Skin
from ultrasound.crater import Filling
from ultrasound.scanner import plane_section

# A line that is nearer to the tumour than the margin by no more than this is not warned of.
TOLERANCE_MM = 0.5
# Period of what the images have shown: a coming cut takes longer than a frame.
SEEN_S = 0.5
UNSEEN = (
    "tumour surface seen {:.0f} %: the cut keeps no margin from the rest, however much of the volume was seen"
)


def cut_settings(settings: LiveSettings) -> CutSettings:
    """How the sliders say that the next cut is made."""
    resection = settings.resection
    filling: Filling = "air" if resection.air_in_crater else "fluid"
    return CutSettings(resection.technique, settings.plan.margin_mm, resection.cut_depth_mm or None, filling)


class ResectionView:
    """The score and the coming resection surface of an anatomy.

    ``plan`` is what is to be followed, if anything. ``line`` is the score's, ``fault`` says why a cut is not
    possible now; ``tumour_mm`` (k,) are the distances of the line's points from the tumour's outline,
    ``seen_share`` is the share of the tumour's surface that the images have shown.
    """

    def __init__(self, anatomy: DeformedAnatomy, plan: ResectionPlan | None = None) -> None:
        self.anatomy, self.plan = anatomy, plan
        self._plan_skin: Skin | None = None
        if plan is not None:
            self._plan_skin = anatomy.skin(np.array(plan.best.line_mm) - anatomy.case.origin)
        self.line: ScoreLine | None = None
        self.fault = ""
        self.tumour_mm = np.zeros(0)
        self.seen_share = 1.0
        self._score_fault = ""
        self._marks: tuple[Point, ...] = ()
        self._score_skin: Skin | None = None
        self._planned: Cut | None = None
        # Nodes and weights of the vertices of the coming specimen. Not a skin, of which there would be one
        # for each change.
        self._carried_by: tuple[np.ndarray, np.ndarray] = np.zeros((0, 8), int), np.zeros((0, 8))
        self._of: tuple[object, ...] = ()
        self._seen = b""
        self._version = anatomy.geometry.version

    def update(self, settings: CutSettings, is_seen: IsSeen) -> None:
        """Follow the marks and the settings, and twice a second what the images have shown of the tumour."""
        resection, tumour = self.anatomy.frame.resection, self.anatomy.case.tumour
        self._follow_marks(resection.marks)
        if not resection.marks and not self._of:
            return
        points = np.zeros((0, 3)) if tumour is None else np.asarray(tumour.vertices)
        of = resection.marks, resection.cut is None, settings, int(self.anatomy.frame.time_s / SEEN_S)
        if of == self._of:
            return
        seen = is_seen(points)
        self.seen_share = float(seen.mean()) if len(seen) else 1.0
        has_news = of[:3] != self._of[:3] or seen.tobytes() != self._seen
        self._of, self._seen = of, seen.tobytes()
        if has_news:
            self._plan_cut(settings, points[seen])

    def _follow_marks(self, marks: tuple[Point, ...]) -> None:
        """Have the line through the marks, which moves with the tissue that is there."""
        version = self.anatomy.geometry.version
        if version != self._version:
            self._version = version
            for skin in (self._score_skin, self._plan_skin):
                if skin is not None:
                    skin.attach_again()
        if marks == self._marks:
            return
        self._marks, self.line, self._score_fault = marks, None, ""
        places = np.array(marks, float).reshape(-1, 3)
        if len(marks) >= LEAST_MARKS:
            try:
                self.line = score_line(self.anatomy.case.organ, places)
            except ResectionError as error:
                self._score_fault = str(error)
        shown = places if self.line is None else np.concatenate([self.line.points, self.line.marks])
        self._score_skin = self.anatomy.skin(shown) if marks else None

    def _plan_cut(self, settings: CutSettings, seen: np.ndarray) -> None:
        """Compute the coming cut around points (n, 3) of the tumour."""
        self.fault, self._planned, line = self._score_fault, None, self.line
        organ, interpolation = self.anatomy.case.organ, self.anatomy.geometry.whole
        self.tumour_mm = distance_to_tumour(line, self.anatomy.case.tumour)
        is_cut = self.anatomy.frame.resection.cut is not None
        if line is None or is_cut or not isinstance(interpolation, CellInterpolation):
            return
        try:
            self._planned = cut_organ(organ, line, settings, seen)
            self._carried_by = interpolation.attach(self._planned.specimen.vertices)
        except ResectionError as error:
            self.fault = str(error)

    @property
    def mark_count(self) -> int:
        """The number of marks of the score."""
        return len(self._marks)

    def figures(self, settings: CutSettings) -> dict[str, str]:
        """Name -> figure with its unit, of the score and of the coming cut."""
        figures = {"marks": str(self.mark_count), "technique": settings.technique}
        if self.line is not None:
            figures["line"] = f"{self.line.length_mm:.0f} mm"
        if len(self.tumour_mm):
            figures["line to tumour"] = f"{self.tumour_mm.min():.1f} mm"
        depth = "as seen" if settings.depth_mm is None else f"{settings.depth_mm:.0f} mm"
        figures |= {"margin asked": f"{settings.margin_mm:.0f} mm", "depth": depth}
        if self._marks:
            figures["tumour surface seen"] = f"{100 * self.seen_share:.0f} %"
        return figures

    def section(self) -> np.ndarray | None:
        """The coming resection surface on the image plane: segments (n, 2, 2) [mm]; None without one."""
        planned, interpolation = self._planned, self.anatomy.geometry.whole
        if planned is None or not isinstance(interpolation, CellInterpolation):
            return None
        moved = interpolation.displacement(self._carried_by, self.anatomy.frame.positions)
        faces = np.asarray(planned.specimen.faces)[planned.on_specimen]
        plane = self.anatomy.image_plane().world_from_plane
        return plane_section(planned.specimen.vertices + moved, faces, np.linalg.inv(plane))

    def score(self, margin_mm: float) -> Score | None:
        """The score and the planned one as they lie now, None without either; a part is near where its
        margin is smaller than asked.
        """
        if not self._marks and self._plan_skin is None:
            return None
        planned = np.zeros((0, 3))
        if self._plan_skin is not None and self.anatomy.cut is None:
            planned = _now(self._plan_skin)
        points = np.zeros((0, 3)) if self._score_skin is None else _now(self._score_skin)
        on_line = 0 if self.line is None else len(self.line.points)
        line, marks = points[:on_line], points[on_line:]
        near = self.tumour_mm < margin_mm - TOLERANCE_MM if len(self.tumour_mm) else np.zeros(len(line), bool)
        return Score(line, marks, near, planned)


def _now(skin: Skin) -> np.ndarray:
    skin.update()
    return array_of(skin.vertices).astype(float)


def warnings_of(anatomy: DeformedAnatomy) -> list[str]:
    """What the user is warned of after a cut."""
    cut, judgement, seen = anatomy.cut, anatomy.judgement, seen_share(anatomy)
    if cut is None:
        return []
    is_as_deep = cut.settings.depth_mm is None
    fault = anatomy.judgement_fault
    return [
        *([UNSEEN.format(100 * seen)] if is_as_deep and seen < LEAST_SEEN else []),
        *cut.warnings,
        *(judgement.warnings() if judgement is not None else ()),
        *([fault] if fault else []),
    ]
