"""A CT of an abdomen from closed forms, in LPS [mm], and what each voxel of it is: only one kidney is
labelled.
"""

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy import ndimage

from scenes.tissue_classes.tissue_map import CODE

# HU by structure, without contrast agent and in the portal phase, as textbooks have them.
PLAIN = {
    "air": -1000,
    "gas": -900,
    "fat": -100,
    "muscle": 55,
    "liver": 60,
    "spleen": 48,
    "kidney": 34,
    "vessel": 42,
}
ENHANCED = PLAIN | {"muscle": 65, "liver": 115, "spleen": 125, "kidney": 185, "vessel": 180}
BONE, MARROW, BOWEL, BILE = 600, 170, 40, 5
LEFT, RIGHT = np.array([68.0, 26.0, 0.0]), np.array([-68.0, 26.0, -6.0])
HALF_AXES = np.array([25.0, 20.0, 46.0])
LOW, HIGH = np.array([-174.0, -117.0, -56.0]), np.array([174.0, 117.0, 56.0])
NOISE_HU = 8.0


@dataclass(frozen=True)
class Abdomen:
    """HU and labels (nx, ny, nz), the kidney's surface, and the ``truth``: a structure's name at each
    voxel.
    """

    hu: np.ndarray
    labels: np.ndarray
    organ: trimesh.Trimesh
    index_from_mm: np.ndarray
    truth: np.ndarray


def _ellipsoid(at: np.ndarray, middle, half_axes) -> np.ndarray:
    return np.linalg.norm((at - np.asarray(middle)) / half_axes, axis=-1) < 1


def _column(at: np.ndarray, x: float, y: float, radius: float) -> np.ndarray:
    return np.hypot(at[..., 0] - x, at[..., 1] - y) < radius


def structures(at: np.ndarray) -> np.ndarray:
    """The name of the structure at each of some places (.., 3) [mm]."""
    truth = np.full(at.shape[:-1], "air", dtype="U12")
    body = np.hypot(at[..., 0] / 165, at[..., 1] / 110)
    masks = [
        ("fat", body < 1),
        ("muscle", (body < 0.94) & (body > 0.8)),
        ("muscle", _column(at, 36, 78, 17) | _column(at, -36, 78, 17)),
        ("muscle", _column(at, 36, 48, 16) | _column(at, -36, 48, 16)),
        ("bone", _column(at, 0, 50, 21)),
        ("marrow", _column(at, 0, 50, 18)),
        ("vessel", _column(at, 12, 16, 10) | _column(at, -15, 17, 11)),
        ("liver", _ellipsoid(at, (-74, -32, 10), (52, 40, 60))),
        ("bile", _ellipsoid(at, (-52, -44, 0), (15, 15, 22))),
        ("spleen", _ellipsoid(at, (108, -12, 15), (17, 30, 42))),
        ("bowel", _ellipsoid(at, (35, -48, -10), (24, 22, 40))),
        ("gas", _ellipsoid(at, (35, -52, -10), (15, 12, 32))),
        ("kidney", _ellipsoid(at, LEFT, HALF_AXES) | _ellipsoid(at, RIGHT, HALF_AXES)),
    ]
    for name, mask in masks:
        truth[mask] = name
    return truth


def abdomen(
    side: str = "left",
    enhanced: bool = True,
    spacing=(3.0, 3.0, 4.0),
    axes=(0, 1, 2),
    mirrored=(False, False, False),
    others=(),
) -> Abdomen:
    """The abdomen, of which a kidney is labelled, in voxels of a spacing along x, y and z, stored with its
    axes in an order and mirrored.

    ``others`` are pairs of a structure and its HU, where these are not the usual ones.
    """
    spacing = np.array(spacing)
    count = np.ceil((HIGH - LOW) / spacing).astype(int)
    at = LOW + np.moveaxis(np.indices(count), 0, -1) * spacing
    truth = structures(at)
    table = (
        (ENHANCED if enhanced else PLAIN)
        | {"bone": BONE, "marrow": MARROW, "bowel": BOWEL, "bile": BILE}
        | dict(others)
    )
    hu = np.zeros(truth.shape, np.float32)
    for name, value in table.items():
        hu[truth == name] = value
    hu = ndimage.gaussian_filter(hu, 0.8 / spacing)
    hu += np.random.default_rng(7).normal(0, NOISE_HU, hu.shape)
    middle = LEFT if side == "left" else RIGHT
    labels = np.where(_ellipsoid(at, middle, HALF_AXES), CODE["kidney"], 0).astype(np.uint8)
    organ = trimesh.creation.icosphere(subdivisions=4)
    organ.vertices = organ.vertices * HALF_AXES + middle
    mm_from_index = np.eye(4)
    mm_from_index[:3, :3], mm_from_index[:3, 3] = np.diag(spacing), LOW
    stored = [stored_as(each, axes, mirrored) for each in (np.rint(hu).astype(np.int16), labels, truth)]
    return Abdomen(
        stored[0],
        stored[1],
        organ,
        np.linalg.inv(mm_from_index @ stored_map(count, axes, mirrored)),
        stored[2],
    )


def stored_as(values: np.ndarray, axes, mirrored) -> np.ndarray:
    """Values (nx, ny, nz) with their axes in an order, and then mirrored."""
    flips = tuple(slice(None, None, -1 if flip else 1) for flip in mirrored)
    return np.ascontiguousarray(values.transpose(axes)[flips])


def as_before(values: np.ndarray, axes, mirrored) -> np.ndarray:
    """Undo ``stored_as``."""
    flips = tuple(slice(None, None, -1 if flip else 1) for flip in mirrored)
    return values[flips].transpose(np.argsort(axes))


def stored_map(count: np.ndarray, axes, mirrored) -> np.ndarray:
    """The map (4, 4) from indices as stored to those of x, y and z."""
    found = np.eye(4)
    found[:3] = 0
    for k, (axis, flip) in enumerate(zip(axes, mirrored, strict=True)):
        found[axis, k], found[axis, 3] = (-1.0, count[axis] - 1.0) if flip else (1.0, 0.0)
    return found
