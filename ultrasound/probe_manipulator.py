"""Poses of the transducer, and the probe manipulator that moves it over the organ.

A pose is a rigid (4, 4) matrix, world from transducer [mm]. The transducer is a cuboid about its origin: x
lateral to the marked side, y elevation, z along its axis; the image leaves its face at z = -length / 2 along
-z.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import igl
import numpy as np
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation, Slerp

# Radius of the surface patch to whose mean normal the probe is aligned.
NORMAL_PATCH_MM = 12.0
MIN_DEPTH_MM, MAX_DEPTH_MM = -40.0, 15.0
# Greatest depth in lengths of the transducer: its holder must stay out of the tissue.
MAX_DEPTH_LENGTHS = 1.5
PRESS_MM_S, RELEASE_MM_S = 12.0, 40.0
TURN_DEG_S = 180.0
# Positions of points are known to this in float32, half a metre from the origin.
FOOTPRINT_MARGIN_MM = 1e-2


@dataclass(frozen=True)
class ImagePlane:
    """The imaged rectangle of the transducer's plane.

    ``width_mm`` along the transducer's x, ``depth_mm`` along its -z, starting ``above_mm`` behind its face.
    ``world_from_plane`` (4, 4): x to the marked side, y down into the tissue, z to the transducer's y [mm].
    """

    world_from_plane: np.ndarray
    width_mm: float
    depth_mm: float
    above_mm: float = 0.0


def array_face_centre(pose: np.ndarray, length_mm: float) -> np.ndarray:
    """The centre (3,) [mm] of the array face of a transducer of a length [mm] at a pose (4, 4)."""
    return pose[:3, 3] - length_mm / 2 * pose[:3, 2]


def pose_at(
    face_centre: np.ndarray, direction: np.ndarray, lateral: np.ndarray, length_mm: float
) -> np.ndarray:
    """The pose with its face centred at a point [mm], beam along ``direction``, x nearest to ``lateral``."""
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
    """The image plane of a pose: x to the marked side, y down into the tissue, origin at the face."""
    return ImagePlane(pose @ _face(length_mm), width_mm, depth_mm, above_mm)


def pose_of_image_plane(world_from_plane: np.ndarray, length_mm: float) -> np.ndarray:
    """The pose of the transducer with a given image plane (4, 4), whose axes are PLUS's axes of a probe."""
    return world_from_plane @ np.linalg.inv(_face(length_mm))


def _face(length_mm: float) -> np.ndarray:
    """The transform from the image plane's axes to the transducer's."""
    return np.array(
        [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, -length_mm / 2], [0.0, 0.0, 0.0, 1.0]]
    )


def indentation(pose: np.ndarray, size_mm: np.ndarray, surface: np.ndarray, radius_mm: float = 0.0) -> float:
    """The depth [mm] of the array face below the highest point (n, 3) of the settled surface under its
    footprint.

    Negative above the surface; -inf where the footprint misses it. The face is flat, or an arc of a radius.
    """
    half = np.asarray(size_mm) / 2
    local = (surface[_near_footprint(pose, half, surface)] - pose[:3, 3]) @ pose[:3, :3]
    under = (np.abs(local[:, :2]) <= half[:2]).all(axis=1)
    behind = sagitta(local[under, 0], radius_mm)
    return float((local[under, 2] + half[2] - behind).max()) if under.any() else -np.inf


def _near_footprint(pose: np.ndarray, half_mm: np.ndarray, surface: np.ndarray) -> np.ndarray:
    """Indices of the points (n, 3) that may be under the footprint, found in float32: of a whole organ
    these are few.
    """
    axes = pose[:3, :2].T.astype(np.float32)
    x, y = np.abs(axes @ surface.T.astype(np.float32) - (axes @ pose[:3, 3].astype(np.float32))[:, None])
    return np.flatnonzero((x <= half_mm[0] + FOOTPRINT_MARGIN_MM) & (y <= half_mm[1] + FOOTPRINT_MARGIN_MM))


def sagitta(x_mm: np.ndarray, radius_mm: float) -> np.ndarray:
    """How far a face of a radius (0: flat) is behind its centre, at lateral positions [mm]."""
    if radius_mm == 0:
        return np.zeros_like(x_mm)
    return radius_mm - np.sqrt(np.maximum(radius_mm**2 - x_mm**2, 0.0))


def touching(
    pose: np.ndarray, size_mm: np.ndarray, surface: np.ndarray, radius_mm: float = 0.0
) -> np.ndarray:
    """The pose moved along its axis to first contact with the settled surface (n, 3)."""
    depth = indentation(pose, size_mm, surface, radius_mm)
    return advanced(pose, -depth) if np.isfinite(depth) else pose.copy()


def advanced(pose: np.ndarray, depth_mm: float) -> np.ndarray:
    """The pose moved by a depth along the beam [mm]."""
    moved = pose.copy()
    moved[:3, 3] -= depth_mm * pose[:3, 2]
    return moved


def poses_between(start: np.ndarray, end: np.ndarray, count: int) -> np.ndarray:
    """Poses (count + 1, 4, 4) evenly from start to end, as ``interpolated``."""
    if count == 1:
        return np.stack([start, end])
    return interpolated(start, end, np.linspace(0.0, 1.0, count + 1))


def moved_towards(pose: np.ndarray, goal: np.ndarray, max_mm: float, max_deg: float) -> np.ndarray:
    """The pose moved towards a goal by at most a distance [mm] and an angle [degrees]."""
    distance = float(np.linalg.norm(goal[:3, 3] - pose[:3, 3]))
    turn = np.degrees(Rotation.from_matrix(goal[:3, :3] @ pose[:3, :3].T).magnitude())
    share = min(1.0, max_mm / max(distance, 1e-9), max_deg / max(turn, 1e-9))
    return goal.copy() if share >= 1.0 else interpolated(pose, goal, share)


def interpolated(start: np.ndarray, end: np.ndarray, share: float | np.ndarray) -> np.ndarray:
    """The pose (4, 4), or poses (n, 4, 4), at a fraction (0 to 1), or fractions (n,), of the path from start
    to end.

    Positions are interpolated linearly, rotations spherically.
    """
    turns = Slerp([0.0, 1.0], Rotation.from_matrix(np.stack([start[:3, :3], end[:3, :3]])))
    shift = np.asarray(share)[..., None] * (end[:3, 3] - start[:3, 3])
    return rigid(turns(share).as_matrix(), start[:3, 3] + shift)


@dataclass(frozen=True)
class ManipulatorState:
    """State of the manipulator: depths [mm], turn (3,) [degrees], and the pose aimed at (4, 4), None for
    home.

    ``depth_mm`` is set by keys, ``pressed_mm`` is added while a button is held.
    """

    depth_mm: float = 0.0
    pressed_mm: float = 0.0
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    aim: np.ndarray | None = None

    @property
    def presses(self) -> bool:
        """Whether the transducer is pushed in, and not only on the surface or above it."""
        return self.depth_mm + self.pressed_mm > 0.0


@dataclass
class ProbeManipulator:
    """Moves the transducer over the settled organ: aim, turn and depth.

    ``vertices`` (n, 3), ``faces`` (m, 3) and ``normals`` (n, 3) are the settled surface [mm]; ``home`` is the
    initial pose. ``radius_mm`` is that of a curved face, ``speed_mm_s`` the greatest speed.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    size_mm: np.ndarray
    home: np.ndarray
    lateral: np.ndarray
    radius_mm: float = 0.0
    speed_mm_s: float = np.inf
    state: ManipulatorState = ManipulatorState()

    def __post_init__(self) -> None:
        # The corners of the transducer may be between vertices: edges and faces are sampled too.
        corners = self.vertices[self.faces]
        middles = (corners + np.roll(corners, 1, axis=1)).reshape(-1, 3) / 2
        self.samples = np.concatenate([self.vertices, corners.mean(axis=1), middles])
        self.max_mm = min(MAX_DEPTH_MM, MAX_DEPTH_LENGTHS * float(self.size_mm[2]))

    @property
    def aim(self) -> np.ndarray:
        """The pose aimed at (4, 4), before it is turned and pressed in."""
        return self.home if self.state.aim is None else self.state.aim

    def indentation_mm(self, pose: np.ndarray) -> float:
        """Depth of a transducer at a pose (4, 4) below the settled surface [mm]; negative above it."""
        return indentation(pose, self.size_mm, self.samples, self.radius_mm)

    def match(self, pose: np.ndarray) -> None:
        """Take over a transducer at a pose (4, 4), as if a button had pressed it in that is now released."""
        depth = self.indentation_mm(pose)
        pressed = float(np.clip(depth, 0.0, self.max_mm)) if np.isfinite(depth) else 0.0
        self.state = ManipulatorState(
            depth - pressed if np.isfinite(depth) else 0.0, pressed, aim=pose.copy()
        )

    def point(self, origin: np.ndarray, direction: np.ndarray) -> None:
        """Aim at the first intersection of a ray [mm] with the settled organ, perpendicular to its
        surface; ignore a miss.
        """
        place = self.ray_hit(origin, direction)
        if place is not None:
            self.aim_at(place)

    def aim_at(self, target: np.ndarray, lateral: np.ndarray | None = None) -> None:
        """Aim at a point of the surface [mm], perpendicular to the patch around it, x nearest to
        ``lateral``.
        """
        lateral = self.lateral if lateral is None else lateral
        aim = pose_at(target, -self.surface_normal(target), lateral, self.size_mm[2])
        self.state = replace(self.state, aim=aim)

    def surface_normal(self, point: np.ndarray) -> np.ndarray:
        """The unit normal (3,) of the surface patch around a point [mm]."""
        return self.surface_normals(point[None])[0]

    def surface_normals(self, points: np.ndarray) -> np.ndarray:
        """The unit normals (n, 3) of the surface patches around points (n, 3) [mm]."""
        normal = np.exp(-((cdist(points, self.vertices) / NORMAL_PATCH_MM) ** 2)) @ self.normals
        return normal / np.linalg.norm(normal, axis=1, keepdims=True)

    def ray_hit(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray | None:
        """The first intersection (3,) of a ray [mm] with the settled organ, None where it misses."""
        origin, direction = np.array(origin, float), np.array(direction, float)
        (distance,) = self.ray_distances(origin[None], direction[None])
        return origin + distance * direction if np.isfinite(distance) else None

    def ray_distances(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """The distances (n,), in lengths of the directions, of rays (n, 3) to the settled organ; infinity
        where they miss.
        """
        hit, distance, _ = self._tree.intersect_ray_first(self.vertices, self.faces, origins, directions)
        return np.where(hit >= 0, distance, np.inf)

    @cached_property
    def _tree(self) -> igl.AABB:
        tree = igl.AABB()
        tree.init(self.vertices, self.faces)
        return tree

    def slide(self, lateral_mm: float, elevation_mm: float) -> None:
        """Move the aim over the surface, along the turned transducer's x and y [mm]."""
        aim = self.aim
        outward = aim[:3, 2]
        along = self._turned(aim)[:3, :2]
        along = along - np.outer(outward, outward @ along)
        along /= np.linalg.norm(along, axis=0)
        wanted = _face_centre(aim, self.size_mm[2]) + along @ [lateral_mm, elevation_mm]
        _, _, nearest = igl.point_mesh_squared_distance(wanted[None], self.vertices, self.faces)
        # With the fixed lateral the probe would flip where the surface normal is along it.
        self.aim_at(nearest.reshape(3), aim[:3, 0])

    def push(self, depth_mm: float) -> None:
        """Push in by a depth [mm]; lift where negative."""
        depth = float(np.clip(self.state.depth_mm + depth_mm, MIN_DEPTH_MM, self.max_mm))
        self.state = replace(self.state, depth_mm=depth)

    def go_back(self, time_s: float) -> None:
        """Go back to the surface for a time [s], from the depth that ``push`` has set."""
        most_mm = RELEASE_MM_S * time_s
        depth = self.state.depth_mm - float(np.clip(self.state.depth_mm, -most_mm, most_mm))
        self.state = replace(self.state, depth_mm=depth)

    def press(self, pressing: bool, time_s: float, share: float = 1.0) -> None:
        """Press further while the button is held, up to a fraction of the greatest depth; release
        otherwise.
        """
        goal = share * self.max_mm if pressing else 0.0
        before = self.state.pressed_mm
        pressed = np.clip(goal, before - RELEASE_MM_S * time_s, before + PRESS_MM_S * time_s)
        self.state = replace(self.state, pressed_mm=float(pressed))

    def turn(self, tilt_deg: float, rock_deg: float, rotate_deg: float) -> None:
        """Turn about the transducer's x, y and z axes [degrees]; tilt and rock are limited."""
        tilt, rock, rotate = map(float, np.add(self.state.turn_deg, [tilt_deg, rock_deg, rotate_deg]))
        turn = min(max(tilt, -60.0), 60.0), min(max(rock, -60.0), 60.0), rotate
        self.state = replace(self.state, turn_deg=turn)

    def turns_to(self, pose: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """What ``turn`` has to add to tilt, rock and rotation (3,) [degrees, -180 to 180], so that the
        transducer at a pose (4, 4) has the orientation of another.
        """
        aim = pose[:3, :3] @ _turn_matrix(self.state.turn_deg).T
        wanted = Rotation.from_matrix(aim.T @ goal[:3, :3]).as_euler("zyx", degrees=True)[::-1]
        return (wanted - self.state.turn_deg + 180.0) % 360.0 - 180.0

    def turned_by(self, pose: np.ndarray, turn_deg: np.ndarray) -> np.ndarray:
        """The poses (..., 4, 4) that ``turn`` leads to from a pose by tilt, rock and rotation (..., 3)
        [degrees], about the centre of the array face.
        """
        aim = pose[:3, :3] @ _turn_matrix(self.state.turn_deg).T
        rotation = aim @ _turn_matrix(np.add(self.state.turn_deg, turn_deg))
        centre = _face_centre(pose, self.size_mm[2])
        return rigid(rotation, centre + self.size_mm[2] / 2 * rotation[..., 2])

    def pose(self) -> np.ndarray:
        """The commanded pose: turned about the face's centre, moved to contact, then pressed in."""
        pose = self._turned(self.aim)
        depth = min(self.state.depth_mm + self.state.pressed_mm, self.max_mm)
        return advanced(touching(pose, self.size_mm, self.samples, self.radius_mm), depth)

    def pose_towards(self, goal: np.ndarray, pose: np.ndarray, time_s: float) -> np.ndarray:
        """The pose after a time [s] from a pose towards a goal (4, 4): limited in speed, and not through the
        organ.
        """
        moved = moved_towards(pose, goal, self.speed_mm_s * time_s, TURN_DEG_S * time_s)
        # The straight path between two points of the surface may cross the organ.
        wanted = max(self.indentation_mm(goal), 0.0)
        through = self.indentation_mm(moved) - max(wanted, self.indentation_mm(pose))
        return advanced(moved, -through) if through > 0 else moved

    def _turned(self, aim: np.ndarray) -> np.ndarray:
        pose, length = aim.copy(), self.size_mm[2]
        pose[:3, :3] = aim[:3, :3] @ _turn_matrix(self.state.turn_deg)
        pose[:3, 3] = _face_centre(aim, length) + length / 2 * pose[:3, 2]
        return pose


def _turn_matrix(turn_deg: Sequence[float] | np.ndarray) -> np.ndarray:
    """The rotations (..., 3, 3) by tilt, rock and rotation (..., 3) [degrees], about axes that turn along."""
    return Rotation.from_euler("zyx", np.asarray(turn_deg)[..., ::-1], degrees=True).as_matrix()


def _face_centre(pose: np.ndarray, length_mm: float) -> np.ndarray:
    return pose[:3, 3] - length_mm / 2 * pose[:3, 2]
