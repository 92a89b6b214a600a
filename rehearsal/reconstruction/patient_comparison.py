"""A rebuilt sweep against the patient that it was taken of: the surfaces of the scene, as they lie in the CT."""

import math
from dataclasses import asdict
from typing import Any

import numpy as np
import trimesh

from rehearsal.reconstruction.segmentation_metrics import SegmentationMetrics, segmentation_metrics
from rehearsal.reconstruction.sweep_volumes import Rebuilt
from scenes.anatomy import LoadedAnatomy
from sim.signed_distance import signed_distance
from ultrasound.reconstruction import VoxelBox


def surfaces_of(anatomy: LoadedAnatomy) -> dict[str, trimesh.Trimesh]:
    """What a sweep is compared with, by name."""
    return {"organ": anatomy.organ} | ({"tumour": anatomy.tumour} if anatomy.tumour is not None else {})


def inside(surface: trimesh.Trimesh, box: VoxelBox) -> np.ndarray:
    """Which voxels (x, y, z) of a box have their centre in a closed surface [mm]."""
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
    """Whether none of a surface [mm] can lie in a box."""
    last = box.origin_mm + box.spacing_mm * (np.array(box.shape) - 1)
    low, high = surface.bounds
    return bool((low > last).any() or (high < box.origin_mm).any())


def wider(rebuilt: Rebuilt, surface: trimesh.Trimesh) -> Rebuilt:
    """The same on a box that holds a surface too, so that what was not scanned counts."""
    box, spacing = rebuilt.box, rebuilt.box.spacing_mm
    low, high = ((surface.bounds - box.origin_mm) / spacing).round().astype(int)
    before = np.maximum(1 - low, 0)
    after = np.maximum(high + 2 - box.shape, 0)
    pad = list(zip(before, after, strict=True))
    regions = {name: np.pad(region, pad) for name, region in rebuilt.regions.items()}
    x, y, z = (int(n) for n in np.array(box.shape) + before + after)
    grown = VoxelBox(box.origin_mm - spacing * before, spacing, (x, y, z))
    return Rebuilt(grown, np.pad(rebuilt.grey, pad), np.pad(rebuilt.known, pad), regions, rebuilt.beads)


def compared(
    rebuilt: Rebuilt, surfaces: dict[str, trimesh.Trimesh], beads_mm: np.ndarray | None = None
) -> dict[str, Any]:
    """Figures of merit of each region, of its whole surface and of the part that was scanned; landmark errors of beads (n, 3) [mm]."""
    found: dict[str, Any] = {}
    for name, surface in surfaces.items():
        if name not in rebuilt.regions:
            continue
        all_of = wider(rebuilt, surface)
        truth = inside(surface, all_of.box)
        if not truth.any():
            # It falls between the centres of voxels.
            continue
        spacing = rebuilt.box.spacing_mm
        region = all_of.regions[name]
        seen = truth & all_of.known
        whole = segmentation_metrics(region, truth, spacing)
        part = segmentation_metrics(region & all_of.known, seen, spacing) if seen.any() else None
        found[name] = dict(
            scanned=float(seen.sum() / truth.sum()),
            whole=_rounded(whole),
            scanned_part=None if part is None else _rounded(part),
        )
    if beads_mm is not None:
        errors = landmark_errors(rebuilt, beads_mm)
        found["landmarks"] = dict(
            count=len(errors),
            of=len(beads_mm),
            mean_mm=float(np.mean(errors)) if errors else None,
            max_mm=float(np.max(errors)) if errors else None,
        )
    return found


def landmark_errors(rebuilt: Rebuilt, beads_mm: np.ndarray) -> list[float]:
    """How far the middles of the beads that were seen are from where they are at rest [mm]."""
    return [float(np.linalg.norm(place - beads_mm[bead])) for bead, place in rebuilt.beads.items()]


def _rounded(figures: SegmentationMetrics) -> dict[str, float | None]:
    """None for what cannot be measured, where nothing was found."""
    return {
        name: round(value, 4) if math.isfinite(value) else None for name, value in asdict(figures).items()
    }
