"""A lattice, its surface points and its membrane after a part of the tissue was cut out: the same nodes
and cells, with less in them (NumPy).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import igl
import numpy as np
import trimesh

from sim.lattice import (
    ERSATZ,
    SAMPLE_POINTS,
    SAMPLES,
    Lattice,
    faces_by_patch,
    gradients,
    shape_functions,
    shares,
    surface_points,
)
from sim.signed_distance import clipped_distance_grid

# The spacing of points on the new surface grows by this factor until there are no more of them than were
# removed.
COARSER = 1.1
# Rounding of points on the surface of what is removed.
NEAR_MM = 0.1


@dataclass(frozen=True)
class RemovedTissue:
    """What is cut out of an organ at rest, and what remains, as closed surfaces [mm]; ``is_new`` (f,) marks
    the faces of ``remaining`` that the cut has made.
    """

    removed: trimesh.Trimesh
    remaining: trimesh.Trimesh
    is_new: np.ndarray

    def new_surface(self) -> trimesh.Trimesh:
        """The faces that the cut has made."""
        faces = np.asarray(self.remaining.faces)[self.is_new]
        return trimesh.Trimesh(self.remaining.vertices, faces, process=False)

    def is_removed(self, points: np.ndarray) -> np.ndarray:
        """Which points (n, 3) of the organ's surface are of the removed part."""
        low, high = self.removed.bounds
        gone = ((points >= low - NEAR_MM) & (points <= high + NEAR_MM)).all(axis=1)
        near = np.asarray(points[gone], float)
        distances = [
            igl.point_mesh_squared_distance(
                near, np.asarray(surface.vertices, float), np.asarray(surface.faces, np.int64)
            )[0]
            for surface in (self.removed, self.remaining)
        ]
        gone[gone] = distances[0] < distances[1]
        return gone


def lattice_without(lattice: Lattice, tissue: RemovedTissue, parts: Sequence[trimesh.Trimesh]) -> Lattice:
    """The lattice without the removed tissue: cells that the cut crosses keep a part of their volume, others
    are as they were or empty.

    Empty cells have neither volume nor gradients, and are at no position of ``index_of``. ``parts`` are those
    of the lattice.
    """
    box = _box_around(lattice, tissue.removed)
    grid = np.argwhere(lattice.index_of[box] >= 0)
    cells = lattice.index_of[box][tuple(grid.T)]
    first = np.array([span.start for span in box])
    removed, filled = (
        _filled(lattice, surface, first, lattice.index_of[box].shape)[tuple(grid.T)]
        for surface in (tissue.removed, tissue.remaining)
    )
    changed, has_tissue = removed.any(axis=1), filled.any(axis=1)
    lost = cells[changed & ~has_tissue]
    kept = changed & has_tissue
    grid, cells, filled = grid[kept] + first, cells[kept], filled[kept]
    new = _copied(lattice)
    _fill_cells(new, cells, filled)
    new.share[cells] = shares(filled, grid, lattice.low_mm, lattice.cell_mm, parts)
    for array in (new.gradient, new.volume, new.hourglass, new.tissue, new.share):
        array[lost] = 0.0
    new.index_of[np.isin(new.index_of, lost)] = -1
    return new


def _box_around(lattice: Lattice, surface: trimesh.Trimesh) -> tuple[slice, slice, slice]:
    """The positions of the lattice's grid that a surface extends over."""
    low, high = (surface.bounds - lattice.low_mm) / lattice.cell_mm
    first = np.clip(np.floor(low).astype(int), 0, lattice.index_of.shape)
    last = np.clip(np.ceil(high).astype(int), 0, lattice.index_of.shape)
    return tuple(slice(a, b) for a, b in zip(first, last, strict=True))  # type: ignore[return-value]


def _filled(
    lattice: Lattice, surface: trimesh.Trimesh, first: np.ndarray, shape: tuple[int, ...]
) -> np.ndarray:
    """Fraction (x, y, z, s) inside a surface around each integration point of the cells from a position of
    the grid on.
    """
    sample_mm = lattice.cell_mm / SAMPLES
    low = lattice.low_mm + lattice.cell_mm * first + sample_mm / 2
    x, y, z = (SAMPLES * count for count in shape)
    distance = clipped_distance_grid(
        surface.vertices, surface.faces, low, (x, y, z), sample_mm, 2 * sample_mm
    )
    by_cell = distance.reshape(shape[0], SAMPLES, shape[1], SAMPLES, shape[2], SAMPLES).transpose(
        0, 2, 4, 1, 3, 5
    )
    return np.clip(0.5 - by_cell.reshape(*shape, SAMPLES**3) / sample_mm, 0, 1)


def _copied(lattice: Lattice) -> Lattice:
    arrays = ("gradient", "volume", "hourglass", "tissue", "share", "index_of")
    return replace(lattice, **{name: getattr(lattice, name).copy() for name in arrays})


def _fill_cells(lattice: Lattice, cells: np.ndarray, filled: np.ndarray) -> None:
    """Integrate cells (k,) over their filled fractions (k, s), as a new lattice is."""
    cell_mm = lattice.cell_mm
    weight = ERSATZ + (1 - ERSATZ) * filled
    mean, variance = gradients(weight / weight.sum(axis=1, keepdims=True))
    tissue_at = filled @ SAMPLE_POINTS / filled.sum(axis=1, keepdims=True)
    lattice.gradient[cells] = mean / cell_mm
    lattice.volume[cells] = cell_mm**3 * weight.mean(axis=1)
    lattice.hourglass[cells] = lattice.volume[cells, None, None] / cell_mm**2 * variance
    lattice.tissue[cells] = cell_mm**3 * filled.mean(axis=1)[:, None] * shape_functions(tissue_at)


def points_without(
    points: np.ndarray, area_mm2: np.ndarray, tissue: RemovedTissue, spacing_mm: float
) -> tuple[np.ndarray, np.ndarray]:
    """Surface points (p, 3) [mm] and areas (p,) [mm^2] after the cut, as many as before: those of removed
    tissue are on the new surface.

    Where that needs fewer points, the rest have no area.
    """
    gone = np.flatnonzero(tissue.is_removed(points))
    new, new_area = _few_points(tissue.new_surface(), spacing_mm, len(gone))
    points, area_mm2 = points.copy(), area_mm2.copy()
    area_mm2[gone] = 0.0
    if len(new):
        points[gone] = new[np.arange(len(gone)) % len(new)]
        area_mm2[gone[: len(new)]] = new_area
    return points, area_mm2


def _few_points(surface: trimesh.Trimesh, spacing_mm: float, most: int) -> tuple[np.ndarray, np.ndarray]:
    """At most so many points (k, 3) [mm] on a surface, a spacing apart or more, and their areas (k,)
    [mm^2], which sum to the surface's.
    """
    points, area = surface_points(surface, spacing_mm)
    while len(points) > most and spacing_mm < surface.extents.max():
        spacing_mm *= COARSER
        points, area = surface_points(surface, spacing_mm)
    # Sides that face different directions have points of their own, however far apart points are: the largest
    # stand for all.
    largest = np.sort(np.argsort(-area, kind="stable")[:most])
    return points[largest], area[largest] * (area.sum() / area[largest].sum() if most else 0.0)


def patch_shares(organ: trimesh.Trimesh, lattice: Lattice, tissue: RemovedTissue) -> np.ndarray:
    """Share of the area of each patch (p,) of an organ's surface (``lattice.surface_patches``) that the
    cut leaves.
    """
    middle, area, *_, owner = faces_by_patch(organ, lattice.cell_mm, lattice.low_mm, lattice.index_of)
    left = area * ~tissue.is_removed(middle)
    return np.bincount(owner, left) / np.bincount(owner, area)
