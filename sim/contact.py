"""Contacts of particles with shapes: found once a substep, solved with Coulomb friction, never left violated."""

import numpy as np
import taichi as ti
import taichi.math as tm

from sim.body import ParticleBody
from sim.shapes import FAR

KEEP_OUT_SWEEPS = 8
# How far around a static shape its distances must be known, in particle radii.
REACH_RADII = 2.0
# Float32 positions of a body of 200 mm carry about 1e-5 mm; distances are compared with room for that.
ROUNDING = 1e-4
SAFETY = 1e-3


@ti.data_oriented
class ShapeContacts:
    """Contact planes of each particle with each shape, and the push that each has given in this substep.

    ``plane`` (shapes, n): normal and offset of n . x >= offset [mm]. ``push`` (shapes, n): friction (x, y, z) and
    normal (w) displacement so far [mm]. As the clusters keep momentum, the sums of the pushes are the impulses
    exchanged with the shape, so Coulomb's law holds for them: |friction| <= coefficient * normal. A coefficient of 0
    takes no memory for pushes and no time.
    """

    def __init__(self, body: ParticleBody, shapes: list, friction: float) -> None:
        self.body = body
        self.shapes = list(shapes)
        self.friction = friction
        self.rough = friction > 0
        self.margin = body.radius_mm / 2
        # A mesh knows no distances beyond its reach, so "farther than that" is all that can be remembered.
        self.reach = REACH_RADII * body.radius_mm
        self.plane = ti.Vector.field(4, ti.f32, (len(shapes), body.count))
        if self.rough:
            self.push = ti.Vector.field(4, ti.f32, (len(shapes), body.count))
        self.touched = ti.field(ti.i32, body.count)
        self.found = ti.Vector.field(4, ti.f32, (len(shapes), body.count))
        self.forget()
        self.penetration = ti.field(ti.f32, ())

    def forget(self) -> None:
        """Drop what is known of the particles' distances, after they were moved by another hand."""
        self.found.fill(-FAR)

    def snapshot(self) -> dict[str, np.ndarray]:
        """What it carries from step to step: nothing, as distances only save time."""
        return {}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Go on after a snapshot."""
        self.forget()

    @ti.func
    def is_clear(self, s: ti.template(), i, p, distance):
        """Whether p is farther than a distance from shape s, by what was last measured there (``found``)."""
        known = self.found[s, i]
        return known.w - (p - known.xyz).norm() > distance + SAFETY

    @ti.func
    def find(self):
        """Lines 6-9: the plane of each shape that a particle's estimate is near to."""
        for i in range(self.body.count):
            p = self.body.estimate[i]
            radius = self.body.contact_radius[i]
            touched = 0
            for s in ti.static(range(len(self.shapes))):
                plane = tm.vec4(0.0, 0.0, 0.0, -FAR)
                if ti.static(self.shapes[s].moves) or not self.is_clear(s, i, p, radius + self.margin):
                    near = self.shapes[s].surface(p)
                    self.found[s, i] = tm.vec4(p, ti.min(near.w, self.reach))
                    if near.w < radius + self.margin:
                        plane = tm.vec4(near.xyz, near.xyz.dot(p) - near.w + radius)
                        touched += 1
                self.plane[s, i] = plane
                if ti.static(self.rough):
                    self.push[s, i] = tm.vec4(0.0)
            self.touched[i] = touched

    @ti.func
    def stabilise(self):
        """Lines 11-14: move positions and estimates alike out of what they start in, which adds no velocity."""
        for i in range(self.body.count):
            if self.touched[i] > 0:
                x = self.body.position[i]
                change, active = tm.vec3(0.0), 0
                for s in ti.static(range(len(self.shapes))):
                    plane = self.plane[s, i]
                    depth = plane.w - plane.xyz.dot(x)
                    if depth > 0.0:
                        change += depth * plane.xyz
                        active += 1
                if active > 0:
                    change /= ti.cast(active, ti.f32)
                    self.body.position[i] = x + change
                    self.body.estimate[i] += change

    @ti.func
    def project(self, relaxation_factor: float):
        """Lines 18-20 for the contact group: pushes out of the shapes with their friction, averaged over the shapes."""
        for i in range(self.body.count):
            if self.touched[i] > 0:
                x = self.body.estimate[i]
                change, active = tm.vec3(0.0), 0
                for s in ti.static(range(len(self.shapes))):
                    plane = self.plane[s, i]
                    depth = ti.max(plane.w - plane.xyz.dot(x), 0.0)
                    pushed = depth > 0.0
                    if ti.static(self.rough):
                        pushed = pushed or self.push[s, i].w > 0.0
                    if pushed:
                        active += 1
                # A push beyond the surface would throw the particle off: averaging is undone, no more.
                share = ti.min(relaxation_factor / ti.cast(ti.max(active, 1), ti.f32), 1.0)
                for s in ti.static(range(len(self.shapes))):
                    plane = self.plane[s, i]
                    depth = share * ti.max(plane.w - plane.xyz.dot(x), 0.0)
                    change += depth * plane.xyz
                    if ti.static(self.rough):
                        change += self.rub(s, i, x, plane.xyz, depth, share)
                self.body.estimate[i] = x + change

    @ti.func
    def rub(self, s: ti.template(), i, x, normal, depth, share):
        """Friction's displacement of particle i by shape s, which pushes it by a further depth now.

        It opposes the motion along the surface since the start of the substep, relative to the shape's own (Macklin
        2014, Eq. 24), up to the coefficient times all of the normal push so far.
        """
        push = self.push[s, i]
        normal_push = push.w + depth
        change = tm.vec3(0.0)
        if normal_push > 0.0:
            slip = x - self.body.position[i] - self.shapes[s].motion(x)
            slip -= slip.dot(normal) * normal
            friction = push.xyz - share * slip
            limit = self.friction * normal_push
            length = friction.norm()
            if length > limit:
                friction *= limit / length
            change = friction - push.xyz
            self.push[s, i] = tm.vec4(friction, normal_push)
        return change

    @ti.func
    def finish(self):
        """End of a substep: leave no particle inside a shape, by exact projections of those that the averaging left there.

        Where shapes leave no room for the contact radius, its half, then the centre alone must be clear. Where they
        overlap, so that each sends a particle into the other, it leaves through that side of a tool which is free.
        """
        for i in range(self.body.count):
            x = self.body.estimate[i]
            radius = self.body.contact_radius[i]
            clear = 0
            for sweep in range(KEEP_OUT_SWEEPS):
                if clear == 0:
                    clear = 1
                    for s in ti.static(range(len(self.shapes))):
                        if not self.is_clear(s, i, x, radius):
                            near = self.shapes[s].surface(x)
                            if near.w < radius - ROUNDING:
                                x += (radius - near.w) * near.xyz
                                clear = 0
                    if sweep % 2 == 1:
                        radius = radius / 2 if sweep < KEEP_OUT_SWEEPS - 3 else 0.0
            if clear == 0:
                x = self.leave_by_a_free_side(x)
            self.body.estimate[i] = x

    @ti.func
    def leave_by_a_free_side(self, x):
        """The nearest point that is out of a tool through one of its sides, and out of every other shape as well."""
        best, least = x, FAR
        if self.depth_inside(x) > ROUNDING:
            for s in ti.static(range(len(self.shapes))):
                if ti.static(self.shapes[s].moves):
                    for k in range(self.shapes[s].count):
                        out = self.shapes[s].way_out(x, k)
                        if (out - x).norm() < least and self.depth_inside(out) <= ROUNDING:
                            best, least = out, (out - x).norm()
        return best

    @ti.func
    def depth_inside(self, x):
        """How deep x lies inside the shapes [mm]; negative outside."""
        depth = -FAR
        for s in ti.static(range(len(self.shapes))):
            depth = ti.max(depth, -self.shapes[s].surface(x).w)
        return depth

    @ti.kernel
    def measure_penetration(self) -> float:
        """Deepest a particle's centre lies inside a shape at the moment [mm], 0 where none does."""
        self.penetration[None] = 0.0
        for i in range(self.body.count):
            # The maximum of numbers does not depend on the order, so this atomic keeps runs alike.
            ti.atomic_max(self.penetration[None], self.depth_inside(self.body.position[i]))
        return self.penetration[None]
