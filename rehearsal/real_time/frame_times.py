"""How fast the window is: pictures a second, simulated over real time, and the time from an input to the
picture that shows it.
"""

from collections import defaultdict, deque
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import takewhile
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from rehearsal.loop.frame import Step

# Frames that are kept.
MOST_FRAMES = 20_000


class FrameTimes:
    """``stages_ms`` are the times of each part of a frame; ``latency_ms`` from an input to the end of the
    frame that shows it; ``steps`` are the steps in between."""

    def __init__(self) -> None:
        self.stages_ms: dict[str, deque[float]] = defaultdict(lambda: deque(maxlen=MOST_FRAMES))
        self.latency_ms: deque[float] = deque(maxlen=MOST_FRAMES)
        self.steps: deque[Step] = deque(maxlen=MOST_FRAMES)
        # The end of each frame by the clock, and the simulated time then [s].
        self.ends_s: deque[tuple[float, float]] = deque(maxlen=MOST_FRAMES)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a part of a frame."""
        start = perf_counter()
        yield
        self.stages_ms[name].append(1000 * (perf_counter() - start))

    def end_frame(self, simulated_s: float, input_s: float | None) -> None:
        """A frame was shown: at a simulated time [s], with the transducer where an input had it at a time
        [s].
        """
        now = perf_counter()
        self.ends_s.append((now, simulated_s))
        if input_s is not None:
            self.latency_ms.append(1000 * (now - input_s))

    def restart(self) -> None:
        """Forget the rates so far, as after a pause."""
        self.ends_s.clear()

    def rates(self, recent_s: float = np.inf) -> tuple[float, float]:
        """Frames a second and the real-time factor, over the last seconds; 0, 1 where too little is
        known.
        """
        last_s = self.ends_s[-1][0] if self.ends_s else 0.0
        # The newest first: after an hour there are many older ones.
        recent = list(takewhile(lambda end: last_s - end[0] <= recent_s, reversed(self.ends_s)))
        if len(recent) < 2:
            return 0.0, 1.0
        (_, simulated_s), (first_s, began_s) = recent[0], recent[-1]
        return (len(recent) - 1) / (last_s - first_s), (simulated_s - began_s) / (last_s - first_s)
