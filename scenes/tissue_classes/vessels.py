"""Vessels around a kidney in an enhanced CT: the aorta of the arterial phase, which is as bright as bone,
and other blood by HU.
"""

import numpy as np
from scipy import ndimage

from scenes.tissue_classes.fine_grid import CELL_MM, cell_voxels, repeated

# In the arterial phase the aorta is brighter than this, as bone is. It contains a ball of this radius, and is
# as long as the CT, as far as that is at least so long: marrow as bright ends at the discs. It is so far in
# front of the spine's middle, and no farther beside it: there is no bowel.
ARTERIAL_ABOVE_HU, AORTA_RADIUS_MM, SHARE_OF_CT, LEAST_LENGTH_MM = 250.0, 4.5, 0.8, 60.0
BEFORE_SPINE_MM, BESIDE_SPINE_MM = 15.0, 45.0
# Its branches have this share of its HU at least.
BRANCH_SHARE = 0.75
# Blood is brighter than this, averaged over this width, and than liver and spleen by the third value; at the
# rim of a vessel, brighter than the fourth. A narrower vessel is brighter than this in each voxel. Contrast
# agent in ureter and bowel is brighter than the last.
BLOOD_ABOVE_HU, AVERAGED_MM, ABOVE_ORGAN_HU, RIM_ABOVE_HU = 125.0, 4.0, 14.0, 90.0
THIN_ABOVE_HU, AGENT_ABOVE_HU = 140.0, 260.0


def arterial_aorta(hu: np.ndarray, mm_from_index: np.ndarray, spine_mm: np.ndarray) -> np.ndarray:
    """A mask (nx, ny, nz) of the aorta in the arterial phase; empty in other phases.

    ``hu`` are of the CT; ``mm_from_index`` (4, 4) is to patient coordinates, LPS, in which ``spine_mm`` (3,)
    is the spine's middle.
    """
    spacing = np.linalg.norm(mm_from_index[:3, :3], axis=0)
    bright, step = hu > ARTERIAL_ABOVE_HU, cell_voxels(spacing)
    cells = bright[tuple(slice(None, None, k) for k in step)]
    core = ndimage.distance_transform_edt(cells, sampling=spacing * step) >= AORTA_RADIUS_MM
    head_foot = int(np.argmax(np.abs(mm_from_index[2, :3])))
    cell_length = spacing[head_foot] * step[head_foot]
    length = max(SHARE_OF_CT * cell_length * cells.shape[head_foot], LEAST_LENGTH_MM)
    pieces, _ = ndimage.label(core, np.ones((3, 3, 3)))
    aorta = np.zeros(cells.shape, bool)
    for n, box in enumerate(ndimage.find_objects(pieces), 1):
        if cell_length * (box[head_foot].stop - box[head_foot].start) < length:
            continue
        piece = pieces[box] == n
        middle = (np.argwhere(piece).mean(axis=0) + [axis.start for axis in box]) * step
        at = mm_from_index[:3, :3] @ middle + mm_from_index[:3, 3]
        if abs(at[0] - spine_mm[0]) < BESIDE_SPINE_MM and at[1] < spine_mm[1] - BEFORE_SPINE_MM:
            aorta[box] |= piece
    if not aorta.any():
        return np.zeros(hu.shape, bool)
    away = ndimage.distance_transform_edt(~aorta, sampling=spacing * step)
    return bright & repeated(away < AORTA_RADIUS_MM + 2 * CELL_MM, step, hu.shape)


def with_branches(hu: np.ndarray, aorta: np.ndarray, others: np.ndarray) -> np.ndarray:
    """An aorta with what is connected to it, nearly as bright, and nothing of the others: bone and kidney."""
    if not aorta.any():
        return aorta
    bright = aorta | ((hu > BRANCH_SHARE * np.median(hu[aorta])) & ~others)
    pieces, _ = ndimage.label(bright, np.ones((3, 3, 3)))
    return np.isin(pieces, np.unique(pieces[aorta]))


def blood(hu: np.ndarray, organ: np.ndarray, spacing_mm: np.ndarray) -> np.ndarray:
    """What has the HU of enhanced blood (nx, ny, nz). ``organ`` is the mask of liver or spleen."""
    width = np.maximum(np.rint(AVERAGED_MM / spacing_mm), 1).astype(int)
    mean = ndimage.uniform_filter(np.asarray(hu, np.float32), (width // 2 * 2 + 1).tolist())
    wide = mean > BLOOD_ABOVE_HU
    if organ.any():
        wide &= ~organ | (mean > np.median(hu[organ]) + ABOVE_ORGAN_HU)
    # The mean of a vessel's rim is that of blood and fat.
    rim = ndimage.maximum_filter(wide, (width // 2 * 2 + 1).tolist()) & (hu > RIM_ABOVE_HU) & ~organ
    return (wide | rim | (hu > THIN_ABOVE_HU)) & (hu < AGENT_ABOVE_HU)
