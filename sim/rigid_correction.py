"""How the whole organ moves as if it were rigid, found at once: node by node that takes hundreds of passes.

A coarse correction with six unknowns: Newton's steps on the time step's energy over rotations and translations of all
nodes, under inertia, gravity and the contacts that the last substep knew. Elastic energy does not see it.
"""

from typing import Any

import numpy as np
import taichi as ti
import taichi.math as tm

from sim.body import Body
from sim.linear_algebra import cross_matrix
from sim.surface_contact import NEAR_MM, SurfaceContacts

# Sums are made of blocks of so many terms, in an order that no thread changes.
BLOCK = 64
# Newton's steps go on until one moves no node by more than this [mm], but are no more than so many; in parallel each of
# them is three kernels, whether it has something to do or not.
ENOUGH_MM = 1e-4
NEWTON_STEPS = 12
NEWTON_STEPS_IN_PARALLEL = 3
# Share of the moments of inertia and contact that is added, so that the system is never singular.
LEAST_HOLD = 1e-5
# No body turns by more in a substep [rad].
MOST_TURN = 0.5


@ti.data_oriented
class RigidCorrection:
    """Moves a body's estimates rigidly towards ``target`` (n,) [mm], where inertia and gravity draw its ``mass`` (n,) [g].

    Unknowns are the translation and the rotation vector about ``centre``, one of the nodes.
    """

    def __init__(
        self,
        body: Body,
        mass: ti.Field,
        target: ti.Field,
        contacts: SurfaceContacts | None = None,
        serial: bool = False,
    ) -> None:
        self.body = body
        self.mass = mass
        self.target = target
        self.contacts: Any = contacts
        self.has_contacts = contacts is not None
        self.serial = serial
        self.terms = body.count + (contacts.count if contacts else 0)
        self.blocks = -(-self.terms // BLOCK)
        middle = body.rest_points.mean(axis=0)
        self.centre = int(np.linalg.norm(body.rest_points - middle, axis=1).argmin())
        self.force = ti.Vector.field(3, ti.f32, self.blocks)
        self.torque = ti.Vector.field(3, ti.f32, self.blocks)
        self.along = ti.Matrix.field(3, 3, ti.f32, self.blocks)
        self.mixed = ti.Matrix.field(3, 3, ti.f32, self.blocks)
        self.about = ti.Matrix.field(3, 3, ti.f32, self.blocks)
        # How far the body reaches from its centre, at rest.
        self.extent_mm = float(np.linalg.norm(body.rest_points - middle, axis=1).max())
        self.rotation = ti.Matrix.field(3, 3, ti.f32, ())
        self.translation = ti.Vector.field(3, ti.f32, ())
        self.change_mm = ti.field(ti.f32, ())
        self.share = ti.field(ti.f32, ())

    @ti.func
    def move(self, dt: float):
        """The motion that goes on, then Newton steps, in which contacts close, open, stick and slide; all estimates moved."""
        for _ in range(1):
            self.rotation[None] = tm.eye(3)
            self.translation[None] = tm.vec3(0.0)
        if ti.static(self.serial):
            for step in range(1 + NEWTON_STEPS):
                if step < 2 or self.change_mm[None] > ENOUGH_MM:
                    self.improve(step > 0, dt)
        else:
            # Only outermost loops run in parallel.
            for step in ti.static(range(1 + NEWTON_STEPS_IN_PARALLEL)):
                self.improve(step > 0, dt)
        for _ in range(1):
            self.share[None] = 1.0
        if ti.static(self.has_contacts):
            for q in range(self.contacts.count):
                if self.is_long():
                    start = self.contacts.carried(self.body.position, q)
                    # The least of numbers does not depend on the order, so this atomic keeps runs alike.
                    ti.atomic_min(self.share[None], self.contacts.free_share(start, self.moved(start)))
        for i in range(self.body.count):
            x = self.body.position[i]
            self.body.predicted[i] = x + self.share[None] * (self.moved(x) - x)

    @ti.func
    def is_long(self):
        """Whether any point may be moved so far that it could go through a shape."""
        turned = (self.rotation[None] - tm.eye(3)).norm() * self.extent_mm
        return self.translation[None].norm() + turned > NEAR_MM

    @ti.func
    def improve(self, newton, dt: float):
        """One more step to the motion."""
        for block in range(self.blocks):
            self.sum_block(block, dt, newton)
        for _ in range(1):
            self.solve()

    @ti.func
    def moved(self, x):
        """Where the motion found so far takes a point."""
        centre = self.body.position[self.centre]
        return centre + self.translation[None] + self.rotation[None] @ (x - centre)

    @ti.func
    def sum_block(self, block, dt: float, newton):
        """Force, torque and their derivatives of a block's terms, nodes first, then points of contact.

        Without ``newton`` they draw the nodes to where their velocities would take them, whatever is in the way.
        """
        force, torque = tm.vec3(0.0), tm.vec3(0.0)
        along, mixed, about = tm.mat3(0.0), tm.mat3(0.0), tm.mat3(0.0)
        centre = self.body.position[self.centre] + self.translation[None]
        for term in range(block * BLOCK, ti.min((block + 1) * BLOCK, self.terms)):
            f, k, x = tm.vec3(0.0), tm.mat3(0.0), centre
            if term < self.body.count:
                inertia = self.mass[term] / (dt * dt)
                x = self.moved(self.body.position[term])
                f = inertia * dt * self.body.velocity[term]
                if newton:
                    f = inertia * (self.target[term] - x)
                k = inertia * tm.eye(3)
            elif ti.static(self.has_contacts):
                q = term - self.body.count
                x = self.moved(self.contacts.point[q])
                f, k = self.contacts.hold(q, x, newton)
            turn = cross_matrix(x - centre)
            force += f
            torque += turn @ f
            along += k
            mixed -= k @ turn
            about -= turn @ k @ turn
        self.force[block], self.torque[block] = force, torque
        self.along[block], self.mixed[block], self.about[block] = along, mixed, about

    @ti.func
    def solve(self):
        """The 6 x 6 system by its Schur complement; the motion as a rotation and a translation."""
        force, torque = tm.vec3(0.0), tm.vec3(0.0)
        along, mixed, about = tm.mat3(0.0), tm.mat3(0.0), tm.mat3(0.0)
        for block in range(self.blocks):
            force += self.force[block]
            torque += self.torque[block]
            along += self.along[block]
            mixed += self.mixed[block]
            about += self.about[block]
        compliance = inverse_of(along)
        schur = about - mixed.transpose() @ compliance @ mixed
        # A body drawn out to a line, or less, has no hold about it.
        schur += (LEAST_HOLD * about.trace() + 1e-12) * tm.eye(3)
        turn = inverse_of(schur) @ (torque - mixed.transpose() @ compliance @ force)
        turn *= ti.min(1.0, MOST_TURN / ti.max(turn.norm(), 1e-12))
        shift = compliance @ (force - mixed @ turn)
        self.change_mm[None] = shift.norm() + turn.norm() * self.extent_mm
        self.translation[None] += shift
        self.rotation[None] = rotation_by(turn) @ self.rotation[None]


@ti.func
def inverse_of(matrix):
    """Inverse of a positive definite 3 x 3 matrix, in units of its trace: a determinant may have no room in float32."""
    unit = 1.0 / matrix.trace()
    return unit * (unit * matrix).inverse()


@ti.func
def rotation_by(turn):
    """Rotation by a vector's length [rad] about it (Rodrigues)."""
    angle = turn.norm()
    axis = turn / ti.max(angle, 1e-12)
    cross = cross_matrix(axis)
    return tm.eye(3) + ti.sin(angle) * cross + (1.0 - ti.cos(angle)) * (cross @ cross)
