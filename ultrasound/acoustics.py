"""Acoustic properties of a CT's voxels from labels and HU: impedance, attenuation and backscatter. NumPy.

A labelled voxel has its tissue's values (``acoustic_tissues.toml``), as contrast agent raises HU by iodine, not by density. Fat and stones
within a kidney are classified by HU: no agent lowers parenchyma to fat or raises it to stone. Enhanced urine is as bright as stone,
so that it needs a label.
"""

import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from errors import UserError
from ultrasound.tissue_classification import classify_tissues

TISSUES = Path(__file__).parent / "acoustic_tissues.toml"
# Amplitude of renal cortex relative to a perfect reflector: its speckle is some 16 dB below the echo of fat on kidney.
CORTEX_DB = -38.0
# Smooths the voxel steps of labels.
SMOOTHING_VOXELS = 0.8
SEED = 20160101
MIN_HU, MAX_HU = -1024, 3071

IMPEDANCE, ATTENUATION, BACKSCATTER = range(3)


class TissueError(UserError):
    """A tissue that is not in the table; the message is one line."""


@cache
def tissue_table() -> dict[str, dict]:
    """Return the values by tissue, as in the file, and "hounsfield"."""
    return tomllib.loads(TISSUES.read_text("utf-8"))


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
    return density * (density + np.float32(349)) / np.float32(0.893e6)


def properties(
    hu: np.ndarray,
    labels: np.ndarray | None = None,
    tissue_of_label: Mapping[int, str] | None = None,
    spacing_mm: np.ndarray | None = None,
) -> np.ndarray:
    """Return impedance [MRayl], attenuation [dB/cm/MHz] and backscattered amplitude (1: perfect reflector), (..., 3) float32.

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
            noise[distance] = _noise(hu.shape, distance / 2 / spacing)
        return np.float32(table["texture_db"]) * noise[distance][where]

    level += texture(tissue_table()["hounsfield"], ...)
    labelled = _labelled(hu, labels, tissue_of_label or {}, spacing)
    stone = labelled.pop("stone", None)
    for tissue, where in labelled.items():
        table = tissue_table()[tissue]
        values[where, IMPEDANCE] = table["impedance_mrayl"]
        values[where, ATTENUATION] = table["attenuation_db_cm_mhz"]
        level[where] = table["backscatter_db"] + texture(table, where)
    values[..., BACKSCATTER] = np.float32(10) ** ((level + np.float32(CORTEX_DB)) / np.float32(20))
    for channel in range(3):
        values[..., channel] = ndimage.gaussian_filter(values[..., channel], SMOOTHING_VOXELS, truncate=2.5)
    if stone is not None:
        _add_stones(values, stone)
    return values


def _add_stones(values: np.ndarray, stone: np.ndarray) -> None:
    """Add stones at full impedance: smoothed like the rest, one of a few voxels would be soft."""
    table = tissue_table()["stone"]
    share = np.minimum(
        2 * ndimage.gaussian_filter(stone.astype(np.float32), SMOOTHING_VOXELS, truncate=2.5), 1
    )
    level = 10 ** ((table["backscatter_db"] + CORTEX_DB) / 20)
    for channel, value in enumerate((table["impedance_mrayl"], table["attenuation_db_cm_mhz"], level)):
        values[..., channel] += share * (np.float32(value) - values[..., channel])


def _by_hounsfield(hu: np.ndarray) -> np.ndarray:
    """Return values (..., 3) of HU, backscatter in dB, from a table of integer HU."""
    table = tissue_table()["hounsfield"]
    every = np.arange(MIN_HU, MAX_HU + 1)
    attenuation = np.interp(every, table["hu"], table["attenuation_db_cm_mhz"])
    level = np.interp(every, table["hu"], table["backscatter_db"])
    values = np.column_stack([impedance_of_hu(every), attenuation, level]).astype(np.float32)
    # Removes the noise of the CT.
    smooth = ndimage.gaussian_filter(np.asarray(hu, np.float32), SMOOTHING_VOXELS, truncate=2.5)
    return values[np.clip(np.rint(smooth), MIN_HU, MAX_HU).astype(np.int16) - MIN_HU]


def _labelled(
    hu: np.ndarray, labels: np.ndarray | None, tissue_of_label: Mapping[int, str], spacing_mm: np.ndarray
) -> dict[str, np.ndarray]:
    """Return masks by tissue, from labels and from HU and shape, in rising priority."""
    found: dict[str, np.ndarray] = {}
    if labels is not None:
        for tissue in dict.fromkeys(tissue_of_label.values()):
            found[tissue] = np.isin(labels, [v for v, name in tissue_of_label.items() if name == tissue])
    for tissue, here in classify_tissues(hu, found, spacing_mm).items():
        found[tissue] = found[tissue] | here if tissue in found else here
    return {tissue: where for tissue, where in found.items() if where.any()}


def _noise(shape: tuple[int, ...], sd_voxels: np.ndarray) -> np.ndarray:
    """Return noise of unit SD, smoothed by an SD along each axis, the same for the same voxels on every machine."""
    noise = np.random.default_rng(SEED).standard_normal(shape, dtype=np.float32)
    noise = ndimage.gaussian_filter(noise, sd_voxels, truncate=2, mode="wrap")
    return noise / max(float(noise.std()), 1e-6)
