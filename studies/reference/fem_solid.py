"""The tissue as quadratic tetrahedra of a compressible neo-Hookean material at finite strain.

W = mu/2 (tr C - 3) - mu ln J + lambda/2 (ln J)^2, so P = mu (F - F^-T) + lambda ln J F^-T [kPa]
(Bonet & Wood, *Nonlinear Continuum Mechanics for Finite Element Analysis*, 2nd ed. 2008, section 6.4.3).
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import bsr_array, coo_array, csr_array, kron
from skfem import Basis, ElementTetP2, FacetBasis, MeshTet2
from skfem.assembly.basis import AbstractBasis
from skfem.mapping import MappingIsoparametric

INVERSION_STEPS, INVERTED_MM = 12, 1e-9
# Order of the polynomials that the points of a boundary face integrate.
SURFACE_ORDER = 6


@dataclass(frozen=True)
class FemMaterial:
    """Isotropic hyperelastic tissue."""

    young_kpa: float = 15.0
    poisson: float = 0.45
    density_kg_m3: float = 1050.0

    @property
    def mu_kpa(self) -> float:
        """Shear modulus [kPa]."""
        return self.young_kpa / (2 * (1 + self.poisson))

    @property
    def lambda_kpa(self) -> float:
        """First Lame parameter [kPa]."""
        return self.young_kpa * self.poisson / ((1 + self.poisson) * (1 - 2 * self.poisson))


class MeshError(ValueError):
    """A mesh that is not valid; the message is one line."""


class CurvedMapping(MappingIsoparametric):
    """scikit-fem's mapping, whose own inverse does not converge for points outside a curved tetrahedron;
    here they have nan.
    """

    def invF(self, x: np.ndarray, tind: np.ndarray | None = None, **_unused: object) -> np.ndarray:
        """Reference coordinates of points x [mm], both of shape (3, tets, points)."""
        local = np.full(x.shape, 0.25)
        for _ in range(INVERSION_STEPS):
            step = np.einsum("ijkl,jkl->ikl", self.invDF(local, tind), x - self.F(local, tind))
            # Far enough outside for all that converges inside, but no overflow.
            local = np.clip(local + step, -1.0, 2.0)
        return np.where(np.abs(self.F(local, tind) - x).max(axis=0) < INVERTED_MM, local, np.nan)


class FemSolid:
    """A body at rest, free of stress, and the forces of its deformation.

    Sparse matrices take values at the nodes to the points of a quadrature, and their transposes take forces
    back.

    Attributes:
        rest: nodes [mm], shape (nodes, 3): corners first, then the middles of edges.
        volume_share: volume of each node [mm^3], shape (nodes,); all positive.
        at_surface: shape functions at 12 points of each boundary face, shape (points, nodes).
        areas: area at rest of each of these points [mm^2], shape (points,).
    """

    def __init__(self, mesh: MeshTet2, material: FemMaterial) -> None:
        """10-node tetrahedra [mm], straight or curved, with 4 Gauss points each."""
        self.mesh, self.material = mesh, material
        mapping = CurvedMapping(mesh, ElementTetP2(), mesh.bndelem)
        self.basis = Basis(mesh, ElementTetP2(), mapping, intorder=2)
        self.rest = np.ascontiguousarray(self.basis.doflocs.T)
        scale = mapping.detDF(self.basis.X)
        if (scale.min(axis=1) * scale.max(axis=1) <= 0).any():
            raise MeshError("a curved tetrahedron of the mesh is folded over")
        self._weights = self.basis.dx.ravel()
        share = np.tile(self.basis.dx.sum(axis=1) / 10, 10)
        self.volume_share = np.bincount(self.basis.element_dofs.ravel(), share)
        gradients = np.stack([function[0].grad for function in self.basis.basis])
        self._gradient = _operator(self.basis, gradients.transpose(0, 2, 3, 1))
        surface = FacetBasis(mesh, ElementTetP2(), mapping, intorder=SURFACE_ORDER)
        self.at_surface, self.areas = _operator(surface, _values(surface)), surface.dx.ravel()
        if not np.isfinite(self.at_surface.data).all():
            raise MeshError("a curved tetrahedron at the surface is nearly folded over")

    def deformation(self, displacement: np.ndarray) -> np.ndarray:
        """Deformation gradients F (points, 3, 3) at the Gauss points, for displacements (nodes, 3) [mm]."""
        return np.eye(3) + (self._gradient @ displacement).reshape(-1, 3, 3).swapaxes(1, 2)

    def least_volume_ratio(self, displacement: np.ndarray) -> float:
        """Least det F of all Gauss points; not positive in inverted tetrahedra."""
        return float(np.linalg.det(self.deformation(displacement)).min())

    def volume_ratio(self, displacement: np.ndarray) -> float:
        """Volume as a share of that at rest."""
        return float(np.average(np.linalg.det(self.deformation(displacement)), weights=self._weights))

    def elastic_force(self, displacement: np.ndarray) -> np.ndarray:
        """Internal forces [mN], shape (nodes, 3): integral of P grad N."""
        deformation = self.deformation(displacement)
        mu, log_ratio = self.material.mu_kpa, self.material.lambda_kpa * _log_ratio(deformation)
        # Transposed, as the rows of a deformation gradient are the directions of the displacement.
        stress = mu * deformation.swapaxes(1, 2) + (log_ratio - mu) * np.linalg.inv(deformation)
        return self._gradient.T @ (self._weights[:, None, None] * stress).reshape(-1, 3)

    def stiffness(self, displacement: np.ndarray) -> csr_array:
        """Derivative of `elastic_force` by the displacements [mN/mm], shape (3 nodes, 3 nodes)."""
        deformation = self.deformation(displacement)
        inverse = np.linalg.inv(deformation)
        mu, lam = self.material.mu_kpa, self.material.lambda_kpa
        crossed = (mu - lam * _log_ratio(deformation))[..., None, None] * np.einsum(
            "pli,pjk->pjilk", inverse, inverse
        )
        blocks = crossed + lam * np.einsum("pji,plk->pjilk", inverse, inverse)
        blocks += mu * np.einsum("jl,ik->jilk", np.eye(3), np.eye(3))
        blocks *= self._weights[:, None, None, None, None]
        return stiffness_of(self._gradient, blocks.reshape(-1, 9, 9))

    def weight(self, acceleration_m_s2: np.ndarray) -> np.ndarray:
        """Forces of gravity on the nodes [mN], shape (nodes, 3), for an acceleration [m/s^2], shape (3,)."""
        force_density = self.material.density_kg_m3 * np.asarray(acceleration_m_s2) * 1e-6  # kPa/mm
        shares = _operator(self.basis, _values(self.basis)).T @ self._weights
        return shares[:, None] * force_density


def stiffness_of(operator: csr_array, blocks: np.ndarray) -> csr_array:
    """Stiffness on the nodes, rows and columns 3 node + axis, of blocks between the values that an operator
    gives.

    ``operator`` (n values, nodes), ``blocks`` (n, 3 values, 3 values) with axes of space last.
    """
    wide = kron(operator, np.eye(3), format="csr")
    count, sides = len(blocks), (wide.shape[0], wide.shape[0])
    return wide.T @ (bsr_array((blocks, np.arange(count), np.arange(count + 1)), shape=sides) @ wide)


def _log_ratio(deformation: np.ndarray) -> np.ndarray:
    """ln det F of deformation gradients (points, 3, 3), shape (points, 1, 1)."""
    return np.log(np.linalg.det(deformation))[:, None, None]


def _values(basis: AbstractBasis) -> np.ndarray:
    """Shape functions at the points of a quadrature, shape (10, elements, points)."""
    return np.stack([np.broadcast_to(function[0], basis.dx.shape) for function in basis.basis])


def _operator(basis: AbstractBasis, values: np.ndarray) -> csr_array:
    """Sparse matrix from the nodes to what the shape functions have as ``values`` (10, elements, ...)."""
    rows = np.broadcast_to(np.arange(values[0].size).reshape(values[0].shape), values.shape)
    nodes = basis.element_dofs.reshape(*values.shape[:2], *[1] * (values.ndim - 2))
    places = rows.ravel(), np.broadcast_to(nodes, values.shape).ravel()
    return coo_array((values.ravel(), places), shape=(values[0].size, basis.N)).tocsr()
