"""What an import says of dense pieces in a kidney: contrast agent or stone, as
``scenes/tissue_classes/collecting_system.py`` decides.
"""

import numpy as np
import SimpleITK as sitk
import trimesh
from scipy import ndimage

from scenes.patients.organ_selection import closing
from scenes.tissue_classes.collecting_system import DENSE_ABOVE_HU, LARGEST_STONE_ML
from scenes.tissue_classes.kidney_parts import ENHANCED_FROM_HU, median_hu
from scenes.tissue_classes.tissue_map import (
    CODE,
    PARENCHYMA,
    codes_of_labels,
    dense_pieces_of_kidney,
    of_tissues,
)
from scenes.volumes.voxel_grid import VoxelGrid

# Less volume gives no warning.
LEAST_ML = 0.1


def dense_findings(
    grid: VoxelGrid,
    hounsfield: np.ndarray,
    coded: np.ndarray,
    tissues: dict[int, str],
    organ: trimesh.Trimesh,
    corrections: sitk.Image | None = None,
) -> tuple[tuple[str, ...], str]:
    """Warnings of the dense pieces of a kidney, which say how they are shown, and a note of its contrast
    phase.

    ``hounsfield`` [HU] and ``coded`` (z, y, x), the codes of the labelled ``tissues`` or 0, are on ``grid``.
    ``organ`` is a surface [mm]; ``corrections`` are the tissues that class images correct, 0 elsewhere.
    """
    own = codes_of_labels(coded.transpose(2, 1, 0), tissues)
    hu = np.ascontiguousarray(hounsfield.transpose(2, 1, 0), np.float32)
    parenchyma = of_tissues(own, *PARENCHYMA)
    level_hu = median_hu(hu, parenchyma)
    is_enhanced, warnings = level_hu > ENHANCED_FROM_HU, list[str]()
    agent_ml = 0.0
    if _has_dense(hu, parenchyma | of_tissues(own, "sinus"), level_hu + DENSE_ABOVE_HU, grid.spacing):
        pieces, index_from_mm = dense_pieces_of_kidney(hu, own, organ, grid.index_from_mm)
        fine = VoxelGrid.of_transform(index_from_mm, pieces.urine.shape)
        corrected = np.zeros(pieces.urine.shape, bool)
        if corrections is not None:
            corrected = _sampled(corrections, fine)
        labelled = _sampled(grid.image((own == CODE["urine"]).transpose(2, 1, 0).astype(np.uint8)), fine)
        urine = _without_touching(pieces.urine, labelled) & ~corrected
        stone = pieces.stone & ~corrected
        is_enhanced, agent_ml = pieces.is_enhanced, float(urine.sum() * fine.voxel_ml)
        kidney = f"kidney {level_hu:.0f} HU: {'enhanced' if is_enhanced else 'unenhanced'}"
        agent = (
            "contrast agent in the collecting system",
            "fluid; a stone in it cannot be distinguished: label it (--stones)",
        )
        large = (
            f"dense, in a piece of more than {LARGEST_STONE_ML:g} ml",
            "contrast agent, as fluid; if it is a stone, label it (--stones)",
        )
        small = "dense", "stone, with its shadow; if it is contrast agent, label it (--collecting)"
        for mask, (what, shown) in ((urine, agent if is_enhanced else large), (stone, small)):
            ml = float(mask.sum() * fine.voxel_ml)
            if ml >= LEAST_ML:
                where = _largest_piece(fine, mask, organ)
                warnings.append(f"{ml:.1f} ml in the kidney are {what} ({kidney}), {where}: shown as {shown}")
    phase = "unenhanced" if not is_enhanced else "enhanced" if agent_ml < LEAST_ML else "excretory"
    return tuple(warnings), (
        f"contrast phase: {phase}, as the kidney has a median of {level_hu:.0f} HU (with contrast agent "
        f"more than {ENHANCED_FROM_HU:g})"
        + f", and its collecting system {agent_ml:.1f} ml of contrast agent"
        * (phase == "excretory")
    )


def _has_dense(hu: np.ndarray, kidney: np.ndarray, above_hu: float, spacing_mm: np.ndarray) -> bool:
    """Whether there is anything dense in a kidney (nx, ny, nz) and its hollows, or next to them: few have
    any.
    """
    if not kidney.any():
        return False
    box = tuple(
        slice(max(a.start - 2, 0), a.stop + 2) for a in ndimage.find_objects(kidney.astype(np.uint8))[0]
    )
    dense = hu[box] > above_hu
    return bool(
        dense.any()
        and (dense & ndimage.binary_dilation(closing(kidney[box], spacing_mm), iterations=2)).any()
    )


def _sampled(image: sitk.Image, grid: VoxelGrid) -> np.ndarray:
    """Whether an image's voxel is not 0 at those of another grid (nx, ny, nz)."""
    return grid.sampled(image, sitk.sitkNearestNeighbor, 0).transpose(2, 1, 0) > 0


def _without_touching(mask: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The pieces of a mask that do not touch another: the rim of labelled contrast agent is as bright by
    partial volume.
    """
    pieces, _ = ndimage.label(mask, np.ones((3, 3, 3)))
    touching = np.unique(pieces[ndimage.binary_dilation(other, np.ones((3, 3, 3)))])
    return mask & ~np.isin(pieces, touching)


def _largest_piece(grid: VoxelGrid, mask: np.ndarray, organ: trimesh.Trimesh) -> str:
    """Where the largest connected piece of a mask (nx, ny, nz) is, in words."""
    pieces, _ = ndimage.label(mask, np.ones((3, 3, 3)))
    piece = pieces == np.bincount(pieces[mask]).argmax()
    x, y, z = grid.place(np.argwhere(piece)).mean(axis=0)
    low, high = organ.bounds[:, 2]
    third = ("lower", "middle", "upper")[int(np.clip(3 * (z - low) / (high - low), 0, 2))]
    return (
        f"the largest piece {piece.sum() * grid.voxel_ml:.1f} ml in the {third} third, at {x:.0f}, "
        f"{y:.0f}, {z:.0f} mm (LPS)"
    )
