"""Whether a CT shows the body as its header says it lies: spine behind, liver on the right, lungs above the
kidneys.

A header may be wrong, and labels of the CT are wrong with it: only the anatomy can object.
"""

from collections.abc import Iterator

import numpy as np
import SimpleITK as sitk
from scipy import ndimage

from scenes.patients.organ_selection import BODY_ABOVE_HU
from scenes.patients.readers.label_maps import LabelMap, among, resample_nearest
from scenes.volumes.voxel_grid import VoxelGrid

BONE_ABOVE_HU = 300
COARSE_MM = 3.0
LEAST_BONE_ML = 15.0
# At the level of the kidneys, the centroid of the bones is posterior to that of the body.
AHEAD_MM = 10.0
# The liver's centroid is on the right, though it extends across the midline.
LIVER_LEFT_MM = 15.0

# The grid on which organs are searched by HU alone: the mean of the voxels in each cell.
CELL_MM = 4.0
# The liver is the largest body of one HU on one side: enhanced 80 to 150 HU, unenhanced 40 to 65. Of the two
# CTs used in development it has 950 and 740 ml, and the largest other one (muscle of the back, stomach) 240
# and 260 ml.
LIVER_HU, HALF_WIDTH_HU, EVEN_SD_HU = range(-15, 200, 15), 15.0, 25.0
LEAST_LIVER_ML, CLEARLY, LEAST_LATERAL_MM = 400.0, 2.5, 30.0
LABELLED_HU = -1000.0
LUNG_HU, LEAST_LUNG_ML = (-950.0, -500.0), 150.0
# The liver's middle and the lungs' are above the kidneys'.
LEAST_BELOW_MM = 20.0


def orientation_warnings(
    overview: sitk.Image, labels: LabelMap, midline: float | None, organ_z_mm: float
) -> tuple[str, ...]:
    """A warning for each organ that is not where it is in a body.

    ``overview`` is the CT [HU] in its full width at the level of the organ; ``labels`` may have a liver.
    ``midline`` is LPS x [mm], None where the CT does not show it; ``organ_z_mm`` is LPS z of the organ's
    middle.
    """
    warnings = []
    if _bones_ahead(overview):
        warnings.append(
            "the bones are in front of the body's centre, not behind it; the CT may be turned over"
        )
    grid, mean = _cells(overview)
    liver = None if midline is None else _liver(grid, mean, labels, midline)
    if liver is not None and midline is not None and liver[0] > midline + LIVER_LEFT_MM:
        warnings.append("the liver is on the patient's left; CT and labels may be mirrored")
    below = {"lungs": _lungs_z(grid, mean), "liver": None if liver is None else liver[2]}
    names = [name for name, z in below.items() if z is not None and z < organ_z_mm - LEAST_BELOW_MM]
    if names:
        warnings.append(f"{' and '.join(names)} are below the kidney's middle; the CT may be upside down")
    return tuple(f"{line}; compare check.png with the patient" for line in warnings)


def _bones_ahead(overview: sitk.Image) -> bool:
    grid, hounsfield = VoxelGrid.of(overview), sitk.GetArrayViewFromImage(overview)
    step = np.maximum(1, (COARSE_MM / grid.spacing).astype(int))
    coarse = hounsfield[:: step[2], :: step[1], :: step[0]]
    bone, body = coarse > BONE_ABOVE_HU, coarse > BODY_ABOVE_HU
    if bone.sum() * np.prod(step * grid.spacing) / 1000 < LEAST_BONE_ML:
        return False
    bone_y, body_y = (_middle(grid, there, step)[1] for there in (bone, body))
    return bool(bone_y < body_y - AHEAD_MM)


def _middle(grid: VoxelGrid, inside: np.ndarray, step: np.ndarray | int = 1) -> np.ndarray:
    """The centroid (3,), LPS [mm], of voxels (z, y, x), of which each ``step``-th of a grid is there."""
    return grid.place(np.argwhere(inside).mean(axis=0)[None, ::-1] * step)[0]


def _cells(overview: sitk.Image) -> tuple[VoxelGrid, np.ndarray]:
    """Grid and mean HU (z, y, x) of cells of about CELL_MM."""
    spacing, size = np.array(overview.GetSpacing()), np.array(overview.GetSize())
    factors = np.minimum(np.maximum(1, np.rint(CELL_MM / spacing)), size).astype(int)
    shrunk = sitk.BinShrink(sitk.Cast(overview, sitk.sitkFloat32), factors.tolist())
    return VoxelGrid.of(shrunk), sitk.GetArrayFromImage(shrunk)


def _liver(grid: VoxelGrid, mean: np.ndarray, labels: LabelMap, midline: float) -> np.ndarray | None:
    """The middle (3,) of the liver, LPS [mm]: as labelled, or else of the clearly largest even body beside
    the midline.
    """
    liver = among(labels.values, labels.of_tissues("liver"))
    if liver.any():
        step = max(1, int(COARSE_MM / labels.grid.spacing.min()))
        coarse = liver[::step, ::step, ::step]
        return _middle(labels.grid, coarse, step) if coarse.any() else None
    # What is labelled is something else, such as a large tumour.
    unlabelled = np.where(resample_nearest(labels.grid, labels.values, grid) > 0, LABELLED_HU, mean)
    bodies = [(ml, middle) for ml, middle in _even_bodies(grid, unlabelled)]
    beside = [body for body in bodies if abs(body[1][0] - midline) > LEAST_LATERAL_MM]
    if not beside:
        return None
    ml, middle = max(beside, key=lambda body: body[0])
    others = [other for other, at in beside if (at[0] > midline) != (middle[0] > midline)]
    return middle if ml >= max(LEAST_LIVER_ML, CLEARLY * max(others, default=0.0)) else None


def _even_bodies(grid: VoxelGrid, mean: np.ndarray) -> Iterator[tuple[float, np.ndarray]]:
    """Volume [ml] and middle (3,), LPS [mm], of the largest connected bodies of soft tissue of one HU."""
    smooth = ndimage.uniform_filter(mean, 3)
    deviation = np.sqrt(np.maximum(ndimage.uniform_filter(mean**2, 3) - smooth**2, 0))
    for level in LIVER_HU:
        inside = (deviation < EVEN_SD_HU) & (np.abs(smooth - level) <= HALF_WIDTH_HU)
        if inside.sum() * grid.voxel_ml < LEAST_LIVER_ML / CLEARLY:
            continue
        parts, count = ndimage.label(ndimage.binary_opening(inside, iterations=2))
        if count:
            largest = parts == 1 + np.argmax(np.bincount(parts.ravel())[1:])
            yield float(largest.sum() * grid.voxel_ml), _middle(grid, largest)


def _lungs_z(grid: VoxelGrid, mean: np.ndarray) -> float | None:
    """LPS z [mm] of the lungs' middle, if there are lungs. Gas in the bowel is in smaller pieces."""
    # A slice is a plane across the body's length in most CTs; in others the holes are open, and nothing is
    # found.
    inside = ndimage.binary_fill_holes(mean > BODY_ABOVE_HU, np.ones((1, 3, 3)))
    parts, count = ndimage.label(ndimage.binary_opening(inside & (mean > LUNG_HU[0]) & (mean < LUNG_HU[1])))
    volumes = np.bincount(parts.ravel(), minlength=count + 1) * grid.voxel_ml
    volumes[0] = 0
    lungs = volumes[parts] >= LEAST_LUNG_ML
    return float(_middle(grid, lungs)[2]) if lungs.any() else None
