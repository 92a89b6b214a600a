"""A tracked probe that leads the transducer: a tracker's newest pose, or those of a file at the rehearsal's time."""

from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from rehearsal.coordinates import transducer_at
from rehearsal.rehearsal import Rehearsal
from rehearsal.sessions.session import Session
from rehearsal.tracking.pose_file import TimedPoses
from ultrasound.probe_manipulator import interpolated

# A probe that is held still moves no farther than this: a hand's tremor, and a tracker's noise.
STILL_MM, STILL_DEG = 3.0, 3.0


class TrackOver(Exception):
    """There will be no more poses; the message is for the user."""


class Tracked(Protocol):
    """Whatever knows where a probe is."""

    def pose(self) -> np.ndarray | None:
        """The probe's newest pose in the patient (4, 4), in PLUS's axes (LPS, mm); None where it is not known now.

        May raise TrackOver.
        """
        ...


class PlayedPoses:
    """Poses of a file as a tracker would give them, by the simulated time of a session."""

    def __init__(self, poses: TimedPoses, session: Session) -> None:
        self.poses, self.session = poses, session

    def pose(self) -> np.ndarray | None:
        # A sum of steps is not to miss the last pose by rounding.
        if self.session.time_s > self.poses.length_s + 1e-9:
            raise TrackOver("The tracked file is over: yours now")
        return pose_at_time(self.poses, self.session.time_s)


def pose_at_time(poses: TimedPoses, time_s: float) -> np.ndarray | None:
    """The pose (4, 4) so long after the first, between two in position and angle; None where one of the two was not seen."""
    times, last = poses.times_s - poses.times_s[0], len(poses.times_s) - 1
    after = min(int(np.searchsorted(times, time_s)), last)
    end = poses.poses[after]
    if after == 0 or time_s >= times[after]:
        return end
    start = poses.poses[after - 1]
    if start is None or end is None:
        return None
    return interpolated(start, end, float((time_s - times[after - 1]) / (times[after] - times[after - 1])))


class Follower:
    """Makes goals for the transducer of where a probe is tracked; ``is_lost`` while that is not known."""

    def __init__(self, tracked: Tracked, rehearsal: Rehearsal) -> None:
        self.tracked, self.rehearsal = tracked, rehearsal
        self.is_lost = False
        self._waits = False
        self._since: np.ndarray | None = None

    def wait(self) -> None:
        """Stay from now on until the tracked probe moves."""
        self._waits, self._since = True, None

    def goal(self) -> np.ndarray | None:
        """The pose (4, 4) that the transducer is to go to, None where it stays. May raise TrackOver."""
        pose = self.tracked.pose()
        self.is_lost = pose is None
        if pose is None or self._is_waiting(pose):
            return None
        return transducer_at(self.rehearsal, pose)

    def _is_waiting(self, pose: np.ndarray) -> bool:
        if self._waits:
            self._since = pose if self._since is None else self._since
            self._waits = not has_moved(self._since, pose)
        return self._waits


def has_moved(before: np.ndarray, now: np.ndarray) -> bool:
    """Whether a pose is another, and not only by tremor and noise."""
    turn = Rotation.from_matrix(now[:3, :3] @ before[:3, :3].T).magnitude()
    return bool(np.linalg.norm(now[:3, 3] - before[:3, 3]) > STILL_MM or np.degrees(turn) > STILL_DEG)
