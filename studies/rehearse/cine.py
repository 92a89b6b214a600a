"""What a frozen scanner offers: the pictures of the last seconds, and a calliper."""

from collections import deque
from dataclasses import dataclass, field
from time import perf_counter

import numpy as np
from scipy.ndimage import map_coordinates

from render.viewer import View

KEPT_S, MOST_FRAMES = 10.0, 600


@dataclass
class Cine:
    """The last KEPT_S seconds of views, each with where its tissue was at rest (rows, columns, 3) [mm]."""

    frames: deque[tuple[float, View, np.ndarray | None]] = field(
        default_factory=lambda: deque(maxlen=MOST_FRAMES)
    )
    back: int = 0

    def keep(self, view: View, rest: np.ndarray | None, now: float | None = None) -> None:
        """Add a view, now the newest, and let go of those that are too old."""
        now = perf_counter() if now is None else now
        self.frames.append((now, view, rest))
        while now - self.frames[0][0] > KEPT_S:
            self.frames.popleft()
        self.back = 0

    def moved(self, frames: int) -> View:
        """The view so many on from the one that was shown last (back, negative), as far as there are any."""
        self.back = int(np.clip(self.back - frames, 0, len(self.frames) - 1))
        return self._shown[1]

    def age_s(self) -> float:
        """How much older than the newest view the one shown is, negative [s]."""
        return self._shown[0] - self.frames[-1][0]

    def rest_places(self) -> np.ndarray | None:
        """Where the tissue of the view shown was at rest."""
        return self._shown[2]

    @property
    def _shown(self) -> tuple[float, View, np.ndarray | None]:
        return self.frames[-1 - self.back]


@dataclass
class Calliper:
    """Two points on the image plane [mm], set by clicks; a third click begins anew."""

    points: tuple[tuple[float, float], ...] = ()

    def point(self, place_mm: tuple[float, float] | None) -> None:
        """Set the next point, if there was a click."""
        if place_mm is not None:
            self.points = (place_mm,) if len(self.points) == 2 else (*self.points, place_mm)

    def readouts(self, view: View, rest: np.ndarray | None) -> dict[str, str]:
        """The distance of the points as the tissue lies, and of the same tissue at rest."""
        if len(self.points) < 2:
            return {}
        start, end = np.array(self.points)
        found = {"calliper": f"{np.linalg.norm(end - start):.1f} mm"}
        if rest is not None:
            places = at_rest(rest, np.array(self.points), view)
            found["at rest"] = f"{np.linalg.norm(places[1] - places[0]):.1f} mm"
        return found


def at_rest(rest: np.ndarray, points_mm: np.ndarray, view: View) -> np.ndarray:
    """Where the tissue at points (n, 2) of a view's plane was at rest (n, 3) [mm]; ``rest`` (rows, columns, 3) is over its picture."""
    share = (points_mm + [view.width_mm / 2, view.above_mm]) / [view.width_mm, view.depth_mm]
    at = share[:, ::-1].T * (np.array(rest.shape[:2])[:, None] - 1)
    return np.column_stack(
        [map_coordinates(rest[..., axis], at, order=1, mode="nearest") for axis in range(3)]
    )
