"""The transducer: its pose, and how a hand moves it over the organ.

A pose is a rigid (4, 4) matrix, world from transducer [mm]. The transducer is a cuboid about its origin: x lateral
to the marked side, y elevation, z along its axis; the image leaves its face at z = -length / 2 along -z.
"""

from dataclasses import dataclass, field

import igl
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from ultrasound.image_plane import ImagePlane

# How wide a patch of surface the probe's axis is perpendicular to, as a hand would hold it.
NORMAL_PATCH_MM = 12.0
LEAST_DEPTH_MM, MOST_DEPTH_MM = -40.0, 15.0
# How deep a hand presses, in lengths of the transducer: what holds it must stay out of the tissue.
MOST_LENGTHS = 1.5
PRESS_MM_S, RELEASE_MM_S = 12.0, 40.0


def pose_at(
    face_centre: np.ndarray, direction: np.ndarray, lateral: np.ndarray, length_mm: float
) -> np.ndarray:
    """Pose whose face is centred at a point [mm] and looks along ``direction``; x is nearest to ``lateral``."""
    z = -np.asarray(direction, float) / np.linalg.norm(direction)
    x = np.asarray(lateral, float) - np.dot(lateral, z) * z
    if np.linalg.norm(x) < 1e-6:
        across = np.eye(3)[np.argmin(np.abs(z))]
        x = across - np.dot(across, z) * z
    x /= np.linalg.norm(x)
    return rigid(np.column_stack([x, np.cross(z, x), z]), np.asarray(face_centre, float) + length_mm / 2 * z)


def rigid(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Matrices (..., 4, 4) of rotations (..., 3, 3) and positions (..., 3)."""
    matrix = np.zeros((*position.shape[:-1], 4, 4))
    matrix[..., :3, :3], matrix[..., :3, 3], matrix[..., 3, 3] = rotation, position, 1.0
    return matrix


def image_plane(
    pose: np.ndarray, length_mm: float, width_mm: float, depth_mm: float, above_mm: float = 0.0
) -> ImagePlane:
    """The plane under the transducer's face: x to the marked side, y down into the tissue, origin at the face."""
    return ImagePlane(pose @ _face(length_mm), width_mm, depth_mm, above_mm)


def pose_of_image_plane(world_from_plane: np.ndarray, length_mm: float) -> np.ndarray:
    """The pose of a transducer whose image plane (4, 4) is there: PLUS's axes of a probe are the plane's."""
    return world_from_plane @ np.linalg.inv(_face(length_mm))


def _face(length_mm: float) -> np.ndarray:
    """The image plane's axes in the transducer's."""
    return np.array(
        [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, -length_mm / 2], [0.0, 0.0, 0.0, 1.0]]
    )


def indentation(pose: np.ndarray, size_mm: np.ndarray, surface: np.ndarray, radius_mm: float = 0.0) -> float:
    """How deep the transducer's face is below the highest point (n, 3) of the settled surface under it [mm].

    Negative above the surface; -inf where the transducer's footprint misses it. The face is flat, or an arc of a radius.
    """
    local = (surface - pose[:3, 3]) @ pose[:3, :3]
    half = np.asarray(size_mm) / 2
    under = (np.abs(local[:, :2]) <= half[:2]).all(axis=1)
    behind = sagitta(local[under, 0], radius_mm)
    return float((local[under, 2] + half[2] - behind).max()) if under.any() else -np.inf


def sagitta(x_mm: np.ndarray, radius_mm: float) -> np.ndarray:
    """How far a face of a radius (0: flat) lies behind its middle, at lateral places [mm]."""
    if radius_mm == 0:
        return np.zeros_like(x_mm)
    return radius_mm - np.sqrt(np.maximum(radius_mm**2 - x_mm**2, 0.0))


def touching(
    pose: np.ndarray, size_mm: np.ndarray, surface: np.ndarray, radius_mm: float = 0.0
) -> np.ndarray:
    """The pose moved along its axis to where it just touches the settled surface (n, 3)."""
    depth = indentation(pose, size_mm, surface, radius_mm)
    return advanced(pose, -depth) if np.isfinite(depth) else pose.copy()


def advanced(pose: np.ndarray, depth_mm: float) -> np.ndarray:
    """The pose moved by a depth along the way it looks [mm]."""
    moved = pose.copy()
    moved[:3, 3] -= depth_mm * pose[:3, 2]
    return moved


def poses_between(start: np.ndarray, end: np.ndarray, count: int) -> np.ndarray:
    """Poses (count + 1, 4, 4) evenly from start to end, as ``interpolated``."""
    return interpolated(start, end, np.linspace(0.0, 1.0, count + 1))


def moved_towards(pose: np.ndarray, goal: np.ndarray, most_mm: float, most_deg: float) -> np.ndarray:
    """The pose moved towards a goal by at most a distance [mm] and an angle [degrees]."""
    way = float(np.linalg.norm(goal[:3, 3] - pose[:3, 3]))
    turn = np.degrees(Rotation.from_matrix(goal[:3, :3] @ pose[:3, :3].T).magnitude())
    share = min(1.0, most_mm / max(way, 1e-9), most_deg / max(turn, 1e-9))
    return goal.copy() if share >= 1.0 else interpolated(pose, goal, share)


def interpolated(start: np.ndarray, end: np.ndarray, share: float | np.ndarray) -> np.ndarray:
    """The pose (4, 4), or poses (n, 4, 4), at a share (0 to 1), or shares (n,), of the way from start to end.

    It is straight in position, and the short way round in angle.
    """
    turns = Slerp([0.0, 1.0], Rotation.from_matrix(np.stack([start[:3, :3], end[:3, :3]])))
    way = np.asarray(share)[..., None] * (end[:3, 3] - start[:3, 3])
    return rigid(turns(share).as_matrix(), start[:3, 3] + way)


@dataclass(frozen=True)
class ManipulatorState:
    """What of a hand changes: how deep it presses [mm], how it is turned (3,) [degrees], where it aims (4, 4), home where None."""

    depth_mm: float = 0.0
    pressed_mm: float = 0.0
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    aim: np.ndarray | None = None


@dataclass
class ProbeManipulator:
    """What holds the transducer: where on the settled organ it aims, how it is turned, how deep it presses.

    ``vertices`` (n, 3), ``faces`` (m, 3) and ``normals`` (n, 3) are the settled surface [mm]; ``home`` is the pose it
    starts from. ``radius_mm`` is that of a curved face. ``depth_mm`` is what keys push, ``pressed_mm`` what a held button
    adds until it is let go.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    size_mm: np.ndarray
    home: np.ndarray
    lateral: np.ndarray
    radius_mm: float = 0.0
    depth_mm: float = 0.0
    pressed_mm: float = 0.0
    turn_deg: np.ndarray = field(default_factory=lambda: np.zeros(3))
    aim: np.ndarray | None = None

    def __post_init__(self) -> None:
        # The transducer's corners find their way between the vertices: edges and faces count too.
        corners = self.vertices[self.faces]
        middles = (corners + np.roll(corners, 1, axis=1)).reshape(-1, 3) / 2
        self.samples = np.concatenate([self.vertices, corners.mean(axis=1), middles])
        self.most_mm = min(MOST_DEPTH_MM, MOST_LENGTHS * float(self.size_mm[2]))

    @property
    def state(self) -> ManipulatorState:
        """How it holds the transducer now; set, it holds it so."""
        tilt, rock, rotate = map(float, self.turn_deg)
        return ManipulatorState(self.depth_mm, self.pressed_mm, (tilt, rock, rotate), self.aim)

    @state.setter
    def state(self, state: ManipulatorState) -> None:
        self.depth_mm, self.pressed_mm = state.depth_mm, state.pressed_mm
        self.turn_deg, self.aim = np.array(state.turn_deg), state.aim

    def match(self, pose: np.ndarray) -> None:
        """Hold a transducer as it is at a pose (4, 4), as if pressed in by a button that is then let go."""
        depth = indentation(pose, self.size_mm, self.samples, self.radius_mm)
        pressed = float(np.clip(depth, 0.0, self.most_mm)) if np.isfinite(depth) else 0.0
        self.state = ManipulatorState(
            depth - pressed if np.isfinite(depth) else 0.0, pressed, aim=pose.copy()
        )

    def point(self, origin: np.ndarray, direction: np.ndarray) -> None:
        """Aim where a ray [mm] first meets the settled organ, perpendicular to its surface; a miss changes nothing."""
        place = self.ray_hit(origin, direction)
        if place is not None:
            self.aim_at(place)

    def aim_at(self, target: np.ndarray, lateral: np.ndarray | None = None) -> None:
        """Aim at a point of the surface [mm], perpendicular to the patch around it; x is nearest to ``lateral``."""
        lateral = self.lateral if lateral is None else lateral
        self.aim = pose_at(target, -self.surface_normal(target), lateral, self.size_mm[2])

    def surface_normal(self, place: np.ndarray) -> np.ndarray:
        """Unit normal (3,) of the patch of surface around a place [mm]."""
        distance = np.linalg.norm(self.vertices - place, axis=1)
        normal = np.exp(-((distance / NORMAL_PATCH_MM) ** 2)) @ self.normals
        return normal / np.linalg.norm(normal)

    def ray_hit(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray | None:
        """Where a ray [mm] first meets the settled organ (3,), None where it misses."""
        # Not its first=True, which invents a hit where there is none.
        hits = igl.ray_mesh_intersect(np.array(origin), np.array(direction), self.vertices, self.faces)
        return np.array(origin) + hits[0][1] * np.array(direction) if hits else None

    def slide(self, lateral_mm: float, elevation_mm: float) -> None:
        """Move the aim over the surface, along the turned transducer's own x and y."""
        aim = self.home if self.aim is None else self.aim
        outward = aim[:3, 2]
        along = self._turned(aim)[:3, :2]
        along = along - np.outer(outward, outward @ along)
        along /= np.linalg.norm(along, axis=0)
        wanted = _face_centre(aim, self.size_mm[2]) + along @ [lateral_mm, elevation_mm]
        _, _, nearest = igl.point_mesh_squared_distance(wanted[None], self.vertices, self.faces)
        # With the hand's own lateral it would turn about where the surface looks along that, and come back.
        self.aim_at(nearest.reshape(3), aim[:3, 0])

    def push(self, depth_mm: float) -> None:
        """Press in by a depth [mm], or lift where negative."""
        self.depth_mm = float(np.clip(self.depth_mm + depth_mm, LEAST_DEPTH_MM, self.most_mm))

    def press(self, pressing: bool, time_s: float, share: float = 1.0) -> None:
        """Press further while the button is held, to a share of the deepest; let go when it is not."""
        goal = share * self.most_mm if pressing else 0.0
        least, most = self.pressed_mm - RELEASE_MM_S * time_s, self.pressed_mm + PRESS_MM_S * time_s
        self.pressed_mm = float(np.clip(goal, least, most))

    def turn(self, tilt_deg: float, rock_deg: float, rotate_deg: float) -> None:
        """Turn about the transducer's x, y and z axes [degrees]; tilt and rock end where a hand's do."""
        self.turn_deg = self.turn_deg + [tilt_deg, rock_deg, rotate_deg]
        self.turn_deg[:2] = np.clip(self.turn_deg[:2], -60.0, 60.0)

    def pose(self) -> np.ndarray:
        """The pose that the hand wants now: turned about the face's centre, touching, then pressed in."""
        pose = self._turned(self.home if self.aim is None else self.aim)
        depth = min(self.depth_mm + self.pressed_mm, self.most_mm)
        return advanced(touching(pose, self.size_mm, self.samples, self.radius_mm), depth)

    def _turned(self, aim: np.ndarray) -> np.ndarray:
        pose, length = aim.copy(), self.size_mm[2]
        turn = Rotation.from_euler("zyx", self.turn_deg[::-1], degrees=True).as_matrix()
        pose[:3, :3] = aim[:3, :3] @ turn
        pose[:3, 3] = _face_centre(aim, length) + length / 2 * pose[:3, 2]
        return pose


def _face_centre(pose: np.ndarray, length_mm: float) -> np.ndarray:
    return pose[:3, 3] - length_mm / 2 * pose[:3, 2]
