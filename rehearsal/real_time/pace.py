"""The pace of the steps: simulated time keeps up with the clock, by longer steps and then by fewer
iterations where it must.
"""

from collections import deque
from dataclasses import dataclass, replace
from math import ceil

import numpy as np

LEAST_ITERATIONS = 2
LONGEST_STEP_S = 1 / 15
# Steps that had to become longer than this wait for the user's input, to show it at once, until so much time
# is to be simulated.
SHORT_STEP_S, MOST_WAIT_S = 1 / 60, 0.1
ROUNDING = 1e-6
# A level is left for a cheaper one when its steps take more than BUSY of the time that they simulate, and for
# a dearer one when that one's would take less than SPARE: the median of so many steps.
BUSY, SPARE = 0.5, 0.35
STEPS_DOWN, STEPS_UP = 12, 90


@dataclass(frozen=True)
class Level:
    """How many times longer steps are, and the share of the iterations that they have."""

    times_longer: int = 1
    iterations: float = 1.0


# An implicit step comes to the same rest at each length, and with fewer iterations to the same rest later: so
# steps get longer first.
TIMES_LONGER = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)
FEWER_ITERATIONS = (0.75, 0.5, 0.25)
# Between the states of a text.
SEPARATOR = "   "


class Pace:
    """Chooses length and iterations of the steps by the time that they take.

    ``time_step_s`` is the length that steps have where the machine can. ``budget_ms`` is a limit for the time
    of a step, beside the one that it simulates. ``level`` 0 is that length with all iterations.
    """

    def __init__(self, time_step_s: float, budget_ms: float = np.inf) -> None:
        self.time_step_s, self.budget_ms = time_step_s, budget_ms
        most = max(1.0, LONGEST_STEP_S / time_step_s + 1e-9)
        longer = [Level(times) for times in TIMES_LONGER if times <= most]
        self.levels = [*longer, *(replace(longer[-1], iterations=share) for share in FEWER_ITERATIONS)]
        self.level = 0
        self._recent: deque[tuple[float, float]] = deque(maxlen=STEPS_UP)

    @property
    def length_s(self) -> float:
        """Length of the steps, or the least one if they wait for the input."""
        return self._length_s(self.level)

    @property
    def waits_for_input(self) -> bool:
        """Whether steps had to become so long that they wait for the input, up to MOST_WAIT_S."""
        return self.level > 0 and self.length_s > SHORT_STEP_S + ROUNDING

    def lengths_s(self, due_s: float) -> list[float]:
        """Lengths of the steps that simulate a time [s], without what remains of it: as few and as equal as
        can be.

        They are multiples of the shortest length, so that a session has only few different ones.
        """
        if not self.waits_for_input:
            return [self.length_s]
        units, most = int(due_s / self.time_step_s + ROUNDING), self.levels[-1].times_longer
        count = -(-units // most)
        return [self.time_step_s * ((units + n) // count) for n in range(count)]

    def iterations(self, full: int) -> int:
        """Iterations of the next step where ``full`` are set."""
        return min(full, max(LEAST_ITERATIONS, ceil(self.levels[self.level].iterations * full)))

    def text(self, full: int) -> str:
        """What the user reads where steps are longer, or have fewer iterations than the ``full`` ones that
        are set; else empty. Of both, with SEPARATOR between them.
        """
        length_s = self._length_s(len(self.levels) - 1) if self.waits_for_input else self.length_s
        longer = f"Longer steps 1/{1 / length_s:.0f} s" if self.levels[self.level].times_longer > 1 else ""
        iterations = self.iterations(full)
        fewer = f"Reduced iterations {iterations} of {full}" if iterations < full else ""
        return SEPARATOR.join(filter(None, [longer, fewer]))

    def note(self, took_ms: float, length_s: float) -> None:
        """Note the duration of a step of a length [s], and change the level if it is time to."""
        self._recent.append((took_ms, took_ms / self._limit_ms(length_s, BUSY)))
        took, busy = np.array(self._recent).T
        if len(took) >= STEPS_DOWN and np.median(busy[-STEPS_DOWN:]) > 1.0:
            self._change_to(min(self.level + 1, len(self.levels) - 1))
        elif self.level > 0 and len(took) == STEPS_UP:
            ratio = self.levels[self.level - 1].iterations / self.levels[self.level].iterations
            if np.median(took) * ratio < self._limit_ms(self._length_s(self.level - 1), SPARE):
                self._change_to(self.level - 1)

    def _length_s(self, level: int) -> float:
        return self.levels[level].times_longer * self.time_step_s

    def _limit_ms(self, length_s: float, share: float) -> float:
        return share * min(1000 * length_s, self.budget_ms / BUSY)

    def _change_to(self, level: int) -> None:
        if level != self.level:
            self.level = level
            self._recent.clear()
