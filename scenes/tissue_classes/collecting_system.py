"""Dense pieces in a kidney: contrast agent in its collecting system, or stones, by contrast phase and size.

Excreted contrast agent has 200 to more than 1000 HU, stones have 200 to 1500: HU alone cannot tell them apart. In an enhanced kidney a dense
piece is taken for contrast agent; a stone in it cannot be seen, and has to be labelled.
"""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from scenes.tissue_classes.kidney_parts import ENHANCED_FROM_HU, median_hu

# So much brighter than parenchyma is dense; voxels beside contrast agent have more than the second value by partial volume.
DENSE_ABOVE_HU, BESIDE_ABOVE_HU, BESIDE_VOXELS = 130.0, 50.0, 2
# Without contrast agent in the parenchyma, a larger piece is contrast agent too, of an earlier injection or through a catheter.
LARGEST_STONE_ML = 3.0
# A dense piece belongs to a kidney with this share of its volume: pelvis and ureter continue outside, bones do not begin inside.
LEAST_SHARE = 0.2


@dataclass(frozen=True)
class DensePieces:
    """Masks (nx, ny, nz) of contrast agent in the collecting system and of stones; and whether the parenchyma is enhanced."""

    urine: np.ndarray
    stone: np.ndarray
    is_enhanced: bool


def dense_pieces(hu: np.ndarray, parenchyma: np.ndarray, kidney: np.ndarray, voxel_ml: float) -> DensePieces:
    """Return the dense pieces of a kidney.

    Args:
        hu: not smoothed, so that small stones remain; (nx, ny, nz).
        parenchyma: whose HU all others are compared with.
        kidney: with its hollow, in which pieces begin.
    """
    median = median_hu(hu, parenchyma)
    is_enhanced = median > ENHANCED_FROM_HU
    dense = hu > median + DENSE_ABOVE_HU
    pieces, count = ndimage.label(dense, np.ones((3, 3, 3)))
    sizes = np.bincount(pieces.ravel(), minlength=count + 1)
    inside = np.bincount(pieces[kidney], minlength=count + 1)
    own = inside >= np.maximum(LEAST_SHARE * sizes, 1)
    own[0] = False
    is_urine = own & (is_enhanced | (inside * voxel_ml > LARGEST_STONE_ML))
    urine = is_urine[pieces]
    beside = ndimage.maximum_filter(urine, 2 * BESIDE_VOXELS + 1) & kidney & (hu > median + BESIDE_ABOVE_HU)
    return DensePieces(urine | beside, (own & ~is_urine)[pieces], is_enhanced)
