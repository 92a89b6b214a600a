"""Contacts of particles with shapes: found once a substep, solved with Coulomb friction, never left violated."""

import numpy as np
import taichi as ti
import taichi.math as tm

from sim.body import ParticleBody
from sim.fields import array_of, fill
from sim.shapes import FAR, TimeOfImpact

KEEP_OUT_SWEEPS = 8
# How far around a static shape its distances must be known, in particle radii.
REACH_RADII = 2.0
# Float32 positions of a body of 200 mm carry about 1e-5 mm; distances are compared with room for that.
ROUNDING = 1e-4
# A plane is as good as the shape itself so far around where it was found: a shape of 2 mm radius leaves it by ROUNDING there.
EXACT_MM = 0.02
SAFETY = 1e-3


@ti.data_oriented
class ShapeContacts:
    """Contact planes of each particle with each shape, and the push that each has given in this substep.

    ``plane`` (n, shapes): normal and offset of the nearest surface, n . x = offset [mm]; of a shape that does not move
    it is kept while the particle stays near to where it was ``found`` (n, shapes), a point and its distance [mm].
    ``touched`` (n,): bits of the shapes that may be touched in this substep. ``push`` (n, shapes): friction (x, y, z) and
    normal (w) displacement so far [mm]. As the clusters keep momentum, the sums of the pushes are the impulses
    exchanged with the shape, so Coulomb's law holds for them: |friction| <= coefficient * normal. A coefficient of 0
    takes no memory for pushes and no time.
    """

    def __init__(self, body: ParticleBody, shapes: list, friction: float) -> None:
        self.body = body
        self.shapes = list(shapes)
        self.free_way = TimeOfImpact(shapes)
        self.friction = friction
        self.rough = friction > 0
        self.margin = body.radius_mm / 2
        self.fresh = body.radius_mm / 4
        # A shape knows no distances beyond its reach, so "farther than that" is all that can be remembered.
        self.reach = REACH_RADII * body.radius_mm
        parts = {"plane": tm.vec4, "push": tm.vec4} if self.rough else {"plane": tm.vec4}
        self.contact = ti.Struct.field(parts, shape=(body.count, len(shapes)))
        self.touched = ti.field(ti.i32, body.count)
        self.found = ti.Vector.field(4, ti.f32, (body.count, len(shapes)))
        self.reset()
        self.penetration = ti.field(ti.f32, ())

    def reset(self) -> None:
        """Drop what is known of the particles' distances, after they were moved by another hand."""
        self.found.fill(-FAR)

    def snapshot(self) -> dict[str, np.ndarray]:
        """What it carries from step to step: planes, and where they were found."""
        return dict(plane=array_of(self.contact.plane), found=array_of(self.found))

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Go back to a snapshot; the steps that follow give the same bits."""
        fill((self.contact.plane, state["plane"]), (self.found, state["found"]))

    @ti.func
    def is_clear(self, s: ti.template(), i, p, distance):
        """Whether it is known at once that p, where particle i is, is farther than a distance from shape s."""
        result = False
        if ti.static(self.shapes[s].moves):
            result = self.shapes[s].is_beyond(p, distance)
        else:
            known = self.found[i, s]
            room = known.w - distance - SAFETY
            result = room > 0.0 and (p - known.xyz).norm_sqr() < room * room
        return result

    @ti.func
    def nearest(self, s: ti.template(), i, p, fresh: float):
        """Normal and distance of shape s from p, where particle i is; from memory if it was measured within ``fresh`` [mm]."""
        result = tm.vec4(0.0)
        if ti.static(self.shapes[s].moves):
            result = self.shapes[s].surface(p)
        else:
            if (p - self.found[i, s].xyz).norm_sqr() > fresh * fresh:
                near = self.shapes[s].surface(p)
                self.found[i, s] = tm.vec4(p, ti.min(near.w, self.reach))
                self.contact[i, s].plane = tm.vec4(
                    near.xyz, near.xyz.dot(p) - near.w + self.body.contact_radius[i]
                )
            plane = self.contact[i, s].plane
            result = tm.vec4(plane.xyz, plane.xyz.dot(p) - plane.w + self.body.contact_radius[i])
        return result

    @ti.func
    def find(self):
        """Lines 6-9: the shapes that each particle's predicted position is near to; none goes through one by its speed."""
        for i in range(self.body.count):
            p = self.halted(self.body.position[i], self.body.predicted[i])
            self.body.predicted[i] = p
            reach = self.body.contact_radius[i] + self.margin
            touched = 0
            for s in ti.static(range(len(self.shapes))):
                if not self.is_clear(s, i, p, reach):
                    near = self.nearest(s, i, p, self.fresh)
                    if near.w < reach:
                        touched |= 1 << s
                        if ti.static(self.shapes[s].moves):
                            self.contact[i, s].plane = tm.vec4(
                                near.xyz, near.xyz.dot(p) - near.w + self.body.contact_radius[i]
                            )
                        if ti.static(self.rough):
                            self.contact[i, s].push = tm.vec4(0.0)
            self.touched[i] = touched

    @ti.func
    def halted(self, start, end):
        """The end of a particle's way, or, of a long one that meets a shape, where it does."""
        way, most = end - start, self.body.radius_mm
        if way.norm_sqr() > most * most:
            way *= self.free_way.share(start, way, most)
        return start + way

    @ti.func
    def depth(self, s: ti.template(), i, x):
        """How deep particle i, at x, is in the plane of shape s [mm]; less than 0 outside."""
        plane = self.contact[i, s].plane
        depth = plane.w - plane.xyz.dot(x)
        return depth if (self.touched[i] >> s) & 1 else -FAR

    @ti.func
    def stabilise(self, iterations: int):
        """Lines 10-15: move positions and estimates alike out of what they start in, which adds no velocity."""
        for i in range(self.body.count):
            if self.touched[i] > 0:
                x, moved = self.body.position[i], tm.vec3(0.0)
                for _ in range(iterations):
                    change, active = tm.vec3(0.0), 0
                    for s in ti.static(range(len(self.shapes))):
                        depth = self.depth(s, i, x + moved)
                        if depth > 0.0:
                            change += depth * self.contact[i, s].plane.xyz
                            active += 1
                    moved += change / ti.cast(ti.max(active, 1), ti.f32)
                self.body.position[i] = x + moved
                self.body.predicted[i] = self.body.predicted[i] + moved

    @ti.func
    def pushed(self, i, x, relaxation_factor: float):
        """How far the shapes push particle i, at x, with their friction, averaged over the shapes [mm] (lines 18-20)."""
        touched, active = self.touched[i], 1
        if touched & (touched - 1) != 0:
            pushing = 0
            for s in ti.static(range(len(self.shapes))):
                pushing += ti.cast(self.pushes(s, i, x), ti.i32)
            active = ti.max(pushing, 1)
        # A push beyond the surface would throw the particle off: averaging is undone, no more.
        share = ti.min(relaxation_factor / ti.cast(active, ti.f32), 1.0)
        change = tm.vec3(0.0)
        for s in ti.static(range(len(self.shapes))):
            if (touched >> s) & 1:
                normal = self.contact[i, s].plane.xyz
                depth = share * ti.max(self.depth(s, i, x), 0.0)
                change += depth * normal
                if ti.static(self.rough):
                    change += self.rub(s, i, x, normal, depth, share)
        return change

    @ti.func
    def pushes(self, s: ti.template(), i, x):
        """Whether shape s pushes particle i, at x, or has done so in this substep."""
        result = self.depth(s, i, x) > 0.0
        if ti.static(self.rough):
            result |= (self.touched[i] >> s) & 1 and self.contact[i, s].push.w > 0.0
        return result

    @ti.func
    def rub(self, s: ti.template(), i, x, normal, depth, share):
        """Friction's displacement of particle i by shape s, which pushes it by a further depth now.

        It opposes the motion along the surface since the start of the substep, relative to the shape's own (Macklin
        2014, Eq. 24), up to the coefficient times all of the normal push so far.
        """
        push = self.contact[i, s].push
        normal_push = push.w + depth
        change = tm.vec3(0.0)
        if normal_push > 0.0:
            slip = x - self.body.position[i] - self.shapes[s].motion(x)
            slip -= slip.dot(normal) * normal
            friction = push.xyz - share * slip
            limit = self.friction * normal_push
            squared = friction.norm_sqr()
            if squared > limit * limit:
                friction *= limit / ti.sqrt(squared)
            change = friction - push.xyz
            self.contact[i, s].push = tm.vec4(friction, normal_push)
        return change

    @ti.func
    def finish(self):
        """End of a substep: leave no particle inside a shape, by exact projections of those that the averaging left there.

        Where shapes leave no room for the contact radius, its half, then the centre alone must be clear. Where they
        overlap, so that each sends a particle into the other, it leaves through that side of a tool which is free.
        """
        for i in range(self.body.count):
            if not self.is_clear_of_all(i, self.body.predicted[i]):
                self.body.predicted[i] = self.kept_out(i, self.body.predicted[i])

    @ti.func
    def is_clear_of_all(self, i, x):
        """Whether it costs next to nothing to tell that particle i touches no shape from x."""
        result = True
        for s in ti.static(range(len(self.shapes))):
            result = result and self.is_clear(s, i, x, self.body.contact_radius[i])
        return result

    @ti.func
    def kept_out(self, i, x):
        """The place outside all shapes that particle i goes to from x."""
        radius = self.body.contact_radius[i]
        clear = False
        for sweep in range(KEEP_OUT_SWEEPS):
            if not clear:
                clear = True
                for s in ti.static(range(len(self.shapes))):
                    if not self.is_clear(s, i, x, radius):
                        near = self.nearest(s, i, x, EXACT_MM)
                        if near.w < radius - ROUNDING:
                            x += (radius - near.w) * near.xyz
                            clear = False
                if sweep % 2 == 1:
                    radius = radius / 2 if sweep < KEEP_OUT_SWEEPS - 3 else 0.0
        if not clear:
            x = self.leave_by_a_free_side(x)
        return x

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
