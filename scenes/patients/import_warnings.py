"""What looks wrong in a CT and its labels, or was taken for what it may not be: said loudly, for the import goes on."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from scenes.patients.organ_selection import BODY_ABOVE_HU, Organ
from scenes.patients.readers.label_maps import LabelMap, listed
from scenes.patients.readers.segment_names import is_understood
from scenes.volumes.voxel_grid import VoxelGrid

BONE_ABOVE_HU = 300
COARSE_MM = 3.0
LEAST_BONE_ML = 15.0
# Bones of a trunk at the kidneys, spine and ribs, lie on the whole behind the middle of the body.
AHEAD_MM = 10.0
# The liver's middle is on the right, but it reaches over.
LIVER_LEFT_MM = 15.0
# So near its surface an organ's label holds little fat where it was drawn on this CT; its sinus lies deeper.
SHELL_MM, FAT_BELOW_HU, MOST_FAT = 4.0, -60, 0.05
LEAST_LEFT_OUT_ML = 0.5
# What of the parenchyma the echo takes for stone (``ultrasound.tissue_classification``), and the least of it that is worth a line.
STONE_ABOVE_MEDIAN_HU, LEAST_STONE_ML = 130.0, 0.1


def orientation_warnings(
    grid: VoxelGrid, hounsfield: np.ndarray, labels: LabelMap, midline: float | None
) -> tuple[str, ...]:
    """Lines for the user: bones in front of the body's middle, a liver on the left.

    ``hounsfield`` (z, y, x) is the CT at the organs' level on ``grid``; ``midline`` is LPS x [mm].
    """
    found = []
    if _bones_ahead(grid, hounsfield):
        found.append(
            "the bones lie in front of the body's middle, not behind it; the CT may be turned over; compare check.png "
            "with the patient"
        )
    liver = np.isin(labels.values, labels.of_tissues("liver"))
    if midline is not None and liver.any():
        step = max(1, int(COARSE_MM / labels.grid.spacing.min()))
        places = labels.grid.place(np.argwhere(liver[::step, ::step, ::step])[:, ::-1] * step)
        if len(places) and places[:, 0].mean() > midline + LIVER_LEFT_MM:
            found.append(
                "the liver lies on the patient's left; CT and labels may be mirrored; compare check.png with the patient"
            )
    return tuple(found)


def _bones_ahead(grid: VoxelGrid, hounsfield: np.ndarray) -> bool:
    step = np.maximum(1, (COARSE_MM / grid.spacing).astype(int))
    coarse = hounsfield[:: step[2], :: step[1], :: step[0]]
    bone, body = coarse > BONE_ABOVE_HU, coarse > BODY_ABOVE_HU
    if bone.sum() * np.prod(step * grid.spacing) / 1000 < LEAST_BONE_ML:
        return False
    bone_y, body_y = (grid.place(np.argwhere(there)[:, ::-1] * step)[:, 1].mean() for there in (bone, body))
    return bool(bone_y < body_y - AHEAD_MM)


def fat_warnings(
    grid: VoxelGrid, hounsfield: np.ndarray, organ: np.ndarray, parenchyma: np.ndarray
) -> tuple[str, ...]:
    """A line where much of an organ's rim is fat or gas: its label belongs to another CT, or is shifted or mirrored.

    Of the organ (z, y, x) the parenchyma counts: a tumour may hold fat.
    """
    depth = ndimage.distance_transform_edt(organ, sampling=grid.spacing[::-1])
    rim = hounsfield[parenchyma & (depth <= SHELL_MM)]
    share = float((rim < FAT_BELOW_HU).mean()) if len(rim) else 0.0
    if share <= MOST_FAT:
        return ()
    return (
        f"{share:.0%} of the organ's rim is fat or gas in the CT; the labels may be shifted, mirrored or of another CT; "
        "compare the outlines in check.png",
    )


def stone_warnings(
    grid: VoxelGrid, hounsfield: np.ndarray, parenchyma: np.ndarray, urine: np.ndarray
) -> tuple[str, ...]:
    """A line where the echo will show stones in parenchyma (z, y, x): a kidney that excretes contrast agent is as bright there.

    What is labelled as urine, with its rim, is left out: of an enhanced kidney the echo takes it for none.
    """
    if not parenchyma.any():
        return ()
    bright = hounsfield > np.median(hounsfield[parenchyma]) + STONE_ABOVE_MEDIAN_HU
    found_ml = float((bright & parenchyma & ~ndimage.binary_dilation(urine)).sum() * grid.voxel_ml)
    if found_ml < LEAST_STONE_ML:
        return ()
    return (
        f"{found_ml:.1f} ml inside the organ are as bright as stone or contrast agent; in the echo they shine and throw shadows; if they "
        "are contrast agent in the collecting system, label it (--collecting), or take a CT of the portal-venous or nephrographic phase",
    )


def label_warnings(labels: LabelMap, piece: Organ, is_named: bool) -> tuple[str, ...]:
    """Lines on labels without a meaning: all taken as the organ, or left out though they touch it."""
    found = []
    unnamed = [value for value in piece.present if not labels.segments[value].name]
    if not is_named and len(unnamed) > 1:
        names = listed([str(labels.segments[value]) for value in unnamed])
        found.append(
            f"labels {names} say nothing, and were all taken as the kidney; say otherwise with --organ, --tumour, --cyst"
        )
    around = ndimage.binary_dilation(piece.mask, iterations=2) & ~piece.mask
    unsaid = {v for v, s in labels.segments.items() if s.tissue is None and not is_understood(s.name)}
    beside = [v for v in np.unique(piece.values[around]).tolist() if v in unsaid]
    left_out = [(v, float((labels.values == v).sum()) * labels.grid.voxel_ml) for v in beside]
    told = [f"{labels.segments[v]} ({ml:.1f} ml)" for v, ml in left_out if ml >= LEAST_LEFT_OUT_ML]
    if told:
        found.append(
            f"labels beside the organ say no tissue, and were left out: {listed(told)}; if one is the patient's tumour or cyst, "
            "give --tumour or --cyst"
        )
    return tuple(found)
