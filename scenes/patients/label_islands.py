"""What is labelled as the organ, a tumour or a cyst, and is connected to no kidney: left out, and named."""

from collections.abc import Sequence

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from scenes.patients.organ_selection import CORNERS, Organ
from scenes.patients.readers.label_maps import LESIONS, LabelMap, among, box_of

# Smaller islands are left out without a warning: specks of an automatic segmentation, a lesion of 6 mm.
LEAST_ORGAN_ML, LEAST_LESION_ML = 1.0, 0.1
# An island that is so much nearer to the other kidney is that one's.
CLEARLY_MM = 30.0


def island_warnings(
    labels: LabelMap, own: Sequence[int], pieces: Sequence[Organ], chosen: Organ
) -> tuple[str, ...]:
    """Warnings of islands of an organ's labels, its tumours and cysts that may be those of the chosen one of
    all pieces.

    ``own`` are the organ's values.
    """
    warnings = _islands(labels, "organ", own, LEAST_ORGAN_ML, pieces, chosen)
    for tissue in LESIONS:
        warnings += _islands(labels, tissue, labels.of_tissues(tissue), LEAST_LESION_ML, pieces, chosen)
    return tuple(warnings)


def _islands(
    labels: LabelMap,
    name: str,
    values: Sequence[int],
    least_ml: float,
    pieces: Sequence[Organ],
    chosen: Organ,
) -> list[str]:
    apart = among(labels.values, values)
    for piece in pieces:
        start = np.rint(labels.grid.index(piece.grid.origin)).astype(int)
        box = tuple(slice(a, a + n) for a, n in zip(start[::-1], piece.mask.shape, strict=True))
        apart[box] &= ~piece.mask
    if apart.sum() * labels.grid.voxel_ml < least_ml:
        return []
    inner = box_of(apart)
    grid = labels.grid.part(inner)
    parts, count = ndimage.label(apart[inner[::-1]], CORNERS)
    volumes = np.bincount(parts.ravel(), minlength=count + 1) * grid.voxel_ml
    warnings = []
    for n in 1 + np.flatnonzero(volumes[1:] >= least_ml):
        places = grid.place(np.argwhere(parts == n)[:, ::-1])
        distance, nearest = _distance_mm(chosen, places), min(_distance_mm(piece, places) for piece in pieces)
        if distance <= nearest + CLEARLY_MM:
            x, y, z = places.mean(axis=0)
            warnings.append(
                f"{volumes[n]:.1f} ml of the {name}'s label touch no labelled kidney, {distance:.0f} mm from "
                f"this one at {x:.0f}, {y:.0f}, "
                f"{z:.0f} mm (LPS), and were left out; compare the labels with the CT"
            )
    return warnings


def _distance_mm(piece: Organ, places: np.ndarray) -> float:
    """Least distance of an organ's voxels from some places (n, 3), LPS [mm]."""
    rim = piece.mask & ~ndimage.binary_erosion(piece.mask)
    return float(cKDTree(piece.grid.place(np.argwhere(rim)[:, ::-1])).query(places)[0].min())
