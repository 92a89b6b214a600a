"""How the organ is attached to what is around it: fixed, or by elastic tethers to where it was segmented
(NumPy).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import igl
import numpy as np
import trimesh
from scipy.sparse import csr_array

from sim.lattice import Lattice, surface_points
from sim.sampling import SamplingError

# A layer of thickness t resists by E / t along its normal and G / t across; fat hardly changes its volume, so
# that G = E / 3.
SHEAR_RATIO = 1 / 3


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
        """Stiffness (n, 3, 3) of each node's spring [N/mm], symmetric. Raises SamplingError."""
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
        """The stiffness, the same in all directions, shared by the volume of tissue of each node."""
        volume = lattice.node_mass(np.ones(len(lattice.cells)))
        volume *= nodes_within(lattice.nodes, self.at_mm, self.radius_mm)
        return (self.stiffness_n_mm * volume / volume.sum())[:, None, None] * np.eye(3)


@dataclass(frozen=True)
class PerirenalFat:
    """Fat around the organ as an elastic foundation (Winkler): ``stiffness_kpa_mm`` (faces,) along the normal
    of each face of the surface, and SHEAR_RATIO of it across.
    """

    stiffness_kpa_mm: np.ndarray

    def stiffness(self, lattice: Lattice, surface: trimesh.Trimesh) -> np.ndarray:
        """The stiffness times the area of surface of each node."""
        points, area_mm2 = surface_points(surface, lattice.cell_mm / 2)
        faces = np.asarray(surface.faces, np.int64)
        face = igl.point_mesh_squared_distance(points, np.asarray(surface.vertices, float), faces)[1]
        normal = surface.face_normals[face]
        n_mm = 1e-3 * self.stiffness_kpa_mm[face] * area_mm2
        along = normal[:, :, None] * normal[:, None, :]
        per_point = n_mm[:, None, None] * (SHEAR_RATIO * np.eye(3) + (1 - SHEAR_RATIO) * along)
        nodes, weights = lattice.interpolation.attach(points)
        offsets = np.arange(0, nodes.size + 1, nodes.shape[1])
        shape = len(points), len(lattice.nodes)
        of_nodes = csr_array((weights.ravel(), nodes.ravel(), offsets), shape=shape).T
        return (of_nodes @ per_point.reshape(-1, 9)).reshape(-1, 3, 3)


def total_stiffness(tethers: Sequence[Tether], lattice: Lattice, surface: trimesh.Trimesh) -> np.ndarray:
    """Stiffness (n, 3, 3) of all tethers on each node [N/mm]. Raises SamplingError."""
    return np.sum([tether.stiffness(lattice, surface) for tether in tethers], axis=0)
