"""Acoustic properties of voxels from their tissue and HU: impedance, attenuation and backscatter. NumPy.

A voxel has its tissue's values (``acoustic_tissues.toml``), as contrast agent raises HU by iodine, not by
density. Within a tissue, what is denser in the CT scatters a little more. Voxels without a tissue have values
by HU.
"""

import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from scipy import ndimage

from errors import UserError
from sim.stored_arrays import stored

TISSUES = Path(__file__).parent / "acoustic_tissues.toml"
# Amplitude of renal cortex relative to a perfect reflector: its speckle is some 16 dB below the echo of fat
# on kidney.
CORTEX_DB = -38.0
# Smooths the voxel steps of labels; the level of scattering, in dB, by less, so that a cyst of three voxels
# reaches its level.
SMOOTHING_VOXELS, LEVEL_SMOOTHING_VOXELS = 0.8, 0.5
# From the first to the second HU unlabelled tissue has the impedance of the first: contrast agent raises HU,
# not density. From the third on it is calcified.
AGENT_FROM_HU, AGENT_TO_HU, CALCIFIED_HU = 55.0, 200.0, 300.0
# Mast 2000: density [kg/m3] = slope * speed of sound [m/s] - offset.
MAST_SLOPE, MAST_OFFSET = 0.893, 349.0
SEED = 20160101
MIN_HU, MAX_HU = -1024, 3071

CHANNELS = IMPEDANCE, ATTENUATION, BACKSCATTER, ANISOTROPY = range(4)

# Within a tissue, backscatter rises with HU [dB/HU], up to this much [dB]; HU are averaged over this
# distance.
DB_OF_HU, MOST_OF_HU_DB, OF_HU_MM = 0.07, 3.0, 1.5
HARD_TISSUES = ("stone", "metal")
# Arcuate vessels: thickness of the layer, distance and share of the places that have them.
ARCUATE_MM, ARCUATE_APART_MM, ARCUATE_SHARE = 1.0, 2.5, 0.25
UNKNOWN = "hounsfield"
KIDNEY = ("kidney", "cortex", "medulla", "sinus", "urine")


class TissueError(UserError):
    """A tissue that is not in the table; the message is one line."""


@cache
def tissue_table() -> dict[str, dict]:
    """The values by tissue, as in the file, and "hounsfield"."""
    return tomllib.loads(TISSUES.read_text("utf-8"))


@dataclass(frozen=True)
class TissueVoxels:
    """HU and labels (nx, ny, nz) on a grid that ``index_from_mm`` (4, 4) gives, and the tissue of each
    label.
    """

    hu: np.ndarray
    labels: np.ndarray | None
    tissues: Mapping[int, str]
    index_from_mm: np.ndarray

    @property
    def spacing_mm(self) -> np.ndarray:
        """Distance of neighbouring voxels along each axis (3,)."""
        return np.linalg.norm(np.linalg.inv(self.index_from_mm[:3, :3]), axis=0)


def acoustic_values(tissue: str) -> tuple[float, float, float, float]:
    """The mean of a tissue's values, as those of a voxel in ``properties``."""
    impedance, attenuation, level_db, anisotropy = acoustic_table(tissue)
    return impedance, attenuation, 10 ** ((level_db + CORTEX_DB) / 20), anisotropy


def check_tissues(tissue_of_label: Mapping[int, str]) -> None:
    """Raise TissueError for a label of a tissue that is not in the table."""
    known = [name for name in tissue_table() if name != "hounsfield"]
    for label, tissue in tissue_of_label.items():
        if tissue not in known:
            raise TissueError(
                f"anatomy.tissues: label {label} is {tissue!r}: no tissue of that name; known: "
                f"{', '.join(known)}"
            )


def impedance_of_hu(hu: np.ndarray) -> np.ndarray:
    """Acoustic impedance [MRayl] of HU: density by Schneider's piecewise fit (k-Wave's
    ``hounsfield2density``), speed of sound from density by Mast 2000, for soft tissue.
    """
    h = np.asarray(hu, np.float32) + np.float32(1000)
    pieces = [h < 930, h < 1098, h < 1260]
    slope = np.select(pieces, [1.025793065, 0.9082709691, 0.5108369316], 0.6625370912).astype(np.float32)
    offset = np.select(pieces, [-5.680404011, 103.6151457, 539.9977189], 348.8555178).astype(np.float32)
    density = np.maximum(slope * h + offset, np.float32(1.2))
    return density * (density + np.float32(MAST_OFFSET)) / np.float32(1e6 * MAST_SLOPE)


def impedance_of_tissue(hu: np.ndarray) -> np.ndarray:
    """Acoustic impedance [MRayl] of unlabelled tissue, perhaps with contrast agent: see AGENT_FROM_HU."""
    without = np.interp(
        hu, [AGENT_FROM_HU, AGENT_TO_HU, CALCIFIED_HU], [AGENT_FROM_HU, AGENT_FROM_HU, CALCIFIED_HU]
    )
    return impedance_of_hu(np.where((hu > AGENT_FROM_HU) & (hu < CALCIFIED_HU), without, hu))


def stored_properties(voxels: TissueVoxels) -> np.ndarray:
    """As ``properties``, but computed only once from the same voxels. Raises TissueError."""
    tissues, table = json.dumps(dict(voxels.tissues)), TISSUES.read_text("utf-8")
    return stored(_properties_of_texts, voxels.hu, voxels.labels, tissues, table, voxels.spacing_mm)[0]


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
    """Impedance [MRayl], attenuation [dB/cm/MHz], backscattered amplitude (1: perfect reflector) and its
    anisotropy [dB], (..., 4) float32.

    ``hu`` and ``labels`` have the same shape; 0 and labels without a tissue have values by HU. Raises
    TissueError.
    """
    tissues = dict(tissue_of_label or {})
    check_tissues(tissues)
    spacing = np.ones(3) if spacing_mm is None else np.asarray(spacing_mm, float)
    codes, names = _codes(np.zeros(hu.shape, np.uint8) if labels is None else labels, tissues)
    values = np.empty((*hu.shape, len(CHANNELS)), np.float32)
    by_table = np.array([acoustic_table(name) for name in names], np.float32)
    for channel in CHANNELS:
        values[..., channel] = by_table[codes, channel]
    unknown = codes == 0
    if unknown.any():
        values[unknown] = _by_hounsfield(hu)[unknown]
    level = values[..., BACKSCATTER]
    level += _texture(codes, names, spacing) + _variation(hu, codes, names, spacing)
    if {"cortex", "medulla"} <= set(names):
        where = _arcuate(codes == names.index("cortex"), codes == names.index("medulla"), spacing)
        values[where] = acoustic_table("arcuate")
    hard = {name: codes == names.index(name) for name in HARD_TISSUES if name in names}
    for where in hard.values():
        # As the tissue around it, until it is added at full impedance.
        values[where] = acoustic_table("kidney")
    for channel in (IMPEDANCE, ATTENUATION, ANISOTROPY):
        values[..., channel] = ndimage.gaussian_filter(values[..., channel], SMOOTHING_VOXELS, truncate=2.5)
    level = ndimage.gaussian_filter(level, LEVEL_SMOOTHING_VOXELS, truncate=2.5)
    values[..., BACKSCATTER] = np.float32(10) ** ((level + np.float32(CORTEX_DB)) / np.float32(20))
    for tissue, where in hard.items():
        _add_hard(values, tissue, where)
    return values


def acoustic_table(tissue: str) -> tuple[float, float, float, float]:
    """A tissue's values as in the table, backscatter in dB against cortex."""
    table = tissue_table()[tissue]
    if tissue == UNKNOWN:
        return 0.0, 0.0, 0.0, 0.0
    return (
        table["impedance_mrayl"],
        table["attenuation_db_cm_mhz"],
        table["backscatter_db"],
        table.get("anisotropy_db", 0.0),
    )


def _codes(labels: np.ndarray, tissues: Mapping[int, str]) -> tuple[np.ndarray, list[str]]:
    """Labels as indices of a list of tissues, of which the first is what has none."""
    present = set(np.unique(labels).tolist())
    names = [UNKNOWN, *dict.fromkeys(name for value, name in tissues.items() if value in present)]
    table = np.zeros(max(present) + 1, np.uint8)
    for value in present & tissues.keys():
        table[value] = names.index(tissues[value])
    return table[labels.astype(np.intp)], names


def _texture(codes: np.ndarray, names: list[str], spacing_mm: np.ndarray) -> np.ndarray:
    """How the backscatter level of each tissue varies by chance [dB]."""
    distance = np.array([tissue_table()[name]["texture_mm"] for name in names])
    size = np.array([tissue_table()[name]["texture_db"] for name in names], np.float32)
    texture = np.zeros(codes.shape, np.float32)
    for mm in np.unique(distance[size > 0]):
        own = np.where(distance == mm, size, 0).astype(np.float32)[codes]
        texture += own * noise_of(codes.shape, mm / 2 / spacing_mm)
    return texture


def _variation(hu: np.ndarray, codes: np.ndarray, names: list[str], spacing_mm: np.ndarray) -> np.ndarray:
    """How the backscatter level varies with HU within a tissue [dB] (Wein et al. 2008, Med Image Anal 12,
    577: echogenicity from HU).

    HU are relative to the tissue's own median, so that its borders are none here, and noise can be averaged
    across them.
    """
    median = np.zeros(len(names), np.float32)
    follows = np.zeros(len(names), np.float32)
    for n, name in enumerate(names[1:], 1):
        median[n] = np.median(hu[codes == n])
        follows[n] = tissue_table()[name].get("follows_hu", 0.0)
    most = np.float32(MOST_OF_HU_DB / DB_OF_HU)
    off = np.clip(hu.astype(np.float32) - median[codes], -most, most) * follows[codes]
    return np.float32(DB_OF_HU) * ndimage.gaussian_filter(off, OF_HU_MM / spacing_mm, truncate=2)


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
    """Values (..., 4) of HU, backscatter in dB, from a table of integer HU."""
    table = tissue_table()["hounsfield"]
    every = np.arange(MIN_HU, MAX_HU + 1)
    attenuation = np.interp(every, table["hu"], table["attenuation_db_cm_mhz"])
    level = np.interp(every, table["hu"], table["backscatter_db"])
    values = np.column_stack([impedance_of_tissue(every), attenuation, level, 0 * level]).astype(np.float32)
    # Removes the noise of the CT.
    smooth = ndimage.gaussian_filter(np.asarray(hu, np.float32), SMOOTHING_VOXELS, truncate=2.5)
    return values[np.clip(np.rint(smooth), MIN_HU, MAX_HU).astype(np.int16) - MIN_HU]


def noise_of(shape: tuple[int, ...], sd_voxels: np.ndarray) -> np.ndarray:
    """Noise of unit SD, smoothed by an SD along each axis, the same for the same voxels on every machine."""
    noise = np.random.default_rng(SEED).standard_normal(shape, dtype=np.float32)
    noise = ndimage.gaussian_filter(noise, sd_voxels, truncate=2, mode="wrap")
    return noise / max(float(noise.std()), 1e-6)


def _arcuate(cortex: np.ndarray, medulla: np.ndarray, spacing_mm: np.ndarray) -> np.ndarray:
    """The places between cortex and medulla where arcuate vessels are."""
    border = _border(medulla, cortex, ARCUATE_MM, spacing_mm)
    if not border.any():
        return border
    places = noise_of(border.shape, ARCUATE_APART_MM / 2 / spacing_mm)
    return border & (places > np.quantile(places[border], 1 - ARCUATE_SHARE))


def _border(
    inside: np.ndarray, outside: np.ndarray, thickness_mm: float, spacing_mm: np.ndarray
) -> np.ndarray:
    """The part of a mask within a thickness of another, at least one voxel thick."""
    if not (inside.any() and outside.any()):
        return np.zeros_like(inside)
    distance = ndimage.distance_transform_edt(~outside, sampling=spacing_mm)
    return inside & (distance <= max(thickness_mm, spacing_mm.min()) + 1e-6)
