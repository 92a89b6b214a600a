"""Compressible neo-Hookean tissue on a lattice of hexahedral elements, solved by vertex block descent.

Implicit Euler as minimisation (Liu et al. 2013, Eq. 3): a step minimises m |x - inertial target|^2 / 2 h^2 +
elastic and contact energy over the positions x. Vertex block descent (Chen et al. 2024) is a nonlinear
Gauss-Seidel method: one Newton step for each node, all others fixed; here with successive over-relaxation.
Elements have one integration point and hourglass stabilisation (Flanagan & Belytschko 1981); those cut by the
surface are integrated as in the finite cell method. At convergence every node is in equilibrium, so the rest
state does not depend on iterations, substeps or time step.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
import taichi as ti
import taichi.math as tm
import trimesh

from sim.attachment import PerirenalFat, total_stiffness
from sim.body import Body
from sim.capsule import N_MM, Capsule
from sim.device import is_too_small
from sim.fields import Field, field_of, fields_of, fill, zeros
from sim.lattice import CORNERS, Lattice, fill_with_cells, surface_points
from sim.linear_algebra import cross, four, row, solve
from sim.material import Material, mixture
from sim.penetration_barrier import BARRIER_SPACING_MM, PenetrationBarrier
from sim.removed_tissue import RemovedTissue, lattice_without, patch_shares, points_without
from sim.rigid_correction import RigidCorrection
from sim.skinning import NodeCarrier
from sim.solver import StepSettings
from sim.stored_arrays import stored
from sim.surface_contact import PENALTY_DEPTH_MM, REACH_MM, SurfaceContacts
from sim.surface_points import SurfacePoints
from sim.tissue_model import ModelInputs
from sim.viscoelasticity import PronyTerm, Relaxation

# Stiffness, in units of the shear modulus, of deformation that varies inside an element. 1 + nu is exact for
# bending, 1 for u_x ~ y z,
# 0.5 for torsion: the least of them, because elements so wide are too stiff around the edges of a probe
# (docs/method.md).
HOURGLASS_STIFFNESS = 0.5
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
# The tissue of a model that is given none.
ORGAN = Material()
LATTICE_SETTINGS = StepSettings(substeps=1, iterations=4, relaxation_factor=1.7, stabilisation_iterations=0)


class NeoHookean:
    """W = mu/2 (tr C - 3) - mu ln J + lambda/2 (ln J)^2 in the elements of a lattice (Bonet & Wood 2008, Eq.
    6.27).

    ``fixed`` (n,) marks nodes that cannot move; ``load_g`` (n,) [g] is added to the nodes' masses; ``serial``
    runs on one core (None: by the number of nodes). ``deformation`` (m + 1,) has the columns of each
    element's deformation gradient F as rows; the last is for elements that do not exist.
    """

    EMBEDDING_CELL_RATIO: ClassVar[float] = 1.35

    @classmethod
    def make(cls, inputs: ModelInputs) -> "NeoHookean":
        """Elements that fill the organ, with contact points on its surface where there are shapes.

        Raises SamplingError.
        """
        tissue = inputs.tissue
        lattice = fill_with_cells(inputs.organ, tissue.cell_mm, [part.surface for part in inputs.parts])
        body = Body(lattice.nodes)
        contacts = None
        if inputs.shapes:
            spacing_mm = POINT_SPACING_CELLS * tissue.cell_mm
            points, area_mm2 = stored(surface_points, inputs.organ, spacing_mm)
            # Between organ and support is its fat, whose stiffness takes the place of friction.
            in_fat = any(isinstance(tether, PerirenalFat) for tether in inputs.tethers)
            barrier, tools = None, [shape for shape in inputs.shapes if shape.moves]
            if tools:
                between, between_mm2 = stored(surface_points, inputs.organ, BARRIER_SPACING_MM)
                barrier = PenetrationBarrier(body, lattice, between, between_mm2, tools)
            surface = points, area_mm2, inputs.shapes
            contacts = SurfaceContacts(body, lattice, *surface, inputs.friction, in_fat, barrier)
        material = Material(tissue.young_kpa, tissue.poisson, tissue.density_g_cm3)
        parts = [part.material for part in inputs.parts]
        fixed = None
        if inputs.fixed:
            fixed = np.any([region.nodes(lattice.nodes) for region in inputs.fixed], axis=0)
        tether_n_mm, capsule = None, None
        if inputs.tethers:
            tether_n_mm = total_stiffness(inputs.tethers, lattice, inputs.organ)
        if tissue.capsule_n_mm > 0:
            capsule = Capsule(body, lattice, inputs.organ, tissue.capsule_n_mm)
        prony = [PronyTerm(term.modulus_ratio, term.time_s) for term in tissue.prony]
        return cls(
            body,
            lattice,
            contacts,
            material,
            parts,
            fixed=fixed,
            serial=inputs.serial,
            tether_n_mm=tether_n_mm,
            capsule=capsule,
            prony=prony,
        )

    @staticmethod
    def reach_mm(tissue: Any) -> float:
        """Distance [mm] within which contacts need the distance to a shape, the same for all cell widths."""
        return REACH_MM

    def __init__(
        self,
        body: Body,
        lattice: Lattice,
        contacts: SurfaceContacts | None = None,
        material: Material = ORGAN,
        parts: Sequence[Material] = (),
        fixed: np.ndarray | None = None,
        serial: bool | None = None,
        load_g: np.ndarray | float = 0.0,
        tether_n_mm: np.ndarray | None = None,
        capsule: Capsule | None = None,
        prony: Sequence[PronyTerm] = (),
        hourglass_stiffness: float = HOURGLASS_STIFFNESS,
    ) -> None:
        starts = [int(v) for v in lattice.colour_start]
        self.body = body
        self.lattice = self.whole_lattice = lattice
        self.carrier = NodeCarrier(lattice.interpolation, body.position, body.rest)
        self.contacts: Any = contacts
        self.has_contacts = contacts is not None
        self.colours = tuple(pairwise(starts))
        self.serial = is_too_small(body.count, PARALLEL_NODES) if serial is None else serial
        self.has_fixed = fixed is not None
        if fixed is not None:
            self.fixed = field_of(fixed)
        self.has_tether = tether_n_mm is not None
        if tether_n_mm is not None:
            self.tether = field_of(N_MM * tether_n_mm, 2)
        self._whole_tether = tether_n_mm
        self.load_g = load_g
        self.capsule: Any = capsule
        self.has_capsule = capsule is not None
        self.count = len(lattice.cells)
        self.has_relaxation = bool(prony)
        self.internal_state: dict[str, Field] = {}
        if prony:
            self.relaxation = Relaxation(prony, self.count)
            self.internal_state = self.relaxation.state
        self.most_mm = MOST_CELLS_AN_ITERATION * lattice.cell_mm
        self.mu = self.lambda_ = 0.0
        self.inertial_target = zeros(body.count, 3, within=1)
        self.predicted = zeros(body.count, 4, within=1)
        self.parts = tuple(parts)
        self.has_parts = bool(parts)
        density = mixture(material, self.parts, lattice.share)[2]
        self.mass = field_of(lattice.node_mass(density) + load_g)
        self._make_fields()
        self.rigid: Any = None
        if not self.has_fixed:
            tether = self.tether if self.has_tether else None
            self.rigid = RigidCorrection(body, self.mass, self.inertial_target, contacts, self.serial, tether)
        self.material = material
        self.hourglass_stiffness = hourglass_stiffness
        self._fill_stiffness(np.ones(self.count))
        self.set_material(material.young_kpa)

    def _make_fields(self) -> None:
        """The elements around each node and its 27 neighbours, itself included; without stiffness."""
        cells, nodes = self.lattice.cells, self.body.count
        around = np.full((nodes, 8), self.count)
        neighbour = np.tile(np.arange(nodes)[:, None], (1, 27))
        for a in range(8):
            around[cells[:, a], a] = np.arange(self.count)
            for b in range(8):
                neighbour[cells[:, a], place_of(a, b)] = cells[:, b]
        self.around, self.neighbour = fields_of(around.ravel(), neighbour.ravel())
        self.cell = field_of(cells, 1)
        self.deformation = field_of(np.tile(np.eye(3, 4), (self.count + 1, 1, 1)), 2)
        self.gradient = zeros(8 * nodes, 4, within=1)
        self.shear = zeros(nodes)
        self.hourglass = zeros(27 * nodes)
        if self.has_parts:
            self.lame_ratio = zeros(self.count + 1)

    def _fill_stiffness(self, stiffness: np.ndarray) -> None:
        """Fill the fields that contain the shear modulus (m,) of the elements, in units of ``mu``."""
        cells, lattice = self.lattice.cells, self.lattice
        gradient = np.zeros((self.body.count, 8, 4))
        hourglass = np.zeros((self.body.count, 27))
        for a in range(8):
            gradient[cells[:, a], a, :3] = lattice.gradient[:, a]
            gradient[cells[:, a], a, 3] = stiffness * lattice.volume
            for b in range(8):
                weight = self.hourglass_stiffness * stiffness * lattice.hourglass[:, a, b]
                hourglass[cells[:, a], place_of(a, b)] += weight
        shear = (gradient[:, :, 3] * (gradient[:, :, :3] ** 2).sum(axis=2)).sum(axis=1)
        # A node whose elements were all removed stays where it is: it has no force, but needs a stiffness.
        shear[shear == 0.0] = 1.0
        fill(
            (self.gradient, gradient.reshape(-1, 4)), (self.shear, shear), (self.hourglass, hourglass.ravel())
        )

    def set_material(
        self, young_kpa: float, poisson: float | None = None, parts: Sequence[Material] | None = None
    ) -> None:
        """Change Young's modulus [kPa] of the tissue outside the parts, and the contacts' penalty stiffness
        with it.

        Without a Poisson's ratio, or without parts, these stay the same; densities do so always.
        """
        poisson = self.material.poisson if poisson is None else poisson
        self.material = replace(self.material, young_kpa=young_kpa, poisson=poisson)
        self.parts = self.parts if parts is None else tuple(parts)
        self.mu, self.lambda_ = self.material.mu, self.material.lambda_
        if self.contacts is not None:
            self.contacts.set_stiffness(young_kpa / PENALTY_DEPTH_MM)
        if self.has_parts:
            mu, lambda_, _ = mixture(self.material, self.parts, self.lattice.share)
            self._fill_stiffness(mu / self.material.mu)
            fill((self.lame_ratio, np.append(lambda_ / mu, 0.0)))

    def remove_tissue(
        self, organ: trimesh.Trimesh, tissue: RemovedTissue | None, parts: Sequence[trimesh.Trimesh]
    ) -> None:
        """Remove tissue from the whole organ at rest, or with None restore all of it. The state stays as it
        is.

        ``organ`` and ``parts`` are the surfaces that the model was made from [mm].
        """
        whole = self.whole_lattice
        self.lattice = whole if tissue is None else lattice_without(whole, tissue, parts)
        self.carrier.interpolation = self.lattice.interpolation
        density = mixture(self.material, self.parts, self.lattice.share)[2]
        fill((self.mass, self.lattice.node_mass(density) + self.load_g))
        if self.has_parts:
            self.set_material(self.material.young_kpa)
        else:
            self._fill_stiffness(np.ones(self.count))
        if self._whole_tether is not None:
            volume = [lattice.node_mass(np.ones(self.count)) for lattice in (self.lattice, whole)]
            share = np.minimum(volume[0] / volume[1], 1.0)
            self.set_tether(self._whole_tether * share[:, None, None])
        if self.has_contacts:
            self._leave(self.contacts, tissue, POINT_SPACING_CELLS * whole.cell_mm)
            if self.contacts.has_barrier:
                self._leave(self.contacts.barrier, tissue, BARRIER_SPACING_MM)
        if self.has_capsule:
            share = np.ones(self.capsule.count) if tissue is None else patch_shares(organ, whole, tissue)
            self.capsule.set_share(share)

    def _leave(self, points: SurfacePoints, tissue: RemovedTissue | None, spacing_mm: float) -> None:
        """Of points on the whole organ's surface leave those that removed tissue leaves."""
        left = points.whole if tissue is None else points_without(*points.whole, tissue, spacing_mm)
        points.set_points(self.lattice, *left)

    def set_tether(self, tether_n_mm: np.ndarray) -> None:
        """Change the stiffness (n, 3, 3) of the springs [N/mm]; only where there were any from the start."""
        fill((self.tether, N_MM * tether_n_mm))

    def counts(self) -> dict[str, int]:
        """Nodes (also as particles), cells, and contact points on the surface."""
        nodes, points = self.body.count, self.contacts.count if self.has_contacts else 0
        return dict(nodes=nodes, particles=nodes, cells=self.count, points=points)

    @ti.func
    def begin(self, dt: float):
        """The solver's prediction is the inertial target; start from the last positions and the rigid-body
        coarse correction.
        """
        for i in range(self.body.count):
            self.inertial_target[i] = self.body.predicted[i]
            self.body.predicted[i] = self.body.position[i]
        if ti.static(not self.has_fixed):
            self.rigid.move(dt)
        for c in range(self.count):
            x, y, z = tm.vec4(0.0), tm.vec4(0.0), tm.vec4(0.0)
            for k in ti.static(range(8)):
                i = self.cell[c][k]
                b, at = self.gradient[8 * i + k], four(self.body.predicted[i])
                x += b.x * at
                y += b.y * at
                z += b.z * at
            self.deformation[c] = ti.Matrix.rows([x, y, z])
        if ti.static(self.has_capsule):
            self.capsule.begin()
        if ti.static(self.has_relaxation):
            self.relaxation.begin(dt)
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

        All ranges are known when the kernel compiles: this makes the code twice as fast, and on Vulkan any
        other range starts 65536 threads.
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
        if ti.static(self.has_tether):
            force += four(self.tether[i] @ (self.body.rest[i] - self.predicted[i].xyz))
            hessian += self.tether[i]
        hessian += inertia * tm.eye(3)
        if ti.static(self.has_capsule):
            tension, stiffness = self.capsule.node_force(i)
            force += four(tension)
            hessian += stiffness
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
        if ti.static(self.has_capsule):
            self.capsule.follow(i, change)
        if ti.static(self.has_contacts):
            self.contacts.follow(i, change)

    @ti.func
    def move(self, i, change):
        """Move node i and update the deformation of the elements around it, which no other node of its
        colour has.
        """
        self.predicted[i] = self.predicted[i] + change
        for k in range(8):
            b = self.gradient[8 * i + k]
            # Not "+=", which is atomic.
            self.deformation[self.around[8 * i + k]] = self.deformation[
                self.around[8 * i + k]
            ] + ti.Matrix.rows([b.x * change, b.y * change, b.z * change])

    @ti.func
    def elastic(self, i):
        """Force [uN] on node i of the elements around it, its negative derivative by the node's position (3,
        3), and that matrix's least eigenvalue.

        With B the node's gradient, f = -V (mu F B + (lambda ln J - mu) G / J), where G = dJ/dx = cof(F) B
        does not depend on the node's own position, so that d^2J/dx^2 = 0.
        """
        mu, lambda_ = self.mu, self.lambda_
        force = -mu * self.hourglass_gradient(i)
        x, y, z = tm.vec4(0.0), tm.vec4(0.0), tm.vec4(0.0)
        # Shear and hourglass stiffness are isotropic and do not depend on the positions.
        isotropic = mu * (self.shear[i] + self.hourglass[27 * i + 13])
        if ti.static(self.has_relaxation):
            factor = self.relaxation.factor[None]
            isotropic += (factor - 1.0) * mu * self.shear[i]
            mu *= factor
            lambda_ *= factor
        for k in range(8):
            b = self.gradient[8 * i + k]
            f = self.deformation[self.around[8 * i + k]]
            if ti.static(self.has_parts):
                lambda_ = mu * self.lame_ratio[self.around[8 * i + k]]
            f1, f2, f3 = row(f, 0), row(f, 1), row(f, 2)
            f23 = cross(f2, f3)
            j = f1.dot(f23)
            g = b.x * f23 + b.y * cross(f3, f1) + b.z * cross(f1, f2)
            at = ti.max(j, LEAST_J)
            one_by = 1.0 / at
            pressure = (lambda_ * (ln(at) + j * one_by - 1.0) - mu) * one_by
            force -= b.w * (mu * (b.x * f1 + b.y * f2 + b.z * f3) + pressure * g)
            if ti.static(self.has_relaxation):
                past = times(self.relaxation.past_stress[self.around[8 * i + k]], b.xyz)
                force -= b.w * (past.x * f1 + past.y * f2 + past.z * f3)
                isotropic += ti.max(b.w * past.dot(b.xyz), 0.0)
            curvature = lambda_ * one_by * one_by - (pressure * one_by if j > LEAST_J else 0.0)
            weighted = (b.w * ti.max(curvature, 0.0)) * g
            x += g.x * weighted
            y += g.y * weighted
            z += g.z * weighted
        return force, tm.mat3(x.x, x.y, x.z, y.x, y.y, y.z, z.x, z.y, z.z) + isotropic * tm.eye(3), isotropic

    @ti.func
    def hourglass_gradient(self, i):
        """Gradient by node i of the hourglass energy for a shear modulus of 1; zero for linear fields, so
        for rotations too.
        """
        x = self.predicted[i]
        gradient = tm.vec4(0.0)
        for k in range(27):
            gradient += self.hourglass[27 * i + k] * (self.predicted[self.neighbour[27 * i + k]] - x)
        return gradient

    @ti.func
    def finish(self, dt: float):
        """End of a substep: store what the next one needs of the stress, if the tissue relaxes."""
        if ti.static(self.has_relaxation):
            for c in range(self.count):
                self.relaxation.finish(c, self.elastic_stress(c), dt)

    @ti.func
    def elastic_stress(self, c):
        """Second Piola-Kirchhoff stress S = mu (1 - C^-1) + lambda ln J C^-1 of element c: 11, 22, 33, 12,
        13, 23, relative to the element's stiffness.
        """
        mu, lambda_ = self.mu, self.lambda_
        if ti.static(self.has_parts):
            lambda_ = mu * self.lame_ratio[c]
        f = self.deformation[c]
        f1, f2, f3 = row(f, 0).xyz, row(f, 1).xyz, row(f, 2).xyz
        g1, g2, g3 = f2.cross(f3), f3.cross(f1), f1.cross(f2)
        j = f1.dot(g1)
        at = ti.max(j, LEAST_J)
        # The rows of F^-1 are g1, g2, g3 over J, and C^-1 = F^-1 F^-T.
        volumetric = (lambda_ * (ln(at) + j / at - 1.0) - mu) / (at * at)
        return ti.Vector(
            [
                mu + volumetric * g1.dot(g1),
                mu + volumetric * g2.dot(g2),
                mu + volumetric * g3.dot(g3),
                volumetric * g1.dot(g2),
                volumetric * g1.dot(g3),
                volumetric * g2.dot(g3),
            ]
        )

    def update_frames(self) -> None:
        """Nothing to do: points are interpolated from the nodes."""


def place_of(a: int, b: int) -> int:
    """The place of a cell's corner b among the 27 neighbours of its corner a."""
    return int((CORNERS[b] - CORNERS[a] + 1) @ [9, 3, 1])


@ti.func
def times(s, b):
    """A symmetric tensor (11, 22, 33, 12, 13, 23) times a vector."""
    return tm.vec3(
        s[0] * b.x + s[3] * b.y + s[4] * b.z,
        s[3] * b.x + s[1] * b.y + s[5] * b.z,
        s[4] * b.x + s[5] * b.y + s[2] * b.z,
    )


@ti.func
def ln(x):
    """Natural logarithm of a normal positive number to float32's rounding; unlike the library's it is
    inlined.
    """
    bits = ti.bit_cast(x, ti.i32)
    exponent = (bits - SQRT_HALF_BITS) >> 23
    z = ti.bit_cast(bits - (exponent << 23), ti.f32)
    # Series of 2 artanh(z), |z| < 0.172.
    z = (z - 1.0) / (z + 1.0)
    s = z * z
    return exponent * LN2 + 2.0 * z * (1.0 + s * (1 / 3 + s * (1 / 5 + s * (1 / 7 + s / 9))))
