"""The tissue as quadratic tetrahedra of a compressible neo-Hookean material at finite strain.

W = mu/2 (tr C - 3) - mu ln J + lambda/2 (ln J)^2, so P = mu (F - F^-T) + lambda ln J F^-T [kPa]
(Bonet & Wood, *Nonlinear Continuum Mechanics for Finite Element Analysis*, 2nd ed. 2008, section 6.4.3).
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix
from skfem import Basis, ElementTetP2, MeshTet, MeshTet2

INVERSION_STEPS = 12


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


class FemSolid:
    """A body at rest, free of stress, and the forces of its deformation.

    Attributes:
        rest: nodes [mm], shape (nodes, 3): corners first, then the middles of edges.
        nodes_of: nodes of each tetrahedron, shape (tets, 10), in scikit-fem's order.
        volume_share: volume of each node [mm^3], shape (nodes,); all positive.
    """

    def __init__(self, mesh: MeshTet2, material: FemMaterial) -> None:
        """10-node tetrahedra [mm], straight or curved, with 4 Gauss points each."""
        self.mesh, self.material = mesh, material
        self.basis = Basis(mesh, ElementTetP2(), intorder=2)
        self.rest = np.ascontiguousarray(self.basis.doflocs.T)
        scale = self.basis.mapping.detDF(self.basis.X)
        if (scale.min(axis=1) * scale.max(axis=1) <= 0).any():
            raise MeshError("a curved tetrahedron of the mesh is folded over")
        self.nodes_of = np.ascontiguousarray(self.basis.element_dofs.T)
        self._weights = np.ascontiguousarray(self.basis.dx)
        # (10, 3, tets, points) -> (tets, points, 10, 3)
        self._gradients = np.stack([f[0].grad for f in self.basis.basis]).transpose(2, 3, 0, 1).copy()
        share = np.repeat(self._weights.sum(axis=1) / 10, 10)
        self.volume_share = np.bincount(self.nodes_of.ravel(), share, len(self.rest))
        freedoms = (
            (3 * self.nodes_of[:, :, None] + np.arange(3)).reshape(len(self.nodes_of), -1).astype(np.int32)
        )
        self._entries = np.repeat(freedoms, 30, axis=1).ravel(), np.tile(freedoms, 30).ravel()

    def deformation(self, displacement: np.ndarray) -> np.ndarray:
        """Deformation gradients F at the Gauss points, shape (tets, 4, 3, 3), for displacements [mm] (nodes, 3)."""
        moved = displacement[self.nodes_of].transpose(0, 2, 1)[:, None]
        return np.eye(3) + moved @ self._gradients

    def least_volume_ratio(self, displacement: np.ndarray) -> float:
        """Least det F of all Gauss points; not positive in inverted tetrahedra."""
        return float(np.linalg.det(self.deformation(displacement)).min())

    def volume_ratio(self, displacement: np.ndarray) -> float:
        """Volume as a share of that at rest."""
        ratio = np.linalg.det(self.deformation(displacement))
        return float((ratio * self._weights).sum() / self._weights.sum())

    def elastic_force(self, displacement: np.ndarray) -> np.ndarray:
        """Internal forces [mN], shape (nodes, 3): integral of P grad N."""
        deformation = self.deformation(displacement)
        spatial, log_ratio = self._spatial_gradients(deformation)
        mu, lam = self.material.mu_kpa, self.material.lambda_kpa
        # F^-T grad N is the spatial gradient, so P grad N needs no F^-T of its own.
        stress = mu * (self._gradients @ deformation.swapaxes(2, 3) - spatial)
        stress += (lam * log_ratio)[..., None, None] * spatial
        return self.gathered(np.einsum("eq,eqai->eai", self._weights, stress))

    def stiffness(self, displacement: np.ndarray) -> np.ndarray:
        """Consistent tangent of `elastic_force` for each tetrahedron [mN/mm], shape (tets, 10, 3, 10, 3)."""
        spatial, log_ratio = self._spatial_gradients(self.deformation(displacement))
        mu, lam = self.material.mu_kpa, self.material.lambda_kpa
        tets, points = self._weights.shape

        def products(rows: np.ndarray, factor: np.ndarray, columns: np.ndarray) -> np.ndarray:
            left = (rows * factor[..., None, None]).reshape(tets, points, -1)
            return left.swapaxes(1, 2) @ columns.reshape(tets, points, -1)

        blocks = products(spatial, lam * self._weights, spatial).reshape(tets, 10, 3, 10, 3)
        crossed = products(spatial, (mu - lam * log_ratio) * self._weights, spatial)
        blocks += crossed.reshape(tets, 10, 3, 10, 3).swapaxes(2, 4)
        flat = self._gradients.transpose(0, 2, 1, 3).reshape(tets, 10, -1)
        weighted = (self._gradients * self._weights[..., None, None]).transpose(0, 2, 1, 3)
        laplacian = mu * weighted.reshape(tets, 10, -1) @ flat.swapaxes(1, 2)
        for axis in range(3):
            blocks[:, :, axis, :, axis] += laplacian
        return blocks

    def weight(self, acceleration_m_s2: np.ndarray) -> np.ndarray:
        """Forces of gravity on the nodes [mN], shape (nodes, 3), for an acceleration [m/s^2], shape (3,)."""
        force_density = self.material.density_kg_m3 * np.asarray(acceleration_m_s2) * 1e-6  # kPa/mm
        shape = np.stack([np.broadcast_to(np.asarray(f[0]), self._weights.shape) for f in self.basis.basis])
        shares = np.einsum("aeq,eq->ea", shape, self._weights)
        return self.gathered(shares[..., None] * force_density)

    def shares_at(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nodes, shape (n, 10), and their shape functions, shape (n, 10), at points at rest [mm], shape (n, 3).

        Raises ValueError for a point outside the body.
        """
        corners = MeshTet(np.ascontiguousarray(self.rest[: self.mesh.nvertices].T), self.mesh.t)
        # The straight tetrahedron of a point is its own, or a neighbour so near that its polynomial can be used.
        nodes = self.nodes_of[corners.element_finder()(*points.T)]
        local = np.full(points.T.shape, 0.25)
        for _ in range(INVERSION_STEPS):
            shapes = [ElementTetP2().lbasis(local, node) for node in range(10)]
            shares = np.stack([np.broadcast_to(shape, len(points)) for shape, _ in shapes], axis=1)
            slopes = np.stack([slope.T for _, slope in shapes], axis=1)
            missing = points - np.einsum("na,nai->ni", shares, self.rest[nodes])
            jacobian = np.einsum("nai,naj->nij", self.rest[nodes], slopes)
            local = local + np.linalg.solve(jacobian, missing[..., None])[..., 0].T
        return nodes, shares

    def gathered(self, of_tets: np.ndarray) -> np.ndarray:
        """Sum of the tetrahedra's contributions to the nodes: shape (tets, 10, 3) to (nodes, 3)."""
        nodes = self.nodes_of.ravel()
        parts = of_tets.reshape(-1, 3).T
        return np.stack([np.bincount(nodes, part, len(self.rest)) for part in parts], axis=1)

    def assembled(self, of_tets: np.ndarray) -> csc_matrix:
        """Sparse matrix of blocks (tets, 10, 3, 10, 3); rows and columns are 3 node + axis."""
        rows, columns = self._entries
        size = 3 * len(self.rest)
        return coo_matrix((of_tets.ravel(), (rows, columns)), shape=(size, size)).tocsc()

    def _spatial_gradients(self, deformation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """F^-T grad N, shape (tets, 4, 10, 3), and ln J, shape (tets, 4)."""
        return self._gradients @ np.linalg.inv(deformation), np.log(np.linalg.det(deformation))
