"""Compressible neo-Hookean tissue on a lattice of hexahedral elements, solved by vertex block descent.

Implicit Euler as minimisation (Liu et al. 2013, Eq. 3): a step minimises m |x - inertial target|^2 / 2 h^2 + elastic and
contact energy over the positions x. Vertex block descent (Chen et al. 2024) is a nonlinear Gauss-Seidel method: one Newton
step for each node, all others fixed; here with successive over-relaxation. Elements have one integration point and hourglass
stabilisation (Flanagan & Belytschko 1981); those cut by the surface are integrated as in the finite cell method.
At convergence every node is in equilibrium, so the rest state does not depend on iterations, substeps or time step.
"""

from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
import taichi as ti
import taichi.math as tm

from sim.body import Body
from sim.device import is_too_small
from sim.fields import field_of, fields_of
from sim.lattice import CORNERS, Lattice, fill_with_cells, surface_points
from sim.linear_algebra import cross, four, row, solve
from sim.rigid_correction import RigidCorrection
from sim.solver import StepSettings
from sim.stored_arrays import stored
from sim.surface_contact import PENALTY_DEPTH_MM, REACH_MM, SurfaceContacts
from sim.tissue_model import ModelInputs

# Stiffness, in units of the shear modulus, of deformation that varies inside an element. 1 is exact for u_x ~ y z and
# 1 + nu for bending; at nu = 0.45 their geometric mean is 1.2. Bead errors hardly depend on it (docs/method.md).
HOURGLASS_STIFFNESS = 1.2
# Below this volume ratio J, ln J is continued by its tangent, so that inverted elements recover.
LEAST_J = 0.2
LN2 = 0.6931471805599453
SQRT_HALF_BITS = 0x3F3504F3
# With fewer nodes, starting threads for eight colours takes a CPU longer than they save.
PARALLEL_NODES = 16_000
# Spacing of the contact points on the surface, in widths of a cell.
POINT_SPACING_CELLS = 0.5
# Largest displacement of a node in one iteration, in widths of a cell.
MOST_CELLS_AN_ITERATION = 0.5
LATTICE_SETTINGS = StepSettings(substeps=1, iterations=4, relaxation_factor=1.7, stabilisation_iterations=0)


@ti.data_oriented
class NeoHookean:
    """W = mu/2 (tr C - 3) - mu ln J + lambda/2 (ln J)^2 in the elements of a lattice (Bonet & Wood 2008, Eq. 6.27).

    ``fixed`` (n,) marks nodes that cannot move; ``load_g`` (n,) [g] is added to the nodes' masses; ``serial`` runs on one core
    (None: by the number of nodes). ``deformation`` (m + 1,) has the columns of each element's deformation gradient F as rows;
    the last is for elements that do not exist.
    """

    EMBEDDING_CELL_RATIO: ClassVar[float] = 1.35

    @classmethod
    def make(cls, inputs: ModelInputs) -> "NeoHookean":
        """Elements that fill the organ, with contact points on its surface where there are shapes. Raises SamplingError."""
        tissue = inputs.tissue
        lattice = fill_with_cells(inputs.organ, tissue.cell_mm)
        body = Body(lattice.nodes)
        contacts = None
        if inputs.shapes:
            spacing_mm = POINT_SPACING_CELLS * tissue.cell_mm
            points, area_mm2 = stored(surface_points, inputs.organ, spacing_mm)
            contacts = SurfaceContacts(body, lattice, points, area_mm2, inputs.shapes, inputs.friction)
        material = (tissue.young_kpa, tissue.poisson, tissue.density_g_cm3)
        fixed = None if inputs.fixed is None else inputs.fixed.nodes(lattice.nodes)
        return cls(body, lattice, contacts, *material, fixed=fixed, serial=inputs.serial)

    @staticmethod
    def reach_mm(tissue: Any) -> float:
        """Distance [mm] within which contacts need the distance to a shape, the same for all cell widths."""
        return REACH_MM

    def __init__(
        self,
        body: Body,
        lattice: Lattice,
        contacts: SurfaceContacts | None = None,
        young_kpa: float = 15.0,
        poisson: float = 0.45,
        density_g_cm3: float = 1.05,
        fixed: np.ndarray | None = None,
        serial: bool | None = None,
        load_g: np.ndarray | float = 0.0,
    ) -> None:
        starts = [int(v) for v in lattice.colour_start]
        self.body = body
        self.lattice = lattice
        self.contacts: Any = contacts
        self.has_contacts = contacts is not None
        self.colours = tuple(pairwise(starts))
        self.serial = is_too_small(body.count, PARALLEL_NODES) if serial is None else serial
        self.has_fixed = fixed is not None
        if fixed is not None:
            self.fixed = field_of(fixed)
        self.count = len(lattice.cells)
        self.most_mm = MOST_CELLS_AN_ITERATION * lattice.cell_mm
        self.mu = ti.field(ti.f32, ())
        self.lambda_ = ti.field(ti.f32, ())
        self.inertial_target = ti.Vector.field(3, ti.f32, body.count)
        self.predicted = ti.Vector.field(4, ti.f32, body.count)
        self.mass = field_of(1e-3 * density_g_cm3 * lattice.tissue + load_g)
        self._store_elements()
        self._store_hourglass()
        self.rigid: Any = None
        if not self.has_fixed:
            self.rigid = RigidCorrection(body, self.mass, self.inertial_target, contacts, self.serial)
        self.poisson = poisson
        self.set_material(young_kpa)

    def _store_elements(self) -> None:
        cells, nodes = self.lattice.cells, self.body.count
        around = np.full((nodes, 8), self.count)
        gradient = np.zeros((nodes, 8, 4))
        for corner in range(8):
            around[cells[:, corner], corner] = np.arange(self.count)
            gradient[cells[:, corner], corner, :3] = self.lattice.gradient[:, corner]
            gradient[cells[:, corner], corner, 3] = self.lattice.volume
        shear = (gradient[:, :, 3] * (gradient[:, :, :3] ** 2).sum(axis=2)).sum(axis=1)
        self.around, self.shear = fields_of(around, shear)
        self.gradient, self.cell = fields_of(gradient, cells, within=1)
        self.deformation = field_of(np.tile(np.eye(3, 4), (self.count + 1, 1, 1)), 2)

    def _store_hourglass(self) -> None:
        """Rows of the hourglass matrix over the 27 nodes around each node, itself included, for a shear modulus of 1."""
        cells, nodes = self.lattice.cells, self.body.count
        neighbour = np.tile(np.arange(nodes)[:, None], (1, 27))
        weight = np.zeros((nodes, 27))
        for a in range(8):
            for b in range(8):
                place = (CORNERS[b] - CORNERS[a] + 1) @ [9, 3, 1]
                neighbour[cells[:, a], place] = cells[:, b]
                weight[cells[:, a], place] += HOURGLASS_STIFFNESS * self.lattice.hourglass[:, a, b]
        self.neighbour, self.hourglass = fields_of(neighbour, weight)

    def set_material(self, young_kpa: float, poisson: float | None = None) -> None:
        """Change Young's modulus [kPa], and the contacts' penalty stiffness with it; without a Poisson's ratio that stays the same."""
        self.poisson = poisson = self.poisson if poisson is None else poisson
        # 1 kPa is 1000 g/(mm s^2).
        self.mu[None] = 1e3 * young_kpa / (2 * (1 + poisson))
        self.lambda_[None] = 1e3 * young_kpa * poisson / ((1 + poisson) * (1 - 2 * poisson))
        if self.contacts is not None:
            self.contacts.stiffness[None] = young_kpa / PENALTY_DEPTH_MM

    def counts(self) -> dict[str, int]:
        """Nodes (also as particles), cells, and contact points on the surface."""
        nodes, points = self.body.count, self.contacts.count if self.has_contacts else 0
        return dict(nodes=nodes, particles=nodes, cells=self.count, points=points)

    @ti.func
    def begin(self, dt: float):
        """The solver's prediction is the inertial target; start from the last positions and the rigid-body coarse correction."""
        for i in range(self.body.count):
            self.inertial_target[i] = self.body.predicted[i]
            self.body.predicted[i] = self.body.position[i]
        if ti.static(not self.has_fixed):
            self.rigid.move(dt)
        for c in range(self.count):
            x, y, z = tm.vec4(0.0), tm.vec4(0.0), tm.vec4(0.0)
            for k in ti.static(range(8)):
                i = self.cell[c][k]
                b, at = self.gradient[i, k], four(self.body.predicted[i])
                x += b.x * at
                y += b.y * at
                z += b.z * at
            self.deformation[c] = ti.Matrix.rows([x, y, z])
        # Nodes at the surface add zero to it, but zero times infinity would make it NaN for ever.
        self.deformation[self.count] = ti.Matrix.rows(
            [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]
        )

    @ti.func
    def gather(self):
        """Read the predicted positions."""
        for i in range(self.body.count):
            self.predicted[i] = four(self.body.predicted[i])

    @ti.func
    def scatter(self):
        """Write the predicted positions."""
        for i in range(self.body.count):
            self.body.predicted[i] = self.predicted[i].xyz

    @ti.func
    def project(self, stiffness: float, relaxation_factor: float, dt: float):
        """One Gauss-Seidel iteration over all nodes; serial and colour by colour give the same result.

        All ranges are known when the kernel compiles: this makes the code twice as fast, and on Vulkan any other range starts
        65536 threads.
        """
        if ti.static(self.serial):
            for i in range(self.body.count):
                self.relax(i, relaxation_factor, dt)
        else:
            for first, last in ti.static(self.colours):
                ti.loop_config(block_dim=32)
                for i in range(first, last):
                    self.relax(i, relaxation_factor, dt)

    @ti.func
    def relax(self, i, relaxation_factor: float, dt: float):
        """One over-relaxed Newton step of node i on its 3 x 3 system, all other nodes fixed."""
        inertia = self.mass[i] / (dt * dt)
        force, hessian, least = self.elastic(i)
        force += inertia * (four(self.inertial_target[i]) - self.predicted[i])
        hessian += inertia * tm.eye(3)
        factor = relaxation_factor
        if ti.static(self.has_contacts):
            contact_force, stiffness = self.contacts.node_force(i)
            if stiffness[0, 0] + stiffness[1, 1] + stiffness[2, 2] > 0.0:
                factor = 1.0
            force += four(contact_force)
            hessian += stiffness
        change = factor * solve(hessian, force.xyz, least + inertia)
        change *= ti.min(1.0, self.most_mm / ti.max(change.norm(), 1e-12))
        if ti.static(self.has_fixed):
            change *= 1.0 - self.fixed[i]
        self.move(i, four(change))
        if ti.static(self.has_contacts):
            self.contacts.follow(i, change)

    @ti.func
    def move(self, i, change):
        """Move node i and update the deformation of the elements around it, which no other node of its colour has."""
        self.predicted[i] = self.predicted[i] + change
        for k in range(8):
            b = self.gradient[i, k]
            # Not "+=", which is atomic.
            self.deformation[self.around[i, k]] = self.deformation[self.around[i, k]] + ti.Matrix.rows(
                [b.x * change, b.y * change, b.z * change]
            )

    @ti.func
    def elastic(self, i):
        """Force [uN] on node i of the elements around it, its negative derivative by the node's position (3, 3), and that
        matrix's least eigenvalue.

        With B the node's gradient, f = -V (mu F B + (lambda ln J - mu) G / J), where G = dJ/dx = cof(F) B does not
        depend on the node's own position, so that d^2J/dx^2 = 0.
        """
        mu, lambda_ = self.mu[None], self.lambda_[None]
        force = -mu * self.hourglass_gradient(i)
        x, y, z = tm.vec4(0.0), tm.vec4(0.0), tm.vec4(0.0)
        for k in range(8):
            b = self.gradient[i, k]
            f = self.deformation[self.around[i, k]]
            f1, f2, f3 = row(f, 0), row(f, 1), row(f, 2)
            f23 = cross(f2, f3)
            j = f1.dot(f23)
            g = b.x * f23 + b.y * cross(f3, f1) + b.z * cross(f1, f2)
            at = ti.max(j, LEAST_J)
            one_by = 1.0 / at
            pressure = (lambda_ * (ln(at) + j * one_by - 1.0) - mu) * one_by
            force -= b.w * (mu * (b.x * f1 + b.y * f2 + b.z * f3) + pressure * g)
            curvature = lambda_ * one_by * one_by - (pressure * one_by if j > LEAST_J else 0.0)
            weighted = (b.w * ti.max(curvature, 0.0)) * g
            x += g.x * weighted
            y += g.y * weighted
            z += g.z * weighted
        # Shear and hourglass stiffness are isotropic and do not depend on the positions.
        isotropic = mu * (self.shear[i] + self.hourglass[i, 13])
        return force, tm.mat3(x.x, x.y, x.z, y.x, y.y, y.z, z.x, z.y, z.z) + isotropic * tm.eye(3), isotropic

    @ti.func
    def hourglass_gradient(self, i):
        """Gradient by node i of the hourglass energy for a shear modulus of 1; zero for linear fields, so for rotations too."""
        x = self.predicted[i]
        gradient = tm.vec4(0.0)
        for k in range(27):
            gradient += self.hourglass[i, k] * (self.predicted[self.neighbour[i, k]] - x)
        return gradient

    def update_frames(self) -> None:
        """Nothing to do: points are interpolated from the nodes."""

    def attach(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nodes (n, 8) around points (n, 3) [mm], and their trilinear weights (n, 8)."""
        return self.lattice.interpolation(points)

    @ti.func
    def carried(self, point, frame, weight):
        """The current position of a point at rest [mm], by the weighted displacements of its nodes."""
        x = point
        for k in ti.static(range(frame.n)):
            x += weight[k] * (self.body.position[frame[k]] - self.body.rest[frame[k]])
        return x


@ti.func
def ln(x):
    """Natural logarithm of a normal positive number to float32's rounding; unlike the library's it is inlined."""
    bits = ti.bit_cast(x, ti.i32)
    exponent = (bits - SQRT_HALF_BITS) >> 23
    z = ti.bit_cast(bits - (exponent << 23), ti.f32)
    # Series of 2 artanh(z), |z| < 0.172.
    z = (z - 1.0) / (z + 1.0)
    s = z * z
    return exponent * LN2 + 2.0 * z * (1.0 + s * (1 / 3 + s * (1 / 5 + s * (1 / 7 + s / 9))))
