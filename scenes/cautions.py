"""What looks mirrored or upside down in a CT and its labels: said loudly, for the import goes on."""

from __future__ import annotations

import numpy as np

from scenes.reading.grid import VoxelGrid
from scenes.reading.labels import LabelMap

BONE_ABOVE_HU, BODY_ABOVE_HU = 300, -300
COARSE_MM = 3.0
LEAST_BONE_ML = 15.0
# Bones of a trunk at the kidneys, spine and ribs, lie on the whole behind the middle of the body.
AHEAD_MM = 10.0
# The liver's middle is on the right, but it reaches over.
LIVER_LEFT_MM = 15.0


def cautions(
    grid: VoxelGrid, hounsfield: np.ndarray, labels: LabelMap, midline: float | None
) -> tuple[str, ...]:
    """Lines for the user: bones in front of the body's middle, a liver on the left.

    ``hounsfield`` (z, y, x) is the CT at the organs' level on ``grid``; ``midline`` is LPS x [mm].
    """
    found = []
    if _bones_ahead(grid, hounsfield):
        found.append(
            "CAUTION: the bones lie in front of the body's middle, not behind it; the CT may be turned over; compare check.png "
            "with the patient"
        )
    liver = np.isin(labels.values, labels.of_tissues("liver"))
    if midline is not None and liver.any():
        step = max(1, int(COARSE_MM / labels.grid.spacing.min()))
        places = labels.grid.place(np.argwhere(liver[::step, ::step, ::step])[:, ::-1] * step)
        if len(places) and places[:, 0].mean() > midline + LIVER_LEFT_MM:
            found.append(
                "CAUTION: the liver lies on the patient's left; CT and labels may be mirrored; compare check.png with the patient"
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
