"""The figures of a cut by voxels and SimpleITK's distance maps: an independent computation of
``rehearsal/resection/judgement.py``, without Boolean operations or distances of triangles.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import SimpleITK as sitk
import trimesh
from scipy.ndimage import gaussian_filter

from rehearsal.resection.cut import Cut
from rehearsal.resection.judgement import NOT_PARENCHYMA


@dataclass(frozen=True)
class RasterGrid:
    """Voxels of one width [mm]: ``low_mm`` (3,) is the centre of the first, ``count`` (3,) their number."""

    low_mm: np.ndarray
    count: np.ndarray
    voxel_mm: float

    @classmethod
    def around(cls, surfaces: list[trimesh.Trimesh], voxel_mm: float, margin_mm: float) -> "RasterGrid":
        """A grid around surfaces and a margin."""
        low = np.min([surface.bounds[0] for surface in surfaces], axis=0) - margin_mm
        high = np.max([surface.bounds[1] for surface in surfaces], axis=0) + margin_mm
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
        """Columns (n,) and heights (n,) [mm] at which the columns cross triangles (f, 3, 3) [mm]."""
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
    """Shares (n, 3) of the corners of triangles (n, 3, 2) at points (n, 2); negative of one on edge."""
    to = triangle - point[:, None]
    after, last = np.roll(to, -1, axis=1), np.roll(to, -2, axis=1)
    opposite = after[..., 0] * last[..., 1] - after[..., 1] * last[..., 0]
    whole = opposite.sum(axis=1, keepdims=True)
    return np.where(whole == 0, -1.0, opposite / np.where(whole == 0, 1.0, whole))


VOXEL_MM = 0.3
# Normals are those of the solid, smoothed with this standard deviation.
SMOOTHED_VOXELS = 2.0
# Distances and normals of voxels need some around each surface.
AROUND_MM = 3.0
BELOW_MM = 5.0
MM3_OF_ML = 1000.0


@dataclass(frozen=True)
class CutFigures:
    """Least and mean margin [mm], area [mm^2] with a margin below 5 mm, and volumes [ml] of a cut."""

    margin_min_mm: float
    margin_mean_mm: float
    below_5_mm2: float
    specimen_ml: float
    tumour_left_ml: float
    parenchyma_ml: float


def figures_by_voxels(
    cut: Cut, organ: trimesh.Trimesh, tumour: trimesh.Trimesh, parts: Mapping[str, trimesh.Trimesh]
) -> CutFigures:
    """Rasterise all surfaces at rest [mm] on one grid, and measure there.

    The resection surface is where a voxel of the specimen has a neighbour that is of the organ and not of the
    specimen.
    """
    grid = RasterGrid.around([cut.specimen, tumour], VOXEL_MM, AROUND_MM)
    specimen, whole, growth = (grid.inside(surface) for surface in (cut.specimen, organ, tumour))
    healthy = whole & ~growth
    for name in NOT_PARENCHYMA:
        if name in parts:
            healthy &= ~grid.inside(parts[name])
    distance, area = _at_border(specimen, whole & ~specimen, signed_distance_map(growth, VOXEL_MM))
    margin = np.maximum(distance, 0.0)

    def volume_ml(voxels: np.ndarray) -> float:
        return float(voxels.sum()) * VOXEL_MM**3 / MM3_OF_ML

    return CutFigures(
        margin_min_mm=float(margin.min()),
        margin_mean_mm=float(area @ margin / area.sum()),
        below_5_mm2=float(area[distance < BELOW_MM].sum()),
        specimen_ml=volume_ml(specimen),
        tumour_left_ml=volume_ml(growth & whole & ~specimen),
        parenchyma_ml=volume_ml(healthy & specimen),
    )


def signed_distance_map(inside: np.ndarray, voxel_mm: float) -> np.ndarray:
    """Signed distance [mm] of voxels (nx, ny, nz) from a solid's surface, negative inside (Maurer et al.
    2003, in SimpleITK).

    SimpleITK's is that from the centres of the solid's outermost voxels. From farther than a voxel the
    nearest of them is close to the surface; nearer than that it is the mean with the distance from the voxels
    around the solid.
    """
    of_solid, of_others = (_maurer(voxels, voxel_mm) for voxels in (inside, ~inside))
    near = (of_solid - of_others) / 2
    return np.where(of_solid > voxel_mm, of_solid, np.where(of_others > voxel_mm, -of_others, near))


def _maurer(inside: np.ndarray, voxel_mm: float) -> np.ndarray:
    image = sitk.GetImageFromArray(inside.astype(np.uint8))
    image.SetSpacing([voxel_mm] * 3)
    distance = sitk.SignedMaurerDistanceMap(
        image, insideIsPositive=False, squaredDistance=False, useImageSpacing=True
    )
    return sitk.GetArrayFromImage(distance).astype(float)


def _at_border(solid: np.ndarray, beside: np.ndarray, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances (n,) [mm] at the faces between voxels of a solid and voxels beside it, and the area (n,)
    [mm^2] of each.

    A face counts by the share of its axis in the surface's normal: of a plane with the normal n, area A has A
    |n_a| of faces across axis a, so that their sum, weighted by |n_a|, is A.
    """
    normal = np.stack(np.gradient(gaussian_filter(solid.astype(np.float32), SMOOTHED_VOXELS)), axis=-1)
    distances, areas = [], []
    for axis in range(3):
        low = tuple(slice(None, -1) if k == axis else slice(None) for k in range(3))
        high = tuple(slice(1, None) if k == axis else slice(None) for k in range(3))
        border = (solid[low] & beside[high]) | (beside[low] & solid[high])
        across = normal[low][border] + normal[high][border]
        distances.append((distance[low][border] + distance[high][border]) / 2)
        size = np.maximum(np.linalg.norm(across, axis=1), 1e-12)
        areas.append(VOXEL_MM**2 * np.abs(across[:, axis]) / size)
    return np.concatenate(distances), np.concatenate(areas)
