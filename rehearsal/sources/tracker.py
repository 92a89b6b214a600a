"""A tracked probe moves the transducer: the newest pose of a tracker, or the poses of a file at the
rehearsal's time.
"""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from rehearsal.case import Case
from rehearsal.tracking.pose_file import TimedPoses

# A resting probe moves less than this: tremor of a hand, and noise of a tracker.
STILL_MM, STILL_DEG = 3.0, 3.0
# Gives the probe's pose in the patient (4, 4), in PLUS's axes (LPS, mm), at a time [s] of the session; None
# while it is not tracked.
# May raise TrackEnded.
PoseSource = Callable[[float], np.ndarray | None]


class TrackEnded(Exception):
    """There are no more poses; the message is for the user."""


def played_pose(poses: TimedPoses, time_s: float) -> np.ndarray | None:
    """The pose of a file at a time [s]: a ``PoseSource``."""
    # The time is a sum of steps: its rounding must not skip the last pose.
    if time_s > poses.length_s + 1e-9:
        raise TrackEnded("End of the tracked file: mouse and keys control the probe")
    return poses.at(time_s)


class Tracker:
    """Goals for the transducer from a tracked probe; ``is_lost`` while it is not tracked."""

    def __init__(self, tracked: PoseSource, case: Case) -> None:
        self.tracked, self.case = tracked, case
        self.is_lost = False
        self._waits = False
        self._resting_pose: np.ndarray | None = None

    def wait(self) -> None:
        """Give no goals until the tracked probe moves."""
        self._waits, self._resting_pose = True, None

    def goal(self, time_s: float) -> np.ndarray | None:
        """The transducer's next goal (4, 4) at a time [s] of the session; None to stay.

        May raise TrackEnded.
        """
        pose = self.tracked(time_s)
        self.is_lost = pose is None
        if pose is None:
            return None
        if self._waits:
            self._resting_pose = pose if self._resting_pose is None else self._resting_pose
            self._waits = not has_moved(self._resting_pose, pose)
        return None if self._waits else self.case.transducer_at(pose)


def has_moved(before: np.ndarray, now: np.ndarray) -> bool:
    """Whether two poses differ by more than tremor and noise."""
    turn = Rotation.from_matrix(now[:3, :3] @ before[:3, :3].T).magnitude()
    return bool(np.linalg.norm(now[:3, 3] - before[:3, 3]) > STILL_MM or np.degrees(turn) > STILL_DEG)
