"""Contacts of a body's surface with shapes: the penalty method at points of the surface, with Coulomb
friction.

The tissue model solves them together with its own forces (``node_force``), so that both are in equilibrium at
rest, however few iterations a step has. The laws are those of finite elements: pressure = depth x penalty
stiffness, and friction with elastic tangential slip, limited by the coefficient times the pressure (Wriggers
2006, ch. 5 and 10).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti
import taichi.math as tm

from sim.body import Body
from sim.fields import array_of, fill, fill_evenly, zeros
from sim.friction import sticking_fraction, tangential
from sim.kernels import kernel
from sim.lattice import Lattice
from sim.penetration_barrier import PenetrationBarrier
from sim.proxy import Proxy
from sim.shapes import FAR, ConvexTool, TimeOfImpact, check_count
from sim.surface_points import SurfacePoints

# Depth in a shape at which the contact pressure is Young's modulus.
PENALTY_DEPTH_MM = 0.05
# Tangential stiffness over normal stiffness.
TANGENTIAL_RATIO = 0.5
# A contact plane is reused until the point has moved this far; a shape of 4 mm radius is 0.003 mm off its
# plane there.
REUSE_MM = 0.15
# Points nearer than this to a shape may touch it within the step.
NEAR_MM = 3.0
# A point deeper in a tool than this, or that passes one on a longer path, leaves it by the side that it came
# by: the nearest side may be another one.
DEEP_MM = 1.0
# Forces are summed in blocks of this many points, in an order that does not depend on threads.
BLOCK = 64
# Distance around a static shape within which the distance to it must be known [mm].
REACH_MM = 6.0
# A point slides where its friction is at least this share of Coulomb's limit, known up to rounding.
SLIDING = 0.999
# A shape slips where more than this share of its contact slides.
SLIPS = 0.5


@dataclass(frozen=True)
class ContactLoad:
    """What a shape bears of the tissue in the last step.

    ``wrench`` (6,): force [N] on the shape, and its torque [N mm] about a point. ``sliding_share``: share of
    the contact that slides, by its normal force, 0 to 1. ``friction_ratio``: tangential over normal force,
    both summed over the contact points; the coefficient where all of them slide. Both are 0 without contact,
    and without friction.
    """

    wrench: np.ndarray
    sliding_share: float
    friction_ratio: float


class SurfaceContacts(SurfacePoints):
    """Contact points on the surface and their contacts; at most MOST_SHAPES shapes.

    plane (shapes, p): normal and offset of n . x >= offset [mm]. slip (shapes, p): elastic tangential slip
    [mm]. near (p,): bits of the shapes that are near. last_query (shapes, p): point and distance [mm] of the
    last distance query. ``stiffness`` [kPa/mm]: penalty stiffness; ``coefficient``: Coulomb's, where there
    was friction from the start: on all shapes, or where the ``support_is_smooth`` on those alone that move. A
    ``barrier`` keeps tools out between the points.
    """

    def __init__(
        self,
        body: Body,
        lattice: Lattice,
        points: np.ndarray,
        area_mm2: np.ndarray,
        shapes: list,
        friction: float,
        support_is_smooth: bool = False,
        barrier: PenetrationBarrier | None = None,
    ) -> None:
        check_count(shapes)
        super().__init__(body, lattice, points, area_mm2)
        self.shapes = list(shapes)
        self.time_of_impact = TimeOfImpact(shapes)
        self.coefficient, self.has_friction = friction, friction > 0
        self.is_rough = [self.has_friction and (shape.moves or not support_is_smooth) for shape in shapes]
        self.start = zeros(self.count, 3, within=1)
        self.near = zeros(self.count, kind=ti.i32)
        self.plane = zeros(len(shapes), self.count, 4, within=1)
        self.last_query = zeros(len(shapes), self.count, 4, within=1)
        # ``found`` and ``stick`` are the names in session files.
        self.state = dict(point=self.point, near=self.near, plane=self.plane, found=self.last_query)
        if self.has_friction:
            self.slip = zeros(len(shapes), self.count, 3, within=1)
            self.state["stick"] = self.slip
        self.barrier: Any = barrier
        self.has_barrier = barrier is not None
        if barrier is not None:
            self.state["barrier"] = barrier.block_load
        self.stiffness = 0.0
        self.penetration = zeros()
        self.blocks = -(-self.count // BLOCK)
        # Of each block: force [uN], torque [uN mm], and the normal, tangential and sliding normal force [uN].
        self.block_load = zeros(self.blocks, 9, within=1)
        self.reset()

    def set_stiffness(self, stiffness: float) -> None:
        """Change the penalty stiffness [kPa/mm]."""
        self.stiffness = stiffness
        if self.barrier is not None:
            self.barrier.stiffness = stiffness

    def set_points(self, lattice: Lattice, points: np.ndarray, area_mm2: np.ndarray) -> None:
        """Put the contact points at other places (p, 3) [mm] at rest, with other areas (p,) [mm^2]; those
        of another place lose their friction.
        """
        before = array_of(self.node), array_of(self.weight)
        super().set_points(lattice, points, area_mm2)
        if self.has_friction:
            now = array_of(self.node), array_of(self.weight)
            moved = np.any([(a != b).any(axis=1) for a, b in zip(before, now, strict=True)], axis=0)
            slip = array_of(self.slip)
            slip[:, moved] = 0.0
            fill((self.slip, slip))

    def reset(self) -> None:
        """Clear stored distances and friction; call it after other code has moved the body."""
        fill_evenly(self.last_query, -FAR)
        fill_evenly(self.near, 0)
        if self.barrier is not None:
            self.barrier.reset()
        if self.has_friction:
            fill_evenly(self.slip, 0.0)

    def snapshot(self) -> dict[str, np.ndarray]:
        """A copy of what persists from step to step: friction and contact planes."""
        return {name: array_of(field) for name, field in self.state.items()}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Restore a snapshot; the steps that follow give the same bits."""
        fill(*((self.state[name], values) for name, values in state.items()))

    @ti.func
    def find(self):
        """Lines 6-9: the contact planes of the shapes that each point's predicted position is near to."""
        if ti.static(self.has_barrier):
            self.barrier.find()
        for q in range(self.count):
            p, start = self.interpolated(self.body.predicted, q), self.interpolated(self.body.position, q)
            self.point[q], self.start[q] = p, start
            near = 0
            for s in ti.static(range(len(self.shapes))):
                if ti.static(self.shapes[s].moves):
                    near |= self.find_tool(s, q, p, start)
                else:
                    query = self.last_query[s, q]
                    if not is_known(query, p):
                        query = self.nearest(s, q, p)
                    if query.w - (p - query.xyz).norm() < NEAR_MM:
                        near |= 1 << s
            self.near[q] = near

    @ti.func
    def nearest(self, s: ti.template(), q, p):
        """Find the contact plane of shape s that is nearest to point q at p; return place and distance
        [mm].
        """
        surface = self.shapes[s].surface(p)
        query = tm.vec4(p, ti.min(surface.w, REACH_MM))
        self.last_query[s, q] = query
        self.plane[s, q] = tm.vec4(surface.xyz, surface.xyz.dot(p) - surface.w)
        return query

    @ti.func
    def find_tool(self, s: ti.template(), q, p, start):
        """Find the contact plane of a tool s, of point q on its path from a start to p; return the tool's bit
        where it is near.
        """
        path = (p - start - self.shapes[s].motion(p)).norm()
        before, depth, bit = self.plane[s, q], 0.0, 0
        if (self.near[q] >> s) & 1:
            depth = ti.max(before.w - before.xyz.dot(start), 0.0)
        if not self.shapes[s].is_beyond(p, NEAR_MM + path + depth):
            query = self.nearest(s, q, p)
            if query.w < NEAR_MM:
                bit = 1 << s
            plane = tm.vec4(0.0)
            if path > DEEP_MM:
                plane = self.shapes[s].entered(start, p, DEEP_MM)
            if depth > 0.0 and plane.xyz.norm_sqr() == 0.0:
                plane = self.still_passed(s, self.shapes[s].carried(before), p)
            if plane.xyz.norm_sqr() > 0.0:
                self.plane[s, q] = plane
                bit = 1 << s
        return bit

    @ti.func
    def still_passed(self, s: ti.template(), plane, p):
        """The contact plane of a point at p that was deep in tool s or behind it before, if it still is; else
        zero.
        """
        result, depth = tm.vec4(0.0), plane.w - plane.xyz.dot(p)
        if depth > DEEP_MM and ti.abs(self.shapes[s].surface(p + depth * plane.xyz).w) < DEEP_MM:
            result = plane
        return result

    @ti.func
    def free_fraction(self, start, end):
        """Fraction of a point's path that is free of shapes; 1 for paths so short that ``find`` sees the
        shapes.
        """
        return self.time_of_impact.fraction(start, end - start, NEAR_MM)

    @ti.func
    def depth(self, s: ti.template(), q):
        """Depth [mm] of point q in shape s, 0 without contact."""
        plane = self.plane[s, q]
        depth = ti.max(plane.w - plane.xyz.dot(self.point[q]), 0.0)
        return depth if (self.near[q] >> s) & 1 else 0.0

    @ti.func
    def tangential_slip(self, s: ti.template(), q, depth):
        """Elastic slip of point q on shape s, limited by friction (return mapping), and the fraction that
        is left.
        """
        normal = self.plane[s, q].xyz
        p = self.point[q]
        slip = tangential(self.slip[s, q] + p - self.start[q] - self.shapes[s].motion(p), normal)
        fraction = sticking_fraction(slip, self.coefficient * depth / TANGENTIAL_RATIO)
        return slip * fraction, fraction

    @ti.func
    def node_force(self, i):
        """Force [uN] of the shapes on node i, and its negative derivative (3, 3) by the node's position."""
        force, stiffness = tm.vec3(0.0), tm.mat3(0.0)
        if ti.static(self.has_barrier):
            force, stiffness = self.barrier.node_force(i)
        for k in range(self.node_start[i], self.node_start[i + 1]):
            q = self.node_point[k]
            near = self.near[q]
            if near > 0:
                p, weight = self.point[q], self.node_weight[k]
                for s in ti.static(range(len(self.shapes))):
                    plane = self.plane[s, q]
                    normal = plane.xyz
                    depth = plane.w - normal.dot(p)
                    if (near >> s) & 1 and depth > 0.0:
                        penalty = weight * 1e3 * self.stiffness * self.area[q]
                        force += penalty * depth * normal
                        tangential = 0.0
                        if ti.static(self.is_rough[s]):
                            slip, factor = self.tangential_slip(s, q, depth)
                            force -= penalty * TANGENTIAL_RATIO * slip
                            tangential = TANGENTIAL_RATIO * factor
                        stiffness += (
                            weight
                            * penalty
                            * ((1.0 - tangential) * normal.outer_product(normal) + tangential * tm.eye(3))
                        )
        return force, stiffness

    @ti.func
    def point_force(self, q, p, has_force):
        """Force [uN] on point q if it were at p, with the contact planes of the last substep, and its
        stiffness (3, 3).

        Without ``has_force``: no force, and the normal stiffness alone. Sliding points resist by friction
        over slip, which is more than the derivative: so Newton's method converges.
        """
        force, stiffness = tm.vec3(0.0), tm.mat3(0.0)
        near = self.near[q]
        for s in ti.static(range(len(self.shapes))):
            if (near >> s) & 1:
                plane = self.plane[s, q]
                normal = plane.xyz
                shift = p - self.shapes[s].motion(p)
                depth = plane.w - normal.dot(shift)
                # A plane that a tool only came near to may be beside the point by now.
                holds = self.depth(s, q) > 0.0 if ti.static(self.shapes[s].moves) else True
                if depth > 0.0 and holds:
                    penalty = 1e3 * self.stiffness * self.area[q]
                    stiffness += penalty * normal.outer_product(normal)
                    if has_force:
                        force += penalty * depth * normal
                        if ti.static(self.is_rough[s]):
                            slip = tangential(self.slip[s, q] + shift - self.point[q], normal)
                            factor = sticking_fraction(slip, self.coefficient * depth / TANGENTIAL_RATIO)
                            force -= penalty * TANGENTIAL_RATIO * factor * slip
                            stiffness += (
                                penalty
                                * TANGENTIAL_RATIO
                                * factor
                                * (tm.eye(3) - normal.outer_product(normal))
                            )
        return force, stiffness

    @ti.func
    def follow(self, i, change):
        """Move the points of node i with it. Nodes of one colour have no point in common."""
        if ti.static(self.has_barrier):
            self.barrier.follow(i, change)
        for k in range(self.node_start[i], self.node_start[i + 1]):
            q = self.node_point[k]
            self.point[q] = self.point[q] + self.node_weight[k] * change

    @ti.func
    def stabilise(self, iterations: int):
        """Nothing to do: the penalty force pushes out what starts inside a shape."""

    @ti.func
    def finish(self):
        """End of a substep: store the tangential slip."""
        if ti.static(self.has_barrier):
            self.barrier.finish()
        if ti.static(self.has_friction):
            for q in range(self.count):
                for s in ti.static(range(len(self.shapes))):
                    if ti.static(self.is_rough[s]):
                        slip = tm.vec3(0.0)
                        depth = self.depth(s, q)
                        if depth > 0.0:
                            slip, _ = self.tangential_slip(s, q, depth)
                        self.slip[s, q] = slip

    def proxy(self, tool: ConvexTool) -> Proxy:
        """The proxy of a tool; only with a barrier."""
        return self.barrier.proxy(tool)

    def load(self, shape: object, about: np.ndarray) -> ContactLoad:
        """The load of the tissue on a shape in the last step, with the torque about a point (3,) [mm].

        Its forces balance those in the tissue, friction included.
        """
        self._sum_forces(self.shapes.index(shape), *about.tolist())
        total = 1e-6 * array_of(self.block_load).sum(axis=0, dtype=np.float64)
        if self.barrier is not None and shape in self.barrier.tools:
            force, torque, size = np.split(self.barrier.load(shape), (3, 6))
            total[:7] += np.concatenate([force, torque - np.cross(about, force), size])
        normal, tangential, sliding = total[6:].tolist()
        if normal == 0.0:
            return ContactLoad(-total[:6], 0.0, 0.0)
        return ContactLoad(-total[:6], sliding / normal, tangential / normal)

    @kernel
    def _sum_forces(self, s: ti.template(), x: float, y: float, z: float):
        """The forces of shape s on the points of each block, as in ``block_load``."""
        for block in range(self.blocks):
            force, torque, sizes = tm.vec3(0.0), tm.vec3(0.0), tm.vec3(0.0)
            for q in range(block * BLOCK, ti.min((block + 1) * BLOCK, self.count)):
                depth = self.depth(s, q)
                if depth > 0.0:
                    penalty = 1e3 * self.stiffness * self.area[q]
                    pressure = depth * self.plane[s, q].xyz
                    friction = 0.0
                    if ti.static(self.has_friction):
                        pressure -= TANGENTIAL_RATIO * self.slip[s, q]
                        friction = TANGENTIAL_RATIO * self.slip[s, q].norm()
                    slides = friction > SLIDING * self.coefficient * depth
                    at_point = penalty * pressure
                    force += at_point
                    torque += (self.point[q] - tm.vec3(x, y, z)).cross(at_point)
                    sizes += penalty * tm.vec3(depth, friction, depth if slides else 0.0)
            for k in ti.static(range(3)):
                self.block_load[block][k], self.block_load[block][k + 3] = force[k], torque[k]
                self.block_load[block][k + 6] = sizes[k]

    @kernel
    def measure_penetration(self) -> float:
        """Largest depth [mm] of a point of the surface in a shape, 0 without penetration."""
        self.penetration[None] = 0.0
        for q in range(self.count):
            p = self.interpolated(self.body.position, q)
            for s in ti.static(range(len(self.shapes))):
                # A maximum does not depend on the order, so this atomic is deterministic.
                ti.atomic_max(self.penetration[None], -self.shapes[s].surface(p).w)
        return self.penetration[None]


@ti.func
def is_known(query, p):
    """Whether the last distance query of a point, its place and distance [mm], is still valid at p."""
    moved = (p - query.xyz).norm()
    return query.w - moved > NEAR_MM or (moved < REUSE_MM and query.w > -FAR)
