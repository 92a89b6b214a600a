"""Penalty contact of the tissue's surface with rigid obstacles: a penalty on the gap, and Coulomb friction.

At each of 12 points of a face, with d = -gap > 0, the pressure is eps d^2 / (2 delta) for d < delta and
eps (d - delta/2) beyond. Friction is elastic up to Coulomb's limit, a return mapping with anchors
that are updated after each increment (Wriggers, *Computational Contact Mechanics*, 2nd ed. 2006,
chapters 5.2 and 10.5). Areas are those at rest.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from skfem import ElementTetP2
from skfem.quadrature import get_quadrature
from skfem.refdom import RefTri

from studies.reference.fem_solid import FemSolid

TINY = 1e-12


class Obstacle(Protocol):
    """A rigid body in its own frame."""

    def gap(self, points: np.ndarray) -> np.ndarray:
        """Distance [mm] from points (n, 3); negative inside. Shape (n,)."""

    def slopes(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gradient, shape (n, 3), and second derivatives [1/mm], shape (n, 3, 3), of the gap."""


@dataclass(frozen=True)
class Law:
    """Contact law of an obstacle."""

    stiffness_kpa_mm: float
    friction: float = 0.35
    stick_kpa_mm: float = 150.0
    soft_mm: float = 0.015
    blend: float = 0.5

    def pressure(self, gap: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pressure [kPa] and its derivative by the gap [kPa/mm]."""
        depth = np.maximum(-gap, 0.0)
        soft = np.minimum(depth, self.soft_mm)
        pressure = self.stiffness_kpa_mm * (soft**2 / (2 * self.soft_mm) + depth - soft)
        return pressure, -self.stiffness_kpa_mm * soft / self.soft_mm

    def most_slip(self, pressure: np.ndarray) -> np.ndarray:
        """Slip [mm] at which the friction has reached Coulomb's limit, shape (n,); beyond it the anchor follows."""
        return (1 + self.blend) * self.friction * pressure / self.stick_kpa_mm

    def friction_share(self, stretch: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Transition from elastic slip to sliding, phi(r) / r and phi'(r), shapes (n,).

        ``stretch`` is r, the elastic friction as a share of Coulomb's limit, shape (n,). A parabola joins phi = r and
        phi = 1: with a corner there Newton's method would alternate between sticking and sliding points.
        """
        beyond = np.clip(stretch - (1 - self.blend), 0.0, 2 * self.blend)
        carried = np.minimum(stretch, 1 + self.blend) - beyond**2 / (4 * self.blend)
        secant = np.where(stretch > TINY, carried / np.maximum(stretch, TINY), 1.0)
        return secant, 1 - beyond / (2 * self.blend)


class ContactSurface:
    """Contact points on the boundary of a solid: 12 on each face of 6 nodes.

    Attributes:
        tets: tetrahedron of each point, shape (points,).
        shares: shape functions of its 10 nodes at the point, shape (points, 10).
        areas: area at rest of each point [mm^2], shape (points,).
    """

    def __init__(self, solid: FemSolid) -> None:
        self.solid, mesh = solid, solid.mesh
        faces = mesh.boundary_facets()
        tets = mesh.f2t[0, faces]
        # scikit-fem has no inverse of curved maps that always converges, so its FacetBasis is not used here.
        corner = (mesh.t[:, tets].T[:, :, None] == mesh.facets[:, faces].T[:, None, :]).argmax(axis=1)
        ends = ElementTetP2.doflocs[corner]
        places, weights = get_quadrature(RefTri, 6)
        sides = ends[:, 1:] - ends[:, :1]
        local = (ends[:, :1] + np.einsum("sp,fsi->fpi", places, sides)).reshape(-1, 3).T
        shapes = [ElementTetP2().lbasis(local, node) for node in range(10)]
        self.tets = np.repeat(tets, len(weights))
        self.shares = np.stack([np.broadcast_to(shape, local.shape[1]) for shape, _ in shapes], axis=1)
        slopes = np.stack([slope.T for _, slope in shapes], axis=1)
        stretched = np.einsum("pai,paj->pij", solid.rest[solid.nodes_of[self.tets]], slopes)
        across = [
            np.einsum("pij,pj->pi", stretched, np.repeat(sides[:, s], len(weights), axis=0)) for s in (0, 1)
        ]
        self.areas = np.linalg.norm(np.cross(*across), axis=1) * np.tile(weights, len(faces))

    def points(self, displacement: np.ndarray) -> np.ndarray:
        """Positions [mm], shape (points, 3), for displacements (nodes, 3)."""
        nodes = (self.solid.rest + displacement)[self.solid.nodes_of[self.tets]]
        return np.einsum("pa,pai->pi", self.shares, nodes)


class PenaltyContact:
    """One obstacle against one surface.

    Attributes:
        offset: origin of the obstacle's frame [mm], shape (3,).
    """

    def __init__(
        self, surface: ContactSurface, obstacle: Obstacle, law: Law, offset: np.ndarray | None = None
    ) -> None:
        self.surface, self.obstacle, self.law = surface, obstacle, law
        self.offset = np.zeros(3) if offset is None else np.array(offset, float)
        self._anchors = np.zeros((len(surface.areas), 3))

    def gaps(self, displacement: np.ndarray) -> np.ndarray:
        """Distance [mm] of each point from the obstacle, shape (points,)."""
        return self.obstacle.gap(self.surface.points(displacement) - self.offset)

    def carry(self, displacement: np.ndarray) -> None:
        """End an increment: the anchor of a sliding point follows it by its slip, that of a free point wholly."""
        places = self.surface.points(displacement) - self.offset
        touching = np.flatnonzero(self.obstacle.gap(places) < 0)
        pressure = self.law.pressure(self.obstacle.gap(places[touching]))[0]
        slip = self._slip(places[touching], touching)[0]
        length = np.linalg.norm(slip, axis=1)
        share = np.minimum(self.law.most_slip(pressure) / np.maximum(length, TINY), 1.0)
        self._anchors = places
        self._anchors[touching] -= share[:, None] * slip

    def force(self, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Contact forces on the nodes [mN], shape (nodes, 3), and their sum, shape (3,)."""
        places, touching = self._touching(displacement)
        traction = self._pressure(places)[0] + self._friction(places, touching)[0]
        on_points = traction * self.surface.areas[touching, None]
        of_tets = np.zeros((*self.surface.solid.nodes_of.shape, 3))
        shares = self.surface.shares[touching]
        np.add.at(of_tets, self.surface.tets[touching], shares[:, :, None] * on_points[:, None, :])
        return self.surface.solid.gathered(of_tets), on_points.sum(axis=0)

    def add_stiffness(self, displacement: np.ndarray, blocks: np.ndarray) -> None:
        """Subtract the derivative of `force` from the tetrahedra's blocks [mN/mm], shape (tets, 10, 3, 10, 3)."""
        places, touching = self._touching(displacement)
        slope = self._pressure(places)[1] + self._friction(places, touching)[1]
        slope *= self.surface.areas[touching, None, None]
        shares, tets = self.surface.shares[touching], self.surface.tets[touching]
        np.subtract.at(blocks, tets, np.einsum("pa,pij,pb->paibj", shares, slope, shares, optimize=True))

    def _touching(self, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        places = self.surface.points(displacement) - self.offset
        touching = np.flatnonzero(self.obstacle.gap(places) < 0)
        return places[touching], touching

    def _pressure(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Traction along the normal [kPa], shape (n, 3), and its derivative by place, shape (n, 3, 3)."""
        pressure, rate = self.law.pressure(self.obstacle.gap(places))
        gradient, bend = self.obstacle.slopes(places)
        normal, turn = _unit(gradient, bend)
        return pressure[:, None] * normal, rate[:, None, None] * _outer(normal, gradient) + pressure[
            :, None, None
        ] * turn

    def _slip(self, places: np.ndarray, touching: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """s = (1 - n n') r with r from the anchor to the point [mm], (n, 3), and its derivative, (n, 3, 3)."""
        normal, turn = _unit(*self.obstacle.slopes(places))
        reach = places - self._anchors[touching]
        along = np.einsum("pi,pi->p", normal, reach)
        rate = np.eye(3) - _outer(normal, normal) - along[:, None, None] * turn
        rate -= _outer(normal, np.einsum("pi,pij->pj", reach, turn))
        return reach - along[:, None] * normal, rate

    def _friction(self, places: np.ndarray, touching: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Traction across the normal [kPa], shape (n, 3), and its derivative by place, shape (n, 3, 3).

        For a slip s it is -L phi(k |s| / L) s / |s|, with Coulomb's limit L = f p.
        """
        pressure, rate = self.law.pressure(self.obstacle.gap(places))
        gradient = self.obstacle.slopes(places)[0]
        slip, slip_rate = self._slip(places, touching)
        length, stick = np.linalg.norm(slip, axis=1), self.law.stick_kpa_mm
        direction = slip / np.maximum(length, TINY)[:, None]
        stretch = stick * length / np.maximum(self.law.friction * pressure, TINY)
        secant, slope = self.law.friction_share(stretch)
        onwards = _outer(direction, direction)
        derivative = (stick * secant)[:, None, None] * ((np.eye(3) - onwards) @ slip_rate)
        derivative += (stick * slope)[:, None, None] * (onwards @ slip_rate)
        by_pressure = self.law.friction * stretch * (secant - slope) * rate
        derivative += by_pressure[:, None, None] * _outer(direction, gradient)
        return -(stick * secant)[:, None] * slip, -derivative


def _outer(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, :, None] * b[:, None, :]


def _unit(gradient: np.ndarray, bend: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit normal, shape (n, 3), and its derivative by place, shape (n, 3, 3), of a gap's slopes."""
    length = np.linalg.norm(gradient, axis=1)[:, None]
    normal = gradient / length
    return normal, (bend - _outer(normal, np.einsum("pi,pij->pj", normal, bend))) / length[..., None]
