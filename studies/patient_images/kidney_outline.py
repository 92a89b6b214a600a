"""An outline of the kidney in a B-mode image, by a segmenter that knows only where its centre is.

Otsu's three classes (1979, IEEE Trans Syst Man Cybern 9, 62; scikit-image) near the centre: fluid, parenchyma, and what is brighter. The outline
grows from a disc about the centre through what is not brighter, without narrow bridges (opening), over bright or dark pieces within (closing,
holes filled).
"""

from collections.abc import Sequence

import numpy as np
from scipy import ndimage
from skimage.filters import threshold_multiotsu

# Half of the thickness of a kidney is 20 to 30 mm: the disc is in it, so are most pixels near its centre.
SEED_MM, NEAR_MM = 12.0, 30.0
# The outline ends so far from the centre: half of the length of a kidney is 50 to 60 mm.
MOST_MM = 55.0
OPENING_MM, CLOSING_MM = 6.0, 6.0
# The sinus is in the outline of a kidney: hollows that no disc of this radius enters.
SINUS_MM = 10.0
GOOD_DICE = 0.8


def outlined_kidney(
    image: np.ndarray, covered: np.ndarray, centre: Sequence[float], pixel_mm: Sequence[float]
) -> np.ndarray:
    """Return the mask (rows, columns) of the kidney in an image whose speckle is averaged.

    Args:
        image: grey values (rows, columns).
        covered: whether the scanlines reach a pixel.
        centre: row and column of the kidney's centre, all that is known of it.
        pixel_mm: height and width of a pixel.
    """
    row, column = np.indices(image.shape)
    away = np.hypot((row - centre[0]) * pixel_mm[0], (column - centre[1]) * pixel_mm[1])
    seed, near = (covered & (away <= mm) for mm in (SEED_MM, NEAR_MM))
    if len(np.unique(image[near])) < 3:
        return seed
    brighter = image > threshold_multiotsu(image[near], 3)[-1]
    dark = covered & (away <= MOST_MM) & ~brighter
    grown = _connected(opened(dark | seed, OPENING_MM, pixel_mm) | seed, seed)
    return ndimage.binary_fill_holes(closed(grown, CLOSING_MM, pixel_mm)) & covered


def kidney_contour(kidney: np.ndarray, pixel_mm: Sequence[float]) -> np.ndarray:
    """Return a mask of parenchyma (rows, columns) with the sinus, which labels of parenchyma may leave out: hollows of SINUS_MM and holes."""
    return ndimage.binary_fill_holes(closed(kidney, SINUS_MM, pixel_mm))


def dice(one: np.ndarray, other: np.ndarray) -> float:
    """Return the Dice coefficient of two masks; NaN where both are empty."""
    total = int(one.sum()) + int(other.sum())
    return 2 * int((one & other).sum()) / total if total else float("nan")


def closed(mask: np.ndarray, radius_mm: float, pixel_mm: Sequence[float]) -> np.ndarray:
    """Return a mask (rows, columns) closed by a disc; beyond the border it goes on as at the border."""
    return ~opened(~mask, radius_mm, pixel_mm)


def opened(mask: np.ndarray, radius_mm: float, pixel_mm: Sequence[float]) -> np.ndarray:
    """Return a mask (rows, columns) opened by a disc; beyond the border it goes on as at the border."""
    margin = [int(np.ceil(2 * radius_mm / mm)) for mm in pixel_mm]
    wide = np.pad(mask, [(n, n) for n in margin], mode="edge")
    core = _distance(wide, pixel_mm) > radius_mm
    inner = tuple(slice(n, -n) for n in margin)
    return (core | (_distance(~core, pixel_mm) <= radius_mm))[inner] & mask


def _distance(mask: np.ndarray, pixel_mm: Sequence[float]) -> np.ndarray:
    """Return the distance [mm] of each pixel of a mask from the nearest outside it, infinite where there is none."""
    if mask.all():
        return np.full(mask.shape, np.inf)
    return ndimage.distance_transform_edt(mask, sampling=pixel_mm)


def _connected(mask: np.ndarray, seed: np.ndarray) -> np.ndarray:
    """Return the pieces of a mask that a seed touches."""
    pieces, _ = ndimage.label(mask)
    return np.isin(pieces, np.setdiff1d(pieces[seed], 0))
