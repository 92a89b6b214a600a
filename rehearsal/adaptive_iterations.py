"""Adaptive iterations: fewer iterations when a step takes longer than its budget, all of them again when there is time."""

from collections import deque
from math import ceil

import numpy as np

# Shares of the iterations that are set. Neo-Hookean tissue reaches the same rest with fewer, but later; shape-matched tissue gets softer.
LEVELS = (1.0, 0.75, 0.5, 0.25)
LEAST_ITERATIONS = 2
# Steps whose median decides: down one level at once, up one only with spare time and after longer.
STEPS_DOWN, STEPS_UP = 20, 120
SPARE = 0.8


class AdaptiveIterations:
    """Keep a step within a budget [ms] by reducing the iterations; ``level`` 0 means all of them."""

    def __init__(self, budget_ms: float) -> None:
        self.budget_ms = budget_ms
        self.level = 0
        self._recent: deque[float] = deque(maxlen=STEPS_UP)

    def iterations(self, full: int) -> int:
        """The number of iterations to make when ``full`` are set."""
        return min(full, max(LEAST_ITERATIONS, ceil(LEVELS[self.level] * full)))

    def watch(self, step_ms: float) -> bool:
        """Note the duration of a step; return whether the level has changed."""
        self._recent.append(step_ms)
        recent = np.array(self._recent)
        if len(recent) >= STEPS_DOWN and np.median(recent[-STEPS_DOWN:]) > self.budget_ms:
            return self.level < len(LEVELS) - 1 and self._change_to(self.level + 1)
        if self.level > 0 and len(recent) == STEPS_UP:
            expected = np.median(recent) * LEVELS[self.level - 1] / LEVELS[self.level]
            return bool(expected < SPARE * self.budget_ms) and self._change_to(self.level - 1)
        return False

    def _change_to(self, level: int) -> bool:
        self.level = level
        self._recent.clear()
        return True

    def status(self, full: int) -> str:
        """The text for the user; empty at level 0."""
        if self.level == 0:
            return ""
        return f"REDUCED ITERATIONS   {self.iterations(full)} of {full}"
