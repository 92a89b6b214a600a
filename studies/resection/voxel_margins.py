"""The figures of a cut by voxels and SimpleITK's distance maps: an independent computation of
``rehearsal/resection/judgement.py``.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import SimpleITK as sitk
import trimesh
from scipy.ndimage import gaussian_filter

from rehearsal.resection.cut import Cut
from rehearsal.resection.judgement import NOT_PARENCHYMA
from studies.resection.voxel_solid import RasterGrid

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
    specimen, whole, growth = (grid.inside(each) for each in (cut.specimen, organ, tumour))
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
    of_solid, of_others = (_maurer(each, voxel_mm) for each in (inside, ~inside))
    near = (of_solid - of_others) / 2
    return np.where(of_solid > voxel_mm, of_solid, np.where(of_others > voxel_mm, -of_others, near))


def _maurer(inside: np.ndarray, voxel_mm: float) -> np.ndarray:
    image = sitk.GetImageFromArray(inside.astype(np.uint8))
    image.SetSpacing([voxel_mm] * 3)
    found = sitk.SignedMaurerDistanceMap(
        image, insideIsPositive=False, squaredDistance=False, useImageSpacing=True
    )
    return sitk.GetArrayFromImage(found).astype(float)


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
