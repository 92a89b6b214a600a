"""Contacts of particles with shapes and their Coulomb friction, found once a substep and never left
violated.
"""

import numpy as np
import taichi as ti
import taichi.math as tm

from sim.body import ParticleBody
from sim.fields import array_of, fill, fill_evenly, zeros
from sim.friction import sticking_fraction, tangential
from sim.kernels import kernel
from sim.proxy import Proxy
from sim.shapes import FAR, ConvexTool, TimeOfImpact, check_count

PROJECTION_ITERATIONS = 8
# Distance around a static shape within which the distance to it must be known, in particle radii.
REACH_RADII = 2.0
# Tolerance of distances [mm]: float32 positions of a body of 200 mm round to about 1e-5 mm.
ROUNDING = 1e-4
# A contact plane is exact within this distance of where it was found: a shape of 2 mm radius is ROUNDING off
# its plane there.
EXACT_MM = 0.02
SAFETY = 1e-3


class ShapeContacts:
    """Contact planes of each particle with each shape, and the displacements by contact in this substep.

    ``plane`` (n, shapes): normal and offset of the nearest surface, n . x = offset [mm]; that of a static
    shape is reused while the particle is near to the ``last_query`` (n, shapes) of its distance: point and
    distance [mm]. ``touched`` (n,): bits of the shapes that may be touched in this substep. ``push`` (n,
    shapes): displacement by friction (x, y, z) and along the normal (w) so far [mm]. The clusters conserve
    momentum, so the sums of the displacements are the impulses exchanged with the shape, and Coulomb's law
    applies to them: |friction| <= coefficient * normal. With coefficient 0, ``push`` does not exist.
    """

    # A proxy tests each particle by itself.
    block = 1

    def __init__(self, body: ParticleBody, shapes: list, friction: float) -> None:
        check_count(shapes)
        self.body = body
        self.shapes = list(shapes)
        self.time_of_impact = TimeOfImpact(shapes)
        self.friction, self.has_friction = friction, friction > 0
        self.margin = body.radius_mm / 2
        self.reuse_mm = body.radius_mm / 4
        # Distances beyond the reach of a shape are unknown, so no larger distance is stored.
        self.reach = REACH_RADII * body.radius_mm
        self.plane = zeros(body.count, len(shapes), 4, within=1)
        if self.has_friction:
            self.push = zeros(body.count, len(shapes), 4, within=1)
        self.count = body.count
        self.touched = zeros(body.count, kind=ti.i32)
        self.last_query = zeros(body.count, len(shapes), 4, within=1)
        self.reset()
        self.penetration = zeros()

    def reset(self) -> None:
        """Clear stored distances; call it after other code has moved the particles."""
        fill_evenly(self.last_query, -FAR)

    def snapshot(self) -> dict[str, np.ndarray]:
        """A copy of what persists from step to step: contact planes, and where they were found."""
        # Session files name the last query so.
        return dict(plane=array_of(self.plane), found=array_of(self.last_query))

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Restore a snapshot; the steps that follow give the same bits."""
        fill((self.plane, state["plane"]), (self.last_query, state["found"]))

    def proxy(self, tool: ConvexTool) -> Proxy:
        """The proxy of a tool."""
        return Proxy(self, tool)

    @ti.func
    def surface_ball(self, i):
        """Particle i, and its radius [mm]."""
        return tm.vec4(self.body.position[i], self.body.contact_radius[i])

    @ti.func
    def block_ball(self, i):
        """A ball with particle i in it: middle and radius [mm]."""
        return self.surface_ball(i)

    @ti.func
    def is_clear(self, s: ti.template(), i, p, distance):
        """Whether particle i, at p, is farther than a distance from shape s, as far as a quick test can
        tell.
        """
        result = False
        if ti.static(self.shapes[s].moves):
            result = self.shapes[s].is_beyond(p, distance)
        else:
            known = self.last_query[i, s]
            slack = known.w - distance - SAFETY
            result = slack > 0.0 and (p - known.xyz).norm_sqr() < slack * slack
        return result

    @ti.func
    def nearest(self, s: ti.template(), i, p, reuse_mm: float):
        """Normal and distance of shape s from particle i, at p, by the stored plane if it was found within
        ``reuse_mm``.
        """
        result = tm.vec4(0.0)
        if ti.static(self.shapes[s].moves):
            result = self.shapes[s].surface(p)
        else:
            if (p - self.last_query[i, s].xyz).norm_sqr() > reuse_mm * reuse_mm:
                near = self.shapes[s].surface(p)
                self.last_query[i, s] = tm.vec4(p, ti.min(near.w, self.reach))
                self.plane[i, s] = tm.vec4(near.xyz, near.xyz.dot(p) - near.w + self.body.contact_radius[i])
            plane = self.plane[i, s]
            result = tm.vec4(plane.xyz, plane.xyz.dot(p) - plane.w + self.body.contact_radius[i])
        return result

    @ti.func
    def find(self):
        """Lines 6-9: the shapes that each particle's predicted position is near to; fast particles stop at
        the first on their path.
        """
        for i in range(self.body.count):
            p = self.path_end(self.body.position[i], self.body.predicted[i])
            self.body.predicted[i] = p
            reach = self.body.contact_radius[i] + self.margin
            touched = 0
            for s in ti.static(range(len(self.shapes))):
                if not self.is_clear(s, i, p, reach):
                    near = self.nearest(s, i, p, self.reuse_mm)
                    if near.w < reach:
                        touched |= 1 << s
                        if ti.static(self.shapes[s].moves):
                            self.plane[i, s] = tm.vec4(
                                near.xyz, near.xyz.dot(p) - near.w + self.body.contact_radius[i]
                            )
                        if ti.static(self.has_friction):
                            self.push[i, s] = tm.vec4(0.0)
            self.touched[i] = touched

    @ti.func
    def path_end(self, start, end):
        """End of a particle's path; where a path longer than the radius meets a static shape, the point of
        impact.
        """
        path, most = end - start, self.body.radius_mm
        if path.norm_sqr() > most * most:
            path *= self.time_of_impact.fraction(start, path, most)
        return start + path

    @ti.func
    def depth(self, s: ti.template(), i, x):
        """Depth [mm] of particle i, at x, below the contact plane of shape s; negative outside."""
        plane = self.plane[i, s]
        depth = plane.w - plane.xyz.dot(x)
        return depth if (self.touched[i] >> s) & 1 else -FAR

    @ti.func
    def stabilise(self, iterations: int):
        """Lines 10-15: move positions and predicted positions together out of shapes, which adds no
        velocity.
        """
        for i in range(self.body.count):
            if self.touched[i] > 0:
                x, moved = self.body.position[i], tm.vec3(0.0)
                for _ in range(iterations):
                    change, active = tm.vec3(0.0), 0
                    for s in ti.static(range(len(self.shapes))):
                        depth = self.depth(s, i, x + moved)
                        if depth > 0.0:
                            change += depth * self.plane[i, s].xyz
                            active += 1
                    moved += change / ti.cast(ti.max(active, 1), ti.f32)
                self.body.position[i] = x + moved
                self.body.predicted[i] = self.body.predicted[i] + moved

    @ti.func
    def pushed(self, i, x, relaxation_factor: float):
        """Displacement [mm] of particle i, at x, by contact and friction, averaged over the shapes (lines
        18-20).
        """
        touched, active = self.touched[i], 1
        if touched & (touched - 1) != 0:
            pushing = 0
            for s in ti.static(range(len(self.shapes))):
                pushing += ti.cast(self.pushes(s, i, x), ti.i32)
            active = ti.max(pushing, 1)
        # Over-relaxation only compensates for averaging: beyond the surface it would throw the particle off.
        factor = ti.min(relaxation_factor / ti.cast(active, ti.f32), 1.0)
        change = tm.vec3(0.0)
        for s in ti.static(range(len(self.shapes))):
            if (touched >> s) & 1:
                normal = self.plane[i, s].xyz
                depth = factor * ti.max(self.depth(s, i, x), 0.0)
                change += depth * normal
                if ti.static(self.has_friction):
                    change += self.friction_change(s, i, x, normal, depth, factor)
        return change

    @ti.func
    def pushes(self, s: ti.template(), i, x):
        """Whether shape s displaces particle i, at x, or has done so in this substep."""
        result = self.depth(s, i, x) > 0.0
        if ti.static(self.has_friction):
            result |= (self.touched[i] >> s) & 1 and self.push[i, s].w > 0.0
        return result

    @ti.func
    def friction_change(self, s: ti.template(), i, x, normal, depth, factor):
        """Displacement of particle i by friction on shape s, which displaces it by ``depth`` along the
        normal.

        It opposes the tangential motion since the start of the substep, relative to the shape's motion
        (Macklin et al. 2014, Eq. 24), up to the coefficient times the total normal displacement.
        """
        push = self.push[i, s]
        normal_push = push.w + depth
        change = tm.vec3(0.0)
        if normal_push > 0.0:
            slip = tangential(x - self.body.position[i] - self.shapes[s].motion(x), normal)
            friction = push.xyz - factor * slip
            friction *= sticking_fraction(friction, self.friction * normal_push)
            change = friction - push.xyz
            self.push[i, s] = tm.vec4(friction, normal_push)
        return change

    @ti.func
    def finish(self):
        """End of a substep: project out of the shapes every particle that is still inside one.

        Where the gap between shapes is too narrow for the contact radius, half of it, then the centre alone
        must be outside. Where shapes overlap, so that each projects a particle into the other, it leaves
        through a free side of a tool.
        """
        for i in range(self.body.count):
            self.body.predicted[i] = self.projected_out(i, self.body.predicted[i])

    @ti.func
    def projected_out(self, i, x):
        """Position of particle i outside all shapes, projected from x."""
        radius = self.body.contact_radius[i]
        clear = False
        for iteration in range(PROJECTION_ITERATIONS):
            if not clear:
                clear = True
                for s in ti.static(range(len(self.shapes))):
                    if not self.is_clear(s, i, x, radius):
                        near = self.nearest(s, i, x, EXACT_MM)
                        if near.w < radius - ROUNDING:
                            x += (radius - near.w) * near.xyz
                            clear = False
                if iteration % 2 == 1:
                    radius = radius / 2 if iteration < PROJECTION_ITERATIONS - 3 else 0.0
        if not clear:
            x = self.projected_through_free_side(x)
        return x

    @ti.func
    def projected_through_free_side(self, x):
        """The nearest point outside one of a tool's half-spaces that is outside all shapes; x itself if
        there is none.
        """
        best, least = x, FAR
        if self.depth_inside(x) > ROUNDING:
            for s in ti.static(range(len(self.shapes))):
                if ti.static(self.shapes[s].moves):
                    for k in range(self.shapes[s].count):
                        out = self.shapes[s].outside(x, k)
                        if (out - x).norm() < least and self.depth_inside(out) <= ROUNDING:
                            best, least = out, (out - x).norm()
        return best

    @ti.func
    def depth_inside(self, x):
        """Depth [mm] of x inside the shapes; negative outside."""
        depth = -FAR
        for s in ti.static(range(len(self.shapes))):
            depth = ti.max(depth, -self.shapes[s].surface(x).w)
        return depth

    @kernel
    def measure_penetration(self) -> float:
        """Largest depth [mm] of a particle's centre in a shape, 0 without penetration."""
        self.penetration[None] = 0.0
        for i in range(self.body.count):
            # A maximum does not depend on the order, so this atomic is deterministic.
            ti.atomic_max(self.penetration[None], self.depth_inside(self.body.position[i]))
        return self.penetration[None]
