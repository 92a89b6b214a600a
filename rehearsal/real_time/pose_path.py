"""The transducer's motion between two inputs: steps follow it continuously, though inputs come only with
each picture.
"""

import numpy as np

from ultrasound.probe_manipulator import interpolated

# The transducer is taken to be at most this far behind its input [s].
LONGEST_S = 0.25
# The transducer moves at most this much faster than the input did, when steps are behind it.
CATCH_UP = 1.25
# Sums of lengths are rounded by less than this share.
ROUNDING = 1e-9


class PosePath:
    """The path from the present pose (4, 4) to that of the newest input. It takes as long as the input took
    to get there, so that the speed is the input's, or a time that ``arrive_in`` sets.

    ``input_s`` is the time at which the input had the present pose, and ``has_news`` whether no step was made
    since the newest input.
    """

    def __init__(self, pose: np.ndarray, input_s: float = 0.0) -> None:
        self.stay(pose, input_s)

    def stay(self, pose: np.ndarray, input_s: float) -> None:
        """Stay at a pose."""
        self.pose = self._goal = pose
        self.input_s = self._goal_s = input_s
        self._left_s, self.has_news = 0.0, False

    def go_to(self, goal: np.ndarray, input_s: float, took_s: float) -> None:
        """Move to the pose of an input, from now on; the input took a time [s] to get there."""
        behind_s = min(input_s - self.input_s, LONGEST_S)
        self._goal, self._goal_s = goal, input_s
        self._left_s, self.has_news = max(took_s, behind_s / CATCH_UP), True

    def arrive_in(self, left_s: float) -> None:
        """Be at the input's pose after a time [s]."""
        self._left_s = left_s

    def pose_after(self, length_s: float) -> np.ndarray:
        """The pose (4, 4) after a step of a length [s]; at the goal it stays."""
        arrives = length_s >= self._left_s * (1.0 - ROUNDING)
        share = 1.0 if arrives else length_s / self._left_s
        self.pose = self._goal if arrives else interpolated(self.pose, self._goal, share)
        self.input_s += share * (self._goal_s - self.input_s)
        self._left_s, self.has_news = 0.0 if arrives else self._left_s - length_s, False
        return self.pose
