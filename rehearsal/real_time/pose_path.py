"""The transducer's motion between two inputs: steps follow it continuously, though inputs come only with each picture."""

import numpy as np

from ultrasound.probe_manipulator import interpolated

# The transducer is taken to be at most this far behind its input [s].
LONGEST_S = 0.25
# The transducer moves at most this much faster than the input did, when steps are behind it.
CATCH_UP = 1.25


class PosePath:
    """The path from the present pose (4, 4) to that of the newest input. It takes as long as the input took to get there, so that the
    speed is the input's.

    ``input_s`` is the time at which the input had the present pose.
    """

    def __init__(self, pose: np.ndarray, input_s: float = 0.0) -> None:
        self.stay(pose, input_s)

    def stay(self, pose: np.ndarray, input_s: float) -> None:
        """Stay at a pose."""
        self.pose = self._start = self._goal = pose
        self.input_s = self._start_s = self._goal_s = input_s
        self._lasts_s = self._passed_s = 0.0

    def go_to(self, goal: np.ndarray, input_s: float, took_s: float) -> None:
        """Move to the pose of an input, from now on; the input took a time [s] to get there."""
        behind_s = min(input_s - self.input_s, LONGEST_S)
        self._start, self._start_s = self.pose, self.input_s
        self._goal, self._goal_s = goal, input_s
        self._lasts_s, self._passed_s = max(took_s, behind_s / CATCH_UP), 0.0

    def pose_after(self, length_s: float) -> np.ndarray:
        """Return the pose (4, 4) after a step of a length [s]; at the goal it stays."""
        self._passed_s += length_s
        share = 1.0 if self._passed_s >= self._lasts_s else self._passed_s / self._lasts_s
        self.input_s = self._start_s + share * (self._goal_s - self._start_s)
        self.pose = self._goal if share == 1.0 else interpolated(self._start, self._goal, share)
        return self.pose
