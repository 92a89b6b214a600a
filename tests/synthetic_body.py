"""A synthetic body whose organs are known in LPS mm, and measures on what is made of it."""

import igl
import numpy as np
import SimpleITK as sitk
import trimesh
from scipy.spatial.transform import Rotation

from scenes.patients.label_surfaces import self_intersections

# Organs of the synthetic body: centre and half-axes in LPS [mm]. Left and right differ in size and place, so
# that a mirrored, swapped or shifted import cannot pass.
LEFT = np.array([70.0, 35.0, 12.0]), np.array([25.0, 20.0, 45.0])
RIGHT = np.array([-62.0, 30.0, -10.0]), np.array([28.0, 22.0, 38.0])
TUMOUR = np.array([92.0, 30.0, 20.0]), np.array([11.0, 11.0, 11.0])  # sticks out of the left kidney
BODY = np.array([0.0, 0.0, 0.0]), np.array([160.0, 110.0, 400.0])
LEFT_ML = 4 / 3 * np.pi * LEFT[1].prod() / 1000

DIRECTIONS = {
    "identity": np.eye(3),
    "RAS": np.diag([-1.0, -1.0, 1.0]),
    "left-handed": np.diag([1.0, 1.0, -1.0]),
    "slices first": np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]),
    "oblique": Rotation.from_euler("xyz", [14, -9, 23], degrees=True).as_matrix(),
}
SPACINGS = {"thick": (1.3, 1.1, 4.5), "even": (1.5, 1.5, 1.5)}


def coarsely(patch):
    """While a patch lasts, surfaces and supports are made on coarse grids: they are tested by themselves,
    and take seconds.
    """
    patch.setattr("scenes.patients.label_surfaces.CELL_MM", (3.0, 3.0))
    patch.setattr("scenes.patients.organ_support.GRID_MM", 3.0)


def without_picture(patch):
    """While a patch lasts, an import leaves an empty check.png: it is tested by itself, and takes a second
    to draw.
    """
    patch.setattr(
        "scenes.patients.import_folder.draw_check",
        lambda patient, rows, folder: (folder / "check.png").touch(),
    )


def level(points, solid):
    """(|p - c| / a) - 1 of an ellipsoid; negative inside."""
    centre, axes = solid
    return np.linalg.norm((points - centre) / axes, axis=-1) - 1


def grid_around(low, high, spacing, direction=DIRECTIONS["identity"]):
    """An image of the given spacing and direction that covers the LPS box [low, high], all zero."""
    corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T @ direction
    size = np.ceil(np.ptp(corners, axis=0) / spacing).astype(int) + 1
    image = sitk.Image(size.tolist(), sitk.sitkInt16)
    image.SetSpacing(list(map(float, spacing)))
    image.SetDirection(np.asarray(direction).ravel().tolist())
    image.SetOrigin((direction @ corners.min(axis=0)).tolist())
    return image


def points_of(image):
    """LPS of every voxel, shape (z, y, x, 3)."""
    nx, ny, nz = image.GetSize()
    index = np.stack(np.meshgrid(np.arange(nz), np.arange(ny), np.arange(nx), indexing="ij"), axis=-1)[
        ..., ::-1
    ]
    direction = np.array(image.GetDirection()).reshape(3, 3)
    return index * np.array(image.GetSpacing()) @ direction.T + np.array(image.GetOrigin())


def drawn(image, *solids):
    """`image` with the i-th solid (value, centre and axes) painted over the earlier ones."""
    points = points_of(image)
    voxels = np.full(points.shape[:3], -1000 if solids[0][0] > 9 else 0, np.int16)
    for value, solid in solids:
        voxels[level(points, solid) < 0] = value
    painted = sitk.GetImageFromArray(voxels)
    painted.CopyInformation(image)
    return painted


def body(direction=DIRECTIONS["identity"], spacing=(3.0, 2.5, 4.0), z=(-90.0, 90.0)):
    """CT [HU] and labels (1 right, 2 left, 3 tumour of the left) of the synthetic body."""
    empty = grid_around((-175, -120, z[0]), (175, 120, z[1]), spacing, direction)
    ct = drawn(empty, (40, BODY), (120, LEFT), (120, RIGHT), (70, TUMOUR))
    labels = drawn(empty, (1, RIGHT), (2, LEFT), (3, TUMOUR))
    return ct, labels


def section(solid, origin, direction=DIRECTIONS["identity"], count=48):
    """The contour (n, 3) of an ellipsoid on a plane through a place, along two axes of a direction; None
    where there is none.
    """
    centre, axes = solid
    plane = direction[:, :2] / axes[:, None]
    start = (np.asarray(origin) - centre) / axes
    middle = -np.linalg.lstsq(plane, start, rcond=None)[0]
    nearest = start + plane @ middle
    if nearest @ nearest >= 0.999:
        return None
    metric = np.linalg.cholesky(np.linalg.inv(plane.T @ plane))
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    at = middle[:, None] + np.sqrt(1 - nearest @ nearest) * metric @ [np.cos(angles), np.sin(angles)]
    return np.asarray(origin) + (direction[:, :2] @ at).T


def ellipsoid(solid, subdivisions=3):
    """The surface of a solid."""
    centre, axes = solid
    ball = trimesh.creation.icosphere(subdivisions)
    return trimesh.Trimesh(ball.vertices * axes + centre, ball.faces, process=False)


def with_voxels(image, voxels):
    changed = sitk.GetImageFromArray(voxels)
    changed.CopyInformation(image)
    return changed


def mapped(labels, values):
    """Label map with each value replaced by values[value]."""
    return with_voxels(labels, np.array(values, np.int16)[sitk.GetArrayFromImage(labels)])


def least_gap(support, organ):
    """Least distance [mm] of 20000 points of the support's surface to the organ; negative inside."""
    points, _ = trimesh.sample.sample_surface(support, 20000, seed=1)
    faces = np.asarray(organ.faces, np.int64)
    return igl.signed_distance(np.ascontiguousarray(points), np.asarray(organ.vertices), faces)[0].min()


def label_boundary(voxels):
    """Faces between inside and outside, in index coordinates (x, y, z): vertices and triangles."""
    padded = np.pad(voxels, 1)
    corners = []
    for axis in range(3):
        centre = np.argwhere(np.diff(padded.astype(np.int8), axis=axis) != 0) - 1.0
        centre[:, axis] += 0.5
        one, two = np.delete(np.eye(3), axis, axis=0) * 0.5
        corners.append(centre[:, None] + np.array([-one - two, one - two, one + two, two - one]))
    quads = np.concatenate(corners)
    first = 4 * np.arange(len(quads))[:, None]
    return quads.reshape(-1, 3), np.vstack([first + [0, 1, 2], first + [0, 2, 3]])


def voxels_to_boundary(surface, mask):
    """Distance of each vertex from the label's boundary, each axis measured in voxels."""
    direction = np.array(mask.GetDirection()).reshape(3, 3)
    index = (surface.vertices - np.array(mask.GetOrigin())) @ direction / np.array(mask.GetSpacing())
    vertices, faces = label_boundary(sitk.GetArrayFromImage(mask).transpose(2, 1, 0) != 0)
    squared = igl.point_mesh_squared_distance(np.ascontiguousarray(index), vertices, faces)[0]
    return np.sqrt(squared)


def assert_sound(mesh):
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
    assert mesh.body_count == 1
    assert self_intersections(mesh) == 0
