"""Tissues around a kidney by HU, place and shape: gas, fat, vessels, liver, spleen, muscle and bowel."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from skimage.feature import peak_local_max
from skimage.measure import block_reduce
from skimage.segmentation import watershed

from scenes.tissue_classes.bones import spine_middle
from scenes.tissue_classes.fine_grid import cell_voxels, repeated
from scenes.tissue_classes.vessels import blood

GAS_BELOW_HU, FAT_BELOW_HU, METAL_ABOVE_HU = -300.0, -30.0, 2500.0
# Marrow where its shell is not closed: share of its surface that is bone; without contrast agent, by its HU
# and volume.
MARROW_SURFACE, ENHANCED_MARROW_ABOVE_HU, MARROW_ABOVE_HU, LEAST_MARROW_ML = 0.4, 140.0, 120.0, 0.4
# Contrast agent in the bowel: so bright, so far in front of the spine's middle, and with this share of its
# volume deeper than a bone's shell.
DENSE_ABOVE_HU, BEFORE_SPINE_MM, SHELL_MM, SOLID_SHARE = 260.0, 15.0, 2.5, 0.1
# Of an enhanced CT, muscle is darker than this, liver and spleen are brighter.
LIVER_ABOVE_HU = 88.0
# Bile, and fluid in the bowel: with contrast agent, and without; in bodies with so many cells to each side of
# their middle.
ENHANCED_FLUID_HU, FLUID_HU, FLUID_CELLS = (-10.0, 32.0), (-10.0, 12.0), 2
# Large bodies of soft tissue are searched in cells of this size; they contain a ball of the first radius,
# liver and spleen of the second.
CELL_MM, BODY_MM, ORGAN_MM = 3.0, 7.0, 12.0
BODIES = ("muscle", "liver", "spleen")
# Without contrast agent, muscle is behind or beside the spine: so far behind the kidney's middle, so near to
# the spine's.
BEHIND_MM, BESIDE_SPINE_MM = 25.0, 45.0
# Soft tissue so near to gas is bowel.
BOWEL_WALL_MM = 12.0


@dataclass(frozen=True)
class Place:
    """Where a kidney is in a CT: ``index_from_mm`` (4, 4), its middle (3,), LPS [mm], and whether it has
    contrast agent.
    """

    index_from_mm: np.ndarray
    middle_mm: np.ndarray
    is_enhanced: bool

    @property
    def spacing_mm(self) -> np.ndarray:
        return np.linalg.norm(np.linalg.inv(self.index_from_mm[:3, :3]), axis=0)

    def of_indices(self, index: np.ndarray) -> np.ndarray:
        """Places (n, 3) of indices (n, 3), from the kidney's middle [mm]."""
        mm_from_index = np.linalg.inv(self.index_from_mm)
        return index @ mm_from_index[:3, :3].T + mm_from_index[:3, 3] - self.middle_mm


def surroundings(
    hu: np.ndarray, kidney: np.ndarray, bone: np.ndarray, near: tuple[slice, ...], place: Place
) -> dict[str, np.ndarray]:
    """Masks (nx, ny, nz) by tissue of what is outside a kidney, in rising priority.

    ``hu`` is smoothed; ``near`` is a box around the kidney.
    """
    gas = (hu < GAS_BELOW_HU) & ~kidney
    agent = _oral_agent(hu, bone, place)
    bone = bone & ~agent
    bone = bone | _marrow(hu, bone, kidney | agent, place)
    fat = (hu < FAT_BELOW_HU) & ~gas & ~kidney
    beside = _dilated(kidney[near], 2)
    # Voxels between kidney and fat have the HU of other soft tissue, by partial volume.
    fat[near] |= beside & _dilated(fat[near], 2) & ~kidney[near] & ~gas[near]
    soft = ~(bone | gas | fat | kidney)
    masks = {"soft-tissue": soft, "fat": fat, "gas": gas}
    masks |= _bodies(hu, soft, bone, place)
    masks["bowel"] = soft & _near(gas & ~_open_air(gas), BOWEL_WALL_MM, place) & ~masks["muscle"]
    if place.is_enhanced:
        # Beside bone and kidney, the mean is theirs.
        vessel = soft & blood(hu, masks["liver"] | masks["spleen"], place.spacing_mm) & ~_dilated(bone, 2)
        vessel[near] &= ~beside
        masks["vessel"] = vessel
    masks["bowel"] = masks["bowel"] | agent
    return masks | {"bone": bone}


def _oral_agent(hu: np.ndarray, bone: np.ndarray, place: Place) -> np.ndarray:
    """What was taken for bone, but is contrast agent in the bowel: in front of the spine, and solid, where a
    bone is a shell.
    """
    agent = np.zeros(bone.shape, bool)
    step = cell_voxels(place.spacing_mm, CELL_MM)
    spine = _spine(block_reduce(bone, tuple(step), np.mean) >= 0.5, step, place)
    if spine is None:
        return agent
    pieces, _ = ndimage.label(bone)
    for n, box in enumerate(ndimage.find_objects(pieces), 1):
        piece = pieces[box] == n
        bright = piece & (hu[box] > DENSE_ABOVE_HU)
        if not bright.any():
            continue
        middle = _middle(bright, np.ones(3), [axis.start for axis in box])
        if place.of_indices(middle)[0, 1] < spine[1] - BEFORE_SPINE_MM:
            depth = ndimage.distance_transform_edt(np.pad(bright, 1), sampling=place.spacing_mm)
            if (depth > SHELL_MM).sum() > SOLID_SHARE * bright.sum():
                agent[box] |= piece
    return agent


def _marrow(hu: np.ndarray, bone: np.ndarray, kidney: np.ndarray, place: Place) -> np.ndarray:
    """Bright pieces whose surface is bone for the most part; without contrast agent, all large bright
    pieces.
    """
    bright = (hu > (ENHANCED_MARROW_ABOVE_HU if place.is_enhanced else MARROW_ABOVE_HU)) & ~kidney & ~bone
    pieces, count = ndimage.label(bright)
    sizes = np.bincount(pieces.ravel(), minlength=count + 1)
    if place.is_enhanced:
        surface = _dilated(bright, 1) & ~bright
        around = ndimage.maximum_filter(pieces, 3)
        touched = np.bincount(around[surface & bone], minlength=count + 1)
        chosen = touched > MARROW_SURFACE * np.bincount(around[surface], minlength=count + 1)
    else:
        chosen = sizes * np.prod(place.spacing_mm) / 1000 > LEAST_MARROW_ML
    chosen[0] = False
    return chosen[pieces]


def _dilated(mask: np.ndarray, voxels: int) -> np.ndarray:
    """A mask dilated by a cube: a maximum filter is faster than a dilation."""
    return ndimage.maximum_filter(mask, 2 * voxels + 1)


def _open_air(gas: np.ndarray) -> np.ndarray:
    """The gas that reaches the border of the CT: the air around the body, or a lung."""
    parts, count = ndimage.label(gas)
    at_border = np.zeros(count + 1, bool)
    for axis in range(3):
        for end in (0, -1):
            at_border[parts.take(end, axis)] = True
    at_border[0] = False
    return at_border[parts]


def _near(mask: np.ndarray, distance_mm: float, place: Place) -> np.ndarray:
    """What is within a distance of a mask, by steps of voxels."""
    if not mask.any():
        return mask
    step = cell_voxels(place.spacing_mm, CELL_MM)
    coarse = block_reduce(mask, tuple(step), np.max)
    near = ndimage.distance_transform_edt(~coarse, sampling=place.spacing_mm * step) <= distance_mm
    return repeated(near, step, mask.shape)


def _bodies(hu: np.ndarray, soft: np.ndarray, bone: np.ndarray, place: Place) -> dict[str, np.ndarray]:
    """Liver, spleen and muscle, soft tissue in large bodies; and fluid."""
    step = cell_voxels(place.spacing_mm, CELL_MM)
    cell_mm = place.spacing_mm * step
    mean, inside = block_reduce(hu, tuple(step), np.mean), block_reduce(soft, tuple(step), np.mean) >= 0.5
    depth = ndimage.gaussian_filter(ndimage.distance_transform_edt(inside, sampling=cell_mm), 1.0)
    peaks = peak_local_max(depth, min_distance=3, threshold_abs=BODY_MM, exclude_border=False)
    seeds = np.zeros(inside.shape, np.int32)
    seeds[tuple(peaks.T)] = np.arange(1, len(peaks) + 1)
    basins = watershed(-depth, seeds, mask=inside)
    spine = _spine(block_reduce(bone, tuple(step), np.mean) >= 0.5, step, place)
    names = ["soft-tissue"]
    for n, (peak, box) in enumerate(zip(peaks, ndimage.find_objects(basins), strict=True), 1):
        own, deep = basins[box] == n, depth[box]
        level = float(np.median(mean[box][own & (deep > deep[own].max() / 3)]))
        at = place.of_indices(_middle(own, step, [axis.start for axis in box]))[0]
        names.append(_body(level, float(depth[tuple(peak)]), at, spine, place.is_enhanced))
    cell_codes = np.array([("soft-tissue", *BODIES).index(name) for name in names])[basins]
    for code in (BODIES.index(name) + 1 for name in ("liver", "spleen")):
        organ = cell_codes == code
        if not organ.any():
            continue
        # What no ball fits into is the wall of the abdomen beside it.
        from_core = ndimage.distance_transform_edt(~(organ & (depth > BODY_MM)), sampling=cell_mm)
        cell_codes[organ & (from_core > BODY_MM + CELL_MM)] = BODIES.index("muscle") + 1
    codes = repeated(cell_codes.astype(np.uint8), step, soft.shape)
    low, high = _fluid_hu(place.is_enhanced)
    # The opening leaves nothing of layers that soft tissue and fat have in common.
    fluid = inside & (cell_codes != BODIES.index("muscle") + 1) & (mean > low) & (mean < high)
    fluid = ndimage.binary_opening(fluid, iterations=FLUID_CELLS)
    near_fluid = repeated(ndimage.binary_dilation(fluid), step, soft.shape)
    masks = {name: soft & (codes == code) for code, name in enumerate(BODIES, 1)}
    return masks | {"fluid": soft & near_fluid & (hu > low) & (hu < high)}


def _fluid_hu(is_enhanced: bool) -> tuple[float, float]:
    return ENHANCED_FLUID_HU if is_enhanced else FLUID_HU


def _spine(bone: np.ndarray, step: np.ndarray, place: Place) -> np.ndarray | None:
    """The middle (3,) of the spine, from the kidney's [mm], by a mask of cells; None without a bone."""
    middle = spine_middle(bone)
    return None if middle is None else place.of_indices((middle[None] + 0.5) * step - 0.5)[0]


def _middle(cells: np.ndarray, step: np.ndarray, first: list[int]) -> np.ndarray:
    """The index (1, 3) of the voxel, fractional, in the middle of a mask of cells, in a box whose first cell
    is given.
    """
    return ((np.argwhere(cells) + first).mean(axis=0)[None] + 0.5) * step - 0.5


def _body(
    level_hu: float, radius_mm: float, at: np.ndarray, spine: np.ndarray | None, is_enhanced: bool
) -> str:
    """The tissue of a body of soft tissue by its HU, the ball in it, and its place from the kidney [mm]."""
    if level_hu < _fluid_hu(is_enhanced)[1]:
        return "soft-tissue"
    beside_spine = spine is not None and abs(at[0] - spine[0]) < BESIDE_SPINE_MM and at[1] > spine[1] - 25.0
    is_muscle = level_hu < LIVER_ABOVE_HU if is_enhanced else at[1] > BEHIND_MM or beside_spine
    if is_muscle:
        return "muscle"
    if spine is None or radius_mm < ORGAN_MM:
        return "soft-tissue"
    # The spine is on the right of the left kidney.
    if spine[0] > 0:
        return "liver"
    return "spleen" if at[0] > 0.0 else "soft-tissue"
