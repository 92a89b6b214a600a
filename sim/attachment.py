"""How the organ is attached to what is around it: fixed, or by elastic tethers to where it was segmented
(NumPy).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import igl
import numpy as np
import trimesh

from sim.lattice import Lattice, surface_points
from sim.sampling import SamplingError


def nodes_within(nodes: np.ndarray, at_mm: np.ndarray, radius_mm: float) -> np.ndarray:
    """Mask (n,) of the nodes (n, 3) within a radius [mm] of a point (3,).

    Raises SamplingError where it is none or all of them.
    """
    distance = np.linalg.norm(nodes - at_mm, axis=1)
    within = distance <= radius_mm
    if within.all() or not within.any():
        raise SamplingError(
            f"an attachment of radius_mm = {radius_mm:g} holds {'all' if within.all() else 'none'} of the "
            "organ, which is "
            f"{distance.min():.1f} to {distance.max():.1f} mm from its centre: choose another radius or point"
        )
    return within


@dataclass(frozen=True)
class FixedRegion:
    """Tissue that cannot move (Dirichlet boundary): all within a distance [mm] of a point (3,) [mm]."""

    at_mm: np.ndarray
    radius_mm: float

    def nodes(self, nodes: np.ndarray) -> np.ndarray:
        """Mask (n,) of the nodes (n, 3) that are fixed.

        Raises SamplingError where it is none or all of them.
        """
        return nodes_within(nodes, self.at_mm, self.radius_mm)


class Tether(Protocol):
    """Springs from the nodes to their places at rest."""

    def stiffness(self, lattice: Lattice, surface: trimesh.Trimesh) -> np.ndarray:
        """Stiffness (n,) of each node's spring [N/mm]. Raises SamplingError."""
        ...


@dataclass(frozen=True)
class Pedicle:
    """Vessels and ureter as springs on the tissue within a radius [mm] of the hilum (3,) [mm]; together
    ``stiffness_n_mm``.
    """

    at_mm: np.ndarray
    radius_mm: float
    stiffness_n_mm: float

    def stiffness(self, lattice: Lattice, surface: trimesh.Trimesh) -> np.ndarray:
        """The stiffness, shared by the volume of tissue of each node."""
        volume = lattice.node_mass(np.ones(len(lattice.cells)))
        volume *= nodes_within(lattice.nodes, self.at_mm, self.radius_mm)
        return self.stiffness_n_mm * volume / volume.sum()


@dataclass(frozen=True)
class PerirenalFat:
    """Fat around the organ as an elastic foundation (Winkler): ``stiffness_kpa_mm`` on the surface, but
    where it faces ``exposed`` (3,).
    """

    stiffness_kpa_mm: float
    exposed: np.ndarray

    def stiffness(self, lattice: Lattice, surface: trimesh.Trimesh) -> np.ndarray:
        """The stiffness times the area of surface of each node."""
        points, area_mm2 = surface_points(surface, lattice.cell_mm / 2)
        faces = np.asarray(surface.faces, np.int64)
        face = igl.point_mesh_squared_distance(points, np.asarray(surface.vertices, float), faces)[1]
        covered = surface.face_normals[face] @ self.exposed <= 0
        nodes, weights = lattice.interpolation.attach(points)
        per_point = 1e-3 * self.stiffness_kpa_mm * area_mm2 * covered
        return np.bincount(nodes.ravel(), (per_point[:, None] * weights).ravel(), len(lattice.nodes))


def total_stiffness(tethers: Sequence[Tether], lattice: Lattice, surface: trimesh.Trimesh) -> np.ndarray:
    """Stiffness (n,) of all tethers on each node [N/mm]. Raises SamplingError."""
    return np.sum([tether.stiffness(lattice, surface) for tether in tethers], axis=0)
