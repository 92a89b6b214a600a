"""Closed surfaces as voxels, without Boolean operations or distances of triangles: by the parity of
crossings along z (NumPy).
"""

from dataclasses import dataclass

import numpy as np
import trimesh


@dataclass(frozen=True)
class RasterGrid:
    """Voxels of one width [mm]; ``low_mm`` (3,) is the centre of the first, ``count`` (3,) their number
    along x, y, z.
    """

    low_mm: np.ndarray
    count: np.ndarray
    voxel_mm: float

    @classmethod
    def around(cls, surfaces: list[trimesh.Trimesh], voxel_mm: float, margin_mm: float) -> "RasterGrid":
        """A grid around surfaces and a margin."""
        low = np.min([each.bounds[0] for each in surfaces], axis=0) - margin_mm
        high = np.max([each.bounds[1] for each in surfaces], axis=0) + margin_mm
        # Centres at odd places, so that no vertex or edge of a surface with round coordinates is straight
        # above one.
        low += voxel_mm * np.array([0.3178, 0.2345, 0.1416])
        return cls(low, np.ceil((high - low) / voxel_mm).astype(int) + 1, voxel_mm)

    def inside(self, surface: trimesh.Trimesh) -> np.ndarray:
        """Which voxel centres (nx, ny, nz) are inside a closed surface [mm]."""
        column, height = self._crossings(np.asarray(surface.triangles) - self.low_mm)
        above = np.clip(np.ceil(height / self.voxel_mm), 0, self.count[2]).astype(int)
        crossed = np.zeros((self.count[0] * self.count[1], self.count[2] + 1), np.int32)
        np.add.at(crossed, (column, above), 1)
        parity = np.cumsum(crossed, axis=1)[:, :-1] % 2 == 1
        return parity.reshape(self.count)

    def _crossings(self, corner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Columns (n,) and heights (n,) [mm] at which lines along z through the centres cross triangles
        (f, 3, 3) [mm].
        """
        first = np.clip(np.ceil(corner[:, :, :2].min(axis=1) / self.voxel_mm), 0, None).astype(int)
        last = np.minimum(np.floor(corner[:, :, :2].max(axis=1) / self.voxel_mm), self.count[:2] - 1).astype(
            int
        )
        size = np.maximum(last - first + 1, 0)
        number = size.prod(axis=1)
        face = np.repeat(np.arange(len(corner)), number)
        within = np.arange(len(face)) - np.repeat(np.cumsum(number) - number, number)
        at = first[face] + np.column_stack([within // size[face, 1], within % size[face, 1]])
        share = _barycentric(corner[face, :, :2], self.voxel_mm * at)
        hit = (share >= 0).all(axis=1)
        height = np.einsum("nk,nk->n", share[hit], corner[face[hit], :, 2])
        return at[hit, 0] * self.count[1] + at[hit, 1], height


def _barycentric(triangle: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Shares (n, 3) of the corners of triangles (n, 3, 2) at points (n, 2); negative where a triangle is
    seen edge on.
    """
    to = triangle - point[:, None]
    after, last = np.roll(to, -1, axis=1), np.roll(to, -2, axis=1)
    opposite = after[..., 0] * last[..., 1] - after[..., 1] * last[..., 0]
    whole = opposite.sum(axis=1, keepdims=True)
    return np.where(whole == 0, -1.0, opposite / np.where(whole == 0, 1.0, whole))
