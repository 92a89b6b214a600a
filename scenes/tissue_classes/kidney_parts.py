"""Parts of a kidney that nobody labelled, by HU, depth and contrast phase: sinus, vessels of the hilum,
cortex and medulla.
"""

import numpy as np
from scipy import ndimage

# Parenchyma above this has contrast agent: without, it has 30 to 50 HU.
ENHANCED_FROM_HU = 75.0
# Cortex is brighter than medulla by this, or more, in the corticomedullary phase. The outer part of the
# parenchyma is cortex, the inner part has both.
CORTEX_ABOVE_MEDULLA_HU, OUTER_MM, INNER_MM, LEAST_VOXELS = 40.0, (2.0, 5.0), (9.0, 16.0), 50
# Fat nearer to the kidney's outer surface than this is partial volume of its label's rim.
RIM_MM = 5.0
FAT_BELOW_HU = -20.0
# In the hollow of a kidney, what is nearly as bright as parenchyma is a vessel or the pelvis: without
# contrast agent, so much darker at most, as fat in the same voxels makes more of a difference, and so much
# brighter, as a stone's blur is more; with it, this share of its HU at least.
VESSEL_AGAINST_MEDIAN_HU, ENHANCED_VESSEL_SHARE = (-10.0, 30.0), 0.6
# In a kidney with contrast agent, what has less than this share of the parenchyma's HU, or of its medulla's,
# is sinus or a calyx without.
SINUS_SHARE = 0.5
# Parenchyma is brighter than this, with or without contrast agent; urine without is darker.
PARENCHYMA_ABOVE_HU = 30.0


def median_hu(hu: np.ndarray, parenchyma: np.ndarray) -> float:
    """The median HU of parenchyma; 0 of none."""
    return float(np.median(hu[parenchyma])) if parenchyma.any() else 0.0


def kidney_parts(
    hu: np.ndarray, parenchyma: np.ndarray, hollow: np.ndarray, depth_mm: np.ndarray
) -> dict[str, np.ndarray]:
    """Masks (nx, ny, nz) of the parts of a kidney by tissue, apart from each other: "kidney", or "cortex" and
    "medulla", and others.

    ``hu`` are smoothed. ``parenchyma`` is what is labelled as kidney and as no part of it, ``hollow`` what
    the kidney encloses outside its label; ``depth_mm`` is below the kidney's outer surface, its hollow
    filled.
    """
    median = median_hu(hu, parenchyma)
    is_enhanced = median > ENHANCED_FROM_HU
    deep = parenchyma & (depth_mm > RIM_MM)
    low, high = (median + off for off in VESSEL_AGAINST_MEDIAN_HU)
    vessel = hollow & ((hu > ENHANCED_VESSEL_SHARE * median) if is_enhanced else (hu > low) & (hu < high))
    levels = cortex_and_medulla_hu(hu, parenchyma, depth_mm) if is_enhanced else None
    darkest = median if levels is None else levels[1]
    sinus = (hollow & ~vessel) | (deep & (hu < (SINUS_SHARE * darkest if is_enhanced else FAT_BELOW_HU)))
    rest = parenchyma & ~sinus
    masks = {"sinus": sinus, "vessel": vessel}
    if levels is None:
        return masks | {"kidney": rest}
    medulla = ndimage.binary_opening(rest & (hu < np.mean(levels)) & (depth_mm > OUTER_MM[0]))
    return masks | {"medulla": medulla, "cortex": rest & ~medulla}


def cortex_and_medulla_hu(
    hu: np.ndarray, parenchyma: np.ndarray, depth_mm: np.ndarray
) -> tuple[float, float] | None:
    """The HU of cortex and medulla; None where the phase does not tell them apart."""
    parenchyma = parenchyma & (hu > PARENCHYMA_ABOVE_HU)
    outer, inner = (
        hu[parenchyma & (depth_mm > low) & (depth_mm < high)] for low, high in (OUTER_MM, INNER_MM)
    )
    if min(len(outer), len(inner)) < LEAST_VOXELS:
        return None
    cortex, medulla = float(np.median(outer)), float(np.percentile(inner, 25))
    return (cortex, medulla) if cortex - medulla > CORTEX_ABOVE_MEDULLA_HU else None
