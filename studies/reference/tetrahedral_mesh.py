"""Graded tetrahedra inside a closed surface, made by Mmg from the surface's signed distance.

Dapogny, Dobrzynski & Frey, *Three-dimensional adaptive domain remeshing, implicit domain meshing, and
applications to free and moving boundary problems* (J. Comput. Phys. 262, 2014). mmgpy is MIT, Mmg itself
LGPL.
"""

from collections.abc import Callable

import igl
import numpy as np
import trimesh
from mmgpy import MmgMesh3D
from skfem import Basis, ElementTetP2, FacetBasis, MeshTet, MeshTet2
from skfem.assembly import Dofs

from scenes.surfaces import signed_distance_from
from studies.reference.fem_solid import SURFACE_ORDER, CurvedMapping, MeshError

GRID_MM = 3.0
CHORD_OF_SIZE = 0.05
GRADATION = 3.0
VOLUME_ERROR = 2e-3
# Volume ratio in a curved tetrahedron, least of largest, below which its edges become straight.
LEAST_SCALE = 0.1


def tetrahedra(surface: trimesh.Trimesh, size_mm: Callable[[np.ndarray], np.ndarray]) -> MeshTet2:
    """10-node tetrahedra that fill a surface, those at the boundary curved with it.

    Args:
        surface: closed, one body, normals outward, vertices [mm].
        size_mm: wanted lengths of edges [mm], shape (n,), at points [mm], shape (n, 3).

    Returns:
        The mesh [mm]; all its boundary nodes are on the surface.

    Raises:
        MeshError: Mmg fails, or its mesh does not fill the surface.
    """
    axes = [
        np.linspace(low, high, int(np.ceil((high - low) / GRID_MM)) + 1)
        for low, high in zip(surface.bounds[0] - GRID_MM, surface.bounds[1] + GRID_MM, strict=True)
    ]
    grid = MeshTet.init_tensor(*axes)
    nodes = np.ascontiguousarray(grid.p.T)
    sizes = size_mm(nodes)
    remesher = MmgMesh3D(nodes, np.ascontiguousarray(grid.t.T, np.int32))
    remesher.set_field("metric", np.ascontiguousarray(sizes[:, None]))
    try:
        remesher.remesh_levelset(
            signed_distance_from(surface, nodes)[:, None],
            hausd=CHORD_OF_SIZE * float(sizes.max()),
            hgrad=GRADATION,
            hmin=0.5 * float(sizes.min()),
            hmax=1.5 * float(sizes.max()),
            verbose=-1,
        )
    except RuntimeError as error:
        raise MeshError(str(error)) from None
    mesh = _curved(_inside(remesher, surface), surface)
    volume = Basis(mesh, ElementTetP2(), intorder=3).dx.sum()
    if abs(volume / surface.volume - 1) > VOLUME_ERROR:
        raise MeshError(
            f"the mesh has {volume:.0f} of {surface.volume:.0f} mm^3: too coarse for this surface"
        )
    return mesh


def _inside(remesher: MmgMesh3D, surface: trimesh.Trimesh) -> MeshTet:
    """The part of Mmg's mesh that is inside the surface."""
    corners = remesher.get_vertices()
    tets, part = remesher.get_elements_with_refs()
    middles = signed_distance_from(surface, corners[tets].mean(axis=1))
    tets = tets[part == min(np.unique(part), key=lambda p: float(np.median(middles[part == p])))]
    used, corner = np.unique(tets, return_inverse=True)
    return MeshTet(
        np.ascontiguousarray(corners[used].T), np.ascontiguousarray(corner.reshape(-1, 4).T.astype(np.int64))
    )


def _curved(straight: MeshTet, surface: trimesh.Trimesh) -> MeshTet2:
    """The mesh with the nodes of its boundary, also those amid edges, moved onto the surface."""
    mesh = MeshTet2.from_mesh(straight)
    boundary = Basis(mesh, ElementTetP2(), intorder=1).get_dofs(mesh.boundary_facets()).all()
    places = mesh.doflocs.copy()
    places[:, boundary] = igl.point_mesh_squared_distance(
        np.ascontiguousarray(places[:, boundary].T),
        np.ascontiguousarray(surface.vertices, float),
        np.ascontiguousarray(surface.faces, np.int64),
    )[2].T
    return unfolded(MeshTet2(places, mesh.t))


def unfolded(mesh: MeshTet2) -> MeshTet2:
    """The mesh with straight edges where tetrahedra would (nearly) fold over: at the surface's edges."""
    while len(folded := _folded(mesh)):
        straight = MeshTet2.from_mesh(MeshTet(mesh.doflocs[:, : mesh.t.max() + 1], mesh.t))
        middles = Dofs(mesh, ElementTetP2()).element_dofs[4:, folded]
        places = mesh.doflocs.copy()
        places[:, middles] = straight.doflocs[:, middles]
        if np.array_equal(places, mesh.doflocs):
            raise MeshError("a tetrahedron of the mesh is inside out")
        mesh = MeshTet2(places, mesh.t)
    return mesh


def _folded(mesh: MeshTet2) -> np.ndarray:
    """The curved tetrahedra (n,) whose volume ratio to straight ones changes its sign among their nodes, or
    almost vanishes.

    Also those in which Newton's method does not find a point of their face at the boundary.
    """
    mapping = CurvedMapping(mesh, ElementTetP2(), mesh.bndelem)
    # scikit-fem's own determinant raises an error where it vanishes.
    scale = np.linalg.det(np.moveaxis(mapping.DF(ElementTetP2().doflocs.T), (0, 1), (2, 3)))
    least, most = np.sort(np.abs(scale), axis=1)[:, [0, -1]].T
    squeezed = np.flatnonzero((scale.min(axis=1) * scale.max(axis=1) <= 0) | (least < LEAST_SCALE * most))
    if len(squeezed):
        return squeezed
    faces = FacetBasis(mesh, ElementTetP2(), mapping, intorder=SURFACE_ORDER)
    return np.unique(faces.tind[~np.isfinite(np.asarray(faces.basis[0][0])).all(axis=1)])
