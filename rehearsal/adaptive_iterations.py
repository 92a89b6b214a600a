"""What gives way when a step takes longer than it may: passes over the tissue, rung by rung, and back when there is time."""

from collections import deque
from math import ceil

import numpy as np

# Shares of the iterations that were asked for. Tissue true to a material comes to the same rest with fewer, later;
# shape-matched tissue gets softer.
RUNGS = (1.0, 0.75, 0.5, 0.25)
LEAST_ITERATIONS = 2
# A rung is left after the median of so many steps: at once to the next, upward only with room to spare and for longer.
STEPS_DOWN, STEPS_UP = 20, 120
ROOM = 0.8


class AdaptiveIterations:
    """Keeps a step within a budget [ms] by asking for fewer iterations; ``rung`` is 0 where nothing gives way."""

    def __init__(self, budget_ms: float) -> None:
        self.budget_ms = budget_ms
        self.rung = 0
        self._recent: deque[float] = deque(maxlen=STEPS_UP)

    def iterations(self, asked: int) -> int:
        """So many of the iterations asked for as this rung leaves."""
        return min(asked, max(LEAST_ITERATIONS, ceil(RUNGS[self.rung] * asked)))

    def watch(self, step_ms: float) -> bool:
        """Look at how long a step took; whether the rung has changed."""
        self._recent.append(step_ms)
        recent = np.array(self._recent)
        if len(recent) >= STEPS_DOWN and np.median(recent[-STEPS_DOWN:]) > self.budget_ms:
            return self.rung < len(RUNGS) - 1 and self._go(self.rung + 1)
        if self.rung > 0 and len(recent) == STEPS_UP:
            wanted = np.median(recent) * RUNGS[self.rung - 1] / RUNGS[self.rung]
            return bool(wanted < ROOM * self.budget_ms) and self._go(self.rung - 1)
        return False

    def _go(self, rung: int) -> bool:
        self.rung = rung
        self._recent.clear()
        return True

    def says(self, asked: int) -> str:
        """For the user; empty where nothing gives way."""
        if self.rung == 0:
            return ""
        return f"LESS EXACT, TO KEEP PACE   {self.iterations(asked)} of {asked} iterations"
