"""The collecting system: contrast agent in it, or stones, by contrast phase and size; and a pelvis with urine
alone, by HU and shape.

Excreted contrast agent has 200 to more than 1000 HU, stones have 200 to 1500: HU alone cannot tell them
apart. In an enhanced kidney a dense piece is taken for contrast agent; a stone in it cannot be seen, and has
to be labelled.
"""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from scenes.tissue_classes.fine_grid import coarse_distance
from scenes.tissue_classes.kidney_parts import ENHANCED_FROM_HU, median_hu

# So much brighter than parenchyma is dense; voxels beside contrast agent have more than the second value by
# partial volume.
DENSE_ABOVE_HU, BESIDE_ABOVE_HU, BESIDE_VOXELS = 130.0, 50.0, 2
# Without contrast agent in the parenchyma, a larger piece is contrast agent too, of an earlier injection or
# through a catheter.
LARGEST_STONE_ML = 3.0
# A dense piece belongs to a kidney with this share of its volume: pelvis and ureter continue outside, bones
# do not begin inside.
LEAST_SHARE = 0.2
# So small a piece belongs to it if it only begins inside.
SMALL_ML = 20.0
# A piece of bone with this share of contrast agent is none: where bones are searched, small gaps are closed.
AGENT_SHARE = 0.2
# Urine without contrast agent: its HU beside enhanced parenchyma, and against the median of parenchyma
# without. A pelvis that is seen contains a ball of this radius and has this volume, reaches into the kidney's
# hollow, and is no farther from its outer surface than this.
URINE_HU, URINE_AGAINST_MEDIAN_HU = (-10.0, 35.0), (-27.0, -8.0)
PELVIS_MM, LEAST_PELVIS_ML, EXTRARENAL_MM = 5.0, 1.0, 14.0


@dataclass(frozen=True)
class DensePieces:
    """Masks (nx, ny, nz) of contrast agent in the collecting system and of stones; and whether the
    parenchyma is enhanced.
    """

    urine: np.ndarray
    stone: np.ndarray
    is_enhanced: bool


def dense_pieces(hu: np.ndarray, parenchyma: np.ndarray, kidney: np.ndarray, voxel_ml: float) -> DensePieces:
    """The dense pieces of a kidney.

    ``hu`` (nx, ny, nz) are not smoothed, so that small stones remain; all are compared with those of the
    ``parenchyma``. Pieces begin in ``kidney``, which includes its hollow.
    """
    median = median_hu(hu, parenchyma)
    is_enhanced = median > ENHANCED_FROM_HU
    dense = hu > median + DENSE_ABOVE_HU
    pieces, count = ndimage.label(dense, np.ones((3, 3, 3)))
    sizes = np.bincount(pieces.ravel(), minlength=count + 1)
    inside = np.bincount(pieces[kidney], minlength=count + 1)
    least = np.where(is_enhanced & (sizes * voxel_ml < SMALL_ML), 1, LEAST_SHARE * sizes)
    own = inside >= np.maximum(least, 1)
    own[0] = False
    is_urine = own & (is_enhanced | (inside * voxel_ml > LARGEST_STONE_ML))
    urine = is_urine[pieces]
    beside = ndimage.maximum_filter(urine, 2 * BESIDE_VOXELS + 1) & kidney & (hu > median + BESIDE_ABOVE_HU)
    return DensePieces(urine | beside, (own & ~is_urine)[pieces], is_enhanced)


def agent_in_bone(bone: np.ndarray, urine: np.ndarray) -> np.ndarray:
    """The pieces (nx, ny, nz) of what was taken for bone, but is contrast agent of the collecting system, and
    what is around it.
    """
    pieces, count = ndimage.label(bone)
    sizes = np.bincount(pieces.ravel(), minlength=count + 1)
    own = np.bincount(pieces[urine], minlength=count + 1)
    is_agent = own > AGENT_SHARE * sizes
    is_agent[0] = False
    return is_agent[pieces]


def pelvis_without_agent(
    hu: np.ndarray, parenchyma: np.ndarray, kidney: np.ndarray, outer_mm: np.ndarray, spacing_mm: np.ndarray
) -> np.ndarray:
    """A mask (nx, ny, nz) of a renal pelvis with urine alone; one that is not dilated is not seen by HU.

    ``hu`` are smoothed; those of the ``parenchyma`` decide whether there is contrast agent. ``kidney`` is
    what is no pelvis. ``outer_mm`` is the distance from the kidney's outer surface, its hollow filled, which
    is where this is negative.
    """
    median = median_hu(hu, parenchyma)
    low, high = URINE_HU if median > ENHANCED_FROM_HU else (median + off for off in URINE_AGAINST_MEDIAN_HU)
    body = (hu > low) & (hu < high) & ~kidney & (outer_mm < EXTRARENAL_MM)
    core = coarse_distance(body, spacing_mm) >= PELVIS_MM
    if not core.any():
        return core
    opened = body & (coarse_distance(~core, spacing_mm) <= PELVIS_MM)
    pieces, count = ndimage.label(opened)
    volumes = np.bincount(pieces.ravel(), minlength=count + 1) * float(np.prod(spacing_mm)) / 1000
    reaches = np.bincount(pieces[outer_mm < 0], minlength=count + 1) > 0
    chosen = reaches & (volumes >= LEAST_PELVIS_ML)
    chosen[0] = False
    return chosen[pieces]
