"""Perirenal fat around an organ: how thick the CT shows it, where the surgeon has removed it, and how stiff
it holds the organ.
"""

import igl
import numpy as np
import trimesh
from scipy import ndimage

from scenes.scene import Attachment

# Fat in a CT: below it is gas, above it firm tissue.
GAS_BELOW_HU, FIRM_ABOVE_HU = -150.0, -30.0
# Rays from the surface outward are sampled so often, and followed so far.
STEP_MM, REACH_MM = 0.5, 40.0
# Within this distance voxels share organ and fat. A layer cannot be seen to be thinner.
RIM_MM = 3.0
# What is firm over a shorter distance is a vessel or a septum in the fat.
FIRM_MM = 3.0
# A ray begins so far in front of its own face.
OFF_MM = 0.01


def fat_thickness(organ: trimesh.Trimesh, voxels: np.ndarray, index_from_mm: np.ndarray) -> np.ndarray:
    """Thickness (faces,) [mm] of the fat before each face of an organ: along the normal, through what is fat
    by HU, to the next firm tissue; RIM_MM to REACH_MM.

    ``organ`` is a closed surface [mm]; ``voxels`` (nx, ny, nz) [HU], whose indices ``index_from_mm`` (4, 4)
    gives. NaN where the CT cannot tell: gas, or the CT's end, before anything firm. Infinite where the organ
    faces itself, as in the hilum: that fat ties it to nothing else.
    """
    centres = np.ascontiguousarray(organ.triangles_center, float)
    normals = _smooth_normals(organ)
    distances = np.arange(RIM_MM, REACH_MM + FIRM_MM + STEP_MM / 2, STEP_MM)
    places = centres[:, None] + distances[:, None] * normals[:, None]
    indices = np.moveaxis(places @ index_from_mm[:3, :3].T + index_from_mm[:3, 3], -1, 0)
    hu = ndimage.map_coordinates(voxels, indices, order=1, cval=np.nan, prefilter=False)
    firm = _first(_lasting(hu > FIRM_ABOVE_HU, round(FIRM_MM / STEP_MM)))
    unknown = _first(~(hu >= GAS_BELOW_HU))
    last = int(np.searchsorted(distances, REACH_MM))
    thickness = distances[np.minimum(firm, last)]
    thickness[(unknown < firm) & (unknown <= last)] = np.nan
    thickness[_free_path(organ, centres, normals) < np.nan_to_num(thickness, nan=REACH_MM)] = np.inf
    return thickness


def foundation_kpa_mm(
    attachment: Attachment,
    organ: trimesh.Trimesh,
    tumour: trimesh.Trimesh | None,
    thickness_mm: np.ndarray | None,
    approach: np.ndarray,
) -> np.ndarray:
    """Normal stiffness (faces,) [kPa/mm] of the fat on each face of an organ, 0 where it is removed.

    ``thickness_mm`` (faces,) is that of ``fat_thickness``, None without a CT. ``approach`` (3,) points from
    the organ to the surgeon, and is the attachment's where that has one.
    """
    stiffness = np.full(len(organ.faces), attachment.fat_kpa_mm)
    if attachment.fat_young_kpa > 0 and thickness_mm is not None:
        known = ~np.isnan(thickness_mm)
        stiffness[known] = attachment.fat_young_kpa / thickness_mm[known]
    stiffness[removed(attachment, organ, tumour, approach)] = 0.0
    return stiffness


def removed(
    attachment: Attachment, organ: trimesh.Trimesh, tumour: trimesh.Trimesh | None, approach: np.ndarray
) -> np.ndarray:
    """Mask (faces,) of the organ's surface that the surgeon has freed of fat: what faces the approach, and
    the surface near a tumour.
    """
    towards = np.array(attachment.approach or approach, float)
    towards /= np.linalg.norm(towards)
    freed = organ.face_normals @ towards > np.cos(np.radians(attachment.freed_deg))
    if tumour is not None and attachment.freed_margin_mm > 0:
        surface = np.ascontiguousarray(tumour.vertices, float), np.ascontiguousarray(tumour.faces, np.int64)
        squared = igl.point_mesh_squared_distance(
            np.ascontiguousarray(organ.triangles_center, float), *surface
        )[0]
        freed |= squared <= attachment.freed_margin_mm**2
    return freed


def _smooth_normals(organ: trimesh.Trimesh) -> np.ndarray:
    """Unit normals (faces, 3) of the patch around each face: a face alone may follow the CT's slices."""
    normals = organ.vertex_normals[organ.faces].sum(axis=1)
    return np.ascontiguousarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def _free_path(organ: trimesh.Trimesh, centres: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Distance (faces,) [mm] from each face, along its normal, to the organ itself; infinite where it is not
    met.
    """
    vertices, faces = np.ascontiguousarray(organ.vertices, float), np.asarray(organ.faces, np.int64)
    tree = igl.AABB()
    tree.init(vertices, faces)
    hit, distance, _ = tree.intersect_ray_first(vertices, faces, centres + OFF_MM * normals, normals)
    return np.where(hit >= 0, distance, np.inf)


def _first(mask: np.ndarray) -> np.ndarray:
    """The first true column (n,) of each row of a mask (n, m); m where there is none."""
    return np.where(mask.any(axis=1), mask.argmax(axis=1), mask.shape[1])


def _lasting(mask: np.ndarray, count: int) -> np.ndarray:
    """Where ``count`` columns of a mask (n, m), from this one on, are true."""
    return np.logical_and.reduce(np.lib.stride_tricks.sliding_window_view(mask, count, axis=1), axis=-1)
