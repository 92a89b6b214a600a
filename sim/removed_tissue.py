"""A lattice, its surface points and its membrane after a part of the tissue was cut out: the same nodes and cells, with less in them (NumPy)."""

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
from sim.signed_distance import signed_distance

# The spacing of points on the new surface grows by this factor until there are no more of them than were removed.
COARSER = 1.1


@dataclass(frozen=True)
class RemovedTissue:
    """What is cut out of an organ at rest, and what remains, as closed surfaces [mm]; ``is_new`` (f,) marks the faces of ``remaining`` that
    the cut has made.
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
        distances = [
            igl.point_mesh_squared_distance(
                np.asarray(points, float), np.asarray(each.vertices, float), np.asarray(each.faces, np.int64)
            )[0]
            for each in (self.removed, self.remaining)
        ]
        return distances[0] < distances[1]


def lattice_without(lattice: Lattice, tissue: RemovedTissue, parts: Sequence[trimesh.Trimesh]) -> Lattice:
    """The lattice without the removed tissue: cells that the cut crosses keep a part of their volume, others are as they were or empty.

    Empty cells have neither volume nor gradients, and are at no position of ``index_of``. ``parts`` are those of the lattice.
    """
    cell_mm, low = lattice.cell_mm, lattice.low_mm
    grid = np.argwhere(lattice.index_of >= 0)
    cells = lattice.index_of[tuple(grid.T)]
    removed = tissue.removed
    near = (
        (grid >= (removed.bounds[0] - low) / cell_mm - 2) & (grid <= (removed.bounds[1] - low) / cell_mm + 1)
    ).all(axis=1)
    grid, cells = grid[near], cells[near]
    centre = signed_distance(removed.vertices, removed.faces, low + cell_mm * (grid + 0.5))[0]
    reach = cell_mm * np.sqrt(3) / 2
    lost = cells[centre <= -reach]
    grid, cells = grid[np.abs(centre) < reach], cells[np.abs(centre) < reach]
    samples = low + cell_mm * (grid[:, None] + SAMPLE_POINTS)
    remaining = tissue.remaining
    distance = signed_distance(remaining.vertices, remaining.faces, samples.reshape(-1, 3))[0]
    filled = np.clip(0.5 - distance.reshape(len(grid), -1) / (cell_mm / SAMPLES), 0, 1)
    has_tissue = filled.sum(axis=1) > 0
    lost = np.concatenate([lost, cells[~has_tissue]])
    grid, cells, filled = grid[has_tissue], cells[has_tissue], filled[has_tissue]
    new = _copied(lattice)
    _fill_cells(new, cells, filled)
    new.share[cells] = shares(filled, grid, low, cell_mm, parts)
    for array in (new.gradient, new.volume, new.hourglass, new.tissue, new.share):
        array[lost] = 0.0
    new.index_of[np.isin(new.index_of, lost)] = -1
    return new


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
    """Surface points (p, 3) [mm] and areas (p,) [mm^2] after the cut, as many as before: those of removed tissue are on the new surface.

    Where that needs fewer points, the rest have no area.
    """
    gone = np.flatnonzero(tissue.is_removed(points))
    new, new_area = surface_points(tissue.new_surface(), spacing_mm)
    while len(new) > len(gone):
        spacing_mm *= COARSER
        new, new_area = surface_points(tissue.new_surface(), spacing_mm)
    points, area_mm2 = points.copy(), area_mm2.copy()
    area_mm2[gone] = 0.0
    if len(new):
        points[gone] = new[np.arange(len(gone)) % len(new)]
        area_mm2[gone[: len(new)]] = new_area
    return points, area_mm2


def patch_shares(organ: trimesh.Trimesh, lattice: Lattice, tissue: RemovedTissue) -> np.ndarray:
    """Share of the area of each patch (p,) of an organ's surface (``lattice.surface_patches``) that the cut leaves."""
    middle, area, *_, owner = faces_by_patch(organ, lattice.cell_mm, lattice.low_mm, lattice.index_of)
    left = area * ~tissue.is_removed(middle)
    return np.bincount(owner, left) / np.bincount(owner, area)
