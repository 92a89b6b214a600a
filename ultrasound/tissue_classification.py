"""HU-based classification of unlabelled tissue: fat and stones of a kidney, tumour necrosis, bone, enhanced vessels. NumPy."""

import numpy as np
from scipy import ndimage

FAT_BELOW_HU = -30.0
STONE_ABOVE_MEDIAN_HU = 130.0
NECROSIS_BELOW_MEDIAN_HU = 40.0
# Fat in a concavity of the kidney no wider than twice this is renal sinus.
CONCAVITY_MM = 10.0
# A kidney above this is enhanced by contrast agent; soft tissue above the second value is then blood.
ENHANCED_FROM_HU, BLOOD_ABOVE_HU = 100.0, 140.0
# Cortical bone; what only bone reaches; the least volume of that which is no stone or calcified vessel.
SHELL_ABOVE_HU, BONE_ABOVE_HU, MIN_BONE_ML = 250.0, 350.0, 0.4
# Bones are searched in blocks of voxels of this size, and continued beyond the CT's border as far as this.
COARSE_MM, BEYOND_MM = 1.8, 45.0
KIDNEY = ("kidney", "cortex", "medulla", "sinus", "urine")


def classify_tissues(
    hu: np.ndarray, labelled: dict[str, np.ndarray], spacing_mm: np.ndarray
) -> dict[str, np.ndarray]:
    """Return masks (nx, ny, nz) of tissues found besides the labelled ones, in rising priority."""
    any_label = np.logical_or.reduce([np.zeros(hu.shape, bool), *labelled.values()])
    bone = bones(hu, spacing_mm) & ~any_label
    found = {"bone": bone}
    kidney = np.logical_or.reduce([np.zeros(hu.shape, bool), *(labelled[t] for t in KIDNEY if t in labelled)])
    if kidney.any():
        median = float(np.median(hu[kidney]))
        if median > ENHANCED_FROM_HU:
            found["vessel"] = _vessels(hu, any_label | bone)
        if "sinus" not in labelled:
            found["sinus"] = enclosed(kidney, spacing_mm) & (hu < FAT_BELOW_HU)
        fat = kidney & (hu < FAT_BELOW_HU)
        found["sinus"] = found["sinus"] | fat if "sinus" in found else fat
        found["stone"] = kidney & (hu > median + STONE_ABOVE_MEDIAN_HU)
        if median > ENHANCED_FROM_HU and "urine" in labelled:
            # Partial-volume voxels around enhanced urine are as bright.
            found["stone"] &= ~ndimage.binary_dilation(labelled["urine"])
    tumour = labelled.get("tumour")
    if tumour is not None and tumour.any():
        found["necrosis"] = tumour & (hu < np.median(hu[tumour]) - NECROSIS_BELOW_MEDIAN_HU)
    return found


def _vessels(hu: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return enhanced blood, away from other tissues, whose partial-volume voxels are as bright."""
    smooth = ndimage.gaussian_filter(np.asarray(hu, np.float32), 1.0, truncate=2)
    return (smooth > BLOOD_ABOVE_HU) & ~ndimage.binary_dilation(others, iterations=3)


def enclosed(kidney: np.ndarray, spacing_mm: np.ndarray) -> np.ndarray:
    """Return the closing of a kidney by a ball of CONCAVITY_MM, without the kidney."""
    rim = np.ceil(CONCAVITY_MM / spacing_mm).astype(int) + 1
    box = ndimage.find_objects(kidney.astype(np.uint8))[0]
    part = np.pad(kidney[box], [(int(r), int(r)) for r in rim])
    grown = ndimage.distance_transform_edt(~part, sampling=spacing_mm) <= CONCAVITY_MM
    closed = ndimage.distance_transform_edt(grown, sampling=spacing_mm) > CONCAVITY_MM
    inside = np.zeros_like(kidney)
    inner = tuple(slice(int(r), n - int(r)) for r, n in zip(rim, part.shape, strict=True))
    inside[box] = (closed & ~part)[inner]
    return inside


def bones(hu: np.ndarray, spacing_mm: np.ndarray) -> np.ndarray:
    """Return cortical bone and marrow. Marrow may be no denser than enhanced soft tissue, but is enclosed by cortical bone."""
    step = np.maximum(1, np.rint(COARSE_MM / spacing_mm)).astype(int)
    if not (hu > BONE_ABOVE_HU).any():
        return np.zeros(hu.shape, bool)
    # The maximum of each block, as cortical bone may be thinner than a block.
    coarse = ndimage.maximum_filter(hu, size=tuple(step))[:: step[0], :: step[1], :: step[2]]
    shell = _large_parts(coarse, float(np.prod(spacing_mm * step)))
    # A bone cut by the CT's border is continued beyond it as its mirror image.
    beyond = [min(n, int(BEYOND_MM / (s * k))) for n, s, k in zip(shell.shape, spacing_mm, step, strict=True)]
    whole = np.pad(shell, [(n, n) for n in beyond], mode="symmetric")
    whole = ndimage.binary_closing(whole, iterations=2)
    filled = np.logical_or.reduce([_filled(whole, axis) for axis in range(3)])
    inner = filled[tuple(slice(n, n + size) for n, size in zip(beyond, shell.shape, strict=True))]
    fine = inner.repeat(step[0], 0).repeat(step[1], 1).repeat(step[2], 2)
    return fine[: hu.shape[0], : hu.shape[1], : hu.shape[2]]


def _filled(solid: np.ndarray, axis: int) -> np.ndarray:
    """Fill the holes of each section across an axis."""
    beside = ndimage.generate_binary_structure(3, 1)
    beside[tuple(slice(None) if k != axis else [0, 2] for k in range(3))] = False
    parts, count = ndimage.label(~solid, beside)
    is_open = np.zeros(count + 1, bool)
    for other in {0, 1, 2} - {axis}:
        for edge in (0, -1):
            is_open[parts.take(edge, other)] = True
    is_open[0] = False
    return ~is_open[parts]


def _large_parts(hu: np.ndarray, voxel_mm3: float) -> np.ndarray:
    """Return the connected parts above SHELL_ABOVE_HU that contain MIN_BONE_ML above BONE_ABOVE_HU."""
    parts, count = ndimage.label(hu > SHELL_ABOVE_HU)
    hard = np.bincount(parts[hu > BONE_ABOVE_HU], minlength=count + 1) * voxel_mm3 / 1000
    is_bone = hard >= MIN_BONE_ML
    is_bone[0] = False
    return is_bone[parts]
