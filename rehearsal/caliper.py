"""The caliper: the distance of two points on the image, now and at rest; ``render/ultrasound_panel.py``
draws it.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates

from rehearsal.cine import CineFrame
from rehearsal.sources.user import STILL_MM
from render.viewer import View


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
        """The distance of the points in the deformed tissue and at rest, as text; empty for fewer than
        two.
        """
        if len(self.points) < 2:
            return ""
        start, end = np.array(self.points)
        text = f"{np.linalg.norm(end - start):.1f} mm"
        if frame.rest is not None:
            places = at_rest(frame.rest, np.array(self.points), frame.view)
            text += f"\nat rest {np.linalg.norm(places[1] - places[0]):.1f} mm"
        return text


def at_rest(rest: np.ndarray, points_mm: np.ndarray, view: View) -> np.ndarray:
    """Rest positions (n, 3) [mm] of points (n, 2) on a view's plane; ``rest`` (rows, columns, 3) are those
    of its image.
    """
    share = (points_mm + [view.width_mm / 2, view.above_mm]) / [view.width_mm, view.depth_mm]
    at = share[:, ::-1].T * (np.array(rest.shape[:2])[:, None] - 1)
    return np.column_stack(
        [map_coordinates(rest[..., axis], at, order=1, mode="nearest") for axis in range(3)]
    )
