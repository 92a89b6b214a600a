"""A plan's sweep as poses to follow: the transducer's in a rehearsal, and a tracked probe's with their times, for a machine."""

from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from rehearsal.coordinates import transducer_at
from rehearsal.planning.plan_file import PlannedSweep
from rehearsal.rehearsal import Rehearsal
from rehearsal.tracking.pose_file import TimedPoses

# Between two passes the probe is backed out so far, and goes so fast.
LIFT_MM, LIFTED_MM_S = 6.0, 60.0
# So long the probe has to come over the first pose, from wherever it was.
COMES_S = 1.0
# A turn by so many degrees takes as long as a way of one millimetre.
DEG_A_MM = 1.5


def passes_in(rehearsal: Rehearsal, sweep: PlannedSweep) -> list[np.ndarray]:
    """The transducer's poses (n, 4, 4) on each pass of a sweep."""
    return [np.stack([transducer_at(rehearsal, pose) for pose in each]) for each in sweep.poses()]


def timed_poses(sweep: PlannedSweep, speed_mm_s: float) -> TimedPoses:
    """The sweep from a wait above its first pose, at a speed on its passes, lifted between them."""
    poses: list[np.ndarray] = []
    speeds: list[float] = []
    for each in sweep.poses():
        poses += [lifted(each[0]), *each, lifted(each[-1])]
        speeds += [LIFTED_MM_S, speed_mm_s, *(speed_mm_s for _ in each[1:]), LIFTED_MM_S]
    lasts = [_length_mm(a, b) / speed for (a, b), speed in zip(pairwise(poses), speeds[1:], strict=True)]
    return TimedPoses(np.cumsum([0.0, COMES_S, *lasts]), [poses[0], *poses])


def lifted(pose: np.ndarray) -> np.ndarray:
    """A probe's pose in the patient (4, 4), in PLUS's axes, backed out along its own axis."""
    above = pose.copy()
    above[:3, 3] -= LIFT_MM * pose[:3, 1]
    return above


def _length_mm(start: np.ndarray, end: np.ndarray) -> float:
    """How long a way is, turns counted as a way too; never nothing, for time must go on."""
    turn = np.degrees(Rotation.from_matrix(end[:3, :3] @ start[:3, :3].T).magnitude())
    return max(float(np.linalg.norm(end[:3, 3] - start[:3, 3])), float(turn) / DEG_A_MM, 1e-3)
