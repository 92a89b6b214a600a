"""Contacts of a body's surface with shapes: a stiff layer on points of the surface, with Coulomb friction.

The tissue model solves them together with its own forces (``push``), so that where it comes to rest both are in
balance, however few iterations it was given. Laws as in finite elements: pressure = depth x stiffness, friction by
an elastic stick that slides at the coefficient times the pressure (Wriggers 2006, ch. 5 and 10).
"""

import numpy as np
import taichi as ti
import taichi.math as tm

from sim.body import Body
from sim.fields import array_of, fields_of, fill
from sim.lattice import Lattice
from sim.shapes import FAR, TimeOfImpact

# A pressure as high as Young's modulus presses the surface this far into a shape.
PENALTY_DEPTH_MM = 0.05
# Along a surface the layer is softer than into it by this factor.
STICK = 0.5
# A plane is kept until the point has moved this far; a shape of 4 mm radius leaves it by 0.003 mm there.
FRESH_MM = 0.15
# Points as far as this from a shape may touch it within the step.
NEAR_MM = 3.0
# How far around a static shape its distances must be known [mm].
REACH_MM = 6.0


@ti.data_oriented
class SurfaceContacts:
    """Points on the surface, each carried by 8 nodes, and what they touch; at most 31 shapes.

    point (p,): where they are [mm]. plane (shapes, p): normal and offset of n . x >= offset [mm]. stick (shapes, p):
    how far the elastic stick is bent [mm]. near (p,): bits of the shapes that are. ``stiffness`` [kPa/mm] of the layer.
    """

    def __init__(
        self,
        body: Body,
        lattice: Lattice,
        points: np.ndarray,
        area_mm2: np.ndarray,
        shapes: list,
        friction: float,
    ) -> None:
        self.body = body
        self.shapes = list(shapes)
        self.free_way = TimeOfImpact(shapes)
        self.friction = friction
        self.rough = friction > 0
        self.count = len(points)
        nodes, weights = lattice.interpolation(points)
        self.point = ti.Vector.field(3, ti.f32, self.count)
        self.start = ti.Vector.field(3, ti.f32, self.count)
        self.near = ti.field(ti.i32, self.count)
        self.node, self.weight = fields_of(nodes, weights, within=1)
        self.area, self.listed_from, self.listed, self.listed_weight = fields_of(
            area_mm2, *_by_node(nodes, weights, body.count)
        )
        self.plane = ti.Vector.field(4, ti.f32, (len(shapes), self.count))
        self.found = ti.Vector.field(4, ti.f32, (len(shapes), self.count))
        if self.rough:
            self.stick = ti.Vector.field(3, ti.f32, (len(shapes), self.count))
        self.remembered = ("point", "near", "plane", "found") + ("stick",) * self.rough
        self.stiffness = ti.field(ti.f32, ())
        self.penetration = ti.field(ti.f32, ())
        self.reset()

    def reset(self) -> None:
        """Drop what is known of distances and of friction, after the body was moved by another hand."""
        self.found.fill(-FAR)
        self.near.fill(0)
        if self.rough:
            self.stick.fill(0.0)

    def snapshot(self) -> dict[str, np.ndarray]:
        """What it carries from step to step: friction, and the planes that were found."""
        return {name: array_of(getattr(self, name)) for name in self.remembered}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Go back to a snapshot; the steps that follow give the same bits."""
        fill(*((getattr(self, name), values) for name, values in state.items()))

    @ti.func
    def carried(self, field: ti.template(), q):
        """Where point q is when the nodes are at a field's positions."""
        x = tm.vec3(0.0)
        for k in ti.static(range(8)):
            x += self.weight[q][k] * field[self.node[q][k]]
        return x

    @ti.func
    def find(self):
        """Lines 6-9: the plane of each shape that a point's predicted position is near to."""
        for q in range(self.count):
            p = self.carried(self.body.predicted, q)
            self.point[q] = p
            self.start[q] = self.carried(self.body.position, q)
            near = 0
            for s in ti.static(range(len(self.shapes))):
                if ti.static(self.shapes[s].moves) or not self.is_known(s, q, p):
                    surface = self.shapes[s].surface(p)
                    self.plane[s, q] = tm.vec4(surface.xyz, surface.xyz.dot(p) - surface.w)
                    self.found[s, q] = tm.vec4(p, ti.min(surface.w, REACH_MM))
                if self.found[s, q].w - (p - self.found[s, q].xyz).norm() < NEAR_MM:
                    near |= 1 << s
            self.near[q] = near

    @ti.func
    def free_share(self, start, end):
        """Share of a point's way that it can go until it meets a shape; ways within which shapes are found are free."""
        return self.free_way.share(start, end - start, NEAR_MM)

    @ti.func
    def is_known(self, s: ti.template(), q, p):
        """Whether what was last measured from point q to shape s still holds at p."""
        known = self.found[s, q]
        moved = (p - known.xyz).norm()
        return known.w - moved > NEAR_MM or (moved < FRESH_MM and known.w > -FAR)

    @ti.func
    def touching(self, s: ti.template(), q):
        """Depth [mm] of point q in shape s, 0 where it does not touch."""
        plane = self.plane[s, q]
        depth = ti.max(plane.w - plane.xyz.dot(self.point[q]), 0.0)
        return depth if (self.near[q] >> s) & 1 else 0.0

    @ti.func
    def bent(self, s: ti.template(), q, depth):
        """The stick of point q on shape s, sliding where it must (return mapping), and whether it holds."""
        normal = self.plane[s, q].xyz
        p = self.point[q]
        stick = self.stick[s, q] + p - self.start[q] - self.shapes[s].motion(p)
        stick -= stick.dot(normal) * normal
        most = self.friction * depth / STICK
        length = stick.norm()
        share = most / ti.max(length, 1e-12)
        return stick * ti.min(share, 1.0), ti.min(share, 1.0)

    @ti.func
    def push(self, i):
        """Force [uN] of the shapes on node i, and its negative derivative (3, 3) by the node's position."""
        force, stiffness = tm.vec3(0.0), tm.mat3(0.0)
        for k in range(self.listed_from[i], self.listed_from[i + 1]):
            q = self.listed[k]
            if self.near[q] > 0:
                weight = self.listed_weight[k]
                layer = weight * 1e3 * self.stiffness[None] * self.area[q]
                for s in ti.static(range(len(self.shapes))):
                    depth = self.touching(s, q)
                    if depth > 0.0:
                        normal = self.plane[s, q].xyz
                        force += layer * depth * normal
                        along = 0.0
                        if ti.static(self.rough):
                            stick, holds = self.bent(s, q, depth)
                            force -= layer * STICK * stick
                            along = STICK * holds
                        stiffness += (
                            weight
                            * layer
                            * ((1.0 - along) * normal.outer_product(normal) + along * tm.eye(3))
                        )
        return force, stiffness

    @ti.func
    def hold(self, q, p, pushing):
        """Force [uN] on point q if it were at p, on the planes that the last substep knew, and its stiffness; where it is not
        ``pushing``, no force, and the stiffness into and off the shapes alone.

        What slides resists by its friction over its way, which is more than the derivative: then Newton's steps converge.
        """
        force, stiffness = tm.vec3(0.0), tm.mat3(0.0)
        if self.near[q] > 0:
            layer = 1e3 * self.stiffness[None] * self.area[q]
            for s in ti.static(range(len(self.shapes))):
                plane = self.plane[s, q]
                normal = plane.xyz
                shift = p - self.shapes[s].motion(p)
                depth = plane.w - normal.dot(shift)
                if (self.near[q] >> s) & 1 and depth > 0.0:
                    stiffness += layer * normal.outer_product(normal)
                    if pushing:
                        force += layer * depth * normal
                        if ti.static(self.rough):
                            stick = self.stick[s, q] + shift - self.point[q]
                            stick -= stick.dot(normal) * normal
                            length = ti.max(stick.norm(), 1e-12)
                            share = ti.min(self.friction * depth / STICK / length, 1.0)
                            force -= layer * STICK * share * stick
                            stiffness += layer * STICK * share * (tm.eye(3) - normal.outer_product(normal))
        return force, stiffness

    @ti.func
    def follow(self, i, change):
        """Carry the points of node i along when it moves. Nodes of one colour have no point in common."""
        for k in range(self.listed_from[i], self.listed_from[i + 1]):
            q = self.listed[k]
            self.point[q] = self.point[q] + self.listed_weight[k] * change

    @ti.func
    def stabilise(self, iterations: int):
        """Nothing to do: what starts inside a shape is pushed out by the layer's force."""

    @ti.func
    def finish(self):
        """End of a substep: how far the sticks are bent is remembered."""
        if ti.static(self.rough):
            for q in range(self.count):
                for s in ti.static(range(len(self.shapes))):
                    stick = tm.vec3(0.0)
                    depth = self.touching(s, q)
                    if depth > 0.0:
                        stick, _ = self.bent(s, q, depth)
                    self.stick[s, q] = stick

    @ti.kernel
    def measure_penetration(self) -> float:
        """Deepest a point of the surface lies inside a shape at the moment [mm], 0 where none does."""
        self.penetration[None] = 0.0
        for q in range(self.count):
            p = self.carried(self.body.position, q)
            for s in ti.static(range(len(self.shapes))):
                # The maximum of numbers does not depend on the order, so this atomic keeps runs alike.
                ti.atomic_max(self.penetration[None], -self.shapes[s].surface(p).w)
        return self.penetration[None]


def _by_node(nodes: np.ndarray, weights: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (n, 8) by their nodes: where each node's points begin in a list, that list, and their weights in it."""
    order = np.argsort(nodes.ravel(), kind="stable")
    begins = np.searchsorted(nodes.ravel()[order], np.arange(count + 1))
    return begins, order // 8, weights.ravel()[order]
