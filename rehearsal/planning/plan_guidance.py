"""Guidance along a plan: the next pose of its sweep, the completed fraction, and the deviation from it."""

from typing import NamedTuple

import numpy as np

from rehearsal.case import Case
from rehearsal.loop.frame import Frame
from rehearsal.planning.guidance_words import NextPose, Side, completed_in_words, next_pose_in_words
from rehearsal.planning.plan_file import Plan, PlannedSweep
from rehearsal.planning.pose_distance import (
    DEG_PER_MM_OFF,
    DegreeOfFreedom,
    arrows_between,
    freedom_distances,
)
from rehearsal.planning.sweep_score import face_centres
from render.viewer import Guidance
from ultrasound.probe_manipulator import ProbeManipulator, advanced, indentation

# A probe farther than NEAR_MM from the sweep does not follow it; within REACHED_MM a pose is reached.
NEAR_MM, REACHED_MM = 6.0, 1.0
# Another degree of freedom is named where it exceeds the one that was named by this factor.
STEADY = 1.5
# How many poses ahead of the next one are compared with the probe.
AHEAD = 6
# The path is drawn this far above the organ.
ABOVE_MM = 1.5


class _Progress(NamedTuple):
    """How far a sweep was followed.

    ``next`` is the index of the next pose. Of each pose, ``deviation`` (n, 2) is the least so far [mm,
    degrees], and ``combined_mm`` (n,) is both together.
    """

    next: int
    deviation: np.ndarray
    combined_mm: np.ndarray


class PlanGuidance:
    """Guides along one sweep of a plan.

    ``number`` is the index of the sweep; one past the last shows none.
    """

    def __init__(self, case: Case, manipulator: ProbeManipulator, plan: Plan, number: int = 0) -> None:
        self.case, self.manipulator, self.plan, self.number = case, manipulator, plan, number
        self.restart()

    def restart(self) -> None:
        """Begin the sweep anew."""
        passes = passes_in(self.case, self.plan.sweeps[self.number]) if self._is_shown else []
        self._poses = np.concatenate([np.zeros((0, 4, 4)), *passes])
        count = len(self._poses)
        self._progress = _Progress(0, np.zeros((count, 2)), np.full(count, np.inf))
        self._pose: np.ndarray | None = None
        self._named: DegreeOfFreedom | None = None
        self._progress_at: dict[int, _Progress] = {}
        drawn = np.array([self._above(pose) for pose in self._poses]).reshape(-1, 3)
        # Each segment ends at a pose that is not the first of its pass.
        firsts = np.cumsum([0, *map(len, passes)])
        self._segment_ends = np.setdiff1d(np.arange(count), firsts)
        self._segments = np.stack([drawn[self._segment_ends - 1], drawn[self._segment_ends]], axis=1)

    @property
    def _is_shown(self) -> bool:
        return self.number < len(self.plan.sweeps)

    @property
    def next_pose(self) -> int:
        """The index of the next pose."""
        return self._progress.next

    def _above(self, pose: np.ndarray) -> np.ndarray:
        """The centre (3,) of the array face, moved out above the settled organ."""
        manipulator = self.manipulator
        depth = indentation(pose, manipulator.size_mm, manipulator.samples, manipulator.radius_mm)
        return face_centres(manipulator, advanced(pose, -max(depth, 0.0) - ABOVE_MM)[None])[0]

    def next_sweep(self) -> str:
        """Show the plan's next sweep, after the last one none; return its title."""
        self.number = (self.number + 1) % (len(self.plan.sweeps) + 1)
        self.restart()
        return self.title()

    def title(self) -> str:
        """The sweep that is shown, for the user."""
        if not self._is_shown:
            return "Plan hidden"
        sweep = self.plan.sweeps[self.number]
        return f"Plan {self.number + 1}: {sweep.name}, covers {100 * sweep.coverage:.0f} %"

    def observe(self, frame: Frame) -> None:
        """Take a frame's pose; after an undo or a redo, restore the progress of that state."""
        known = dict.fromkeys(frame.kept, self._progress) | self._progress_at
        for number in frame.restored:
            self._progress = known.get(number, self._progress)
        self._progress_at = {number: known[number] for number in frame.kept}
        self.follow(frame.pose)

    def follow(self, pose: np.ndarray) -> None:
        """Take the transducer's pose (4, 4)."""
        self._pose = pose
        at, deviation, combined = self._progress
        first = max(at - AHEAD, 0)
        now = self._deviation(pose, self._poses[first : at + AHEAD])
        now_mm = now[:, 0] + now[:, 1] / DEG_PER_MM_OFF
        closer = first + np.flatnonzero(now_mm < combined[first : at + AHEAD])
        # The kept progress refers to the old arrays.
        deviation, combined = deviation.copy(), combined.copy()
        deviation[closer], combined[closer] = now[closer - first], now_mm[closer - first]
        ahead = now_mm[at - first :]
        if len(ahead) and ahead.min() <= NEAR_MM:
            nearest = at + int(np.argmin(ahead))
            is_at_end = nearest == first + int(np.argmin(now_mm)) == len(self._poses) - 1
            at = nearest + int(is_at_end or ahead.min() <= REACHED_MM)
        self._progress = _Progress(at, deviation, combined)

    def _deviation(self, pose: np.ndarray, others: np.ndarray) -> np.ndarray:
        """The distances of a pose from others (n, 4, 4), (n, 2): of the centre of the array face [mm], and
        angular [degrees].
        """
        manipulator = self.manipulator
        away = np.linalg.norm(
            face_centres(manipulator, others) - face_centres(manipulator, pose[None]), axis=1
        )
        cosine = (np.einsum("nij,ij->n", others[:, :3, :3], pose[:3, :3]) - 1) / 2
        return np.column_stack([away, np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))])

    def figures(self) -> dict[str, float | None]:
        """The completed fraction of the sweep, 0 to 1, and the mean deviation over the completed poses;
        empty where none is shown.
        """
        if not self._is_shown:
            return {}
        followed = self.next_pose / len(self._poses) if len(self._poses) else 0.0
        off_mm, off_deg = None, None
        if self.next_pose > 0:
            off_mm, off_deg = map(float, self._progress.deviation[: self.next_pose].mean(axis=0))
        return dict(plan_followed=followed, plan_off_mm=off_mm, plan_off_deg=off_deg)

    def guidance(self, has_arrows: bool = True) -> Guidance | None:
        """For the 3D view; None where no sweep is shown."""
        if not self._is_shown:
            return None
        goal, arrows = self._goal, tuple[np.ndarray, ...]()
        if has_arrows and goal is not None and self._pose is not None:
            arrows = arrows_between(self.manipulator, self._pose, goal)
        return Guidance(goal, self._segments, self._segment_ends < self.next_pose, arrows)

    @property
    def _goal(self) -> np.ndarray | None:
        return self._poses[self.next_pose] if self.next_pose < len(self._poses) else None

    def next_in_words(self, side: Side | None, has_keys: bool) -> str:
        """What leads to the next pose, as ``next_pose_in_words``; empty where no sweep is shown."""
        if not self._is_shown:
            return ""
        number, count, goal = self.next_pose, len(self._poses), self._goal
        if goal is None:
            return completed_in_words(count)
        if self._pose is None:
            return ""
        distances = freedom_distances(self.manipulator, self._pose, goal)
        largest = max(distances, key=lambda one: one.weight_mm)
        # Words that change with each frame cannot be read.
        before = [one for one in distances if one.freedom == self._named]
        named = next((one for one in before if STEADY * one.weight_mm > largest.weight_mm), largest)
        self._named = named.freedom
        has_reached = number > 0 and bool(self._progress.combined_mm[number - 1] <= REACHED_MM)
        return next_pose_in_words(NextPose(number + 1, count, has_reached, distances, named), side, has_keys)

    def in_words(self, coverage: float | None) -> str:
        """A line for the terminal, with the coverage of the target that was reached; empty where no sweep
        is shown.
        """
        if not self._is_shown:
            return ""
        sweep, figures = self.plan.sweeps[self.number], self.figures()
        text = f"plan      {sweep.name}: {100 * (figures['plan_followed'] or 0.0):.0f} % completed"
        if figures["plan_off_mm"] is not None:
            text += (
                f", mean deviation {figures['plan_off_mm']:.1f} mm and {figures['plan_off_deg']:.0f} degrees"
            )
        if coverage is not None:
            text += (
                f"; coverage of {self.plan.target} {100 * coverage:.0f} % (planned "
                f"{100 * sweep.coverage:.0f} %)"
            )
        return text


def passes_in(case: Case, sweep: PlannedSweep) -> list[np.ndarray]:
    """The transducer's poses (n, 4, 4) of a case, on each pass of a sweep."""
    return [np.stack([case.transducer_at(pose) for pose in poses]) for poses in sweep.poses()]
