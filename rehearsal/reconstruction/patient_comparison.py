"""The volumes of a sweep compared with the patient: with the surfaces of the scene, at rest in the CT, by
Dice, HD95, volume, centroid.
"""

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import trimesh
from scipy import ndimage

from rehearsal.reconstruction.sweep_volumes import SweepVolumes
from scenes.anatomy import LoadedAnatomy
from sim.signed_distance import signed_distance
from ultrasound.reconstruction import VoxelBox


@dataclass(frozen=True)
class SegmentationMetrics:
    """Metrics of a region found, against the true region.

    - ``dice``: Dice coefficient, 0 to 1.
    - ``hd95_mm``: 95th percentile Hausdorff distance: the larger of the two directed percentiles (MONAI's
      definition). The surface is the voxels of a region with one outside among their six neighbours.
    - ``volume_percent``: volume relative to the truth, minus 100 %.
    - ``centroid_mm``: distance of the centroids.

    Where nothing was found, Dice is 0, the volume -100 %, and the two distances are nan.
    """

    dice: float
    hd95_mm: float
    volume_percent: float
    centroid_mm: float


def segmentation_metrics(region: np.ndarray, truth: np.ndarray, spacing_mm: float) -> SegmentationMetrics:
    """Compare two regions (x, y, z) bool on one grid of cubic voxels.

    Raises ValueError where the grids differ, or where the truth is empty.
    """
    region, truth = np.asarray(region, bool), np.asarray(truth, bool)
    if region.shape != truth.shape:
        raise ValueError(f"regions are on grids of {region.shape} and {truth.shape} voxels")
    if not truth.any():
        raise ValueError("the true region is empty")
    if not region.any():
        return SegmentationMetrics(0.0, math.nan, -100.0, math.nan)
    # The bounding box of both: distances do not change.
    both = ndimage.find_objects((region | truth).astype(np.uint8))[0]
    region, truth = region[both], truth[both]
    shared, count, true_count = (int(np.count_nonzero(a)) for a in (region & truth, region, truth))
    return SegmentationMetrics(
        dice=2 * shared / (count + true_count),
        hd95_mm=spacing_mm * max(_distance95(region, truth), _distance95(truth, region)),
        volume_percent=100 * (count / true_count - 1),
        centroid_mm=spacing_mm * math.dist(ndimage.center_of_mass(region), ndimage.center_of_mass(truth)),
    )


def _distance95(region: np.ndarray, other: np.ndarray) -> float:
    """95th percentile of the distances [voxels] from the surface of one region to the other's."""
    distances = ndimage.distance_transform_edt(~_surface(other))
    return float(np.percentile(distances[_surface(region)], 95))


def _surface(region: np.ndarray) -> np.ndarray:
    return region & ~ndimage.binary_erosion(region)


def surfaces_of(anatomy: LoadedAnatomy) -> dict[str, trimesh.Trimesh]:
    """The surfaces that a sweep is compared with, by name."""
    return {"organ": anatomy.organ} | ({"tumour": anatomy.tumour} if anatomy.tumour is not None else {})


def voxels_inside(surface: trimesh.Trimesh, box: VoxelBox) -> np.ndarray:
    """The voxels (x, y, z) of a box whose centre is inside a closed surface [mm]."""
    mask = np.zeros(box.shape, bool)
    low, high = ((surface.bounds - box.origin_mm) / box.spacing_mm).round().astype(int)
    part = tuple(
        slice(max(a - 1, 0), max(min(b + 2, n), 0)) for a, b, n in zip(low, high, box.shape, strict=True)
    )
    first = box.origin_mm + box.spacing_mm * np.array([s.start for s in part])
    shape = mask[part].shape
    places = first + box.spacing_mm * np.moveaxis(np.indices(shape), 0, -1).reshape(-1, 3)
    if len(places):
        mask[part] = (signed_distance(surface.vertices, surface.faces, places)[0] < 0).reshape(shape)
    return mask


def are_apart(box: VoxelBox, surface: trimesh.Trimesh) -> bool:
    """Whether the bounding box of a surface [mm] and a voxel box do not overlap."""
    last = box.origin_mm + box.spacing_mm * (np.array(box.shape) - 1)
    low, high = surface.bounds
    return bool((low > last).any() or (high < box.origin_mm).any())


def enclosing(volumes: SweepVolumes, surface: trimesh.Trimesh) -> SweepVolumes:
    """The same volumes on a box that encloses a surface too, so that what was not scanned counts."""
    box, spacing = volumes.box, volumes.box.spacing_mm
    low, high = ((surface.bounds - box.origin_mm) / spacing).round().astype(int)
    before = np.maximum(1 - low, 0)
    after = np.maximum(high + 2 - box.shape, 0)
    pad = list(zip(before, after, strict=True))
    regions = {name: np.pad(region, pad) for name, region in volumes.regions.items()}
    x, y, z = (int(n) for n in np.array(box.shape) + before + after)
    grown = VoxelBox(box.origin_mm - spacing * before, spacing, (x, y, z))
    return SweepVolumes(grown, np.pad(volumes.grey, pad), np.pad(volumes.known, pad), regions, volumes.beads)


def compare_with_surfaces(
    volumes: SweepVolumes, surfaces: dict[str, trimesh.Trimesh], beads_mm: np.ndarray | None = None
) -> dict[str, Any]:
    """Segmentation metrics of each region, for the whole surface and for the scanned part; landmark errors
    of beads (n, 3) [mm].
    """
    comparison: dict[str, Any] = {}
    for name, surface in surfaces.items():
        if name not in volumes.regions:
            continue
        enclosed = enclosing(volumes, surface)
        truth = voxels_inside(surface, enclosed.box)
        if not truth.any():
            # It is smaller than a voxel.
            continue
        spacing = volumes.box.spacing_mm
        region = enclosed.regions[name]
        scanned = truth & enclosed.known
        whole = segmentation_metrics(region, truth, spacing)
        part = segmentation_metrics(region & enclosed.known, scanned, spacing) if scanned.any() else None
        comparison[name] = dict(
            scanned=float(scanned.sum() / truth.sum()),
            whole=_rounded(whole),
            scanned_part=None if part is None else _rounded(part),
        )
    if beads_mm is not None:
        errors = [float(np.linalg.norm(place - beads_mm[bead])) for bead, place in volumes.beads.items()]
        comparison["landmarks"] = dict(
            count=len(errors),
            of=len(beads_mm),
            mean_mm=float(np.mean(errors)) if errors else None,
            max_mm=float(np.max(errors)) if errors else None,
        )
    return comparison


def _rounded(figures: SegmentationMetrics) -> dict[str, float | None]:
    """None for metrics that are not defined, where nothing was found."""
    return {
        name: round(value, 4) if math.isfinite(value) else None for name, value in asdict(figures).items()
    }
