"""Penalty contact of the tissue's surface with rigid obstacles: a penalty on the gap, and Coulomb friction.

At each of 12 points of a face, with d = -gap > 0, the pressure is eps d^2 / (2 delta) for d < delta and
eps (d - delta/2) beyond. Friction is elastic up to Coulomb's limit, a return mapping with anchors
that are updated after each increment (Wriggers, *Computational Contact Mechanics*, 2nd ed. 2006,
chapters 5.2 and 10.5). Areas are those at rest.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from studies.reference.fem_solid import FemSolid, stiffness_of
from studies.reference.smooth_obstacles import DistanceField, RoundedBox

TINY = 1e-12
# Half of the central difference that gives the tangent: far below the lengths of the contact law.
DIFFERENCE_MM = 1e-6


@dataclass(frozen=True)
class Law:
    """Contact law of an obstacle."""

    stiffness_kpa_mm: float
    friction: float = 0.35
    stick_kpa_mm: float = 150.0
    soft_mm: float = 0.015
    blend: float = 0.5

    def pressure(self, gap: np.ndarray) -> np.ndarray:
        """Pressure [kPa]."""
        depth = np.maximum(-gap, 0.0)
        soft = np.minimum(depth, self.soft_mm)
        return self.stiffness_kpa_mm * (soft**2 / (2 * self.soft_mm) + depth - soft)

    def most_slip(self, pressure: np.ndarray) -> np.ndarray:
        """Slip (n,) [mm] at which friction reaches Coulomb's limit; beyond it the anchor follows."""
        return (1 + self.blend) * self.friction * pressure / self.stick_kpa_mm

    def friction_share(self, stretch: np.ndarray) -> np.ndarray:
        """Transition from elastic slip to sliding, phi(r) / r, shape (n,).

        ``stretch`` is r, the elastic friction as a share of Coulomb's limit, shape (n,). A parabola joins phi
        = r and phi = 1: with a corner there Newton's method would alternate between sticking and sliding
        points.
        """
        beyond = np.clip(stretch - (1 - self.blend), 0.0, 2 * self.blend)
        carried = np.minimum(stretch, 1 + self.blend) - beyond**2 / (4 * self.blend)
        return np.where(stretch > TINY, carried / np.maximum(stretch, TINY), 1.0)


class PenaltyContact:
    """One obstacle, such as a ``RoundedBox``, against the surface of a solid.

    Attributes:
        offset: origin of the obstacle's frame [mm], shape (3,).
    """

    def __init__(
        self,
        solid: FemSolid,
        obstacle: RoundedBox | DistanceField,
        law: Law,
        offset: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        self.solid, self.obstacle, self.law = solid, obstacle, law
        self.offset = np.array(offset)
        self._anchors = np.zeros((len(solid.areas), 3))

    def places(self, displacement: np.ndarray) -> np.ndarray:
        """Contact points in the obstacle's frame [mm], shape (points, 3), for displacements (nodes, 3)."""
        return self.solid.at_surface @ (self.solid.rest + displacement) - self.offset

    def gaps(self, displacement: np.ndarray) -> np.ndarray:
        """Distance [mm] of each point from the obstacle, shape (points,)."""
        return self.obstacle.gap(self.places(displacement))

    def carry(self, displacement: np.ndarray) -> None:
        """End an increment: the anchor of a sliding point follows by its slip, that of a free one wholly."""
        places = self.places(displacement)
        gap = self.obstacle.gap(places)
        touching = np.flatnonzero(gap < 0)
        slip = self._slip(places[touching], self._anchors[touching])
        length = np.linalg.norm(slip, axis=1)
        share = np.minimum(
            self.law.most_slip(self.law.pressure(gap[touching])) / np.maximum(length, TINY), 1.0
        )
        self._anchors = places
        self._anchors[touching] -= share[:, None] * slip

    def force(self, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Contact forces on the nodes [mN], shape (nodes, 3), and their sum, shape (3,)."""
        places, touching = self._touching(displacement)
        forces = self._traction(places, touching) * self.solid.areas[touching, None]
        return self.solid.at_surface[touching].T @ forces, forces.sum(axis=0)

    def stiffness(self, displacement: np.ndarray) -> csr_array:
        """Derivative of `force` by the displacements [mN/mm], shape (3 nodes, 3 nodes)."""
        places, touching = self._touching(displacement)
        columns = [
            self._traction(places + shift, touching) - self._traction(places - shift, touching)
            for shift in DIFFERENCE_MM * np.eye(3)
        ]
        slope = np.stack(columns, axis=-1) / (2 * DIFFERENCE_MM)
        return stiffness_of(self.solid.at_surface[touching], slope * self.solid.areas[touching, None, None])

    def _touching(self, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        places = self.places(displacement)
        touching = np.flatnonzero(self.obstacle.gap(places) < 0)
        return places[touching], touching

    def _traction(self, places: np.ndarray, touching: np.ndarray) -> np.ndarray:
        """Pressure along the normal and friction across it [kPa], shape (n, 3).

        For a slip s the friction is -L phi(k |s| / L) s / |s|, with Coulomb's limit L = f p.
        """
        pressure, stick = self.law.pressure(self.obstacle.gap(places)), self.law.stick_kpa_mm
        slip = self._slip(places, self._anchors[touching])
        stretch = stick * np.linalg.norm(slip, axis=1) / np.maximum(self.law.friction * pressure, TINY)
        friction = stick * self.law.friction_share(stretch)[:, None] * slip
        return pressure[:, None] * self.obstacle.normal(places) - friction

    def _slip(self, places: np.ndarray, anchors: np.ndarray) -> np.ndarray:
        """The way from an anchor to its point across the normal [mm], shape (n, 3)."""
        normal, reach = self.obstacle.normal(places), places - anchors
        return reach - (normal * reach).sum(axis=1, keepdims=True) * normal
