"""Regions of a CT that may be a kidney, and how much each is like one: convex, with an edge in HU along
its surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import ConvexHull

from scenes.patients.readers.label_maps import box_of

FAT_HU = -100.0
# A surface point is on an edge where the HU one or two voxels outside differ by this share of the region's
# contrast to fat. Of a kidney of 150 HU, a liver of 110 HU differs by 0.16.
EDGE_SHARE = 0.15
# Of the CTs used in development, kidneys have at least 0.87 and 0.68; spleen, stomach, muscle and vertebra at
# most 0.83 of the first; spleen and kidney in one region at most 0.83 of the first, or 0.61 of the second.
LEAST_EDGE, LEAST_SOLIDITY = 0.85, 0.65


@dataclass(frozen=True)
class Region:
    """What may be a kidney."""

    inside: np.ndarray  # bool (z, y, x)
    edge: float  # share of its surface on an edge
    solidity: float  # share of its convex hull that it fills
    open_side: np.ndarray  # (3,) voxels x, y, z, from its middle to that of the surface without an edge
    is_whole: bool  # it does not touch the border

    @classmethod
    def of(cls, inside: np.ndarray, hounsfield: np.ndarray) -> Region:
        """A region (z, y, x) of more than a few voxels in a CT [HU]."""
        # Its shell is two voxels wider.
        part = tuple(slice(max(axis.start - 3, 0), axis.stop + 3) for axis in box_of(inside)[::-1])
        own, values = inside[part], hounsfield[part]
        near = ndimage.binary_dilation(own)
        shell = np.argwhere(ndimage.binary_dilation(near) & ~near)
        middle = float(np.median(values[own]))
        edge = np.abs(values[tuple(shell.T)] - middle) > EDGE_SHARE * (middle - FAT_HU)
        places = np.argwhere(own)
        hull = ConvexHull(np.argwhere(own & ~ndimage.binary_erosion(own)))
        return cls(
            inside=inside,
            edge=float(edge.mean()),
            # The hull of the voxel centres is half a voxel inside that of the voxels.
            solidity=float(len(places) / (hull.volume + 0.5 * hull.area)),
            open_side=np.zeros(3) if edge.all() else (shell[~edge].mean(axis=0) - places.mean(axis=0))[::-1],
            is_whole=not any(inside.take(end, axis).any() for axis in range(3) for end in (0, -1)),
        )

    @property
    def is_kidney(self) -> bool:
        return self.edge >= LEAST_EDGE and self.solidity >= LEAST_SOLIDITY

    @property
    def rank(self) -> tuple[bool, bool, float]:
        """Greatest for the region that is most like a whole kidney."""
        return self.is_whole and self.is_kidney, self.is_whole, self.edge * self.solidity**0.5

    def deepest(self) -> np.ndarray:
        """The voxel (x, y, z) that is farthest from the surface."""
        box = box_of(self.inside)
        depth = ndimage.distance_transform_edt(np.pad(self.inside[box[::-1]], 1))
        z, y, x = (int(n) - 1 for n in np.unravel_index(np.argmax(depth), depth.shape))
        return np.array([x, y, z]) + [axis.start for axis in box]
