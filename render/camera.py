"""The camera that orbits the organ, and the ray under the mouse. NumPy only; lengths in mm.

Window coordinates run from (0, 0) bottom left to (1, 1) top right, as GGUI gives the mouse.
"""

from itertools import product

import numpy as np

FIELD_OF_VIEW_DEG = 28.0
MARGIN = 1.04
HOME_DEG = (20.0, 32.0)


class OrbitCamera:
    """Perspective camera that turns about a target and shows it in the middle of one part of the window.

    It frames the box ``bounds`` (2, 3) [mm]; the unit direction ``up`` (3,) stays upright. ``part`` is the
    part of the window that shows the scene: left, bottom, right, top, in window coordinates. ``aspect`` is
    width / height of the whole window.
    """

    def __init__(self, bounds, up, part, aspect: float):
        bounds = np.asarray(bounds, dtype=np.float64)
        self.up = np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
        self._up_home = self.up
        self._middle = bounds.mean(axis=0)
        self.aspect = aspect
        self.part = part
        self.distance_home = 0.0
        self.go_home()
        # The long side of the organ is horizontal in the view, as usual for a kidney.
        flat = np.eye(3) - np.outer(self.up, self.up)
        spread = (bounds[1] - bounds[0]) * np.linalg.norm(flat, axis=1)
        side = flat[int(np.argmax(spread))]
        self._side = self._side_home = side / np.linalg.norm(side)
        self._ahead = np.cross(self.up, self._side)
        self.distance = self.distance_home = self._framing_distance(bounds)

    @property
    def state(self) -> tuple[float, ...]:
        """What the user changes: target, angles and distance."""
        return (*map(float, self.target), self.azimuth_deg, self.elevation_deg, self.distance)

    def go_home(self) -> None:
        """Return to the initial view."""
        self.target = self._middle
        self.azimuth_deg, self.elevation_deg = HOME_DEG
        self.distance = self.distance_home

    def look(self, ahead: np.ndarray, up: np.ndarray) -> None:
        """Look along a direction (3,) at the organ, with another (3,), not parallel to it, upwards."""
        self.target, self.distance = self._middle, self.distance_home
        self.up = up / np.linalg.norm(up)
        along = ahead / np.linalg.norm(ahead)
        level = along - (along @ self.up) * self.up
        self._ahead = level / np.linalg.norm(level)
        self._side = np.cross(self._ahead, self.up)
        self.azimuth_deg = 0.0
        self.elevation_deg = float(np.degrees(np.arcsin(-along @ self.up)))

    def look_from_home(self) -> None:
        """Return to the initial view, also from ``look``."""
        self.up, self._side = self._up_home, self._side_home
        self._ahead = np.cross(self.up, self._side)
        self.go_home()

    def _framing_distance(self, bounds: np.ndarray) -> float:
        right, up, ahead = self.axes()
        offset = np.array(list(product(*bounds.T))) - self.target
        left, bottom, right_edge, top = self.part
        half = self.half_extent() * [right_edge - left, top - bottom]
        # The eye is beside the target: what is behind the target is shifted towards the centre of the window.
        shift = np.outer(offset @ ahead, self._aside())
        reach = np.abs(np.stack([offset @ right, offset @ up], axis=1) - shift) / half
        return float(MARGIN * np.max(reach.max(axis=1) - offset @ ahead))

    def axes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The unit vectors to the right, up and ahead of the camera, world."""
        azimuth, elevation = np.radians([self.azimuth_deg, self.elevation_deg])
        level = np.cos(azimuth) * self._ahead + np.sin(azimuth) * self._side
        ahead = np.cos(elevation) * level - np.sin(elevation) * self.up
        right = np.cross(ahead, self.up)
        right /= np.linalg.norm(right)
        return right, np.cross(right, ahead), ahead

    def half_extent(self) -> np.ndarray:
        """Half width and half height of the window at distance 1."""
        half_height = np.tan(np.radians(FIELD_OF_VIEW_DEG / 2))
        return np.array([half_height * self.aspect, half_height])

    def _aside(self) -> np.ndarray:
        """Slopes to the right and up of the ray through the centre of the part."""
        left, bottom, right_edge, top = self.part
        return np.array([left + right_edge - 1.0, bottom + top - 1.0]) * self.half_extent()

    def eye(self) -> np.ndarray:
        """Position [mm]. It is beside the target, so that the target is in the centre of its part."""
        right, up, ahead = self.axes()
        across, along = self._aside()
        return self.target - self.distance * (ahead + across * right + along * up)

    def direction(self, cursor) -> np.ndarray:
        """Direction, of length 1 along the view, from the eye through window coordinates (2,) or (k, 2)."""
        slope = (2.0 * np.asarray(cursor, dtype=np.float64) - 1.0) * self.half_extent()
        right, up, ahead = self.axes()
        return ahead + slope[..., :1] * right + slope[..., 1:] * up

    def ray(self, cursor) -> tuple[np.ndarray, np.ndarray]:
        """Origin [mm] and unit direction under window coordinates (2,)."""
        direction = self.direction(cursor)
        return self.eye(), direction / np.linalg.norm(direction)

    def project(self, points) -> np.ndarray:
        """Window coordinates, shape (k, 2), of world points [mm], shape (k, 3), in front of the camera."""
        offset = np.asarray(points, dtype=np.float64) - self.eye()
        right, up, ahead = self.axes()
        plane = np.stack([offset @ right, offset @ up], axis=-1) / (offset @ ahead)[..., None]
        return 0.5 + 0.5 * plane / self.half_extent()

    def orbit(self, across: float, along: float) -> None:
        """Turn by a drag of the mouse, in window coordinates.

        The poles are excluded: up is undefined there.
        """
        self.azimuth_deg += 220.0 * across
        self.elevation_deg = float(np.clip(self.elevation_deg - 160.0 * along, -80.0, 85.0))

    def pan(self, across: float, along: float) -> None:
        """Shift so that the tissue follows a drag of the mouse, in window coordinates."""
        right, up, _ = self.axes()
        half_width, half_height = self.half_extent()
        self.target = self.target - 2.0 * self.distance * (
            across * half_width * right + along * half_height * up
        )

    def zoom(self, factor: float) -> None:
        """Multiply the distance, between a third and three times the first one."""
        self.distance = float(np.clip(self.distance * factor, self.distance_home / 3, self.distance_home * 3))

    def near_far(self) -> tuple[float, float]:
        """Clipping distances [mm]."""
        return self.distance_home / 100.0, self.distance_home * 10.0
