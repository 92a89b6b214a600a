"""A barrier that keeps the edges of a tool out of the tissue between the contact points.

Contact points are the quadrature of the pressure, half an element apart: between them an edge or a corner of
a tool can be millimetres deep in the surface. The barrier has many more points. They touch a slightly smaller
tool with rounder edges, without friction: presses that the contact points bear alone stay as they are.
"""

import numpy as np
import taichi as ti
import taichi.math as tm

from sim.body import Body
from sim.fields import array_of, fill, fill_evenly, zeros
from sim.lattice import Lattice
from sim.proxy import Proxy
from sim.shapes import ConvexTool
from sim.surface_points import SurfacePoints

# Spacing of the points.
BARRIER_SPACING_MM = 0.7
# How far the smaller tool's faces are inside the tool, in widths of a cell: wide elements follow its edges
# less. With less, the barrier would bear a part of presses that are right without it (docs/accuracy.md).
INSET_CELLS = 0.09
# Least radius of the smaller tool's edges. At sharp ones the direction of the force would jump, and the
# tissue never come to rest.
RADIUS_MM = 1.5
# Penalty stiffness over that of the contact points: an edge is borne by few points.
STIFFNESS_RATIO = 4.0
# Points farther outside the smaller tool than this do not get into it within a step.
NEAR_MM = 0.8
# Points are tested, and their forces summed, in blocks of this many neighbours.
BLOCK = 16
# In strained tissue, points of a block may be so much farther from its middle than at rest.
STRETCH = 1.8


class PenetrationBarrier(SurfacePoints):
    """Points on the surface, and the tools that they are near to.

    plane (tools, p): normal and offset of n . x >= offset [mm]. near (p,): bits of the tools that are near.
    active (n,): whether a node has such a point. Neighbouring points are a block: middle (b,): the point in
    its middle; reach (b,): how far [mm] others may be from it; block_is_near (b,): whether a tool is near;
    block_load (tools, b): of its points, at the end of the last substep, force [uN], torque about the origin
    [uN mm] and sum of the normal forces [uN]. ``stiffness`` [kPa/mm]: that of the contact points.
    """

    block = BLOCK

    def __init__(
        self, body: Body, lattice: Lattice, points: np.ndarray, area_mm2: np.ndarray, tools: list
    ) -> None:
        self.blocks = -(-len(points) // BLOCK)
        self.middle, self.block_is_near = (zeros(self.blocks, kind=ti.i32) for _ in range(2))
        self.reach = zeros(self.blocks)
        super().__init__(body, lattice, *self._in_blocks(points, area_mm2))
        self.tools = list(tools)
        self.inset_mm = INSET_CELLS * lattice.cell_mm
        self.near = zeros(self.count, kind=ti.i32)
        self.active = zeros(body.count, kind=ti.i32)
        self.plane = zeros(len(tools), self.count, 4, within=1)
        self.block_load = zeros(len(tools), self.blocks, 7, within=1)
        # A thinner tool has no edges of this radius.
        radius_mm = max(RADIUS_MM, *(tool.edge_radius for tool in tools))
        self.radius_mm = max(0.0, min(radius_mm, *(tool.inner_ball_mm - self.inset_mm for tool in tools)))
        self.stiffness = 0.0

    def _in_blocks(self, points: np.ndarray, area_mm2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (p, 3) and areas (p,) in the order of their blocks, whose middle and reach are set."""
        order = np.concatenate(in_blocks(points, np.arange(len(points))))
        points = points[order]
        middle, reach = np.zeros(self.blocks, int), np.zeros(self.blocks)
        for block in range(self.blocks):
            first = block * BLOCK
            own = points[first : first + BLOCK]
            centre = np.linalg.norm(own - (own.min(axis=0) + own.max(axis=0)) / 2, axis=1).argmin()
            middle[block] = first + centre
            reach[block] = STRETCH * np.linalg.norm(own - own[centre], axis=1).max()
        fill((self.middle, middle), (self.reach, reach))
        return points, area_mm2[order]

    def set_points(self, lattice: Lattice, points: np.ndarray, area_mm2: np.ndarray) -> None:
        """Put the points at other places (p, 3) [mm] at rest, with other areas (p,) [mm^2]."""
        super().set_points(lattice, *self._in_blocks(points, area_mm2))

    def reset(self) -> None:
        """Clear forces and what is near; call it after other code has moved the body."""
        for field in (self.near, self.active, self.block_is_near, self.block_load):
            fill_evenly(field, 0)

    def load(self, tool: object) -> np.ndarray:
        """Of the points that a tool touches (7,): the tool's force [N], its torque about the origin [N mm],
        and the sum of the normal forces [N].
        """
        return 1e-6 * array_of(self.block_load)[self.tools.index(tool)].sum(axis=0, dtype=np.float64)

    def proxy(self, tool: ConvexTool) -> Proxy:
        """The proxy of a tool, which meets what the tool meets."""
        return Proxy(self, tool, self.inset_mm, self.radius_mm)

    @ti.func
    def surface_ball(self, q):
        """Point q of the surface, and its radius [mm]."""
        return tm.vec4(self.interpolated(self.body.position, q), 0.0)

    @ti.func
    def block_ball(self, block):
        """A ball with all points of a block in it: middle and radius [mm]."""
        return tm.vec4(self.interpolated(self.body.position, self.middle[block]), self.reach[block])

    @ti.func
    def find(self):
        """The planes of the tools that each point's predicted position is near to."""
        for i in range(self.body.count):
            self.active[i] = 0
        for block in range(self.blocks):
            is_near, middle = 0, self.interpolated(self.body.predicted, self.middle[block])
            for s in ti.static(range(len(self.tools))):
                if not self.tools[s].is_beyond(middle, NEAR_MM + self.reach[block]):
                    is_near = 1
            # Points that are no longer near are so marked.
            if is_near + self.block_is_near[block] > 0:
                for q in range(block * BLOCK, ti.min((block + 1) * BLOCK, self.count)):
                    self.find_tools(q)
            self.block_is_near[block] = is_near

    @ti.func
    def find_tools(self, q):
        """The planes of the tools that point q is near to, and mark its nodes."""
        near, p = 0, self.interpolated(self.body.predicted, q)
        for s in ti.static(range(len(self.tools))):
            pose = self.tools[s].pose[None]
            local = pose[:3, :3].transpose() @ (p - pose[:3, 3])
            surface = self.tools[s].inner_surface(local, self.inset_mm, self.radius_mm)
            # Deeper points are left to the contact points, which know by which side they came.
            if -self.radius_mm < surface.w < NEAR_MM:
                self.point[q] = p
                normal = pose[:3, :3] @ surface.xyz
                self.plane[s, q] = tm.vec4(normal, normal.dot(p) - surface.w)
                near |= 1 << s
        self.near[q] = near
        if near > 0:
            for k in ti.static(range(8)):
                self.active[self.node[q][k]] = 1

    @ti.func
    def depth(self, s: ti.template(), q):
        """Depth [mm] of point q in the smaller tool s, 0 outside."""
        plane = self.plane[s, q]
        depth = ti.max(plane.w - plane.xyz.dot(self.point[q]), 0.0)
        return depth if (self.near[q] >> s) & 1 else 0.0

    @ti.func
    def node_force(self, i):
        """Force [uN] of the tools on node i, and its negative derivative (3, 3) by the node's position."""
        force, stiffness = tm.vec3(0.0), tm.mat3(0.0)
        if self.active[i] > 0:
            for k in range(self.node_start[i], self.node_start[i + 1]):
                q = self.node_point[k]
                if self.near[q] > 0:
                    weight = self.node_weight[k]
                    for s in ti.static(range(len(self.tools))):
                        depth = self.depth(s, q)
                        if depth > 0.0:
                            normal = self.plane[s, q].xyz
                            penalty = weight * 1e3 * STIFFNESS_RATIO * self.stiffness * self.area[q]
                            force += penalty * depth * normal
                            stiffness += weight * penalty * normal.outer_product(normal)
        return force, stiffness

    @ti.func
    def follow(self, i, change):
        """Move the points of node i with it. Nodes of one colour have no point in common."""
        if self.active[i] > 0:
            for k in range(self.node_start[i], self.node_start[i + 1]):
                q = self.node_point[k]
                if self.near[q] > 0:
                    self.point[q] = self.point[q] + self.node_weight[k] * change

    @ti.func
    def finish(self):
        """End of a substep: sum the forces of each block."""
        for block in range(self.blocks):
            end = ti.min((block + 1) * BLOCK, self.count) if self.block_is_near[block] > 0 else 0
            for s in ti.static(range(len(self.tools))):
                force, torque, size = tm.vec3(0.0), tm.vec3(0.0), 0.0
                for q in range(block * BLOCK, end):
                    depth = self.depth(s, q)
                    if depth > 0.0:
                        pressed = 1e3 * STIFFNESS_RATIO * self.stiffness * self.area[q] * depth
                        size += pressed
                        force += pressed * self.plane[s, q].xyz
                        torque += self.point[q].cross(pressed * self.plane[s, q].xyz)
                for k in ti.static(range(3)):
                    self.block_load[s, block][k], self.block_load[s, block][k + 3] = force[k], torque[k]
                self.block_load[s, block][6] = size


def in_blocks(points: np.ndarray, which: np.ndarray) -> list[np.ndarray]:
    """Some of points (p, 3) [mm], their numbers (n,), in blocks of BLOCK neighbours, the last of the rest."""
    if len(which) <= BLOCK:
        return [which]
    axis = np.ptp(points[which], axis=0).argmax()
    which = which[np.argsort(points[which, axis], kind="stable")]
    half = BLOCK * -(-len(which) // (2 * BLOCK))
    return in_blocks(points, which[:half]) + in_blocks(points, which[half:])
