"""An outline of the kidney in a B-mode image, by a segmenter that knows only where its centre is.

The outline is a minimal path (Cohen and Kimmel 1997, Int J Comput Vis 24, 57; scikit-image) once around the
centre, in polar coordinates. Steps between darker within and brighter beyond cost least, so that it keeps to
the kidney's border and bridges what is hidden of it.
"""

from collections.abc import Sequence

import numpy as np
from scipy import ndimage
from skimage.graph import route_through_array

# The outline is so far from the centre: half of the thickness of a kidney is 20 to 30 mm, half of its length
# 50 to 60 mm.
LEAST_MM, MOST_MM = 12, 60
# Most that is so near to the centre is parenchyma. What is darker is fluid within the kidney, and as good as
# parenchyma.
NEAR_MM = 30.0
# Thickness of each of the layers within and beyond the outline that are compared: two of the squares that
# speckle is averaged over.
LAYER_MM = 6
# At a border grey values rise by this ratio: a step costs 1/e there, 1 where they do not rise. Where the
# image does not reach, it is not known whether there is a border.
CONTRAST, UNKNOWN_COST = 1.15, 0.5
# Neighbouring directions, 2 degrees apart, are averaged with this SD, in directions: 2 mm of outline at 30
# mm.
ANGLES, ANGLES_SD = 180, 2.0
# The sinus is in the outline of a kidney: hollows that no disc of this radius enters.
SINUS_MM = 10.0
GOOD_DICE = 0.8
# Of a kidney that touches the array, by place alone: the width of an ellipse against its height.
ELLIPSE_WIDTH = 1.3


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
    down, right = (row - centre[0]) * pixel_mm[0], (column - centre[1]) * pixel_mm[1]
    away, angle = np.hypot(down, right), np.arctan2(down, right)
    parenchyma = max(float(np.median(image[covered & (away <= NEAR_MM)])), 1.0)
    level = np.log(np.maximum(image, parenchyma))
    # A step of the radius is 1 mm.
    radius = np.arange(MOST_MM + LAYER_MM)
    directions = np.sin(_angles())[:, None], np.cos(_angles())[:, None]
    places = [at + radius * to / mm for at, to, mm in zip(centre, directions, pixel_mm, strict=True)]
    level, reached = (
        ndimage.map_coordinates(values.astype(float), places, order=1) for values in (level, covered)
    )
    outline = _closed_path(_step_cost(level, reached > 0.5)[:, LEAST_MM : MOST_MM + 1]) + LEAST_MM
    return covered & (away <= np.interp(angle, _angles(), outline, period=2 * np.pi))


def outline_by_place(covered: np.ndarray, centre: Sequence[float], pixel_mm: Sequence[float]) -> np.ndarray:
    """An outline (rows, columns) that sees no image: an ellipse about the kidney's centre that touches the
    array.
    """
    row, column = np.indices(covered.shape)
    height = (centre[0] + 0.5) * pixel_mm[0]
    down, right = (row - centre[0]) * pixel_mm[0], (column - centre[1]) * pixel_mm[1] / ELLIPSE_WIDTH
    return covered & (np.hypot(down, right) <= height)


def _angles() -> np.ndarray:
    return np.arange(ANGLES) * 2 * np.pi / ANGLES


def _step_cost(level: np.ndarray, reached: np.ndarray) -> np.ndarray:
    """Cost of a step of the outline by direction and radius [mm], of the logarithm of grey values and of
    where they are known.
    """

    def layers(values: np.ndarray) -> np.ndarray:
        smooth = ndimage.gaussian_filter1d(values, ANGLES_SD, axis=0, mode="wrap")
        return ndimage.uniform_filter1d(smooth, LAYER_MM, axis=1, mode="constant")

    known = layers(reached.astype(float))
    mean = layers(np.where(reached, level, 0.0)) / np.maximum(known, 1e-6)
    (within, beyond), (known_within, known_beyond) = (
        (np.roll(layer, LAYER_MM // 2, axis=1), np.roll(layer, -LAYER_MM // 2, axis=1))
        for layer in (mean, known)
    )
    cost = np.exp(-np.maximum(beyond - within, 0.0) / np.log(CONTRAST))
    return np.where(np.minimum(known_within, known_beyond) > 0.5, cost, UNKNOWN_COST)


def _closed_path(cost: np.ndarray) -> np.ndarray:
    """Radius (angles,), as an index, of a cheap path through a cost (angles, radii) that begins and ends at
    the cheapest step.
    """
    first, start = np.unravel_index(cost.argmin(), cost.shape)
    turn = np.roll(cost, -first, axis=0)
    path, _ = route_through_array(np.concatenate([turn, turn[:1]]), (0, start), (len(cost), start))
    radius = np.zeros(len(cost) + 1)
    np.maximum.at(radius, *np.transpose(path))
    return np.roll(radius[:-1], first)


def kidney_contour(kidney: np.ndarray, pixel_mm: Sequence[float]) -> np.ndarray:
    """A mask of parenchyma (rows, columns) with the sinus, which labels of parenchyma may leave out: hollows
    of SINUS_MM and holes.
    """
    return ndimage.binary_fill_holes(closed(kidney, SINUS_MM, pixel_mm))


def dice(one: np.ndarray, other: np.ndarray) -> float:
    """Dice coefficient of two masks; NaN where both are empty."""
    total = int(one.sum()) + int(other.sum())
    return 2 * int((one & other).sum()) / total if total else float("nan")


def closed(mask: np.ndarray, radius_mm: float, pixel_mm: Sequence[float]) -> np.ndarray:
    """A mask (rows, columns) closed by a disc; beyond the border it goes on as at the border."""
    margin = [int(np.ceil(2 * radius_mm / mm)) for mm in pixel_mm]
    wide = np.pad(mask, [(n, n) for n in margin], mode="edge")
    core = _distance(~wide, pixel_mm) > radius_mm
    inner = tuple(slice(n, -n) for n in margin)
    return mask | ~(core | (_distance(~core, pixel_mm) <= radius_mm))[inner]


def _distance(mask: np.ndarray, pixel_mm: Sequence[float]) -> np.ndarray:
    """Distance [mm] of each pixel of a mask from the nearest outside it, infinite where there is none."""
    if mask.all():
        return np.full(mask.shape, np.inf)
    return ndimage.distance_transform_edt(mask, sampling=pixel_mm)
