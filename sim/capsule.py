"""The organ's capsule: a thin elastic membrane on its surface, carried by the lattice.

Incompressible neo-Hookean material in plane stress, W = mu h / 2 (tr C + 1 / det C - 3) for the surface's C =
F^T F (2 x 2), with mu h = E h / 3 of modulus E and thickness h (Holzapfel 2000, ch. 6; the capsule's:
Snedeker et al. 2005). A membrane so thin has no resistance to compression: it wrinkles, and W is relaxed to
that of tension alone (Pipkin 1986).
"""

import numpy as np
import taichi as ti
import taichi.math as tm
import trimesh
from scipy.sparse import csr_array

from sim.body import Body
from sim.fields import field_of, fields_of, fill, zeros
from sim.lattice import Lattice, surface_patches
from sim.stored_arrays import stored

# 1 N/mm in g/s^2.
N_MM = 1e6


class Capsule:
    """Patches of the surface, each in one cell of the lattice.

    ``stiffness_n_mm`` is modulus times thickness [N/mm]. deformation (p,): F (3, 2) of each patch, from its
    tangential axes.
    """

    def __init__(self, body: Body, lattice: Lattice, surface: trimesh.Trimesh, stiffness_n_mm: float) -> None:
        nodes, gradient, area = stored(
            surface_patches, surface, lattice.cell_mm, lattice.low_mm, lattice.cells, lattice.index_of
        )
        self.body = body
        self.count = len(nodes)
        self.node, self.gradient = field_of(nodes, 1), field_of(gradient.reshape(-1, 2), 1)
        self.area_mm2, self.share = area, np.ones(self.count)
        self.stiffness_n_mm = stiffness_n_mm
        self.weight = field_of(N_MM * stiffness_n_mm / 3 * area)
        self.deformation = zeros(self.count, 3, 2, within=2)
        places = csr_array(
            (np.arange(nodes.size), nodes.ravel(), np.arange(0, nodes.size + 1, 8)),
            shape=(self.count, body.count),
        ).tocsc()
        self.start, self.patch = fields_of(places.indptr, places.indices)
        self.slope = field_of(gradient.reshape(-1, 2)[places.data], 1)

    def set_stiffness(self, stiffness_n_mm: float) -> None:
        """Change modulus times thickness [N/mm]."""
        self.stiffness_n_mm = stiffness_n_mm
        fill((self.weight, N_MM * stiffness_n_mm / 3 * self.area_mm2 * self.share))

    def set_share(self, share: np.ndarray) -> None:
        """Leave a share (p,) of each patch's area."""
        self.share = share
        self.set_stiffness(self.stiffness_n_mm)

    @ti.func
    def begin(self):
        """The patches' deformation at the predicted positions."""
        for q in range(self.count):
            u, v = tm.vec3(0.0), tm.vec3(0.0)
            for k in ti.static(range(8)):
                at, b = self.body.predicted[self.node[q][k]], self.gradient[8 * q + k]
                u += b.x * at
                v += b.y * at
            self.deformation[q] = ti.Matrix.cols([u, v])

    @ti.func
    def node_force(self, i):
        """Force [uN] of the membrane on node i, and a positive bound of its negative derivative (3, 3) by
        the node's position.
        """
        force, stiffness = tm.vec3(0.0), tm.mat3(0.0)
        for k in range(self.start[i], self.start[i + 1]):
            q, b = self.patch[k], self.slope[k]
            u = tm.vec3(self.deformation[q][0, 0], self.deformation[q][1, 0], self.deformation[q][2, 0])
            v = tm.vec3(self.deformation[q][0, 1], self.deformation[q][1, 1], self.deformation[q][2, 1])
            f, h = patch_force(u, v, b)
            force -= self.weight[q] * f
            stiffness += self.weight[q] * h
        return force, stiffness

    @ti.func
    def follow(self, i, change):
        """Move node i in the patches around it, which no other node of its colour has."""
        for k in range(self.start[i], self.start[i + 1]):
            q, b = self.patch[k], self.slope[k]
            self.deformation[q] = self.deformation[q] + ti.Matrix.cols([b.x * change, b.y * change])


@ti.func
def patch_force(u, v, b):
    """P b, the derivative of W / (mu h) by a node whose shape function has the tangential gradient b, for F =
    (u, v); and a positive bound of its derivative.
    """
    force, stiffness = tm.vec3(0.0), tm.mat3(0.0)
    uu, uv, vv = u.dot(u), u.dot(v), v.dot(v)
    # Squares of the principal stretches, and the first principal direction.
    half, shift = 0.5 * (uu + vv), ti.sqrt(0.25 * (uu - vv) ** 2 + uv * uv)
    first = half + shift
    if first > 1.0:
        normal = u.cross(v)
        det = normal.norm_sqr()
        isotropic = b.norm_sqr() * tm.eye(3)
        if det * det > first:  # second^2 > 1 / first, with the squares' product det
            along = b.x * u + b.y * v
            # adj(C) b of C^-1 = adj(C) / det C.
            adjoint = (vv * b.x - uv * b.y) * u + (uu * b.y - uv * b.x) * v
            force = along - adjoint / (det * det)
            stiffness = isotropic + 3.0 / (det**3) * adjoint.outer_product(adjoint)
        else:
            direction = (
                tm.vec2(uv, first - uu)
                if ti.abs(first - uu) > ti.abs(first - vv)
                else tm.vec2(first - vv, uv)
            )
            direction /= ti.max(direction.norm(), 1e-12)
            share = direction.dot(b)
            axis = direction.x * u + direction.y * v
            inverse = 1.0 / (first * ti.sqrt(first))
            force = (1.0 - inverse) * share * axis
            stiffness = isotropic + 3.0 * inverse * share * share / first * axis.outer_product(axis)
    return force, stiffness
