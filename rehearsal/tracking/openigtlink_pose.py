"""Where a client holds the probe: the poses that come in over the link."""

from collections.abc import Callable
from time import monotonic

import numpy as np

from rehearsal.tracking.openigtlink_messages import RAS_FROM_LPS

# Not ProbeToReference: that is sent out, and a program that has both would take one for the other.
HAND = "HandToReference"
STALE_S = 1.0
# A float32's rounding, and a tracker's, leave less; a scaled or sheared matrix more.
SQUARE = 1e-3
REACH_MM = 10_000.0


class HandPose:
    """The newest pose of a probe that a client sent as HandToReference; safe to be fed by one thread and read by another."""

    def __init__(self, say: Callable[[str], None], clock: Callable[[], float] = monotonic) -> None:
        self._say, self._clock = say, clock
        self._newest: tuple[np.ndarray, float] | None = None
        self._has_refused = False

    def pose(self) -> np.ndarray | None:
        """The probe in the patient (4, 4) [mm, LPS], in PLUS's axes.

        None before the first, when the last came more than ``STALE_S`` ago, and when it was no rigid one.
        """
        newest = self._newest
        if newest is None or self._clock() - newest[1] > STALE_S:
            return None
        return newest[0]

    def take(self, name: str, matrix: np.ndarray | None) -> None:
        """Note a message's matrix (4, 4) [mm, RAS], where it is this hand's."""
        if name != HAND or matrix is None:
            return
        if is_rigid(matrix):
            self._newest = _squared(RAS_FROM_LPS @ matrix), self._clock()
            return
        self._newest = None
        if not self._has_refused:
            self._has_refused = True
            self._say(
                f"Mind: {HAND} of the link is no rigid transform within {REACH_MM / 1000:.0f} m: it is not followed; send a rotation "
                "and a shift in mm"
            )


def is_rigid(matrix: np.ndarray) -> bool:
    """Whether a matrix (4, 4) is a rotation, not mirrored, and a shift that a patient's room has space for."""
    if not np.isfinite(matrix).all() or np.abs(matrix[:3, 3]).max() > REACH_MM:
        return False
    axes = matrix[:3, :3]
    return bool(np.abs(axes.T @ axes - np.eye(3)).max() < SQUARE and np.linalg.det(axes) > 0)


def _squared(pose: np.ndarray) -> np.ndarray:
    """A pose with the nearest axes that are at right angles: what follows turns by its inverse."""
    u, _, v = np.linalg.svd(pose[:3, :3])
    squared = pose.copy()
    squared[:3, :3] = u @ v
    return squared
