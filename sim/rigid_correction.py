"""Rigid-body coarse correction: the rigid motion of the whole body, which Gauss-Seidel takes hundreds of
iterations to find.

Newton's method with six unknowns minimises the energy of the time step over rigid motions of all nodes, under
inertia, gravity and the contacts of the last substep. Elastic energy is invariant to them.
"""

from typing import Any

import numpy as np
import taichi as ti
import taichi.math as tm

from sim.body import Body
from sim.fields import Field, zeros
from sim.kernels import function
from sim.linear_algebra import axial, cross_matrix, inverse_of, rotation_by
from sim.surface_contact import NEAR_MM, SurfaceContacts

# Sums are made in blocks of this many terms, in an order that does not depend on threads.
BLOCK = 64
# Newton's method ends when a step moves no node by more than this [mm], or after this many steps. In parallel
# each step is three kernels even when converged, so there are fewer.
CONVERGED_MM = 1e-4
NEWTON_STEPS = 12
NEWTON_STEPS_IN_PARALLEL = 3
# Regularisation of the rotational system, relative to its trace.
REGULARISATION = 1e-5
# Largest rotation in one Newton step [rad].
MOST_ROTATION = 0.5


# Force, torque, and their negative derivatives: by translation, mixed, and by rotation.
Sums = ti.types.struct(
    force=tm.vec3, torque=tm.vec3, translational=tm.mat3, mixed=tm.mat3, rotational=tm.mat3
)
# Of nodes at an arm a from the centre, held to a shift d from there with a stiffness w: sums of w, w a, w d,
# w a a^T and w d a^T; and the force and torque that give the nodes their velocities.
Moments = ti.types.struct(
    stiffness=ti.f32,
    arm=tm.vec3,
    shift=tm.vec3,
    arm_arm=tm.mat3,
    shift_arm=tm.mat3,
    force=tm.vec3,
    torque=tm.vec3,
)


class SumsField:
    """``Sums`` of each of ``count`` blocks."""

    def __init__(self, count: int) -> None:
        self.force, self.torque = (zeros(count, 3, within=1) for _ in range(2))
        self.translational, self.mixed, self.rotational = (zeros(count, 3, 3, within=2) for _ in range(3))

    @ti.func
    def store(self, block, sums):
        self.force[block], self.torque[block] = sums.force, sums.torque
        self.translational[block], self.mixed[block] = sums.translational, sums.mixed
        self.rotational[block] = sums.rotational

    @ti.func
    def of(self, block):
        return Sums(
            self.force[block],
            self.torque[block],
            self.translational[block],
            self.mixed[block],
            self.rotational[block],
        )


class MomentsField:
    """``Moments`` of each of ``count`` blocks."""

    def __init__(self, count: int) -> None:
        self.stiffness = zeros(count)
        self.arm, self.shift, self.force, self.torque = (zeros(count, 3, within=1) for _ in range(4))
        self.arm_arm, self.shift_arm = (zeros(count, 3, 3, within=2) for _ in range(2))

    @ti.func
    def store(self, block, sums):
        self.stiffness[block], self.arm[block], self.shift[block] = sums.stiffness, sums.arm, sums.shift
        self.arm_arm[block], self.shift_arm[block] = sums.arm_arm, sums.shift_arm
        self.force[block], self.torque[block] = sums.force, sums.torque

    @ti.func
    def of(self, block):
        return Moments(
            self.stiffness[block],
            self.arm[block],
            self.shift[block],
            self.arm_arm[block],
            self.shift_arm[block],
            self.force[block],
            self.torque[block],
        )


@ti.func
def no_sums():
    """Sums of no terms."""
    return Sums(tm.vec3(0.0), tm.vec3(0.0), tm.mat3(0.0), tm.mat3(0.0), tm.mat3(0.0))


@ti.func
def no_moments():
    """Moments of no nodes."""
    return Moments(0.0, tm.vec3(0.0), tm.vec3(0.0), tm.mat3(0.0), tm.mat3(0.0), tm.vec3(0.0), tm.vec3(0.0))


class RigidCorrection:
    """Moves a body's predicted positions rigidly towards ``inertial_target`` (n,) [mm], weighted with
    ``mass`` (n,) [g], and to the places at rest to which a ``tether`` (n, 3, 3) [g/s^2] holds.

    The unknowns are the translation and the rotation vector about the node ``centre``. The nodes' forces
    depend on them by sums that are made once; the contacts' forces are summed in each Newton step. The force
    of a tether is exact where the nodes are, and changes with the motion by its mean stiffness of all
    directions: sums of no more than the moments, and no motion where the forces are in equilibrium.
    """

    def __init__(
        self,
        body: Body,
        mass: Field,
        inertial_target: Field,
        contacts: SurfaceContacts | None = None,
        serial: bool = False,
        tether: Field | None = None,
    ) -> None:
        self.body = body
        self.mass = mass
        self.inertial_target = inertial_target
        self.contacts: Any = contacts
        self.has_contacts = contacts is not None
        self.serial = serial
        self.tether: Any = tether
        self.has_tether = tether is not None
        self.blocks = -(-body.count // BLOCK)
        self.contact_blocks = -(-contacts.count // BLOCK) if contacts else 0
        middle = body.rest_points.mean(axis=0)
        self.centre = int(np.linalg.norm(body.rest_points - middle, axis=1).argmin())
        self.moments, self.total_moments = MomentsField(self.blocks), MomentsField(1)
        if self.has_contacts:
            self.contact_sums = SumsField(self.contact_blocks)
        # Largest distance of a node from the centre at rest.
        self.extent_mm = float(np.linalg.norm(body.rest_points - middle, axis=1).max())
        self.rotation = zeros(3, 3, within=2)
        self.translation = zeros(3, within=1)
        self.change_mm = zeros()
        self.fraction = zeros()

    @function
    def move(self, dt: float):
        """Move all predicted positions by the rigid part of their velocities, corrected by Newton steps,
        up to the time of impact.
        """
        for block in range(self.blocks):
            self.sum_nodes(block, dt)
        for _ in range(1):
            self.begin()
        if ti.static(self.serial):
            for step in range(1 + NEWTON_STEPS):
                if step < 2 or self.change_mm[None] > CONVERGED_MM:
                    self.newton_step(step > 0)
        else:
            # Only outermost loops run in parallel.
            for step in ti.static(range(1 + NEWTON_STEPS_IN_PARALLEL)):
                self.newton_step(step > 0)
        for _ in range(1):
            self.fraction[None] = 1.0
        if ti.static(self.has_contacts):
            for q in range(self.contacts.count):
                if self.is_long():
                    start = self.contacts.interpolated(self.body.position, q)
                    # A minimum does not depend on the order, so this atomic is deterministic.
                    ti.atomic_min(self.fraction[None], self.contacts.free_fraction(start, self.moved(start)))
        for i in range(self.body.count):
            x = self.body.position[i]
            self.body.predicted[i] = x + self.fraction[None] * (self.moved(x) - x)

    @ti.func
    def is_long(self):
        """Whether a point may move so far that it could pass through a shape."""
        rotated = (self.rotation[None] - tm.eye(3)).norm() * self.extent_mm
        return self.translation[None].norm() + rotated > NEAR_MM

    @ti.func
    def moved(self, x):
        """Position of a point after the rigid motion found so far."""
        centre = self.body.position[self.centre]
        return centre + self.translation[None] + self.rotation[None] @ (x - centre)

    @ti.func
    def sum_nodes(self, block, dt: float):
        """The moments of a block's nodes."""
        sums = no_moments()
        centre = self.body.position[self.centre]
        for i in range(block * BLOCK, ti.min((block + 1) * BLOCK, self.body.count)):
            x = self.body.position[i]
            arm = x - centre
            push = self.mass[i] / dt * self.body.velocity[i]
            stiffness = self.mass[i] / (dt * dt)
            shift = stiffness * (self.inertial_target[i] - x)
            if ti.static(self.has_tether):
                shift += self.tether[i] @ (self.body.rest[i] - x)
                stiffness += self.tether[i].trace() / 3.0
            sums.stiffness += stiffness
            sums.arm += stiffness * arm
            sums.shift += shift
            sums.arm_arm += stiffness * arm.outer_product(arm)
            sums.shift_arm += shift.outer_product(arm)
            sums.force += push
            sums.torque += arm.cross(push)
        self.moments.store(block, sums)

    @ti.func
    def begin(self):
        """Add the blocks' moments; no motion yet."""
        total = no_moments()
        for block in range(self.blocks):
            moments = self.moments.of(block)
            total.stiffness += moments.stiffness
            total.arm += moments.arm
            total.shift += moments.shift
            total.arm_arm += moments.arm_arm
            total.shift_arm += moments.shift_arm
            total.force += moments.force
            total.torque += moments.torque
        self.total_moments.store(0, total)
        self.rotation[None] = tm.eye(3)
        self.translation[None] = tm.vec3(0.0)

    @ti.func
    def newton_step(self, has_forces):
        """One step; the first, without forces, takes the rigid part of the velocities and ignores the
        contacts' forces.
        """
        if ti.static(self.has_contacts):
            for block in range(self.contact_blocks):
                self.sum_contacts(block, has_forces)
        for _ in range(1):
            self.solve(has_forces)

    @ti.func
    def node_sums(self, has_forces):
        """Forces of the nodes, and their derivatives: a node at R a is pulled towards a + d, both relative
        to the moved centre.
        """
        of, rotation, translation = self.total_moments.of(0), self.rotation[None], self.translation[None]
        arm = rotation @ of.arm
        arm_arm = rotation @ of.arm_arm @ rotation.transpose()
        force, torque = of.force, of.torque
        if has_forces:
            pull = (of.shift_arm + of.arm_arm) @ rotation.transpose()
            force = of.shift - of.stiffness * translation - (rotation - tm.eye(3)) @ of.arm
            torque = axial(pull) - arm.cross(translation)
        return Sums(
            force, torque, of.stiffness * tm.eye(3), -cross_matrix(arm), arm_arm.trace() * tm.eye(3) - arm_arm
        )

    @ti.func
    def sum_contacts(self, block, has_forces):
        """Forces of the shapes on a block's contact points, and their derivatives."""
        sums = no_sums()
        rotation, centre = self.rotation[None], self.body.position[self.centre]
        moved_centre = centre + self.translation[None]
        for q in range(block * BLOCK, ti.min((block + 1) * BLOCK, self.contacts.count)):
            if self.contacts.near[q] > 0:
                arm = rotation @ (self.contacts.point[q] - centre)
                x = moved_centre + arm
                f, k = self.contacts.point_force(q, x, has_forces)
                turned = ti.Matrix.rows([arm.cross(k[0, :]), arm.cross(k[1, :]), arm.cross(k[2, :])])
                sums.force += f
                sums.torque += arm.cross(f)
                sums.translational += k
                sums.mixed += turned
                sums.rotational += ti.Matrix.cols(
                    [arm.cross(turned[:, 0]), arm.cross(turned[:, 1]), arm.cross(turned[:, 2])]
                )
        self.contact_sums.store(block, sums)

    @ti.func
    def solve(self, has_forces):
        """Solve the 6 x 6 system by its Schur complement, and add the step to the rigid motion."""
        total = self.node_sums(has_forces)
        if ti.static(self.has_contacts):
            for block in range(self.contact_blocks):
                sums = self.contact_sums.of(block)
                total.force += sums.force
                total.torque += sums.torque
                total.translational += sums.translational
                total.mixed += sums.mixed
                total.rotational += sums.rotational
        compliance = inverse_of(total.translational)
        schur = total.rotational - total.mixed.transpose() @ compliance @ total.mixed
        # A body collapsed to a line or a point has no resistance to rotation about it.
        schur += (REGULARISATION * total.rotational.trace() + 1e-12) * tm.eye(3)
        vector = inverse_of(schur) @ (total.torque - total.mixed.transpose() @ compliance @ total.force)
        vector *= ti.min(1.0, MOST_ROTATION / ti.max(vector.norm(), 1e-12))
        shift = compliance @ (total.force - total.mixed @ vector)
        self.change_mm[None] = shift.norm() + vector.norm() * self.extent_mm
        self.translation[None] += shift
        self.rotation[None] = rotation_by(vector) @ self.rotation[None]
