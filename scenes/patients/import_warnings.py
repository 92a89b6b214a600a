"""Warnings of an import: what looks wrong in a CT and its labels, or was assumed."""

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from scenes.patients.organ_selection import HILAR, PARENCHYMA, Organ
from scenes.patients.readers.label_maps import LESIONS, LabelMap, box_of, listed
from scenes.patients.readers.segment_names import is_derived
from scenes.volumes.voxel_grid import VoxelGrid

# The outer shell of a correct label contains little fat; the sinus is deeper.
SHELL_MM, FAT_BELOW_HU, MOST_FAT = 4.0, -60, 0.05
# Tissues that are in a kidney, or at its hilum.
OF_KIDNEY = (*PARENCHYMA, *LESIONS, *HILAR)
# A segment touches an organ that is so many voxels away, and is in it with this share; beside it, less volume
# gives no warning.
REACH, LEAST_WITHIN, LEAST_BESIDE_ML = 2, 0.5, 0.5
# What is larger than this share of the organ is around it, as its fascia.
MOST_WITHIN = 0.5
MOST_PLACES = 100_000


def fat_warnings(
    grid: VoxelGrid, hounsfield: np.ndarray, organ: np.ndarray, parenchyma: np.ndarray, slice_mm: float
) -> tuple[str, ...]:
    """A warning where much of an organ's outer shell is fat or gas: its label is shifted, mirrored or of
    another CT.

    Of the organ (z, y, x) only the parenchyma counts: a tumour may contain fat. A label whose slices are
    ``slice_mm`` apart ends in steps of that height.
    """
    # A voxel beyond the organ's box is farther than one at its side.
    box = tuple(slice(max(0, a.start - 1), a.stop + 1) for a in box_of(organ)[::-1]) if organ.any() else ()
    depth = ndimage.distance_transform_edt(organ[box], sampling=grid.spacing[::-1])
    step_mm = max(0.0, 0.5 * (slice_mm - float(grid.spacing.max())))
    rim = hounsfield[box][parenchyma[box] & (depth > step_mm) & (depth <= SHELL_MM + step_mm)]
    share = float((rim < FAT_BELOW_HU).mean()) if len(rim) else 0.0
    if share <= MOST_FAT:
        return ()
    return (
        f"{share:.0%} of the organ's rim is fat or gas in the CT; the labels may be shifted, mirrored or "
        "of another CT; "
        "compare the outlines in check.png",
    )


def label_warnings(
    labels: LabelMap, piece: Organ, is_named: bool, drawn: Sequence[LabelMap]
) -> tuple[str, ...]:
    """Warnings of labels without a known tissue: taken as the organ, or left out though they are in it or
    touch it.

    ``piece`` is the organ in ``labels``, ``drawn`` the label maps before they were merged; ``is_named``:
    whether the user named the organ's labels.
    """
    warnings = []
    unnamed = [value for value in piece.present if not labels.segments[value].name]
    if not is_named and len(unnamed) > 1:
        names = listed([str(labels.segments[value]) for value in unnamed])
        warnings.append(
            f"labels {names} have no names, and were all taken as the kidney; if they are not, give --organ, "
            "--tumour, --cyst"
        )
    taken = [labels.segments[value] for value in piece.present]
    filled = ndimage.binary_fill_holes(np.pad(piece.mask, REACH))
    near = ndimage.binary_dilation(filled, iterations=REACH)
    for one in drawn:
        for value, segment in one.segments.items():
            if segment not in taken and segment.tissue not in OF_KIDNEY and not is_derived(segment.name):
                warnings += _other_segment(one, value, piece, near)
    return tuple(warnings)


def _other_segment(one: LabelMap, value: int, piece: Organ, near: np.ndarray) -> list[str]:
    """A warning of a segment that is no part of a kidney: in an organ, or, where its tissue is not known,
    beside it.

    ``near`` is the organ without hollows, dilated by REACH voxels.
    """
    segment = one.segments[value]
    indices = np.argwhere(one.values == value)[:, ::-1]
    volume_ml = len(indices) * one.grid.voxel_ml
    places = one.grid.place(indices[:: max(1, len(indices) // MOST_PLACES)])
    share = _share_in(near, piece.grid.index(places) + REACH)
    advice = "if it is the patient's tumour or cyst, give --tumour or --cyst with its name or value"
    if share >= LEAST_WITHIN and volume_ml < MOST_WITHIN * piece.volume_ml:
        known = "is of no tissue of a kidney" if segment.is_understood else "has no known tissue"
        return [
            f"label {segment} ({volume_ml:.1f} ml) in the organ {known}, and is not shown, "
            f"{_place(piece, places)}; {advice}"
        ]
    if segment.is_understood or segment.tissue is not None or share == 0 or volume_ml < LEAST_BESIDE_ML:
        return []
    return [
        f"label {segment} ({volume_ml:.1f} ml) touches the organ and has no known tissue, and was left "
        f"out; {advice}"
    ]


def _share_in(mask: np.ndarray, indices: np.ndarray) -> float:
    """The share of places, as voxel indices (n, 3) with fractions, in a mask (z, y, x)."""
    at = np.rint(indices).astype(int)
    at = at[((at >= 0) & (at < mask.shape[::-1])).all(axis=1)]
    return float(mask[tuple(at.T[::-1])].sum() / max(1, len(indices)))


def _place(piece: Organ, places: np.ndarray) -> str:
    """Where the middle of some places (n, 3), LPS [mm], of an organ is, in words."""
    x, y, z = places.mean(axis=0)
    heights = piece.grid.corners()[:, 2]
    share = (z - heights.min()) / max(float(np.ptp(heights)), 1e-9)
    third = ("lower", "middle", "upper")[int(np.clip(3 * share, 0, 2))]
    return f"in the {third} third, at {x:.0f}, {y:.0f}, {z:.0f} mm (LPS)"
