"""A regular lattice of hexahedral elements, the cells of a grid, that fills a closed surface (NumPy).

No mesh has to fit the organ: cells that contain tissue are kept, and those cut by the surface are integrated
over their filled part (finite cell method, Parvizian, Duester & Rank 2007).
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import igl
import numpy as np
import trimesh
from scipy.spatial import cKDTree

from sim.fields import fields_of
from sim.sampling import SamplingError, check_memory
from sim.signed_distance import signed_distance
from sim.skinning import NodeCarrier
from sim.stored_arrays import stored

# Corners of a cell, x slowest.
CORNERS = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)])
# A cut cell is integrated over this many samples along each edge; distances are interpolated from 3 x 3 x 3
# points.
SAMPLES = 6
SAMPLE_POINTS = (np.indices((SAMPLES,) * 3).reshape(3, -1).T + 0.5) / SAMPLES
# Stiffness of the empty part of a cut cell, relative to the tissue's, so that every node has some.
ERSATZ = 0.02
# Displacements are extrapolated from the nearest cell over at most this many widths of a cell.
EXTRAPOLATED_CELLS = 1.0
MOST_CELLS = 400_000
# Memory of a cell while the model is built: measured on 243000 cells of a kidney.
CELL_BYTES = 9000
# Surface points with less than this fraction of the mean area are merged with their neighbours.
LEAST_AREA = 0.4
# Separates points that face different directions by more than any distance between points.
APART_MM = 1e6
VOLUME_ITERATIONS = 4
# Largest relative error of the volume before it is corrected.
MOST_VOLUME_ERROR = 0.1


@dataclass(frozen=True)
class Lattice:
    """Cells and nodes at rest [mm]; nodes of one colour share no cell and are numbered consecutively.

    nodes (n, 3); colour_start (9,): first node of each of the 8 colours; cells (m, 8): nodes at CORNERS;
    gradient (m, 8, 3) [1/mm]: B, the gradients of the corners' shape functions, averaged over the cell's
    filled part; volume (m,) [mm^3]: elastic volume; hourglass (m, 8, 8) [mm]: integral of (B - mean B)(B -
    mean B)^T over the filled part; tissue (m, 8) [mm^3]: volume of tissue of each corner; share (m, parts):
    volume share of each part of the organ; index_of (x, y, z): the cell at a position of the grid that starts
    at low_mm, -1 where there is none.
    """

    cell_mm: float
    low_mm: np.ndarray
    nodes: np.ndarray
    colour_start: np.ndarray
    cells: np.ndarray
    gradient: np.ndarray
    volume: np.ndarray
    hourglass: np.ndarray
    tissue: np.ndarray
    share: np.ndarray
    index_of: np.ndarray

    def node_mass(self, density: np.ndarray) -> np.ndarray:
        """Mass (n,) of each node for a density (m,) of each cell, in the density's unit of mass for 1
        mm^3.
        """
        return np.bincount(self.cells.ravel(), (density[:, None] * self.tissue).ravel(), len(self.nodes))

    @property
    def interpolation(self) -> "CellInterpolation":
        """Between the nodes, for points of the tissue."""
        return CellInterpolation(self.nodes, self.cells, self.cell_mm, self.low_mm, self.index_of)


@dataclass(frozen=True)
class CellInterpolation:
    """Points between the nodes of a lattice: the arrays of ``Lattice`` that it takes."""

    nodes: np.ndarray
    cells: np.ndarray
    cell_mm: float
    low_mm: np.ndarray
    index_of: np.ndarray

    def attach(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nodes (k, 8) and trilinear weights (k, 8), which sum to 1, of points (k, 3) [mm].

        Points outside all cells are extrapolated linearly from the nearest cell, for one width of a cell at
        most.
        """
        cell, inside = places_in_cells(points, self.cell_mm, self.low_mm, self.index_of)
        return self.cells[cell], shape_functions(inside)

    def carrier(self) -> NodeCarrier:
        """As ``Interpolation.carrier``."""
        return NodeCarrier(self, *fields_of(self.nodes, self.nodes, within=1))

    def carried(self, points: np.ndarray, position: np.ndarray) -> np.ndarray:
        """Where points (k, 3) [mm] at rest are for positions (n, 3) [mm] of the nodes."""
        return points + self.displacement(self.attach(points), position)

    def displacement(self, at: tuple[np.ndarray, np.ndarray], position: np.ndarray) -> np.ndarray:
        """Displacement (k, 3) [mm] at places with these nodes and weights (k, 8), for positions (n, 3)
        [mm] of the nodes.
        """
        nodes, weights = at
        return np.einsum("kn,kna->ka", weights, (position - self.nodes)[nodes])


def places_in_cells(
    points: np.ndarray, cell_mm: float, low_mm: np.ndarray, index_of: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The cell (k,) of points (k, 3) [mm], or the nearest one, and their places (k, 3) in the unit cell,
    in it or beside it.
    """
    at = (np.asarray(points, float) - low_mm) / cell_mm
    index = np.clip(np.floor(at).astype(int), 0, np.array(index_of.shape) - 1)
    cell = index_of[tuple(index.T)]
    centres = np.argwhere(index_of >= 0)
    outside = cell < 0
    if outside.any():
        nearest = cKDTree(centres + 0.5).query(at[outside])[1]
        index[outside] = centres[nearest]
        cell[outside] = index_of[tuple(index[outside].T)]
    return cell, np.clip(at - index, -EXTRAPOLATED_CELLS, 1 + EXTRAPOLATED_CELLS)


def shape_functions(at: np.ndarray) -> np.ndarray:
    """Trilinear shape functions (k, 8) of a unit cell's corners at points (k, 3)."""
    return np.where(CORNERS == 1, at[:, None], 1 - at[:, None]).prod(axis=2)


def shape_gradients(at: np.ndarray) -> np.ndarray:
    """Gradients (k, 8, 3) of the shape functions in the unit cell."""
    factor = np.where(CORNERS == 1, at[:, None], 1 - at[:, None])
    sign = np.where(CORNERS == 1, 1.0, -1.0)
    other = [factor[..., (axis + 1) % 3] * factor[..., (axis + 2) % 3] for axis in range(3)]
    return sign * np.stack(other, axis=2)


def fill_with_cells(
    surface: trimesh.Trimesh, cell_mm: float, parts: Sequence[trimesh.Trimesh] = ()
) -> Lattice:
    """The lattice of a closed surface [mm], with the shares of parts inside it; where parts overlap, the
    later one counts.

    Raises SamplingError when the cells are too many for a step or for the memory, or too large for the
    surface's shape.
    """
    size = _grid_around(surface, cell_mm)[1]
    if size.prod() > 50 * MOST_CELLS or surface.volume / cell_mm**3 > MOST_CELLS:
        raise SamplingError(
            f"cells of {cell_mm:g} mm are more than {MOST_CELLS} in an organ of {surface.volume / 1000:.0f} "
            "ml: "
            "choose larger ones"
        )
    check_memory(CELL_BYTES * surface.volume / cell_mm**3, f"cells of {cell_mm:g} mm", "choose larger ones")
    return Lattice(cell_mm, *stored(_arrays_of_cells, surface, cell_mm, *parts))


def _arrays_of_cells(
    surface: trimesh.Trimesh, cell_mm: float, *parts: trimesh.Trimesh
) -> tuple[np.ndarray, ...]:
    """All of a surface's lattice but ``cell_mm``. Raises SamplingError."""
    low, size = _grid_around(surface, cell_mm)
    indices = np.indices(tuple(size.tolist())).reshape(3, -1).T
    lattice = _assemble(low, cell_mm, size, *_filled(surface, low, cell_mm, indices), parts)
    return tuple(getattr(lattice, field.name) for field in fields(Lattice)[1:])


def _grid_around(surface: trimesh.Trimesh, cell_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Lowest corner (3,) [mm] and number of cells (3,) of a grid around a surface."""
    low = surface.bounds[0] - cell_mm / 2
    return low, np.ceil((surface.bounds[1] - low) / cell_mm).astype(int)


def fill_block(
    counts: tuple[int, int, int], cell_mm: float, parts: Sequence[trimesh.Trimesh] = ()
) -> Lattice:
    """The lattice of a block with a corner at the origin and ``counts`` cells along each axis; parts as in
    ``fill_with_cells``.
    """
    indices = np.indices(counts).reshape(3, -1).T
    filled = np.ones((len(indices), len(SAMPLE_POINTS)))
    return _assemble(np.zeros(3), cell_mm, np.array(counts), indices, filled, parts)


def _filled(
    surface: trimesh.Trimesh, low: np.ndarray, cell_mm: float, indices: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Grid positions (m, 3) of the cells that contain tissue, and the filled fraction (m, s) around each
    integration point.
    """
    centre = signed_distance(surface.vertices, surface.faces, low + cell_mm * (indices + 0.5))[0]
    reach = cell_mm * np.sqrt(3) / 2
    indices, centre = indices[centre < reach], centre[centre < reach]
    filled = np.ones((len(indices), len(SAMPLE_POINTS)))
    cut = centre > -reach
    halves = np.indices((3, 3, 3)).reshape(3, -1).T
    grid = 2 * indices[cut][:, None] + halves
    unique, back = _unique_rows(grid.reshape(-1, 3))
    known = signed_distance(surface.vertices, surface.faces, low + cell_mm / 2 * unique)[0]
    distance = known[back].reshape(-1, 27) @ _from_halves(SAMPLE_POINTS).T
    # Linear interpolation cuts off convex surfaces: offset the surface outwards until the volume is right.
    offset = 0.0
    for iteration in range(VOLUME_ITERATIONS):
        filled[cut] = np.clip(0.5 - (distance - offset) / (cell_mm / SAMPLES), 0, 1)
        volume = cell_mm**3 * filled.mean(axis=1).sum()
        if iteration == 0 and abs(volume / surface.volume - 1) > MOST_VOLUME_ERROR:
            raise SamplingError(
                f"cells of {cell_mm:g} mm fill {100 * volume / surface.volume:.0f} % of the organ's "
                f"{surface.volume / 1000:.3g} ml: choose smaller ones"
            )
        offset += (surface.volume - volume) / surface.area
    has_tissue = filled.sum(axis=1) > 0
    return indices[has_tissue], filled[has_tissue]


def shares(
    filled: np.ndarray, indices: np.ndarray, low: np.ndarray, cell_mm: float, parts: Sequence[trimesh.Trimesh]
) -> np.ndarray:
    """Volume shares (m, parts) of the parts in the tissue of each cell."""
    shares = np.zeros((*filled.shape, len(parts)))
    for number, part in enumerate(parts):
        centre = signed_distance(part.vertices, part.faces, low + cell_mm * (indices + 0.5))[0]
        fraction = np.repeat((centre < 0)[:, None].astype(float), len(SAMPLE_POINTS), axis=1)
        cut = np.abs(centre) < cell_mm * np.sqrt(3) / 2
        # The distance at each sample: parts may be thin, or extend beyond the organ, so that no volume could
        # correct it.
        samples = low + cell_mm * (indices[cut][:, None] + SAMPLE_POINTS)
        distance = signed_distance(part.vertices, part.faces, samples.reshape(-1, 3))[0]
        fraction[cut] = np.clip(0.5 - distance.reshape(-1, len(SAMPLE_POINTS)) / (cell_mm / SAMPLES), 0, 1)
        shares *= 1 - fraction[..., None]
        shares[:, :, number] = fraction
    return np.einsum("ms,msp->mp", filled, shares) / filled.sum(axis=1, keepdims=True)


def _from_halves(at: np.ndarray) -> np.ndarray:
    """Weights (k, 27) that interpolate values on the 3 x 3 x 3 half-grid of a unit cell at points (k, 3)."""
    hat = np.maximum(1 - np.abs(2 * at[:, :, None] - np.arange(3)), 0)
    return np.einsum("ki,kj,kl->kijl", hat[:, 0], hat[:, 1], hat[:, 2]).reshape(len(at), 27)


def _assemble(
    low: np.ndarray,
    cell_mm: float,
    size: np.ndarray,
    indices: np.ndarray,
    filled: np.ndarray,
    parts: Sequence[trimesh.Trimesh] = (),
) -> Lattice:
    corner = indices[:, None] + CORNERS
    flat = np.ravel_multi_index(tuple(np.moveaxis(corner, 2, 0)), tuple(size + 1))
    used = np.unique(flat)
    node = np.column_stack(np.unravel_index(used, tuple(size + 1)))
    colour = node % 2 @ [4, 2, 1]
    order = np.argsort(colour, kind="stable")
    number = np.empty(len(used), int)
    number[order] = np.arange(len(used))
    cells = number[np.searchsorted(used, flat)]
    weight = ERSATZ + (1 - ERSATZ) * filled
    tissue_at = filled @ SAMPLE_POINTS / filled.sum(axis=1, keepdims=True)
    carried = cell_mm**3 * filled.mean(axis=1)[:, None] * shape_functions(tissue_at)
    index_of = np.full(size, -1)
    index_of[tuple(indices.T)] = np.arange(len(indices))
    volume = cell_mm**3 * weight.mean(axis=1)
    mean, variance = gradients(weight / weight.sum(axis=1, keepdims=True))
    return Lattice(
        cell_mm=cell_mm,
        low_mm=low,
        nodes=low + cell_mm * node[order],
        colour_start=np.searchsorted(colour[order], np.arange(9)),
        cells=cells,
        gradient=mean / cell_mm,
        volume=volume,
        hourglass=volume[:, None, None] / cell_mm**2 * variance,
        tissue=carried,
        share=shares(filled, indices, low, cell_mm, parts),
        index_of=index_of,
    )


def gradients(weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean (m, 8, 3) and variance (m, 8, 8), summed over the axes, of B over samples with weights (m, s)."""
    at_samples = shape_gradients(SAMPLE_POINTS)
    mean = np.einsum("ms,sia->mia", weight, at_samples)
    square = np.einsum("sia,sja->sij", at_samples, at_samples).reshape(-1, 64)
    return mean, (weight @ square).reshape(-1, 8, 8) - np.einsum("mia,mja->mij", mean, mean)


def surface_patches(
    surface: trimesh.Trimesh, cell_mm: float, low_mm: np.ndarray, cells: np.ndarray, index_of: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Patches of a surface, one for each cell and direction that it faces: nodes (p, 8), tangential gradients
    (p, 8, 2) [1/mm] of their shape functions, averaged over the patch, and areas (p,) [mm^2].
    """
    _, area, normal, inside, keys, owner = faces_by_patch(surface, cell_mm, low_mm, index_of)
    total = np.bincount(owner, area)

    def mean(values: np.ndarray) -> np.ndarray:
        columns = [np.bincount(owner, area * column) for column in values.reshape(len(values), -1).T]
        return (np.column_stack(columns) / total[:, None]).reshape(len(total), *values.shape[1:])

    gradient = mean(shape_gradients(inside)) / cell_mm
    # Two axes in the plane whose normal is the mean one.
    tangents = np.linalg.svd(mean(normal)[:, None])[2][:, 1:]
    return cells[keys[:, 0]], np.einsum("pka,pta->pkt", gradient, tangents), total


def faces_by_patch(
    surface: trimesh.Trimesh, cell_mm: float, low_mm: np.ndarray, index_of: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Small faces of a surface: middles (f, 3) [mm], areas (f,) [mm^2], normals (f, 3), places (f, 3) in
    their unit cell; the cell and side (p, 2) of each patch, and the patch (f,) of each face.
    """
    middle, area, normal = _small_faces(surface, cell_mm / 2)
    cell, inside = places_in_cells(middle, cell_mm, low_mm, index_of)
    keys, owner = _unique_rows(np.column_stack([cell, _sides(normal)]))
    return middle, area, normal, inside, keys, owner


def _small_faces(surface: trimesh.Trimesh, longest_mm: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Middles (f, 3) [mm], areas (f,) [mm^2] and unit normals (f, 3) of a surface's faces, divided until no
    edge is longer.

    Faces without area, which a cut can leave, are left out.
    """
    vertices, faces = trimesh.remesh.subdivide_to_size(
        surface.vertices, surface.faces, longest_mm, max_iter=30
    )
    corner = vertices[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    has_area = length[:, 0] > 0
    corner, normal, length = corner[has_area], normal[has_area], length[has_area]
    return corner.mean(axis=1), length[:, 0] / 2, normal / np.maximum(length, 1e-30)


def _sides(normal: np.ndarray) -> np.ndarray:
    """The side of a cube (n,), 0 to 5, that normals (n, 3) face."""
    axis = np.abs(normal).argmax(axis=1)
    return 2 * axis + (np.take_along_axis(normal, axis[:, None], axis=1)[:, 0] > 0)


def surface_points(surface: trimesh.Trimesh, spacing_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (k, 3) [mm] on a surface, about a spacing apart, and the area (k,) [mm^2] of each."""
    middle, area, normal = _small_faces(surface, spacing_mm / 2)
    # The grid of the cells begins half a cell beside the same corner: with two points a cell, all cells have
    # them at the same places, without which the forces of contacts vary twice as much (docs/accuracy.md).
    bins = np.floor((middle - surface.bounds[0]) / spacing_mm).astype(int)
    # Points are separate for faces of different direction: only what faces a support is in contact with it.
    keys, owner = _unique_rows(np.column_stack([bins, _sides(normal)]))
    total = np.bincount(owner, area)
    mean = np.column_stack([np.bincount(owner, area * middle[:, axis]) for axis in range(3)]) / total[:, None]
    # A point of very small area would have little stiffness and penetrate deeply.
    kept = total >= LEAST_AREA * total.mean()
    apart = np.column_stack([mean, keys[:, 3] * APART_MM])
    nearest = cKDTree(apart[kept]).query(apart)[1]
    on_surface = igl.point_mesh_squared_distance(
        mean[kept], surface.vertices, np.asarray(surface.faces, np.int64)
    )[2]
    return on_surface, np.bincount(nearest, total)


def _unique_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``np.unique`` with its inverse for rows (n, k) of integers, ten times as fast: it sorts one number
    for each row.
    """
    least = rows.min(axis=0)
    shape = tuple(rows.max(axis=0) - least + 1)
    keys, which = np.unique(np.ravel_multi_index(tuple((rows - least).T), shape), return_inverse=True)
    return np.column_stack(np.unravel_index(keys, shape)) + least, which
