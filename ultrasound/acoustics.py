"""Acoustic properties of a CT's voxels from labels and HU: impedance, attenuation and backscatter. NumPy.

A labelled voxel has its tissue's values (``acoustic_tissues.toml``), as contrast agent raises HU by iodine, not by density. Fat and stones
within a kidney are classified by HU: no agent lowers parenchyma to fat or raises it to stone. Enhanced urine is as bright as stone,
so that it needs a label.
"""

import json
import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from errors import UserError
from sim.stored_arrays import stored

TISSUES = Path(__file__).parent / "acoustic_tissues.toml"
# Amplitude of renal cortex relative to a perfect reflector: its speckle is some 16 dB below the echo of fat on kidney.
CORTEX_DB = -38.0
# Smooths the voxel steps of labels; the level of scattering, in dB, by less, so that a cyst of three voxels reaches its level.
SMOOTHING_VOXELS, LEVEL_SMOOTHING_VOXELS = 0.8, 0.5
# From the first to the second HU unlabelled tissue has the impedance of the first: contrast agent raises HU, not density. From the
# third on it is calcified.
AGENT_FROM_HU, AGENT_TO_HU, CALCIFIED_HU = 55.0, 200.0, 300.0
# Mast 2000: density [kg/m3] = slope * speed of sound [m/s] - offset.
MAST_SLOPE, MAST_OFFSET = 0.893, 349.0
SEED = 20160101
MIN_HU, MAX_HU = -1024, 3071

CHANNELS = IMPEDANCE, ATTENUATION, BACKSCATTER, ANISOTROPY = range(4)

# Classification by HU: fat and stones of a kidney, tumour necrosis, bone, enhanced vessels.
FAT_BELOW_HU = -30.0
HARD_TISSUES = ("stone", "metal")
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
# Above this only metal.
METAL_ABOVE_HU = 2500.0
# A tumour's pseudocapsule, and the arcuate vessels: thickness of the layer, distance and share of the places that have them.
PSEUDOCAPSULE_MM, ARCUATE_MM, ARCUATE_APART_MM, ARCUATE_SHARE = 1.0, 1.0, 2.5, 0.25
KIDNEY = ("kidney", "cortex", "medulla", "sinus", "urine")


class TissueError(UserError):
    """A tissue that is not in the table; the message is one line."""


@cache
def tissue_table() -> dict[str, dict]:
    """Return the values by tissue, as in the file, and "hounsfield"."""
    return tomllib.loads(TISSUES.read_text("utf-8"))


def acoustic_values(tissue: str) -> tuple[float, float, float, float]:
    """Return the mean of a tissue's values, as those of a voxel in ``properties``."""
    table = tissue_table()[tissue]
    level = 10 ** ((table["backscatter_db"] + CORTEX_DB) / 20)
    return (
        table["impedance_mrayl"],
        table["attenuation_db_cm_mhz"],
        level,
        table.get("anisotropy_db", 0.0),
    )


def check_tissues(tissue_of_label: Mapping[int, str]) -> None:
    """Raise TissueError for a label of a tissue that is not in the table."""
    known = [name for name in tissue_table() if name != "hounsfield"]
    for label, tissue in tissue_of_label.items():
        if tissue not in known:
            raise TissueError(
                f"anatomy.tissues: label {label} is {tissue!r}: no tissue of that name; known: {', '.join(known)}"
            )


def impedance_of_hu(hu: np.ndarray) -> np.ndarray:
    """Return acoustic impedance [MRayl] of HU: density by Schneider's piecewise fit (k-Wave's ``hounsfield2density``), speed of sound
    from density by Mast 2000, for soft tissue."""
    h = np.asarray(hu, np.float32) + np.float32(1000)
    pieces = [h < 930, h < 1098, h < 1260]
    slope = np.select(pieces, [1.025793065, 0.9082709691, 0.5108369316], 0.6625370912).astype(np.float32)
    offset = np.select(pieces, [-5.680404011, 103.6151457, 539.9977189], 348.8555178).astype(np.float32)
    density = np.maximum(slope * h + offset, np.float32(1.2))
    return density * (density + np.float32(MAST_OFFSET)) / np.float32(1e6 * MAST_SLOPE)


def impedance_of_tissue(hu: np.ndarray) -> np.ndarray:
    """Return acoustic impedance [MRayl] of unlabelled tissue, perhaps with contrast agent: see AGENT_FROM_HU."""
    without = np.interp(
        hu, [AGENT_FROM_HU, AGENT_TO_HU, CALCIFIED_HU], [AGENT_FROM_HU, AGENT_FROM_HU, CALCIFIED_HU]
    )
    return impedance_of_hu(np.where((hu > AGENT_FROM_HU) & (hu < CALCIFIED_HU), without, hu))


def stored_properties(
    hu: np.ndarray, labels: np.ndarray | None, tissue_of_label: Mapping[int, str], spacing_mm: np.ndarray
) -> np.ndarray:
    """As ``properties``, but computed only once from the same arguments. Raises TissueError."""
    tissues, table = json.dumps(dict(tissue_of_label)), TISSUES.read_text("utf-8")
    return stored(_properties_of_texts, hu, labels, tissues, table, spacing_mm)[0]


def _properties_of_texts(
    hu: np.ndarray, labels: np.ndarray | None, tissues: str, table: str, spacing_mm: np.ndarray
) -> tuple[np.ndarray]:
    tissue_of_label = {int(label): tissue for label, tissue in json.loads(tissues).items()}
    return (properties(hu, labels, tissue_of_label, spacing_mm),)


def properties(
    hu: np.ndarray,
    labels: np.ndarray | None = None,
    tissue_of_label: Mapping[int, str] | None = None,
    spacing_mm: np.ndarray | None = None,
) -> np.ndarray:
    """Return impedance [MRayl], attenuation [dB/cm/MHz], backscattered amplitude (1: perfect reflector) and its anisotropy [dB], (..., 4)
    float32.

    ``hu`` and ``labels`` are integers of the same shape; 0 and labels without a tissue are classified by HU. Raises TissueError.
    """
    check_tissues(tissue_of_label or {})
    spacing = np.ones(3) if spacing_mm is None else np.asarray(spacing_mm, float)
    values, noise = _by_hounsfield(hu), {}
    level = values[..., BACKSCATTER]

    def texture(table: dict, where: Any) -> np.ndarray:
        """Return the texture of the backscatter level at some voxels [dB]."""
        distance = float(table["texture_mm"])
        if distance not in noise:
            noise[distance] = noise_of(hu.shape, distance / 2 / spacing)
        return np.float32(table["texture_db"]) * noise[distance][where]

    level += texture(tissue_table()["hounsfield"], ...)
    # Masks by tissue, from labels and from HU and shape, in rising priority.
    labelled: dict[str, np.ndarray] = {}
    tissues = tissue_of_label or {}
    if labels is not None:
        for tissue in dict.fromkeys(tissues.values()):
            labelled[tissue] = np.isin(labels, [v for v, name in tissues.items() if name == tissue])
    for tissue, here in classify_tissues(hu, labelled, spacing).items():
        labelled[tissue] = labelled[tissue] | here if tissue in labelled else here
    labelled = {tissue: where for tissue, where in labelled.items() if where.any()}
    hard = {tissue: labelled.pop(tissue) for tissue in HARD_TISSUES if tissue in labelled}
    for tissue, where in labelled.items():
        table = tissue_table()[tissue]
        values[where, IMPEDANCE] = table["impedance_mrayl"]
        values[where, ATTENUATION] = table["attenuation_db_cm_mhz"]
        values[where, ANISOTROPY] = table.get("anisotropy_db", 0.0)
        level[where] = table["backscatter_db"] + texture(table, where)
    for channel in (IMPEDANCE, ATTENUATION, ANISOTROPY):
        values[..., channel] = ndimage.gaussian_filter(values[..., channel], SMOOTHING_VOXELS, truncate=2.5)
    level = ndimage.gaussian_filter(level, LEVEL_SMOOTHING_VOXELS, truncate=2.5)
    values[..., BACKSCATTER] = np.float32(10) ** ((level + np.float32(CORTEX_DB)) / np.float32(20))
    for tissue, where in hard.items():
        _add_hard(values, tissue, where)
    return values


def _add_hard(values: np.ndarray, tissue: str, where: np.ndarray) -> None:
    """Add stones or clips at full impedance: smoothed like the rest, one of a few voxels would be soft."""
    table = tissue_table()[tissue]
    share = np.minimum(
        2 * ndimage.gaussian_filter(where.astype(np.float32), SMOOTHING_VOXELS, truncate=2.5), 1
    )
    level = 10 ** ((table["backscatter_db"] + CORTEX_DB) / 20)
    for channel, value in enumerate((table["impedance_mrayl"], table["attenuation_db_cm_mhz"], level)):
        values[..., channel] += share * (np.float32(value) - values[..., channel])
    values[..., ANISOTROPY] *= 1 - share


def _by_hounsfield(hu: np.ndarray) -> np.ndarray:
    """Return values (..., 4) of HU, backscatter in dB, from a table of integer HU."""
    table = tissue_table()["hounsfield"]
    every = np.arange(MIN_HU, MAX_HU + 1)
    attenuation = np.interp(every, table["hu"], table["attenuation_db_cm_mhz"])
    level = np.interp(every, table["hu"], table["backscatter_db"])
    values = np.column_stack([impedance_of_tissue(every), attenuation, level, 0 * level]).astype(np.float32)
    # Removes the noise of the CT.
    smooth = ndimage.gaussian_filter(np.asarray(hu, np.float32), SMOOTHING_VOXELS, truncate=2.5)
    return values[np.clip(np.rint(smooth), MIN_HU, MAX_HU).astype(np.int16) - MIN_HU]


def noise_of(shape: tuple[int, ...], sd_voxels: np.ndarray) -> np.ndarray:
    """Return noise of unit SD, smoothed by an SD along each axis, the same for the same voxels on every machine."""
    noise = np.random.default_rng(SEED).standard_normal(shape, dtype=np.float32)
    noise = ndimage.gaussian_filter(noise, sd_voxels, truncate=2, mode="wrap")
    return noise / max(float(noise.std()), 1e-6)


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
            smooth = ndimage.gaussian_filter(np.asarray(hu, np.float32), 1.0, truncate=2)
            # Away from other tissues, whose partial-volume voxels are as bright.
            others = ndimage.binary_dilation(any_label | bone, iterations=3)
            found["vessel"] = (smooth > BLOOD_ABOVE_HU) & ~others
        if "sinus" not in labelled:
            found["sinus"] = enclosed(kidney, spacing_mm) & (hu < FAT_BELOW_HU)
        fat = kidney & (hu < FAT_BELOW_HU)
        found["sinus"] = found["sinus"] | fat if "sinus" in found else fat
        found["stone"] = kidney & (hu > median + STONE_ABOVE_MEDIAN_HU)
        if median > ENHANCED_FROM_HU and "urine" in labelled:
            # Partial-volume voxels around enhanced urine are as bright.
            found["stone"] &= ~ndimage.binary_dilation(labelled["urine"])
    if "cortex" in labelled and "medulla" in labelled:
        found["arcuate"] = _arcuate(labelled["cortex"], labelled["medulla"], spacing_mm)
    found["metal"] = hu > METAL_ABOVE_HU
    tumour = labelled.get("tumour")
    if tumour is not None and tumour.any():
        found["pseudocapsule"] = _border(tumour, ~tumour, PSEUDOCAPSULE_MM, spacing_mm)
        found["necrosis"] = tumour & (hu < np.median(hu[tumour]) - NECROSIS_BELOW_MEDIAN_HU)
    return found


def _arcuate(cortex: np.ndarray, medulla: np.ndarray, spacing_mm: np.ndarray) -> np.ndarray:
    """Return the places between cortex and medulla where arcuate vessels are."""
    border = _border(medulla, cortex, ARCUATE_MM, spacing_mm)
    if not border.any():
        return border
    places = noise_of(border.shape, ARCUATE_APART_MM / 2 / spacing_mm)
    return border & (places > np.quantile(places[border], 1 - ARCUATE_SHARE))


def _border(
    inside: np.ndarray, outside: np.ndarray, thickness_mm: float, spacing_mm: np.ndarray
) -> np.ndarray:
    """Return the part of a mask within a thickness of another, at least one voxel thick."""
    if not (inside.any() and outside.any()):
        return np.zeros_like(inside)
    distance = ndimage.distance_transform_edt(~outside, sampling=spacing_mm)
    return inside & (distance <= max(thickness_mm, spacing_mm.min()) + 1e-6)


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
