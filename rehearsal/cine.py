"""Cine memory: the images of the last seconds."""

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from render.viewer import View

KEPT_S, KEPT_A_SECOND = 10.0, 30


@dataclass(frozen=True)
class CineFrame:
    """A view, its time [s], and the rest positions (rows, columns, 3) [mm] of its tissue; None without a
    CT.
    """

    time_s: float
    view: View
    rest: np.ndarray | None


@dataclass
class Cine:
    """The frames of the last KEPT_S seconds. ``back`` counts from the newest to the one shown."""

    frames: deque[CineFrame] = field(default_factory=deque)
    back: int = 0

    def keep(self, frame: CineFrame) -> None:
        """Add a frame unless the last was kept just before, and discard those that are too old."""
        self.back = 0
        if self.frames and frame.time_s - self.frames[-1].time_s < 0.99 / KEPT_A_SECOND:
            return
        self.frames.append(frame)
        while frame.time_s - self.frames[0].time_s > KEPT_S:
            self.frames.popleft()

    def go(self, frames: int) -> None:
        """Move by so many frames, back if negative, within those kept."""
        self.back = int(np.clip(self.back - frames, 0, max(len(self.frames) - 1, 0)))

    @property
    def shown(self) -> CineFrame:
        """The frame shown."""
        return self.frames[-1 - self.back]

    @property
    def age_s(self) -> float:
        """Time of the shown frame relative to the newest, negative [s]."""
        return self.shown.time_s - self.frames[-1].time_s
