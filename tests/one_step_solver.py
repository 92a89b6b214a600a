"""A solver for windows in tests: in this process, one step a frame."""

from collections.abc import Callable

import numpy as np

from rehearsal.pressed_organ import Step
from rehearsal.rehearsal import Rehearsal


class OneStepSolver:
    """Makes each step at once, where ``SolverProcess`` makes it by the clock. The iterations change, as on a machine whose load does."""

    def __init__(self, rehearsal: Rehearsal) -> None:
        self.rehearsal = rehearsal
        self.is_paused = True
        self.on_step: Callable[[Step], None] = lambda step: None
        self._made = 0

    def collect(self) -> None: ...

    def hand_over(self) -> None: ...

    def pause(self) -> None:
        self.is_paused = True

    def run(self) -> None:
        self.is_paused = False

    def go_to(self, pose: np.ndarray, input_s: float, took_s: float) -> None:
        self._made += 1
        full = self.rehearsal.settings.iterations
        self._make(pose, None, max(2, full - self._made // 40))

    def play(self, poses: np.ndarray, lengths_s: np.ndarray) -> None:
        for pose, length_s in zip(poses, lengths_s, strict=True):
            self._make(pose, float(length_s), None)

    def _make(self, pose: np.ndarray, length_s: float | None, iterations: int | None) -> None:
        self.on_step(self.rehearsal.timed_step(pose.copy(), length_s, iterations))
