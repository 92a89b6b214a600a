"""Volume reconstruction from tracked images: freehand 3D ultrasound, a pixel-based method of Solberg et al.
2007.

1. Distribution: each pixel is added to the nearest voxel, or to the eight around it.
2. Hole filling within the closing of the scanned region by a ball, which does not extend the region. Holes
   take the nearest voxel with data, or an interpolation between the images on both sides.

O. V. Solberg, F. Lindseth, H. Torp, R. E. Blake, T. A. Nagelhus Hernes, Freehand 3D ultrasound reconstruction
algorithms - a review, Ultrasound in Medicine & Biology 33(7), 2007, doi 10.1016/j.ultrasmedbio.2007.02.015.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

METHODS = ("nearest", "smooth")
# A volume of this size takes some 4 GB.
MAX_VOXELS = 64_000_000
# Standard deviation [voxels] of the Gaussian that smooths interpolated holes.
SMOOTHING_VOXELS = 1.0


@dataclass(frozen=True)
class VoxelBox:
    """Cubic voxels along the axes of the reference frame.

    ``origin_mm`` (3,) is the centre of the first voxel, ``spacing_mm`` the distance to the next, ``shape``
    the counts along x, y and z. Raises ValueError for no voxels, or more than MAX_VOXELS.
    """

    origin_mm: np.ndarray
    spacing_mm: float
    shape: tuple[int, int, int]

    def __post_init__(self) -> None:
        if min(self.shape) < 1:
            raise ValueError(f"a box needs a voxel along each axis, not {self.shape}")
        if math.prod(self.shape) > MAX_VOXELS:
            raise ValueError(
                f"{' x '.join(f'{n:g}' for n in self.shape)} voxels of {self.spacing_mm:g} mm are over "
                f"{MAX_VOXELS:,}: "
                "take larger voxels or a smaller region"
            )

    @classmethod
    def around(cls, corners_mm: np.ndarray, spacing_mm: float) -> "VoxelBox":
        """The smallest box from the minimum of ``corners_mm`` (n, 3) that covers their maximum."""
        counts = np.ceil(np.ptp(corners_mm, axis=0) / spacing_mm) + 1
        # Also a corner that is infinitely far away is beyond the limit.
        x, y, z = (int(n) for n in np.fmin(counts, MAX_VOXELS + 1))
        return cls(corners_mm.min(axis=0), float(spacing_mm), (x, y, z))

    @property
    def index_from_mm(self) -> np.ndarray:
        """Affine map (4, 4) from the reference frame [mm] to voxel indices."""
        matrix = np.diag([1 / self.spacing_mm] * 3 + [1.0])
        matrix[:3, 3] = -np.asarray(self.origin_mm) / self.spacing_mm
        return matrix

    def places(self) -> np.ndarray:
        """The centres (x, y, z, 3) [mm] of all voxels."""
        return np.moveaxis(np.indices(self.shape), 0, -1) * self.spacing_mm + self.origin_mm


class Reconstruction:
    """Images accumulated in a box of voxels. The same images in the same order give the same bits.

    - "nearest": pixel nearest neighbour (Solberg et al. 2007). A voxel is the mean of its pixels; a hole
      takes the nearest voxel with data.
    - "smooth": a pixel is distributed to the eight voxels around it by trilinear weights (PLUS's LINEAR).
      Holes are interpolated along sticks (``_along_sticks``) and smoothed by normalised convolution (Knutsson
      & Westin 1993, doi 10.1109/CVPR.1993.341081). Voxels with data are not changed.
    """

    def __init__(self, box: VoxelBox, method: str) -> None:
        self.box, self.method = box, method
        # One voxel more on each side, for weights that fall outside the box.
        self._shape = np.array(box.shape) + 2
        self._sum, self._weight = np.zeros(self._shape.prod()), np.zeros(self._shape.prod())
        self._seen = np.zeros(self._shape.prod(), bool)

    def add(
        self, image: np.ndarray, reference_from_image: np.ndarray, mask: np.ndarray | None = None
    ) -> None:
        """Add an image (rows, columns) of any numbers, where ``mask`` (rows, columns) is true.

        ``reference_from_image`` (4, 4) maps (column, row, 0, 1), counted from the first pixel's centre, to
        the reference frame [mm]; pixels outside the box are ignored.
        """
        matrix = self.box.index_from_mm @ reference_from_image
        along_row, along_column, first = (matrix[:3, k, None, None] for k in (0, 1, 3))
        rows, columns = np.arange(image.shape[0])[:, None], np.arange(image.shape[1])
        at = along_row * columns + (along_column * rows + first)
        values, at = image.ravel(), at.reshape(3, -1)
        if mask is not None:
            chosen = np.asarray(mask, bool).ravel()
            values, at = values[chosen], np.compress(chosen, at, axis=1)
        self._distribute(values, at)

    def add_points(self, values: np.ndarray, points_mm: np.ndarray) -> None:
        """As ``add`` for values (m,) at points (m, 3) [mm]; points that are not finite are ignored."""
        self._distribute(values, (points_mm - self.box.origin_mm).T / self.box.spacing_mm)

    def _distribute(self, values: np.ndarray, at: np.ndarray) -> None:
        """Add values (m,) at voxel coordinates (3, m)."""
        inside = ((at >= -0.5) & (at < np.array(self.box.shape)[:, None] - 0.5)).all(axis=0)
        value, at = values[inside].astype(float), np.compress(inside, at, axis=1) + 1.0
        nearest = self._flat(np.floor(at + 0.5))
        self._seen[nearest] = True
        if self.method == "nearest":
            np.add.at(self._sum, nearest, value)
            np.add.at(self._weight, nearest, 1.0)
            return
        low = np.floor(at)
        shares = at - low
        first = self._flat(low)
        steps = self._shape[1] * self._shape[2], self._shape[2], 1
        for corner in np.ndindex(2, 2, 2):
            x, y, z = (share if on else 1.0 - share for on, share in zip(corner, shares, strict=True))
            weight = x * y * z
            voxel = first + sum(on * step for on, step in zip(corner, steps, strict=True))
            np.add.at(self._sum, voxel, weight * value)
            np.add.at(self._weight, voxel, weight)

    def _flat(self, voxel: np.ndarray) -> np.ndarray:
        return ((voxel[0] * self._shape[1] + voxel[1]) * self._shape[2] + voxel[2]).astype(np.intp)

    def volume(self, reach_mm: float) -> tuple[np.ndarray, np.ndarray]:
        """Values (x, y, z) float32 and the mask (x, y, z) of voxels with data or in a hole.

        The mask is the closing, by a ball of ``reach_mm``, of the voxels with data: holes up to twice as wide
        are filled. Elsewhere values are 0.
        """
        values, known = np.zeros(self.box.shape, np.float32), np.zeros(self.box.shape, bool)
        if self._seen.any():
            total, weight, seen = (
                a.reshape(self._shape)[1:-1, 1:-1, 1:-1] for a in (self._sum, self._weight, self._seen)
            )
            part = ndimage.find_objects(seen.astype(np.uint8))[0]
            np.divide(total[part], weight[part], out=values[part], where=seen[part], casting="same_kind")
            values[part], known[part] = _filled(
                values[part], seen[part], reach_mm / self.box.spacing_mm, self.method
            )
        return values, known


def _filled(values: np.ndarray, seen: np.ndarray, reach: float, method: str) -> tuple[np.ndarray, np.ndarray]:
    """Values (x, y, z) with holes filled, and the closing of ``seen`` (x, y, z) by ``reach`` voxels."""
    # Padding: without it the closing would include the border.
    margin = int(reach) + 2
    inner = (slice(margin, -margin),) * 3
    values, seen = np.pad(values, margin), np.pad(seen, margin)
    distance, nearest = ndimage.distance_transform_edt(~seen, return_indices=True)
    # A reach of whole voxels is off them by rounding.
    within = reach + 1e-6
    closed = ndimage.distance_transform_edt(distance <= within) > within
    gaps = closed & ~seen
    if method == "nearest":
        values[gaps] = values[tuple(axis[gaps] for axis in nearest)]
    else:
        _fill_smoothly(values, seen, gaps, nearest, math.ceil(2 * reach))
    return values[inner], closed[inner]


def _fill_smoothly(
    values: np.ndarray, seen: np.ndarray, gaps: np.ndarray, nearest: np.ndarray, longest: int
) -> None:
    """Fill the holes ``gaps`` of ``values``, both (x, y, z), in place."""
    # Slice by slice, to save memory. Sticks end at voxels with data, never at filled ones.
    for x in np.flatnonzero(gaps.any(axis=(1, 2))):
        y, z = np.nonzero(gaps[x])
        gap = np.stack([np.full(len(y), x), y, z])
        values[x, y, z] = _along_sticks(values, seen, gap, nearest[:, x, y, z], longest)
    known = seen | gaps
    smooth = _gaussian(np.where(known, values, 0.0)) / np.maximum(_gaussian(known.astype(np.float32)), 1e-6)
    values[gaps] = smooth[gaps]


def _gaussian(values: np.ndarray) -> np.ndarray:
    return ndimage.gaussian_filter(values, SMOOTHING_VOXELS, mode="constant", truncate=3.0)


def _along_sticks(
    values: np.ndarray, seen: np.ndarray, gap: np.ndarray, near: np.ndarray, longest: int
) -> np.ndarray:
    """Values (m,) at voxels ``gap`` (3, m): between the nearest voxel with data, ``near`` (3, m), and the
    first beyond.

    Weighted by distance, as in Vaughan, Lasso, Ungi, Fichtinger, Hole filling with oriented sticks in
    ultrasound volume reconstruction, J Med Imaging 2(3), 2015, doi 10.1117/1.JMI.2.3.034002; the stick points
    to the nearest voxel with data instead of the best of 13 directions. With none within ``longest``: the
    nearest's value.
    """
    distance = np.linalg.norm(gap - near, axis=0)
    direction = (gap - near) / distance
    first = values[tuple(near)]
    between = first.copy()
    searching = np.arange(gap.shape[1])
    for step in range(1, longest + 1):
        beyond = np.rint(gap[:, searching] + step * direction[:, searching]).astype(np.intp)
        # The margin has no data; it stands for what is farther.
        beyond = np.clip(beyond, 0, np.array(seen.shape)[:, None] - 1)
        hit = seen[tuple(beyond)]
        met = searching[hit]
        share = distance[met] / (distance[met] + step)
        between[met] += share * (values[tuple(beyond[:, hit])] - first[met])
        searching = searching[~hit]
    return between
