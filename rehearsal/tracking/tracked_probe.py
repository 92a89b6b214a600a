"""A tracked probe as input: the newest pose of a tracker, or the poses of a file at the rehearsal's time."""

from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from rehearsal.coordinates import transducer_at
from rehearsal.rehearsal import Rehearsal
from rehearsal.sessions.session import Session
from rehearsal.tracking.pose_file import TimedPoses
from ultrasound.probe_manipulator import interpolated

# A resting probe moves less than this: tremor of a hand, and noise of a tracker.
STILL_MM, STILL_DEG = 3.0, 3.0


class TrackEnded(Exception):
    """There are no more poses; the message is for the user."""


class PoseSource(Protocol):
    """Gives the pose of a probe."""

    def pose(self) -> np.ndarray | None:
        """The probe's newest pose in the patient (4, 4), in PLUS's axes (LPS, mm); None while it is not tracked.

        May raise TrackEnded.
        """
        ...


class PosePlayback:
    """The poses of a file, at the simulated time of a session."""

    def __init__(self, poses: TimedPoses, session: Session) -> None:
        self.poses, self.session = poses, session

    def pose(self) -> np.ndarray | None:
        # The time is a sum of steps: its rounding must not skip the last pose.
        if self.session.time_s > self.poses.length_s + 1e-9:
            raise TrackEnded("End of the tracked file: mouse and keys control the probe")
        return pose_at_time(self.poses, self.session.time_s)


def pose_at_time(poses: TimedPoses, time_s: float) -> np.ndarray | None:
    """The pose (4, 4) at a time after the first, interpolated between two; None where one of the two was not tracked."""
    times, last = poses.times_s - poses.times_s[0], len(poses.times_s) - 1
    after = min(int(np.searchsorted(times, time_s)), last)
    end = poses.poses[after]
    if after == 0 or time_s >= times[after]:
        return end
    start = poses.poses[after - 1]
    if start is None or end is None:
        return None
    return interpolated(start, end, float((time_s - times[after - 1]) / (times[after] - times[after - 1])))


class TrackingInput:
    """Goals for the transducer from a tracked probe; ``is_lost`` while it is not tracked."""

    def __init__(self, tracked: PoseSource, rehearsal: Rehearsal) -> None:
        self.tracked, self.rehearsal = tracked, rehearsal
        self.is_lost = False
        self._waits = False
        self._resting_pose: np.ndarray | None = None

    def wait(self) -> None:
        """Give no goals until the tracked probe moves."""
        self._waits, self._resting_pose = True, None

    def goal(self) -> np.ndarray | None:
        """The transducer's next goal (4, 4); None to stay. May raise TrackEnded."""
        pose = self.tracked.pose()
        self.is_lost = pose is None
        if pose is None or self._is_waiting(pose):
            return None
        return transducer_at(self.rehearsal, pose)

    def _is_waiting(self, pose: np.ndarray) -> bool:
        if self._waits:
            self._resting_pose = pose if self._resting_pose is None else self._resting_pose
            self._waits = not has_moved(self._resting_pose, pose)
        return self._waits


def has_moved(before: np.ndarray, now: np.ndarray) -> bool:
    """Whether two poses differ by more than tremor and noise."""
    turn = Rotation.from_matrix(now[:3, :3] @ before[:3, :3].T).magnitude()
    return bool(np.linalg.norm(now[:3, 3] - before[:3, 3]) > STILL_MM or np.degrees(turn) > STILL_DEG)
