"""Rigid-body coarse correction: the rigid motion of the whole body, which Gauss-Seidel takes hundreds of iterations to find.

Newton's method with six unknowns minimises the energy of the time step over rigid motions of all nodes, under inertia,
gravity and the contacts of the last substep. Elastic energy is invariant to them.
"""

from typing import Any

import numpy as np
import taichi as ti
import taichi.math as tm

from sim.body import Body
from sim.linear_algebra import cross_matrix, inverse_of, rotation_by
from sim.surface_contact import NEAR_MM, SurfaceContacts

# Sums are made in blocks of this many terms, in an order that does not depend on threads.
BLOCK = 64
# Newton's method ends when a step moves no node by more than this [mm], or after this many steps. In parallel each step is
# three kernels even when converged, so there are fewer.
CONVERGED_MM = 1e-4
NEWTON_STEPS = 12
NEWTON_STEPS_IN_PARALLEL = 3
# Regularisation of the rotational system, relative to its trace.
REGULARISATION = 1e-5
# Largest rotation in one Newton step [rad].
MOST_ROTATION = 0.5


# The negative derivatives of force and torque are by translation, mixed, and by rotation.
Sums = ti.types.struct(
    force=tm.vec3, torque=tm.vec3, translational=tm.mat3, mixed=tm.mat3, rotational=tm.mat3
)


@ti.func
def nothing():
    """Sums of no terms."""
    return Sums(tm.vec3(0.0), tm.vec3(0.0), tm.mat3(0.0), tm.mat3(0.0), tm.mat3(0.0))


@ti.data_oriented
class RigidCorrection:
    """Moves a body's predicted positions rigidly towards ``inertial_target`` (n,) [mm], weighted with ``mass`` (n,) [g],
    and to the places at rest to which a ``tether`` (n,) [g/s^2] holds.

    The unknowns are the translation and the rotation vector about the node ``centre``.
    """

    def __init__(
        self,
        body: Body,
        mass: ti.Field,
        inertial_target: ti.Field,
        contacts: SurfaceContacts | None = None,
        serial: bool = False,
        tether: ti.Field | None = None,
    ) -> None:
        self.body = body
        self.mass = mass
        self.inertial_target = inertial_target
        self.contacts: Any = contacts
        self.has_contacts = contacts is not None
        self.serial = serial
        self.tether: Any = tether
        self.has_tether = tether is not None
        self.terms = body.count + (contacts.count if contacts else 0)
        self.blocks = -(-self.terms // BLOCK)
        middle = body.rest_points.mean(axis=0)
        self.centre = int(np.linalg.norm(body.rest_points - middle, axis=1).argmin())
        self.sums = Sums.field(shape=self.blocks)
        # Largest distance of a node from the centre at rest.
        self.extent_mm = float(np.linalg.norm(body.rest_points - middle, axis=1).max())
        self.rotation = ti.Matrix.field(3, 3, ti.f32, ())
        self.translation = ti.Vector.field(3, ti.f32, ())
        self.change_mm = ti.field(ti.f32, ())
        self.fraction = ti.field(ti.f32, ())

    @ti.func
    def move(self, dt: float):
        """Move all predicted positions by the rigid part of their velocities, corrected by Newton steps, up to the time of impact."""
        for _ in range(1):
            self.rotation[None] = tm.eye(3)
            self.translation[None] = tm.vec3(0.0)
        if ti.static(self.serial):
            for step in range(1 + NEWTON_STEPS):
                if step < 2 or self.change_mm[None] > CONVERGED_MM:
                    self.newton_step(step > 0, dt)
        else:
            # Only outermost loops run in parallel.
            for step in ti.static(range(1 + NEWTON_STEPS_IN_PARALLEL)):
                self.newton_step(step > 0, dt)
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
    def newton_step(self, has_forces, dt: float):
        """One step; the first, without forces, takes the rigid part of the velocities."""
        for block in range(self.blocks):
            self.sum_block(block, dt, has_forces)
        for _ in range(1):
            self.solve()

    @ti.func
    def moved(self, x):
        """Position of a point after the rigid motion found so far."""
        centre = self.body.position[self.centre]
        return centre + self.translation[None] + self.rotation[None] @ (x - centre)

    @ti.func
    def sum_block(self, block, dt: float, has_forces):
        """Force, torque and their derivatives of a block's terms: nodes first, then contact points.

        Without ``has_forces`` the forces move the nodes by their velocities and ignore contacts.
        """
        sums = nothing()
        centre = self.body.position[self.centre] + self.translation[None]
        for term in range(block * BLOCK, ti.min((block + 1) * BLOCK, self.terms)):
            f, k, x = tm.vec3(0.0), tm.mat3(0.0), centre
            if term < self.body.count:
                inertia = self.mass[term] / (dt * dt)
                x = self.moved(self.body.position[term])
                f = inertia * dt * self.body.velocity[term]
                if has_forces:
                    f = inertia * (self.inertial_target[term] - x)
                if ti.static(self.has_tether):
                    if has_forces:
                        f += self.tether[term] * (self.body.rest[term] - x)
                    inertia += self.tether[term]
                k = inertia * tm.eye(3)
            elif ti.static(self.has_contacts):
                q = term - self.body.count
                x = self.moved(self.contacts.point[q])
                f, k = self.contacts.point_force(q, x, has_forces)
            arm = cross_matrix(x - centre)
            sums.force += f
            sums.torque += arm @ f
            sums.translational += k
            sums.mixed -= k @ arm
            sums.rotational -= arm @ k @ arm
        self.sums[block] = sums

    @ti.func
    def solve(self):
        """Solve the 6 x 6 system by its Schur complement, and add the step to the rigid motion."""
        total = nothing()
        for block in range(self.blocks):
            sums = self.sums[block]
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
