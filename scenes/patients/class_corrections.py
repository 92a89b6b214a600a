"""What a user corrected in a class image (``scenes/tissue_classes/class_image.py``): where it differs from
the classification.

The kidney, its tumour and what else was labelled come from the other labels: a class image says of what
tissue their surroundings and the parts of the kidney are.
"""

from collections.abc import Sequence

import numpy as np
import SimpleITK as sitk
import trimesh
from scipy import ndimage

from scenes.patients.organ_selection import VESSELS
from scenes.patients.readers.label_maps import LESIONS, LabelMap, listed, resample_nearest
from scenes.tissue_classes.class_image import DRAWN_NAME, is_drawn
from scenes.tissue_classes.fine_grid import fine_factors
from scenes.tissue_classes.tissue_map import CODE, TISSUES, codes_of_labels, of_tissues, tissue_map
from scenes.volumes.voxel_grid import VoxelGrid

# A class image may name these within what is labelled as kidney, the first not outside it.
WITHIN_KIDNEY = ("cortex", "medulla", "arcuate")
PARTS_OF_KIDNEY = (*WITHIN_KIDNEY, "sinus", "urine", "stone", *VESSELS)
# What is labelled, and not corrected.
OF_LABELS = ("kidney", *LESIONS, "pseudocapsule")
# Segments of what was drawn as thin sheets in another tissue.
DRAWN_SHEETS = tuple(tissue + DRAWN_NAME for tissue in ("fascia", "perimysium"))
LEAST_ML = 0.05


def corrections_of(
    grid: VoxelGrid,
    hounsfield: np.ndarray,
    coded: np.ndarray,
    tissues: dict[int, str],
    organ: trimesh.Trimesh,
    classes: Sequence[LabelMap],
) -> tuple[sitk.Image | None, list[str]]:
    """Codes of TISSUES where class images correct the classification, 0 elsewhere, uint8 on its fine grid, or
    None where they correct nothing; and notes.

    ``hounsfield`` [HU] and ``coded`` (z, y, x), the codes of the labelled ``tissues`` or 0, are on ``grid``.
    ``organ`` is a surface [mm]; ``classes`` are the label maps of class images, on any grid.
    """
    own = codes_of_labels(coded.transpose(2, 1, 0), tissues)
    hu = np.ascontiguousarray(hounsfield.transpose(2, 1, 0), np.float32)
    classification = tissue_map(hu, own, organ, grid.index_from_mm, draws=False)
    fine = VoxelGrid.of_transform(classification.index_from_mm, classification.codes.shape)
    stated = _stated(classes, fine, classification.codes)
    changed = (stated > 0) & (stated != classification.codes)
    for axis, factor in enumerate(fine_factors(grid.spacing)):
        own = own.repeat(factor, axis)
    taken = changed & _may_be(stated, own, classification.codes)
    texts = {
        "corrected by the class image": _changes(classification.codes, stated, taken, fine),
        "not taken from the class image, as the labels say where kidney, tumours, cysts and other "
        "labelled tissues are": (_changes(classification.codes, stated, changed & ~taken, fine)),
        "left out of the class image, as drawn from an atlas": _drawn(classes),
    }
    notes = [f"{text}: {listed(names)}" for text, names in texts.items() if names]
    if not taken.any():
        return None, notes
    return fine.image(np.ascontiguousarray(np.where(taken, stated, 0).transpose(2, 1, 0), np.uint8)), notes


def _stated(classes: Sequence[LabelMap], fine: VoxelGrid, classified: np.ndarray) -> np.ndarray:
    """What class images say (nx, ny, nz), as codes of TISSUES; 0 where they say nothing.

    Where several layers of a file say something, what differs from ``classified`` counts. Sheets are of the
    tissue that they were drawn in.
    """
    stated, sheets = np.zeros(classified.shape, np.uint8), np.zeros(classified.shape, bool)
    for one in classes:
        known = {v: s.tissue for v, s in one.segments.items() if s.tissue and not is_drawn(s.name)}
        values = resample_nearest(one.grid, one.values, fine).transpose(2, 1, 0)
        sheets |= np.isin(values, [v for v, s in one.segments.items() if s.name in DRAWN_SHEETS])
        codes = codes_of_labels(values, known)
        counts = (codes > 0) & ((stated == 0) | (codes != classified))
        stated[counts] = codes[counts]
    for tissue in np.unique(classified[sheets & (stated == 0)]):
        of_tissue = (stated > 0) & (classified == tissue)
        if (stated[of_tissue] != tissue).any():
            nearest = ndimage.distance_transform_edt(~of_tissue, fine.spacing, False, True)
            lines = sheets & (stated == 0) & (classified == tissue)
            stated[lines] = stated[tuple(nearest[:, lines])]
    return stated


def _may_be(stated: np.ndarray, own: np.ndarray, classified: np.ndarray) -> np.ndarray:
    """Whether what a class image says counts, where the labels say ``own``: the kidney's surface leaves out
    some of its voxels.
    """
    kidney = own == CODE["kidney"]
    within = kidney & of_tissues(classified, "kidney", *PARTS_OF_KIDNEY)
    beside = ((own == 0) | kidney) & ~within
    return (within & of_tissues(stated, *PARTS_OF_KIDNEY)) | (
        beside & ~of_tissues(stated, *OF_LABELS, *WITHIN_KIDNEY)
    )


def _changes(classified: np.ndarray, stated: np.ndarray, where: np.ndarray, grid: VoxelGrid) -> list[str]:
    """What class images change, from tissue to tissue in words, the largest volumes first."""
    ml = np.bincount(256 * classified[where].astype(int) + stated[where], minlength=1) * grid.voxel_ml
    largest = [int(n) for n in np.argsort(ml)[::-1] if ml[n] >= LEAST_ML]
    return [f"{TISSUES[n // 256 - 1]} is {TISSUES[n % 256 - 1]} ({ml[n]:.1f} ml)" for n in largest]


def _drawn(classes: Sequence[LabelMap]) -> list[str]:
    names = {segment.name for one in classes for segment in one.segments.values()}
    return sorted(name.removesuffix(DRAWN_NAME) for name in names if is_drawn(name))
