"""Read closed surfaces (STL, PLY, OBJ) as labels: one structure a file, voxels where the surface is wound
around their centre.
"""

from collections.abc import Sequence
from pathlib import Path

import igl
import numpy as np
import trimesh

from errors import PatientError
from scenes.patient_space import Space
from scenes.patients.readers.label_maps import LabelMap, Segment, Segmentation
from scenes.surfaces import in_lps, read_triangles, stated_space
from scenes.terminal import Progress
from scenes.volumes.voxel_grid import VoxelGrid

# Voxels along the edge of a cube of a structure's volume, and limits of their width [mm].
VOXELS, VOXEL_MM = 75, (0.5, 1.5)
# Voxels of a box: those of a structure that is long and thin, such as vessels, become wider for that.
MOST_VOXELS = 30e6
# The first voxel before the surface, in voxels. On voxels that lie evenly about a ball, the errors of eight
# octants would be one, not eight: 0.6 % of its volume instead of 0.07 % (radius 5 to 10 mm).
FIRST_VOXEL = np.array([0.13, 0.29, 0.41])
# Voxels along a block: one far from the surface is inside or outside as a whole.
BLOCK = 4
MOST_DOUBLE = 0.01
# Smaller or larger structures are not in mm, nor is a shorter kidney.
EXTENT_MM, LEAST_KIDNEY_MM = (1.0, 2000.0), 30.0
# A surface with less of its vertices in the CT is elsewhere.
LEAST_IN_CT = 0.5
NAMED_OPENINGS = 3


def read_surfaces(
    files: Sequence[Path], near_mm: float, progress: Progress, space: Space | None = None
) -> Segmentation:
    """One structure a file, named by the file, of one or more. Of other structures than kidneys only the part
    within ``near_mm`` of these is labelled.

    ``space`` is that of files that state none; ``progress`` shows the progress of reading. Raises
    PatientError where there is no closed surface in mm; later, on the CT's grid, where one is outside the CT
    or bodies cover each other.
    """
    stated = {file: stated_space(file) for file in files}
    spaces = {file: own or space for file, own in stated.items()}
    surfaces = {file: in_lps(_closed(file), spaces[file]) for file in progress(files, "surfaces")}

    def maps(ct: VoxelGrid) -> list[LabelMap]:
        for file, surface in surfaces.items():
            _check_place(file, surface, spaces[file], ct)
        segments = {file: Segment.named(file.stem) for file in files}
        corners = [surfaces[file].bounds for file in files if segments[file].tissue == "kidney"]
        near = np.concatenate(corners or [surface.bounds for surface in surfaces.values()])
        low, high = near.min(axis=0) - near_mm, near.max(axis=0) + near_mm
        label_maps = []
        for file, surface in surfaces.items():
            if grid := _grid_of(surface, low, high):
                label_maps.append(LabelMap.single(grid, _voxels(file, surface, grid), segments[file]))
        return label_maps

    assumed = sum(space is None for space in spaces.values())
    return Segmentation(
        maps,
        notes=(f"surfaces that state no coordinate system were taken as LPS: {assumed}",) if assumed else (),
        space=space if None in stated.values() else None,
    )


def _closed(file: Path) -> trimesh.Trimesh:
    """A closed surface in mm, in the coordinates of its file. Raises PatientError."""
    surface = read_triangles(file)
    extent = float(surface.extents.max())
    is_kidney = Segment.named(file.stem).tissue == "kidney"
    if not EXTENT_MM[0] <= extent <= EXTENT_MM[1] or (is_kidney and extent < LEAST_KIDNEY_MM):
        unit = (
            "metres"
            if extent < EXTENT_MM[0]
            else "centimetres"
            if extent < LEAST_KIDNEY_MM
            else "micrometres"
        )
        raise PatientError(
            f"{file}: is {extent:.3g} mm long; expected mm, and these seem to be {unit}; scale the surface, "
            "or export it in mm"
        )
    edges = surface.edges  # directed, three a triangle
    if openings := _openings(surface.vertices, edges):
        places = "; ".join(
            f"({', '.join(f'{c:.1f}' for c in middle)}), {width:.1f} mm wide"
            for middle, width in openings[:NAMED_OPENINGS]
        )
        raise PatientError(
            f"{file}: is not closed, or its triangles face both ways, at {len(openings)} places, in the "
            "file's coordinates around "
            f"{places}; expected a closed surface; repair it, for example in 3D Slicer or MeshLab"
        )
    return surface


def _openings(vertices: np.ndarray, edges: np.ndarray) -> list[tuple[np.ndarray, float]]:
    """Middle (3,) and width of each place where directed edges (n, 2) have no opposite: the surface is
    open, or turns over.
    """
    pairs, place = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    ways = np.bincount(place.ravel(), np.where(edges[:, 0] < edges[:, 1], 1, -1), len(pairs))
    alone = pairs[(ways != 0) & (pairs[:, 0] != pairs[:, 1])]
    groups = trimesh.graph.connected_components(alone, min_len=2)
    openings = [vertices[group] for group in groups]
    return [(places.mean(axis=0), float(np.ptp(places, axis=0).max())) for places in openings]


def _check_place(file: Path, surface: trimesh.Trimesh, space: Space | None, ct: VoxelGrid) -> None:
    """Raises PatientError where a surface is outside the CT, but inside it in the other coordinate system."""
    other: Space = "LPS" if space == "RAS" else "RAS"
    here, there = (
        ct.share_inside(vertices) for vertices in (surface.vertices, surface.vertices * (-1.0, -1.0, 1.0))
    )
    if here < LEAST_IN_CT < there:
        stated = "as it states" if space else "as was assumed"
        raise PatientError(
            f"{file}: has {here:.0%} of its surface in the CT as {space or 'LPS'}, {stated}, and {there:.0%} "
            f"as {other}; export it again "
            f"with the right coordinate system, or write SPACE={other} into its header"
        )


def _grid_of(surface: trimesh.Trimesh, low: np.ndarray, high: np.ndarray) -> VoxelGrid | None:
    """Voxels around the part of a surface in an LPS box [mm]; None where there is none."""
    width = float(np.clip(np.cbrt(abs(surface.volume)) / VOXELS, *VOXEL_MM))
    first, last = np.maximum(surface.bounds[0], low), np.minimum(surface.bounds[1], high)
    if not (first < last).all():
        return None
    width = max(width, float(np.cbrt(np.prod(last - first) / MOST_VOXELS)))
    size = np.ceil((last - first) / width).astype(int) + 1
    x, y, z = (max(2, int(n)) for n in size)
    return VoxelGrid((x, y, z), np.full(3, width), first - width * FIRST_VOXEL, np.eye(3))


def _voxels(file: Path, surface: trimesh.Trimesh, grid: VoxelGrid) -> np.ndarray:
    """Mask (z, y, x) of the voxels that a surface is wound around, whichever way it faces; a hollow faces the
    other way.

    Raises PatientError where much of it is inside two bodies of the surface.
    """
    vertices = np.ascontiguousarray(surface.vertices, float)
    faces = np.ascontiguousarray(surface.faces, np.int64)

    def windings(indices: np.ndarray) -> np.ndarray:
        return np.rint(igl.fast_winding_number(vertices, faces, grid.place(indices))).astype(np.int8)

    blocks = -(-np.array(grid.size) // BLOCK)
    middles = (np.argwhere(np.ones(blocks, bool)) + 0.5) * BLOCK - 0.5
    squared = igl.point_mesh_squared_distance(grid.place(middles), vertices, faces)[0]
    is_near = squared <= 0.75 * (BLOCK * grid.spacing[0]) ** 2

    def voxels_of(values: np.ndarray) -> np.ndarray:
        whole = values.reshape(blocks)
        for axis in range(3):
            whole = whole.repeat(BLOCK, axis)
        return whole[tuple(slice(0, n) for n in grid.size)]

    wound = np.ascontiguousarray(voxels_of(windings(middles)))
    near = np.argwhere(voxels_of(is_near))
    wound[tuple(near.T)] = windings(near)
    inside = wound != 0
    if not inside.any():
        raise PatientError(
            f"{file}: encloses no voxel of {grid.spacing[0]:.1f} mm; expected a solid structure"
        )
    double = float((np.abs(wound[inside]) > 1).mean())
    if double > MOST_DOUBLE:
        raise PatientError(
            f"{file}: {double:.0%} of it is inside two bodies that face the same way; expected one "
            "structure, a hollow in it facing inward; "
            "export each structure as its own file, or unite its bodies"
        )
    return inside.transpose(2, 1, 0)
