"""Cine memory (the images of the last seconds) and caliper of the scanner."""

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import map_coordinates

from rehearsal.inputs.user_input import STILL_MM
from render.viewer import View

KEPT_S, KEPT_A_SECOND = 10.0, 30


@dataclass(frozen=True)
class CineFrame:
    """A view, its time [s], and the rest positions (rows, columns, 3) [mm] of its tissue; None without a CT."""

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


@dataclass
class Caliper:
    """Two points on the image plane [mm], set by clicks; a third click or a moving probe removes them."""

    points: tuple[tuple[float, float], ...] = ()
    _pose: np.ndarray | None = None

    def point(self, place_mm: tuple[float, float] | None, pose: np.ndarray) -> None:
        """Set the next point, or remove both, after a click into an image of a probe at a pose (4, 4)."""
        if place_mm is None:
            return
        if not self.points:
            self._pose = pose
        self.points = () if len(self.points) == 2 else (*self.points, place_mm)

    def go_with(self, pose: np.ndarray) -> None:
        """Remove the points if the probe of a live image has left the pose (4, 4) of the first point."""
        if self.points and self._pose is not None and np.abs(pose - self._pose).max() > STILL_MM:
            self.points = ()

    def figure(self, frame: CineFrame) -> str:
        """The distance of the points in the deformed tissue and at rest, as text; empty for fewer than two."""
        if len(self.points) < 2:
            return ""
        start, end = np.array(self.points)
        found = f"{np.linalg.norm(end - start):.1f} mm"
        if frame.rest is not None:
            places = at_rest(frame.rest, np.array(self.points), frame.view)
            found += f"\nat rest {np.linalg.norm(places[1] - places[0]):.1f} mm"
        return found


def at_rest(rest: np.ndarray, points_mm: np.ndarray, view: View) -> np.ndarray:
    """Rest positions (n, 3) [mm] of points (n, 2) on a view's plane; ``rest`` (rows, columns, 3) are those of its image."""
    share = (points_mm + [view.width_mm / 2, view.above_mm]) / [view.width_mm, view.depth_mm]
    at = share[:, ::-1].T * (np.array(rest.shape[:2])[:, None] - 1)
    return np.column_stack(
        [map_coordinates(rest[..., axis], at, order=1, mode="nearest") for axis in range(3)]
    )
