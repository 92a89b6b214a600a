"""Measures of a renal tumour for nephrometry: size, exophytic share, contact surface area, distances to
the structures around it.
"""

from dataclasses import dataclass

import igl
import numpy as np
import trimesh
from scipy import ndimage
from scipy.spatial.distance import pdist

from scenes.anatomy import Grid
from scenes.kidney_axes import KidneyAxes, kidney_axes
from scenes.surfaces import signed_distance_from

# Points inside the tumour that shares of its volume are counted with.
POINTS = 20_000
# The tumour's surface is in contact with the kidney where the point this far outside it is in the organ.
CONTACT_MM = 0.5
# Labels do not tell a main vessel from its branches: one at least this wide counts as the main one. An
# estimate, between main renal artery (5 to 6 mm) and vein (10 to 12 mm) and their first branches, about half
# as wide.
MAIN_DIAMETER_MM = {"artery": 4.0, "vein": 7.0, "vessel": 4.0}
# Main vessels are searched this far around the tumour, and touch it within this distance.
AROUND_MM, TOUCH_MM = 15.0, 1.0


@dataclass(frozen=True)
class TumourAnatomy:
    """One tumour in its kidney; None for what the labels do not show."""

    tumours: int
    """Number of separate tumours; the measures are of the largest."""
    diameter_mm: float
    """Greatest distance between two points of the surface."""
    volume_ml: float
    exophytic_share: float
    """Share of the volume outside the kidney's contour, 0 to 1."""
    contact_cm2: float
    """Contact surface area."""
    distance_mm: dict[str, float]
    """Least distance from the surface to each labelled structure: urine (collecting system), sinus,
    artery, vein, vessel.
    """
    touches_main_vessel: bool | None
    axes: KidneyAxes
    heights_mm: tuple[float, float]
    """Lowest and highest point along the polar axis (``KidneyAxes.heights``)."""
    points: np.ndarray
    """Points (n, 3) evenly inside the tumour [mm, LPS]."""


def tumour_anatomy(
    organ: trimesh.Trimesh,
    tumour: trimesh.Trimesh,
    parts: dict[str, trimesh.Trimesh],
    labels: Grid | None = None,
    tissues: dict[int, str] | None = None,
    hilum_mm: tuple[float, float, float] | None = None,
) -> TumourAnatomy:
    """The measures of the largest tumour of a kidney. All surfaces are closed, in LPS [mm].

    ``organ`` includes its tumours and cysts; ``tumour`` is of one or several, apart from each other.
    ``parts`` are the surfaces of other parts by tissue: sinus, urine (collecting system), vessel, cyst.
    ``labels`` are voxels whose values ``tissues`` names; they alone distinguish arteries from veins.
    ``hilum_mm`` is a point at the hilum, for where no sinus is labelled.
    """
    bodies = sorted(tumour.split(only_watertight=False), key=lambda body: abs(body.volume))
    largest = bodies[-1]
    cysts = [parts["cyst"]] if "cyst" in parts else []
    axes = kidney_axes(organ, [tumour, *cysts], parts, hilum_mm)
    points = points_inside(largest)
    heights = axes.heights(largest.vertices)
    labelled = vessels_of(labels, tissues or {})
    vessels = {kind: vessel for kind, vessel in labelled.items() if reaches_kidney(vessel, axes.contour)}
    # Arteries and veins share one surface: it serves where no voxels tell them apart.
    wanted = ("urine", "sinus") if labelled else ("urine", "sinus", "vessel")
    surfaces = {tissue: parts[tissue] for tissue in wanted if tissue in parts}
    return TumourAnatomy(
        tumours=len(bodies),
        diameter_mm=float(pdist(largest.convex_hull.vertices).max()),
        volume_ml=float(largest.volume) / 1000,
        exophytic_share=exophytic_share(points, axes.contour),
        contact_cm2=contact_mm2(organ, largest) / 100,
        distance_mm={tissue: surface_distance_mm(largest, surface) for tissue, surface in surfaces.items()}
        | {kind: voxel_distance_mm(largest, vessel) for kind, vessel in vessels.items()},
        touches_main_vessel=touches_main_vessel(largest, vessels),
        axes=axes,
        heights_mm=(float(heights.min()), float(heights.max())),
        points=points,
    )


def points_inside(surface: trimesh.Trimesh) -> np.ndarray:
    """About POINTS points (n, 3) of a cubic grid inside a closed surface."""
    step = (abs(surface.volume) / POINTS) ** (1 / 3)
    low, high = surface.bounds
    axes = [np.arange(a + step / 2, b, step) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return grid[_inside(surface, grid)]


def exophytic_share(points: np.ndarray, contour: trimesh.Trimesh) -> float:
    """Share of points (n, 3) outside the kidney's contour.

    The contour is the convex hull of the kidney without the tumour, as in the computer-generated scores of
    Heller et al. 2022 (J Urol 207, 1105), but in space instead of on axial slices, so that it follows the
    kidney's long axis.
    """
    return float(1 - _inside(contour, points).mean())


def contact_mm2(organ: trimesh.Trimesh, tumour: trimesh.Trimesh) -> float:
    """Contact surface area [mm^2]: of the tumour's triangles that have the kidney beyond them.

    As Bulanti et al. 2024 (arXiv:2402.16857; J Imaging 2025, 11, 78), it is the area of triangles of the
    segmented tumour, without an assumption about its shape. They search the triangles near the surface of the
    kidney without tumour; here the organ's surface encloses the tumour, so a triangle counts where the organ
    goes on CONTACT_MM beyond it. For a ball cut by a plane at depth d, both are 2 pi r d, the formula of
    Hsieh et al. 2016 (J Urol 196, 33) after Leslie et al. 2014 (Eur Urol 66, 884).
    """
    beyond = tumour.triangles_center + CONTACT_MM * tumour.face_normals
    return float(tumour.area_faces[signed_distance_from(organ, beyond) < 0].sum())


def surface_distance_mm(tumour: trimesh.Trimesh, surface: trimesh.Trimesh) -> float:
    """Least distance [mm] between two surfaces at the vertices of the second; 0 where they meet."""
    return max(0.0, float(signed_distance_from(tumour, surface.vertices).min()))


def vessels_of(labels: Grid | None, tissues: dict[int, str]) -> dict[str, Grid]:
    """The voxels of each kind of vessel that is labelled, True where it is."""
    if labels is None:
        return {}
    codes = {kind: [code for code, tissue in tissues.items() if tissue == kind] for kind in MAIN_DIAMETER_MM}
    masks = {kind: np.isin(labels.voxels, values) for kind, values in codes.items() if values}
    return {kind: Grid(mask, labels.index_from_mm) for kind, mask in masks.items() if mask.any()}


def reaches_kidney(vessel: Grid, contour: trimesh.Trimesh) -> bool:
    """Whether a labelled vessel is the kidney's own, which ends in its contour; aorta and vena cava do
    not.
    """
    return bool(_inside(contour, _places(vessel, np.argwhere(vessel.voxels))).any())


def voxel_distance_mm(tumour: trimesh.Trimesh, vessel: Grid) -> float:
    """Least distance [mm] from a surface to the border of labelled voxels, half a voxel from their
    centres; 0 where they meet.
    """
    indices = np.argwhere(vessel.voxels)
    squared, _, nearest = igl.point_mesh_squared_distance(
        _places(vessel, indices),
        np.ascontiguousarray(tumour.vertices, float),
        np.ascontiguousarray(tumour.faces, np.int64),
    )
    first = np.argmin(squared)
    at = vessel.index_from_mm[:3, :3] @ nearest[first] + vessel.index_from_mm[:3, 3]
    voxels = float(np.linalg.norm(at - indices[first]))
    return float(np.sqrt(squared[first])) * max(0.0, 1 - 0.5 / voxels) if voxels > 0 else 0.0


def main_vessel_gap_mm(tumour: trimesh.Trimesh, vessel: Grid, least_diameter_mm: float) -> float:
    """Distance [mm] from a surface to the part of a vessel that is at least so wide; infinite where there is
    none near.

    This part is the union of the balls inside the label that have this diameter.
    """
    corners = np.array(np.meshgrid(*(tumour.bounds + [[-AROUND_MM], [AROUND_MM]]).T)).reshape(3, -1).T
    indices = corners @ vessel.index_from_mm[:3, :3].T + vessel.index_from_mm[:3, 3]
    first = np.clip(np.floor(indices.min(axis=0)), 0, vessel.voxels.shape).astype(int)
    last = np.clip(np.ceil(indices.max(axis=0)) + 1, first, vessel.voxels.shape).astype(int)
    near = vessel.voxels[tuple(slice(a, b) for a, b in zip(first, last, strict=True))]
    if not near.any():
        return np.inf
    spacing = np.linalg.norm(np.linalg.inv(vessel.index_from_mm)[:3, :3], axis=0)
    radius = ndimage.distance_transform_edt(near, sampling=spacing)
    middle = 2 * radius >= least_diameter_mm
    if not middle.any():
        return np.inf
    places = _places(vessel, np.argwhere(middle) + first)
    return float((signed_distance_from(tumour, places) - radius[middle]).min())


def touches_main_vessel(tumour: trimesh.Trimesh, vessels: dict[str, Grid]) -> bool | None:
    """Whether a surface touches the main renal artery or vein; None where it touches none, and not both
    kinds are labelled.
    """
    gaps = [main_vessel_gap_mm(tumour, vessel, MAIN_DIAMETER_MM[kind]) for kind, vessel in vessels.items()]
    if gaps and min(gaps) <= TOUCH_MM:
        return True
    return False if "vessel" in vessels or {"artery", "vein"} <= set(vessels) else None


def _inside(surface: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """Which points (n, 3) are inside a closed surface; faster than their distances."""
    vertices, faces = (
        np.ascontiguousarray(surface.vertices, float),
        np.ascontiguousarray(surface.faces, np.int64),
    )
    return igl.fast_winding_number(vertices, faces, points) > 0.5


def _places(grid: Grid, indices: np.ndarray) -> np.ndarray:
    """LPS [mm] of voxel indices (n, 3)."""
    mm_from_index = np.linalg.inv(grid.index_from_mm)
    return indices @ mm_from_index[:3, :3].T + mm_from_index[:3, 3]
