"""Label map to surface: shape-based interpolation, HC-Laplacian smoothing, quadric decimation.

The order is the paper's (Camara et al. 2016, "Patient-specific modelling"): the label's iso-surface, smoothed
with the HC-Laplacian of Vollmer, Mencl and Mueller (1999), then simplified by quadric edge collapse. What is
added before it, because clinical slices are up to 5 mm apart, is the shape-based interpolation of Raya and
Udupa (1990): the signed distance of the label is resampled, not the label, which avoids steps between slices.
"""

import igl
import numpy as np
import SimpleITK as sitk
import trimesh
from scipy import ndimage
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

FACES = 5000
SMOOTHING_ITERATIONS = 20
# The contouring grid: cells along the edge of a cube of the body's volume, and limits of the cell size [mm].
CELLS, CELL_MM = 40, (0.3, 1.0)
# Standard deviation, in voxels, of the low-pass filter on the signed distance. A label's boundary is known to
# half a voxel, so terraces of that size are not anatomy; the HC filter alone preserves them.
TERRACE_SD = 0.7


def surface_from_mask(mask: sitk.Image, faces: int = FACES) -> trimesh.Trimesh:
    """The closed surface of the largest body in a label: a watertight mesh, normals outward, vertices (n, 3)
    in LPS [mm].

    It encloses the volume of that body (internal holes counted as tissue) to about 0.01 %. ``mask`` is a 3D
    image, non-zero inside the body, of any spacing [mm], origin and direction; ``faces`` is the number of
    triangles, met within a few. Raises ValueError where the mask is empty, or so small or thin that it has no
    closed surface.
    """
    solid, corner = _largest_solid(mask)
    spacing = np.array(mask.GetSpacing())
    volume = float(solid.sum() * spacing.prod())

    fine = _iso_surface(solid, spacing, step=float(np.clip(np.cbrt(volume) / CELLS, *CELL_MM)))
    trimesh.smoothing.filter_humphrey(fine, alpha=0.1, beta=0.5, iterations=SMOOTHING_ITERATIONS)

    coarse = decimate(fine, faces)
    even = _match_volume(_even_triangles(coarse, fine), volume)
    coarse = even if self_intersections(even) == 0 else _match_volume(coarse, volume)

    # Up to here all is in the image's axes; direction and origin are applied only here.
    direction = np.array(mask.GetDirection()).reshape(3, 3)
    origin = np.array(mask.GetOrigin()) + direction @ (corner * spacing)
    surface = trimesh.Trimesh(coarse.vertices @ direction.T + origin, coarse.faces, process=False)
    if surface.volume < 0:  # a left-handed direction turns the triangles inside out
        surface.invert()
    if not (surface.is_watertight and surface.is_winding_consistent and surface.body_count == 1):
        raise ValueError("the label has no closed surface of one body: it is too thin for its voxels")
    return surface


def _largest_solid(mask: sitk.Image) -> tuple[np.ndarray, np.ndarray]:
    """Largest face-connected body, holes filled, cropped; axes (x, y, z) and index of its first voxel.

    Islands would become loose bodies. Internal holes (a cyst, a stone or sinus fat that the label leaves out)
    would be closed surfaces inside the tissue, where contact, sampling and skinning have no meaning; the
    model fills them.
    """
    voxels = sitk.GetArrayViewFromImage(mask).transpose(2, 1, 0) != 0
    if not voxels.any():
        raise ValueError("the label is empty")
    box = ndimage.find_objects(voxels.astype(np.uint8))[0]
    labelled, count = ndimage.label(voxels[box])
    largest = labelled == 1 + np.argmax(np.bincount(labelled.ravel(), minlength=count + 1)[1:])
    return ndimage.binary_fill_holes(largest), np.array([axis.start for axis in box], float)


def _iso_surface(solid: np.ndarray, spacing: np.ndarray, step: float) -> trimesh.Trimesh:
    """Zero level of the label's signed distance, on an isotropic grid of `step` mm; voxel 0 at the origin."""
    rim = np.ceil(3 * step / spacing).astype(int) + 2
    padded = np.pad(solid, [(n, n) for n in rim])
    # The difference of both distances changes sign midway between voxel centres, that is at voxel faces; the
    # distance to the inner voxels alone would be half a voxel inside.
    distance = ndimage.distance_transform_edt(~padded, sampling=spacing)
    distance -= ndimage.distance_transform_edt(padded, sampling=spacing)

    distance = ndimage.gaussian_filter(distance, TERRACE_SD)

    image = sitk.GetImageFromArray(distance.transpose(2, 1, 0).astype(np.float32))
    image.SetSpacing(spacing.tolist())
    size = [int((n - 1) * s / step) + 1 for n, s in zip(padded.shape, spacing, strict=True)]
    grid = sitk.Resample(
        image,
        size,
        sitk.Transform(),
        sitk.sitkBSpline,
        [0.0] * 3,
        [step] * 3,
        np.eye(3).ravel().tolist(),
        float(distance.max()),
    )
    levels = _one_solid(sitk.GetArrayFromImage(grid).transpose(2, 1, 0), clear_of_zero=1e-3 * step)
    vertices, faces, _, _ = marching_cubes(levels, 0.0, spacing=(step,) * 3)
    # process=False: welding vertices that merely coincide would join sheets that only touch.
    surface = trimesh.Trimesh(vertices - rim * spacing, faces, process=False)
    if surface.volume < 0:
        surface.invert()
    return surface


def _one_solid(levels: np.ndarray, clear_of_zero: float) -> np.ndarray:
    """Levels of which only the largest region of negative ones is left, without cavities; none is nearer to
    zero than stated.

    The low-pass filter may cut a thin bridge or close a cleft, and a level of exactly zero gives triangles of
    zero area.
    """
    labelled, count = ndimage.label(levels < 0)
    if count == 0:
        raise ValueError("the label is too small or too thin for its voxels: nothing is left after smoothing")
    largest = ndimage.binary_fill_holes(labelled == 1 + np.argmax(np.bincount(labelled.ravel())[1:]))
    return np.where(largest, np.minimum(levels, -clear_of_zero), np.maximum(levels, clear_of_zero))


def decimate(surface: trimesh.Trimesh, faces: int) -> trimesh.Trimesh:
    """Quadric edge collapse (Garland and Heckbert 1997) to about `faces` triangles.

    libigl, not fast_simplification, though it takes a second longer: it refuses collapses that break the
    manifold or make the surface intersect itself.
    """
    if len(surface.faces) <= faces:
        return surface
    vertices, triangles, _, _ = igl.qslim(
        np.asfortranarray(surface.vertices), np.asfortranarray(surface.faces, np.int32), faces, True
    )
    return trimesh.Trimesh(vertices, triangles, process=False)


def _even_triangles(coarse: trimesh.Trimesh, fine: trimesh.Trimesh, iterations: int = 8) -> trimesh.Trimesh:
    """The coarse surface with its vertices moved along the fine one towards the mean of their neighbours
    (tangential Laplacian smoothing).

    Edge collapse leaves needles, which have poor contact normals and skinning weights. Connectivity and shape
    are kept: each iteration projects onto the fine surface.
    """
    neighbours = trimesh.smoothing.laplacian_calculation(coarse)
    vertices = coarse.vertices.view(np.ndarray)
    fine_vertices, fine_faces = fine.vertices.view(np.ndarray), fine.faces.view(np.ndarray)
    for _ in range(iterations):
        middle = 0.5 * (vertices + neighbours.dot(vertices))
        _, _, vertices = igl.point_mesh_squared_distance(middle, fine_vertices, fine_faces)
    return trimesh.Trimesh(vertices, coarse.faces, process=False)


def _match_volume(surface: trimesh.Trimesh, volume: float) -> trimesh.Trimesh:
    """The surface with its vertices offset along their normals until it encloses `volume` [mm^3].

    dV = A * offset to first order, so three Newton steps suffice; the offset is what smoothing and chords
    removed, about 0.1 mm.
    """
    matched = surface.copy()
    for _ in range(3):
        offset = (volume - matched.volume) / matched.area
        matched.vertices = matched.vertices + offset * matched.vertex_normals
    return matched


def self_intersections(surface: trimesh.Trimesh) -> int:
    """Number of crossings of edges and triangles that share no vertex."""
    triangles, faces = surface.triangles.view(np.ndarray), surface.faces.view(np.ndarray)
    low, high, centres = triangles.min(axis=1), triangles.max(axis=1), triangles.mean(axis=1)
    reach = np.linalg.norm(triangles - centres[:, None], axis=2).max(axis=1)
    # Search from the larger triangle of each pair, so that a few large ones do not widen every search.
    near = cKDTree(centres).query_ball_point(centres, 2 * reach, return_sorted=False)
    first = np.repeat(np.arange(len(faces)), [len(n) for n in near])
    second = np.concatenate([np.asarray(n, int) for n in near])
    for keep in (
        lambda i, j: reach[j] <= reach[i],
        lambda i, j: ((low[i] <= high[j]) & (low[j] <= high[i])).all(axis=1),
        lambda i, j: (faces[i][:, :, None] != faces[j][:, None, :]).all(axis=(1, 2)),
    ):
        kept = keep(first, second)
        first, second = first[kept], second[kept]
    return sum(
        int(_crosses(triangles[a, i], triangles[a, (i + 1) % 3], triangles[b]).sum())
        for a, b in ((first, second), (second, first))
        for i in range(3)
    )


def _crosses(start: np.ndarray, end: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """Whether each segment crosses its triangle: signs of tetrahedron volumes, shape (n,)."""
    a, b, c = triangle[:, 0], triangle[:, 1], triangle[:, 2]

    def side(p, q, r, s):
        return np.sign(np.einsum("ij,ij->i", np.cross(q - p, r - p), s - p))

    through = side(start, end, a, b), side(start, end, b, c), side(start, end, c, a)
    plane = side(a, b, c, start) * side(a, b, c, end) < 0
    return plane & (through[0] == through[1]) & (through[1] == through[2]) & (through[0] != 0)
