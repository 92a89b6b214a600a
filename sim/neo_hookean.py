"""A tissue model true to a material: compressible neo-Hookean tissue on a lattice, node after node to its balance.

The implicit time step is the minimum of |x - target|^2 m / 2 h^2 + elastic and contact energy over the positions
(Liu et al. 2013, Eq. 3). Each node in turn goes to the minimum for itself with all others fixed (vertex block descent,
Chen et al. 2024), over-relaxed. Where nothing moves any more every node is in balance with its neighbours, so what
the tissue comes to rest at does not depend on iterations, substeps or time step.
"""

from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
import taichi as ti
import taichi.math as tm

from sim.body import Body
from sim.device import is_too_small
from sim.fields import field_of, fields_of
from sim.lattice import Lattice, fill_with_cells, surface_points
from sim.linear_algebra import cross, four, row
from sim.rigid_correction import RigidCorrection
from sim.solver import StepSettings
from sim.surface_contact import PENALTY_DEPTH_MM, REACH_MM, SurfaceContacts
from sim.tissue_model import ModelInputs

# Stiffness, in units of the shear modulus, of deformation that varies inside a cell: between 1, exact for torsion,
# and (1 + nu), exact for bending.
HOURGLASS_STIFFNESS = 1.2
# Below this volume ratio ln J goes on as its tangent, so that inverted cells find back.
LEAST_J = 0.2
LN2 = 0.6931471805599453
SQRT_HALF_BITS = 0x3F3504F3
# With fewer nodes, starting threads for eight colours costs a CPU more than they save.
PARALLEL_NODES = 16_000
# Points of the surface that can touch are this share of a cell apart.
POINTS_A_CELL = 0.5
# No node moves farther in a pass than this share of a cell.
MOST_CELLS_A_PASS = 0.5
LATTICE_SETTINGS = StepSettings(substeps=1, iterations=4, relaxation_factor=1.7, stabilisation_iterations=0)


@ti.data_oriented
class NeoHookean:
    """W = mu/2 (tr C - 3) - mu ln J + lambda/2 (ln J)^2 on a lattice's cells (Bonet & Wood 2008, Eq. 6.27).

    Nodes are projected colour by colour, on one core where ``serial`` (left open, their number decides); those ``fixed``
    (n,) stay where they are, and ``load_g`` (n,) [g] hangs at them. ``deformation`` (m + 1,) has the columns of every
    cell's F as rows and follows its nodes; the last stands for cells that are not there.
    """

    EMBEDDING_CELL_RATIO: ClassVar[float] = 1.35

    @classmethod
    def make(cls, parts: ModelInputs) -> "NeoHookean":
        """Cells that fill the organ, and points of its surface where there is something to touch. Raises SamplingError."""
        tissue = parts.tissue
        lattice = fill_with_cells(parts.organ, tissue.cell_mm)
        body = Body(lattice.nodes)
        contacts = None
        if parts.shapes:
            points, area_mm2 = surface_points(parts.organ, POINTS_A_CELL * tissue.cell_mm)
            contacts = SurfaceContacts(body, lattice, points, area_mm2, parts.shapes, parts.friction)
        material = (tissue.young_kpa, tissue.poisson, tissue.density_g_cm3)
        fixed = None if parts.fixed is None else parts.fixed.nodes(lattice.nodes)
        return cls(body, lattice, contacts, *material, fixed=fixed, serial=parts.serial)

    @staticmethod
    def reach_mm(tissue: Any) -> float:
        """As far as its contacts look, whatever the cells [mm]."""
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
        self.most_mm = MOST_CELLS_A_PASS * lattice.cell_mm
        self.mu = ti.field(ti.f32, ())
        self.lambda_ = ti.field(ti.f32, ())
        self.target = ti.Vector.field(3, ti.f32, body.count)
        self.predicted = ti.Vector.field(4, ti.f32, body.count)
        self.mass = field_of(1e-3 * density_g_cm3 * lattice.tissue + load_g)
        self._store_cells()
        self._store_hourglass()
        self.rigid: Any = (
            None if self.has_fixed else RigidCorrection(body, self.mass, self.target, contacts, self.serial)
        )
        self.set_material(young_kpa, poisson)

    def _store_cells(self) -> None:
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
        """Rows of the hourglass matrix, over the 27 nodes around each node and itself, for a shear modulus of 1."""
        cells, nodes = self.lattice.cells, self.body.count
        neighbour = np.tile(np.arange(nodes)[:, None], (1, 27))
        weight = np.zeros((nodes, 27))
        corners = np.indices((2, 2, 2)).reshape(3, -1).T
        for a in range(8):
            for b in range(8):
                place = (corners[b] - corners[a] + 1) @ [9, 3, 1]
                neighbour[cells[:, a], place] = cells[:, b]
                weight[cells[:, a], place] += HOURGLASS_STIFFNESS * self.lattice.hourglass[:, a, b]
        self.neighbour, self.hourglass = fields_of(neighbour, weight)

    def set_young(self, young_kpa: float) -> None:
        """Change Young's modulus [kPa], Poisson's ratio stays."""
        self.set_material(young_kpa, self.poisson)

    def set_material(self, young_kpa: float, poisson: float) -> None:
        """Change Young's modulus [kPa] and Poisson's ratio; the contact layer is as much stiffer as the tissue is."""
        self.poisson = poisson
        # 1 kPa is 1000 g/(mm s^2).
        self.mu[None] = 1e3 * young_kpa / (2 * (1 + poisson))
        self.lambda_[None] = 1e3 * young_kpa * poisson / ((1 + poisson) * (1 - 2 * poisson))
        if self.contacts is not None:
            self.contacts.stiffness[None] = young_kpa / PENALTY_DEPTH_MM

    def counts(self) -> dict[str, int]:
        """Nodes, which are its particles, and cells, and points of the surface that may touch."""
        nodes, points = self.body.count, self.contacts.count if self.has_contacts else 0
        return dict(nodes=nodes, particles=nodes, cells=self.count, points=points)

    @ti.func
    def begin(self, dt: float):
        """Start from where the body is, moved rigidly; what the solver predicted is where inertia and gravity draw it."""
        for i in range(self.body.count):
            self.target[i] = self.body.predicted[i]
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
        # Every node at the skin adds nothing to it, but nothing times infinity stays.
        self.deformation[self.count] = ti.Matrix.rows(
            [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]
        )

    @ti.func
    def gather(self):
        """Take over the estimates."""
        for i in range(self.body.count):
            self.predicted[i] = four(self.body.predicted[i])

    @ti.func
    def scatter(self):
        """Give the estimates back."""
        for i in range(self.body.count):
            self.body.predicted[i] = self.predicted[i].xyz

    @ti.func
    def project(self, stiffness: float, relaxation_factor: float, dt: float):
        """Nodes one after another or a colour at once, which is the same, to their balance: each by a Newton step on its
        own 3 x 3 system, over-relaxed.

        All ranges are known when the kernel compiles: that makes the code twice as fast, and on Vulkan any other starts
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
        """Node i goes to its balance with all others fixed."""
        inertia = self.mass[i] / (dt * dt)
        force, hessian, least = self.elastic(i)
        force += inertia * (four(self.target[i]) - self.predicted[i])
        hessian += inertia * tm.eye(3)
        factor = relaxation_factor
        if ti.static(self.has_contacts):
            pushed, layer = self.contacts.push(i)
            if layer[0, 0] + layer[1, 1] + layer[2, 2] > 0.0:
                factor = 1.0
            force += four(pushed)
            hessian += layer
        change = factor * solve(hessian, force.xyz, least + inertia)
        change *= ti.min(1.0, self.most_mm / ti.max(change.norm(), 1e-12))
        if ti.static(self.has_fixed):
            change *= 1.0 - self.fixed[i]
        self.move(i, four(change))
        if ti.static(self.has_contacts):
            self.contacts.follow(i, change)

    @ti.func
    def move(self, i, change):
        """Node i moves, and the cells around it follow. No other node of its colour has them."""
        self.predicted[i] = self.predicted[i] + change
        for k in range(8):
            b = self.gradient[i, k]
            # Not "+=", which is atomic.
            self.deformation[self.around[i, k]] = self.deformation[self.around[i, k]] + ti.Matrix.rows(
                [b.x * change, b.y * change, b.z * change]
            )

    @ti.func
    def elastic(self, i):
        """Force [uN] of the cells around node i and of the hourglass, its negative derivative by the node's position, and
        the least eigenvalue of that.

        With B the node's gradient, f = -V (mu F B + (lambda ln J - mu) G / J), where G = dJ/dx = cof(F) B does not
        depend on the node's own position, so that d^2J/dx^2 = 0.
        """
        mu, lambda_ = self.mu[None], self.lambda_[None]
        force = -mu * self.hourglass_pull(i)
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
            bent = (b.w * ti.max(curvature, 0.0)) * g
            x += g.x * bent
            y += g.y * bent
            z += g.z * bent
        # Shear and hourglass resist in all directions alike, wherever the node is.
        alike = mu * (self.shear[i] + self.hourglass[i, 13])
        return force, tm.mat3(x.x, x.y, x.z, y.x, y.y, y.z, z.x, z.y, z.z) + alike * tm.eye(3), alike

    @ti.func
    def hourglass_pull(self, i):
        """Force, for a shear modulus of 1, against deformation that varies inside the cells: blind to rotations."""
        x = self.predicted[i]
        pull = tm.vec4(0.0)
        for k in range(27):
            pull += self.hourglass[i, k] * (self.predicted[self.neighbour[i, k]] - x)
        return pull

    def update_frames(self) -> None:
        """Nothing to do: points are carried by the nodes themselves."""

    def attach(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nodes (n, 8) around points (n, 3) [mm], and their trilinear weights (n, 8)."""
        return self.lattice.interpolation(points)

    @ti.kernel
    def carry(self, rest: ti.template(), frame: ti.template(), weight: ti.template(), out: ti.template()):
        """Points moved by the weighted displacements of their nodes."""
        for v in rest:
            x = rest[v]
            for k in ti.static(range(frame.n)):
                i = frame[v][k]
                x += weight[v][k] * (self.body.position[i] - self.body.rest[i])
            out[v] = x


@ti.func
def ln(x):
    """Natural logarithm of a normal positive number to float32's rounding; a call of the library's would not inline."""
    bits = ti.bit_cast(x, ti.i32)
    exponent = (bits - SQRT_HALF_BITS) >> 23
    z = ti.bit_cast(bits - (exponent << 23), ti.f32)
    # The series of 2 artanh(z), |z| < 0.172.
    z = (z - 1.0) / (z + 1.0)
    s = z * z
    return exponent * LN2 + 2.0 * z * (1.0 + s * (1 / 3 + s * (1 / 5 + s * (1 / 7 + s / 9))))


@ti.func
def solve(matrix, right, least):
    """Solution of a symmetric 3 x 3 system whose eigenvalues are ``least`` or more, by its square-root-free Cholesky factors.

    No pivot is less either, but by rounding, where a node torn far away is stiff one way and not the others.
    """
    d0 = matrix[0, 0]
    l10, l20 = matrix[1, 0] / d0, matrix[2, 0] / d0
    d1 = ti.max(matrix[1, 1] - l10 * matrix[1, 0], least)
    l21 = (matrix[2, 1] - l20 * matrix[1, 0]) / d1
    d2 = ti.max(matrix[2, 2] - l20 * matrix[2, 0] - l21 * l21 * d1, least)
    y1 = right.y - l10 * right.x
    y2 = right.z - l20 * right.x - l21 * y1
    z = y2 / d2
    y = y1 / d1 - l21 * z
    return tm.vec3(right.x / d0 - l10 * y - l20 * z, y, z)
