"""Where the probe of an imported patient starts: over the tumour's middle, or the kidney's, where its face
meets the organ best.
"""

import numpy as np
import trimesh

from scenes.scene import Press
from scenes.surfaces import depth_below_hull

# Directions that are compared: within this angle from above, as the support is below.
DIRECTIONS, MOST_TILT_DEG = 300, 60.0
# The surface under the face is known in squares of this width: a triangle of an organ's surface is 3 mm wide.
SQUARE_MM = 4.0
# What of the face is beside the organ counts as a gap of this length.
BESIDE_MM = 10.0
# A gap of 1 mm under the face, on average, counts as much as so many mm more between face and target; so does
# each mm that the face is in a concavity, as at the hilum, where an instrument with its vessels has no room.
GAP_WEIGHT = 3.0
# Each degree from above counts as so many mm: the instruments come from the front.
TILT_MM_DEG = 0.1
# The probe stays so far beside the support, and where it cannot, a direction comes after all others.
CLEARANCE_MM = 2.0
BLOCKED = 1e6


def opening_press(
    organ: trimesh.Trimesh,
    tumour: trimesh.Trimesh | None,
    support: trimesh.Trimesh,
    gravity: tuple[float, float, float],
    housing_mm: tuple[float, float, float],
) -> Press:
    """The press that begins over the middle of the tumour, without one of the organ, from the side that can
    be reached.

    ``organ`` is a closed surface [mm], LPS, with its tumours; ``support`` is what it rests on; ``gravity`` is
    a direction. ``housing_mm`` is the probe's: lateral x elevation x length; the lateral axis is along the
    organ's long axis.
    """
    middle = (organ if tumour is None else tumour).center_mass
    long_axis = np.linalg.svd(organ.vertices - organ.vertices.mean(axis=0), full_matrices=False)[2][0]
    half = np.array(housing_mm[:2]) / 2
    outward = directions_around(-np.array(gravity))
    axes = [_axes_of(direction, long_axis) for direction in outward]
    surface = np.concatenate([organ.vertices, organ.triangles_center]) - middle
    face, gap = np.array([_touching(surface @ frame, half) for frame in axes]).T
    concavity = np.maximum(depth_below_hull(organ, middle + face[:, None] * outward), 0.0)
    blocked = [_is_under(support, middle, frame, half, mm) for frame, mm in zip(axes, face, strict=True)]
    tilt_deg = np.degrees(np.arccos(np.clip(outward @ outward[0], -1, 1)))
    costs = face + GAP_WEIGHT * (gap + concavity) + TILT_MM_DEG * tilt_deg + BLOCKED * np.array(blocked)
    best = outward[np.argmin(costs)]
    x, y, z = middle.round(1).tolist()
    u, v, w = (-best).round(3).tolist()
    return Press(target_mm=(x, y, z), direction=(u, v, w))


def directions_around(axis: np.ndarray) -> np.ndarray:
    """Unit vectors (DIRECTIONS, 3), evenly within MOST_TILT_DEG from an axis (3,), which is the first."""
    axis = axis / np.linalg.norm(axis)
    n = np.arange(DIRECTIONS)
    cosine = 1 - n / (DIRECTIONS - 1) * (1 - np.cos(np.radians(MOST_TILT_DEG)))
    # Successive ones are apart by the golden angle.
    turn = n * np.pi * (3 - np.sqrt(5))
    across = np.sqrt(1 - cosine**2) * np.array([np.cos(turn), np.sin(turn)])
    return np.outer(cosine, axis) + across.T @ np.linalg.svd(axis[None])[2][1:]


def _axes_of(outward: np.ndarray, long_axis: np.ndarray) -> np.ndarray:
    """Axes (3, 3) of a face in columns: lateral, elevation, outward."""
    elevation = np.cross(outward, long_axis)
    elevation /= max(float(np.linalg.norm(elevation)), 1e-9)
    return np.column_stack([np.cross(elevation, outward), elevation, outward])


def _touching(surface: np.ndarray, half_mm: np.ndarray) -> tuple[float, float]:
    """Height [mm] of a face that touches a surface, points (n, 3) on the face's axes, and its mean
    distance [mm] from the surface below.
    """
    counts = np.maximum(np.rint(2 * half_mm / SQUARE_MM).astype(int), 1)
    square = np.floor((surface[:, :2] / half_mm + 1) / 2 * counts).astype(int)
    under = ((square >= 0) & (square < counts)).all(axis=1)
    if not under.any():
        return 0.0, BLOCKED
    highest = np.full(counts, -np.inf)
    np.maximum.at(highest, tuple(square[under].T), surface[under, 2])
    face = float(highest.max())
    return face, float(np.minimum(face - highest, BESIDE_MM).mean())


def _is_under(
    support: trimesh.Trimesh, middle: np.ndarray, axes: np.ndarray, half_mm: np.ndarray, face_mm: float
) -> bool:
    """Whether the support is in the place of the probe, whose face has a height along the axes (3, 3)
    through the middle (3,).
    """
    at = (support.vertices - middle) @ axes
    beside = (np.abs(at[:, :2]) > half_mm + CLEARANCE_MM).any(axis=1)
    return bool((~beside & (at[:, 2] > face_mm)).any())
