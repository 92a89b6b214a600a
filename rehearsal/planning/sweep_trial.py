"""Trials of sweeps on the deforming organ, as the transducer would be driven: their score terms; in this
process or on workers, with the same results.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any
from uuid import uuid4

import numpy as np

from rehearsal.case import case_of
from rehearsal.planning.plan_file import DEG_PER_MM, LIFT_MM, LIFTED_MM_S, PlanError
from rehearsal.planning.sweep_path import LIFTS_MM, clear_of_organ, reachable, transfer
from rehearsal.planning.sweep_score import MEANS, ScoreTerms, TriedPass, face_centres, incidence_deg, path_mm
from rehearsal.rehearsal import Rehearsal
from rehearsal.worker_processes import Workers, built_once
from scenes.anatomy import LoadedAnatomy, fingerprint
from scenes.scene import Scene, Trocar
from ultrasound.array_contact import measure_contact
from ultrasound.coverage import GRID_POINTS, VOXEL_MM, Coverage
from ultrasound.plane_in_tissue import PlaneInTissue
from ultrasound.probe import Probe
from ultrasound.probe_manipulator import advanced, poses_between
from ultrasound.target import Target

# The most places of the target that are looked at in a search.
PLACES = 1500
# Passes of a search are tried at this speed, from so near above the first pose [mm].
TRIAL_MM_S, ABOVE_MM = 60.0, 2.0
# Poses from a file are rounded: an excess of this fraction of a step does not add a step.
ROUNDED_STEPS = 1e-3


@dataclass(frozen=True)
class PlanningProblem:
    """The target of a patient that a plan is to cover.

    Raises PlanError for a tumour target without a tumour.
    """

    scene: Scene
    anatomy: LoadedAnatomy
    probe: Probe
    target: Target
    margin_mm: float
    trocar: Trocar
    whole_fingerprint: str | None = None
    """Of the anatomy with all its images, where this one lacks them."""

    def __post_init__(self) -> None:
        if self.target != "organ" and self.anatomy.tumour is None:
            raise PlanError(
                f"--target {self.target}: this scene has no tumour; expected organ, or another scene"
            )

    @property
    def fingerprint(self) -> str:
        """Of the patient's anatomy with all its images."""
        return self.whole_fingerprint or fingerprint(self.anatomy)

    @property
    def without_images(self) -> "PlanningProblem":
        """The same without CT and labels, and without parts that have no material of their own, which no
        trial needs.
        """
        material = getattr(self.scene.tissue, "parts", {})
        parts = {name: part for name, part in self.anatomy.parts.items() if name in material}
        bare = replace(self.anatomy, ct=None, labels=None, parts=parts)
        return replace(self, anatomy=bare, whole_fingerprint=self.fingerprint)


class Trial:
    """Tries sweeps and single passes in one rehearsal, each from the settled organ. Raises PlanError.

    ``places`` (n, 3) are the target's voxels, ``sampled_places`` (p, 3) those that a search looks at.
    """

    def __init__(self, problem: PlanningProblem) -> None:
        self.case = case_of(problem.scene, problem.anatomy, problem.probe)
        self.rehearsal = Rehearsal(self.case, problem.anatomy)
        self.manipulator = self.rehearsal.manipulator
        self.target = problem.target
        self.coverage = Coverage(self.case.organ, self.case.tumour, problem.margin_mm)
        self.places = self.coverage.voxel_centres(self.target)
        if len(self.places) == 0:
            raise PlanError(
                f"--target {self.target}: it is smaller than a voxel of {VOXEL_MM:g} mm; expected a larger "
                "one"
            )
        self._sampled = slice(None, None, -(-len(self.places) // PLACES))
        self.sampled_places = self.places[self._sampled]
        held = self.manipulator, self.case.origin, self.places.mean(axis=0)
        self.reach = partial(reachable, problem.trocar, *held)
        self.plane = PlaneInTissue(self.rehearsal.anatomy.embedding, GRID_POINTS)

    def run(self, passes: list[np.ndarray], speed_mm_s: float) -> ScoreTerms:
        """Follow a path at a speed on its passes; deterministic."""
        self.begin(speed_mm_s)
        for poses, way in zip(passes, [None, *self.transfers(passes)], strict=False):
            self._approach(poses[0], way)
            self._follow(poses)
        return self.so_far(passes)

    def so_far(self, passes: list[np.ndarray]) -> ScoreTerms:
        """The terms of the measurements since the begin, at the poses of these passes."""
        return self.terms(
            passes,
            *self._measured(),
            seen=self.coverage.fraction(self.target),
            path_mm=self._path_mm,
            time_s=self._steps_taken * self.rehearsal.organ.settings.time_step_s,
        )

    def terms(
        self,
        passes: list[np.ndarray],
        compression_mm: Sequence[float],
        contact: Sequence[float],
        restored: np.ndarray | bool = False,
        **others: float,
    ) -> ScoreTerms:
        """The terms of a path, from the compression and contact at each of its poses and whether a state
        was restored before it.
        """
        if not passes:
            return ScoreTerms()
        compression, poses = np.array(compression_mm), np.concatenate(passes)
        limit = self.case.scene.transducer.compression_warning_mm
        return ScoreTerms(
            compression_mean_mm=float(compression.mean()),
            compression_max_mm=float(compression.max()),
            over_limit=float(((compression > limit) | restored).mean()),
            contact=float(np.mean(contact)),
            incidence_deg=incidence_deg(self.manipulator, poses),
            reachable=float(self.held(passes).mean()),
            **others,
        )

    def try_pass(self, parameters: np.ndarray, poses: np.ndarray) -> TriedPass:
        """Follow one pass (n, 4, 4) from close above its first pose; deterministic."""
        self.begin(TRIAL_MM_S)
        self.rehearsal.organ.place(advanced(poses[0], -ABOVE_MM))
        self.move(self.rehearsal.organ.pose, poses[0])
        self._follow(poses)
        seen = self.coverage.seen[self.coverage.targets[self.target]][self._sampled]
        return self.tried(parameters, poses, seen, *self._measured())

    def tried(
        self,
        parameters: np.ndarray,
        poses: np.ndarray,
        seen: np.ndarray,
        compression_mm: Sequence[float],
        contact: Sequence[float],
        restored: np.ndarray | bool = False,
    ) -> TriedPass:
        """A pass with what it has ``seen`` (p,), and the compression and contact at each of its poses."""
        terms = self.terms([poses], compression_mm, contact, restored)
        sums = len(poses) * np.array([getattr(terms, name) for name in MEANS])
        return TriedPass(parameters, seen, sums, len(poses), path_mm(self.manipulator, poses))

    def transfers(self, passes: list[np.ndarray]) -> list[np.ndarray]:
        """The poses (n, 4, 4) from each pass to the next."""
        return [transfer(self.manipulator, one[-1], other[0]) for one, other in pairwise(passes)]

    def held(self, passes: list[np.ndarray]) -> np.ndarray:
        """Whether the instrument can hold each pose; and whether the probe can be lifted off the organ
        from both ends of each pass.
        """
        # In a hollow of the organ it would meet another part of it.
        lifted = [advanced(pose, -lift) for poses in passes for pose in poses[[0, -1]] for lift in LIFTS_MM]
        clear = clear_of_organ(self.manipulator, np.array(lifted))
        return np.concatenate([self.reach(np.concatenate(passes)), clear])

    def begin(self, speed_mm_s: float) -> None:
        """Begin anew: the organ settled, nothing measured."""
        self.rehearsal.reset()
        self.coverage.clear()
        self._compressions: list[float] = []
        self._contacts: list[float] = []
        self._restored: list[bool] = []
        self._was_restored = False
        self._path_mm, self._steps_taken, self._speed_mm_s = 0.0, 0, speed_mm_s

    def _measured(self) -> tuple[list[float], list[float], np.ndarray]:
        """Compression [mm] and contact at each pose, and whether a state was restored before it (n,)."""
        return self._compressions, self._contacts, np.array(self._restored)

    def _follow(self, poses: np.ndarray) -> None:
        """From the first pose, where the probe is, to the last, with measurements at each."""
        self.measure()
        for start, end in pairwise(poses):
            self.move(start, end)
            self.measure()

    def _approach(self, pose: np.ndarray, way: np.ndarray | None) -> None:
        """Lower the probe to a pose, after its way from another pass, if there was one."""
        if way is None:
            self.rehearsal.organ.place(advanced(pose, -LIFT_MM))
        else:
            for goal in way:
                self.move(self.rehearsal.organ.pose, goal, LIFTED_MM_S)
        self.move(self.rehearsal.organ.pose, pose)

    def move(self, start: np.ndarray, end: np.ndarray, speed_mm_s: float | None = None) -> None:
        """Move the probe at a speed, the trial's by default."""
        for pose in poses_between(start, end, self._steps(start, end, speed_mm_s or self._speed_mm_s))[1:]:
            self._step(pose)

    def _step(self, pose: np.ndarray) -> None:
        self._path_mm += self._distance_mm(self.rehearsal.organ.hand, pose)
        self.rehearsal.advance(pose)
        self._was_restored |= bool(self.rehearsal.organ.notice)
        self._steps_taken += 1

    def _distance_mm(self, start: np.ndarray, end: np.ndarray) -> float:
        start_face, end_face = face_centres(self.manipulator, np.stack([start, end]))
        return float(np.linalg.norm(end_face - start_face))

    def _steps(self, start: np.ndarray, end: np.ndarray, speed_mm_s: float) -> int:
        cosine = (np.einsum("ij,ij->", start[:3, :3], end[:3, :3]) - 1) / 2
        angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
        path_mm = max(self._distance_mm(start, end), angle / DEG_PER_MM)
        steps = path_mm / (speed_mm_s * self.rehearsal.organ.settings.time_step_s)
        return max(1, int(np.ceil(steps - ROUNDED_STEPS)))

    def measure(self) -> None:
        """Measure compression, contact and coverage at the present pose."""
        self.rehearsal.show()
        anatomy, organ, probe = self.rehearsal.anatomy, self.case.organ, self.case.probe
        anatomy.embedding.update()
        self.plane.locate(anatomy.image_plane())
        gap = self.case.scene.image.coupling_gap_mm
        touches = self.coverage.add(self.plane.rest_grid(GRID_POINTS), probe, gap)
        size_mm, now = self.case.size_mm, anatomy.vertices
        pressed = measure_contact(
            anatomy.pose, size_mm, probe.radius_mm, now, np.asarray(organ.vertices), organ.faces
        )
        self._compressions.append(pressed.compression_mm)
        self._contacts.append(float(touches.mean()))
        self._restored.append(self._was_restored)
        self._was_restored = False


class TrialWorkers:
    """Workers with a trial of one problem each."""

    def __init__(self, problem: PlanningProblem, workers: Workers) -> None:
        self.problem, self._workers = problem, workers
        self._key, self._sent = uuid4().hex, workers.share(problem.without_images)

    def map(self, function: Callable, tasks: Sequence[tuple]) -> Iterator[Any]:
        """The results of ``function(trial, *task)`` in the order of the tasks, each as soon as it is there.

        Raises WorkerError.
        """
        return self._workers.map(_call, ((self._key, self._sent, function, *task) for task in tasks))


class TrialHere:
    """The one trial of this process."""

    def __init__(self, problem: PlanningProblem, trial: Trial) -> None:
        self.problem, self._trial = problem, trial

    def map(self, function: Callable, tasks: Sequence[tuple]) -> Iterator[Any]:
        """As ``TrialWorkers.map``."""
        return (function(self._trial, *task) for task in tasks)


Trials = TrialWorkers | TrialHere


def _call(key: str, problem: PlanningProblem, function: Callable, *task: object) -> Any:
    return function(built_once(key, lambda: Trial(problem)), *task)
