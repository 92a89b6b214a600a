"""Segmentation metrics of a reconstructed region: Dice, HD95, volume, centroid."""

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage


@dataclass(frozen=True)
class SegmentationMetrics:
    """Metrics of a region found, against the true region.

    - ``dice``: Dice coefficient, 0 to 1.
    - ``hd95_mm``: 95th percentile Hausdorff distance: the larger of the two directed percentiles (MONAI's definition). The
      surface is the voxels of a region with one outside among their six neighbours.
    - ``volume_percent``: volume relative to the truth, minus 100 %.
    - ``centroid_mm``: distance of the centroids.

    Where nothing was found, Dice is 0, the volume -100 %, and the two distances are nan.
    """

    dice: float
    hd95_mm: float
    volume_percent: float
    centroid_mm: float


def segmentation_metrics(found: np.ndarray, truth: np.ndarray, spacing_mm: float) -> SegmentationMetrics:
    """Compare two regions (x, y, z) bool on one grid of cubic voxels.

    Raises ValueError where the grids differ, or where the truth is empty.
    """
    found, truth = np.asarray(found, bool), np.asarray(truth, bool)
    if found.shape != truth.shape:
        raise ValueError(f"regions are on grids of {found.shape} and {truth.shape} voxels")
    if not truth.any():
        raise ValueError("the true region is empty")
    if not found.any():
        return SegmentationMetrics(0.0, math.nan, -100.0, math.nan)
    # The bounding box of both: distances do not change.
    both = ndimage.find_objects((found | truth).astype(np.uint8))[0]
    found, truth = found[both], truth[both]
    shared, count, true_count = (int(np.count_nonzero(a)) for a in (found & truth, found, truth))
    return SegmentationMetrics(
        dice=2 * shared / (count + true_count),
        hd95_mm=spacing_mm * max(_distance95(found, truth), _distance95(truth, found)),
        volume_percent=100 * (count / true_count - 1),
        centroid_mm=spacing_mm * float(np.linalg.norm(_centroid(found) - _centroid(truth))),
    )


def _distance95(region: np.ndarray, other: np.ndarray) -> float:
    """95th percentile of the distances [voxels] from the surface of one region to the other's."""
    distances = ndimage.distance_transform_edt(~_surface(other))
    return float(np.percentile(distances[_surface(region)], 95))


def _surface(region: np.ndarray) -> np.ndarray:
    return region & ~ndimage.binary_erosion(region)


def _centroid(region: np.ndarray) -> np.ndarray:
    return np.argwhere(region).mean(axis=0)
