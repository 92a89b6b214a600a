"""A way of the probe tried on the deforming organ, without a screen: what it sees of a target, and what that costs."""

from itertools import pairwise

import numpy as np

from rehearsal.planning.instrument_reach import Reach
from rehearsal.planning.plan_poses import DEG_A_MM, LIFT_MM
from rehearsal.planning.score_terms import ScoreTerms, faces_of, incidence_deg
from rehearsal.planning.sweep_path import SweepPath
from rehearsal.rehearsal import Rehearsal
from sim.fields import array_of
from ultrasound.array_contact import measure_contact
from ultrasound.coverage import GRID_POINTS, Coverage
from ultrasound.image_plane import PlaneInTissue
from ultrasound.probe_manipulator import advanced, poses_between

# Between two passes the probe is over its next place after so many steps at the latest.
MOST_STEPS = 240
# A whole number of steps is not one more where the poses come from a file, which rounds them.
ROUNDED_STEPS = 1e-3


class Trial:
    """Tries ways in one rehearsal, each from the settled organ, at a speed [mm/s] on the passes.

    ``target`` is one of ``Coverage.targets``.
    """

    def __init__(
        self, rehearsal: Rehearsal, coverage: Coverage, target: str, reach: Reach, speed_mm_s: float
    ) -> None:
        self.rehearsal, self.coverage, self.target, self.reach = rehearsal, coverage, target, reach
        self.speed_mm_s = speed_mm_s
        self.plane = PlaneInTissue(rehearsal.embedding, GRID_POINTS)

    def run(self, way: SweepPath) -> ScoreTerms:
        """Go the way; the same way gives the same figures."""
        self._begin()
        for each in way.passes:
            self._come(each[0])
            self._look()
            for start, end in pairwise(each):
                for pose in poses_between(start, end, self._steps(start, end))[1:]:
                    self._step(pose)
                self._look()
        return self._parts(way)

    def _begin(self) -> None:
        self.rehearsal.reset()
        self.coverage.clear()
        self._squeezed: list[float] = []
        self._touching: list[float] = []
        self._troubled: list[bool] = []
        self._trouble = False
        self._way_mm, self._steps_taken = 0.0, 0

    def _come(self, pose: np.ndarray) -> None:
        """Lift the probe, bring it over its next place, and set it down there."""
        if self._steps_taken == 0:
            self.rehearsal.pose = advanced(pose, -LIFT_MM)
        else:
            for goal in (advanced(self.rehearsal.pose, -LIFT_MM), advanced(pose, -LIFT_MM)):
                self._go(goal)
        for down in poses_between(self.rehearsal.pose, pose, self._steps(self.rehearsal.pose, pose))[1:]:
            self._step(down)

    def _go(self, goal: np.ndarray) -> None:
        """Towards a goal no faster than a hand, around the organ."""
        for _ in range(MOST_STEPS):
            if np.allclose(self.rehearsal.pose, goal, atol=1e-6):
                return
            self._step(self.rehearsal.pose_towards(goal))

    def _step(self, pose: np.ndarray) -> None:
        self._way_mm += float(np.linalg.norm(self._face(pose) - self._face(self.rehearsal.pose)))
        self.rehearsal.advance(pose)
        self._trouble |= bool(self.rehearsal.notice)
        self._steps_taken += 1

    def _face(self, pose: np.ndarray) -> np.ndarray:
        return faces_of(self.rehearsal.manipulator, pose[None])[0]

    def _steps(self, start: np.ndarray, end: np.ndarray) -> int:
        cosine = (np.einsum("ij,ij->", start[:3, :3], end[:3, :3]) - 1) / 2
        turn = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
        way = max(float(np.linalg.norm(self._face(end) - self._face(start))), turn / DEG_A_MM)
        steps = way / (self.speed_mm_s * self.rehearsal.settings.time_step_s)
        return max(1, int(np.ceil(steps - ROUNDED_STEPS)))

    def _look(self) -> None:
        rehearsal = self.rehearsal
        rehearsal.embedding.update()
        self.plane.locate(rehearsal.image_plane())
        gap = rehearsal.scene.image.contact_gap_mm
        touches = self.coverage.add(self.plane.rest_grid(GRID_POINTS), rehearsal.probe, gap)
        rehearsal.organ_skin.update()
        now = array_of(rehearsal.organ_skin.vertices).astype(float)
        organ, probe = rehearsal.organ, rehearsal.probe
        pressed = measure_contact(
            rehearsal.pose, rehearsal.size_mm, probe.radius_mm, now, np.asarray(organ.vertices), organ.faces
        )
        self._squeezed.append(pressed.compression_mm)
        self._touching.append(float(touches.mean()))
        self._troubled.append(self._trouble)
        self._trouble = False

    def _parts(self, way: SweepPath) -> ScoreTerms:
        if not self._squeezed:
            return ScoreTerms.nothing()
        squeezed, limit = np.array(self._squeezed), self.rehearsal.scene.transducer.compression_warning_mm
        return ScoreTerms(
            seen=self.coverage.fraction(self.target),
            compression_mean_mm=float(squeezed.mean()),
            compression_max_mm=float(squeezed.max()),
            over_limit=float(((squeezed > limit) | self._troubled).mean()),
            contact=float(np.mean(self._touching)),
            incidence_deg=incidence_deg(self.rehearsal.manipulator, way.poses),
            path_mm=self._way_mm,
            time_s=self._steps_taken * self.rehearsal.settings.time_step_s,
            reachable=float(self.reach(way.poses).mean()),
        )
