"""A sweep tried on the deforming organ, without a screen: its score terms."""

from itertools import pairwise

import numpy as np

from rehearsal.planning.instrument_reach import InstrumentReach
from rehearsal.planning.plan_file import DEG_PER_MM, LIFT_MM
from rehearsal.planning.sweep_path import SweepPath
from rehearsal.planning.sweep_score import ScoreTerms, face_centres, incidence_deg
from rehearsal.rehearsal import Rehearsal
from sim.fields import array_of
from ultrasound.array_contact import measure_contact
from ultrasound.coverage import GRID_POINTS, Coverage
from ultrasound.probe_manipulator import advanced, poses_between
from ultrasound.scanner import PlaneInTissue

# The most steps of a move between passes.
MOST_STEPS = 240
# Poses from a file are rounded: an excess of this fraction of a step does not add a step.
ROUNDED_STEPS = 1e-3


class Trial:
    """Tries paths in one rehearsal, each from the settled organ; ``target`` is one of ``Coverage.targets``."""

    def __init__(self, rehearsal: Rehearsal, coverage: Coverage, target: str, reach: InstrumentReach) -> None:
        self.rehearsal, self.coverage, self.target, self.reach = rehearsal, coverage, target, reach
        self.plane = PlaneInTissue(rehearsal.embedding, GRID_POINTS)

    def run(self, path: SweepPath, speed_mm_s: float) -> ScoreTerms:
        """Follow a path at a speed on its passes; deterministic."""
        self._restart()
        self._speed_mm_s = speed_mm_s
        for poses in path.passes:
            self._approach(poses[0])
            self._measure()
            for start, end in pairwise(poses):
                self._move(start, end)
                self._measure()
        return self._terms(path)

    def _restart(self) -> None:
        self.rehearsal.reset()
        self.coverage.clear()
        self._compressions: list[float] = []
        self._contacts: list[float] = []
        self._restored: list[bool] = []
        self._was_restored = False
        self._path_mm, self._steps_taken = 0.0, 0

    def _approach(self, pose: np.ndarray) -> None:
        """Lift the probe, move it above a pose, and lower it there."""
        if self._steps_taken == 0:
            self.rehearsal.pose = advanced(pose, -LIFT_MM)
        else:
            for goal in (advanced(self.rehearsal.pose, -LIFT_MM), advanced(pose, -LIFT_MM)):
                self._go_around_organ(goal)
        self._move(self.rehearsal.pose, pose)

    def _go_around_organ(self, goal: np.ndarray) -> None:
        """Move to a goal as the probe manipulator does."""
        for _ in range(MOST_STEPS):
            if np.allclose(self.rehearsal.pose, goal, atol=1e-6):
                return
            self._step(self.rehearsal.pose_towards(goal))

    def _move(self, start: np.ndarray, end: np.ndarray) -> None:
        for pose in poses_between(start, end, self._steps(start, end))[1:]:
            self._step(pose)

    def _step(self, pose: np.ndarray) -> None:
        self._path_mm += self._distance_mm(self.rehearsal.pose, pose)
        self.rehearsal.advance(pose)
        self._was_restored |= bool(self.rehearsal.notice)
        self._steps_taken += 1

    def _distance_mm(self, start: np.ndarray, end: np.ndarray) -> float:
        start_face, end_face = face_centres(self.rehearsal.manipulator, np.stack([start, end]))
        return float(np.linalg.norm(end_face - start_face))

    def _steps(self, start: np.ndarray, end: np.ndarray) -> int:
        cosine = (np.einsum("ij,ij->", start[:3, :3], end[:3, :3]) - 1) / 2
        angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
        path_mm = max(self._distance_mm(start, end), angle / DEG_PER_MM)
        steps = path_mm / (self._speed_mm_s * self.rehearsal.settings.time_step_s)
        return max(1, int(np.ceil(steps - ROUNDED_STEPS)))

    def _measure(self) -> None:
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
        self._compressions.append(pressed.compression_mm)
        self._contacts.append(float(touches.mean()))
        self._restored.append(self._was_restored)
        self._was_restored = False

    def _terms(self, path: SweepPath) -> ScoreTerms:
        if not self._compressions:
            return ScoreTerms.zero()
        compression = np.array(self._compressions)
        limit = self.rehearsal.scene.transducer.compression_warning_mm
        return ScoreTerms(
            seen=self.coverage.fraction(self.target),
            compression_mean_mm=float(compression.mean()),
            compression_max_mm=float(compression.max()),
            over_limit=float(((compression > limit) | self._restored).mean()),
            contact=float(np.mean(self._contacts)),
            incidence_deg=incidence_deg(self.rehearsal.manipulator, path.poses),
            path_mm=self._path_mm,
            time_s=self._steps_taken * self.rehearsal.settings.time_step_s,
            reachable=float(self.reach(path.poses).mean()),
        )
