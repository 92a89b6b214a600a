"""Tissues that no label tells, but HU and shape do: fat and stones of a kidney, dead parts of a tumour, bone, enhanced vessels. NumPy."""

import numpy as np
from scipy import ndimage

FAT_BELOW_HU = -30.0
STONE_ABOVE_MEDIAN_HU = 130.0
NECROSIS_BELOW_MEDIAN_HU = 40.0
# Fat in a hollow of the kidney no wider than twice this is the sinus's.
HOLLOW_MM = 10.0
# A kidney brighter than this has taken up contrast agent, and soft tissue as bright as that is blood.
ENHANCED_FROM_HU, BLOOD_ABOVE_HU = 100.0, 140.0
# The shell of a bone, the least that only bone has, and the least of it that is not a stone or calcified vessel.
SHELL_ABOVE_HU, BONE_ABOVE_HU, BONE_FROM_ML = 250.0, 350.0, 0.4
# Bones are large: voxels are taken together to this size to find them, and continue beyond the CT's border as far as this.
COARSE_MM, BEYOND_MM = 1.8, 45.0
KIDNEY = ("kidney", "cortex", "medulla", "sinus", "urine")


def classify_tissues(
    hu: np.ndarray, labelled: dict[str, np.ndarray], spacing_mm: np.ndarray
) -> dict[str, np.ndarray]:
    """Tissue -> which voxels (nx, ny, nz) are of it besides those that labels say, in the order in which they win."""
    everything = np.logical_or.reduce([np.zeros(hu.shape, bool), *labelled.values()])
    bone = bones(hu, spacing_mm) & ~everything
    found = {"bone": bone}
    kidney = np.logical_or.reduce([np.zeros(hu.shape, bool), *(labelled[t] for t in KIDNEY if t in labelled)])
    if kidney.any():
        median = float(np.median(hu[kidney]))
        if median > ENHANCED_FROM_HU:
            found["vessel"] = _vessels(hu, everything | bone)
        if "sinus" not in labelled:
            found["sinus"] = hollow(kidney, spacing_mm) & (hu < FAT_BELOW_HU)
        fat = kidney & (hu < FAT_BELOW_HU)
        found["sinus"] = found["sinus"] | fat if "sinus" in found else fat
        found["stone"] = kidney & (hu > median + STONE_ABOVE_MEDIAN_HU)
        if median > ENHANCED_FROM_HU and "urine" in labelled:
            # A rim of it is as bright, where voxels are cut.
            found["stone"] &= ~ndimage.binary_dilation(labelled["urine"])
    tumour = labelled.get("tumour")
    if tumour is not None and tumour.any():
        found["necrosis"] = tumour & (hu < np.median(hu[tumour]) - NECROSIS_BELOW_MEDIAN_HU)
    return found


def _vessels(hu: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Blood with contrast agent, away from other tissues, whose rims are as bright where voxels are cut."""
    smooth = ndimage.gaussian_filter(np.asarray(hu, np.float32), 1.0, truncate=2)
    return (smooth > BLOOD_ABOVE_HU) & ~ndimage.binary_dilation(others, iterations=3)


def hollow(kidney: np.ndarray, spacing_mm: np.ndarray) -> np.ndarray:
    """What a kidney encloses besides itself: its closing by a ball of HOLLOW_MM, without it."""
    rim = np.ceil(HOLLOW_MM / spacing_mm).astype(int) + 1
    box = ndimage.find_objects(kidney.astype(np.uint8))[0]
    part = np.pad(kidney[box], [(int(r), int(r)) for r in rim])
    grown = ndimage.distance_transform_edt(~part, sampling=spacing_mm) <= HOLLOW_MM
    closed = ndimage.distance_transform_edt(grown, sampling=spacing_mm) > HOLLOW_MM
    inside = np.zeros_like(kidney)
    inner = tuple(slice(int(r), n - int(r)) for r, n in zip(rim, part.shape, strict=True))
    inside[box] = (closed & ~part)[inner]
    return inside


def bones(hu: np.ndarray, spacing_mm: np.ndarray) -> np.ndarray:
    """Bones, shell and marrow: marrow may be no denser than soft tissue with contrast agent, but is enclosed."""
    step = np.maximum(1, np.rint(COARSE_MM / spacing_mm)).astype(int)
    if not (hu > BONE_ABOVE_HU).any():
        return np.zeros(hu.shape, bool)
    # The brightest of each block, for a shell may be thinner than one.
    coarse = ndimage.maximum_filter(hu, size=tuple(step))[:: step[0], :: step[1], :: step[2]]
    shell = _large_parts(coarse, float(np.prod(spacing_mm * step)))
    # A bone cut by the CT's border goes on beyond it as its mirror image.
    beyond = [min(n, int(BEYOND_MM / (s * k))) for n, s, k in zip(shell.shape, spacing_mm, step, strict=True)]
    whole = np.pad(shell, [(n, n) for n in beyond], mode="symmetric")
    whole = ndimage.binary_closing(whole, iterations=2)
    filled = np.logical_or.reduce([_filled(whole, axis) for axis in range(3)])
    inner = filled[tuple(slice(n, n + size) for n, size in zip(beyond, shell.shape, strict=True))]
    fine = inner.repeat(step[0], 0).repeat(step[1], 1).repeat(step[2], 2)
    return fine[: hu.shape[0], : hu.shape[1], : hu.shape[2]]


def _filled(solid: np.ndarray, axis: int) -> np.ndarray:
    """Each section across an axis with its holes filled: what reaches no edge of the section."""
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
    """Connected parts of what may be a bone's shell that hold some of what only bone is."""
    parts, count = ndimage.label(hu > SHELL_ABOVE_HU)
    hard = np.bincount(parts[hu > BONE_ABOVE_HU], minlength=count + 1) * voxel_mm3 / 1000
    is_bone = hard >= BONE_FROM_ML
    is_bone[0] = False
    return is_bone[parts]
