"""The proxy of a tool (god object: Zilles and Salisbury 1995, with six degrees of freedom Ortega et al.
2007): the pose that the tissue lets a tool have, where a hand wants it elsewhere.

The tool moves towards its goal in small increments, and is moved out of the tissue after each: no point of
the surface is ever deep in the tool, nor passed by it.
"""

from typing import Any

import numpy as np
import taichi as ti
import taichi.math as tm
from scipy.spatial.transform import Rotation

from sim.fields import array_of, fill, zeros
from sim.kernels import kernel
from sim.linear_algebra import rotation_by
from sim.shapes import FAR, ConvexTool

# No point of a tool moves further than this between two tests of contact: less than half of the thinnest
# tool.
INCREMENT_MM = 1.0
MOST_INCREMENTS = 1000
# In contact it moves no further than this at a time: its path is bent, and the solver takes it to be
# straight.
MOST_CONTACT_PATH_MM = 10.0
# The points deepest in the tool are moved out one after the other, at most so many in an increment.
PROJECTIONS = 8
# What may be left of a penetration after that, and how much further than needed the tool retreats.
TOLERANCE_MM, ROUNDING_MM = 0.005, 1e-3
# A tool retreats along its axis, as it is held, where that takes no more than this; else along the normal of
# its nearest side.
MOST_AXIAL_MM = 2.0


class Proxy:
    """The proxy of a tool that may touch the ``count`` points of a ``surface``, each a ball.

    What presses is a smaller tool: its faces an inset inside the tool, its edges of a radius, by default the
    tool itself.
    """

    def __init__(
        self, surface: Any, tool: ConvexTool, inset_mm: float = 0.0, radius_mm: float | None = None
    ) -> None:
        self.surface, self.tool = surface, tool
        self.inset_mm, self.radius_mm = inset_mm, tool.edge_radius if radius_mm is None else radius_mm
        self.start = zeros(4, 4, within=2)
        # Fraction of the path, and retreat from it.
        self.reached = zeros(4, within=1)
        # The points that it may touch: place and radius.
        self.near = zeros(surface.count, 4, within=1)

    def pose_towards(
        self, pose: np.ndarray, goal: np.ndarray, most_mm: float, presses: bool = True
    ) -> np.ndarray:
        """The pose (4, 4) of the tool that follows a goal (4, 4) from a pose (4, 4), world from tool [mm].

        It is the goal itself where no point of the tissue is deeper than ``most_mm`` on its path in what
        ``presses``, or in the whole tool; else the tool slides along the tissue, or stays before it.
        """
        shift = goal[:3, 3] - pose[:3, 3]
        turn = np.zeros(3)
        if not np.array_equal(goal[:3, :3], pose[:3, :3]):
            turn = Rotation.from_matrix(goal[:3, :3] @ pose[:3, :3].T).as_rotvec()
        fill((self.start, pose))
        inset_mm, radius_mm = (self.inset_mm, self.radius_mm) if presses else (0.0, self.tool.edge_radius)
        self.find(*shift.tolist(), *turn.tolist(), inset_mm, radius_mm, most_mm)
        share, *retreat = array_of(self.reached).tolist()
        if share == 1.0 and not any(retreat):
            return goal
        reached = pose.copy()
        reached[:3, :3] = Rotation.from_rotvec(share * turn).as_matrix() @ pose[:3, :3]
        reached[:3, 3] += share * shift + retreat
        return reached

    @kernel
    def find(
        self,
        x: float,
        y: float,
        z: float,
        turn_x: float,
        turn_y: float,
        turn_z: float,
        inset: float,
        radius: float,
        most_mm: float,
    ):
        """How far the tool gets along a shift [mm] and a rotation vector [rad], and its retreat [mm]."""
        ti.loop_config(serialize=True)
        for _ in range(1):
            shift, turn = tm.vec3(x, y, z), tm.vec3(turn_x, turn_y, turn_z)
            length = ti.max(shift.norm() + turn.norm() * self.tool.ball_mm, 1e-6)
            count = self.gather_near(length)
            reached, share, retreat, clearance = tm.vec4(0.0), 0.0, tm.vec3(0.0), 0.0
            # Where the tissue itself has moved into the tool, this gets no worse at least.
            least = ti.min(
                -TOLERANCE_MM, self.deepest(self.start[None], retreat, count, inset, radius)[0].w + most_mm
            )
            for _increment in range(MOST_INCREMENTS):
                is_free = retreat.norm_sqr() == 0.0 or share * length < MOST_CONTACT_PATH_MM
                if share < 1.0 and clearance >= least and is_free:
                    share = ti.min(1.0, share + (INCREMENT_MM + ti.max(clearance, 0.0)) / length)
                    pose = self.moved(share, shift, turn)
                    back = self.retreat(pose, retreat, count, inset, radius, most_mm)
                    retreat, clearance = back.xyz, back.w
                    if clearance >= least:
                        reached = tm.vec4(share, retreat)
            self.reached[None] = reached

    @ti.func
    def gather_near(self, length):
        """The points that the tool may touch on a path of a length [mm]: their number."""
        pose, count, size = self.start[None], 0, self.surface.block
        for block in range((self.surface.count + size - 1) // size):
            ball = self.surface.block_ball(block)
            if not self.tool.is_beyond_at(pose, ball.xyz, ball.w + length + MOST_AXIAL_MM):
                for q in range(block * size, ti.min((block + 1) * size, self.surface.count)):
                    self.near[count] = self.surface.surface_ball(q)
                    count += 1
        return count

    @ti.func
    def moved(self, share, shift, turn):
        """The pose at a fraction of the path."""
        pose = self.start[None]
        rotation = rotation_by(share * turn) @ pose[:3, :3]
        place = pose[:3, 3] + share * shift
        for i in ti.static(range(3)):
            pose[i, 3] = place[i]
            for k in ti.static(range(3)):
                pose[i, k] = rotation[i, k]
        return pose

    @ti.func
    def retreat(self, pose, retreat, count, inset: float, radius: float, most_mm: float):
        """The retreat [mm] from a pose after which no point is deeper in the tool than ``most_mm``, and how
        far the tool may then move before it meets one; that is negative where there is no such retreat.
        """
        clearance = -FAR
        for projection in range(PROJECTIONS + 1):
            if clearance < 0.0:
                nearest, local = self.deepest(pose, retreat, count, inset, radius)
                clearance = nearest.w + most_mm
                if clearance < 0.0 and projection < PROJECTIONS:
                    axial = self.tool.way_out(local.xyz, inset, radius, most_mm - local.w)
                    if axial < MOST_AXIAL_MM:
                        retreat += (axial + ROUNDING_MM) * pose[:3, 2]
                    else:
                        retreat += (clearance - ROUNDING_MM) * (pose[:3, :3] @ nearest.xyz)
        return tm.vec4(retreat, clearance)

    @ti.func
    def deepest(self, pose, retreat, count, inset: float, radius: float):
        """The point that is deepest in the tool: the tool's outward normal and signed distance [mm] there,
        and its place and radius, in the tool's own frame.
        """
        rotation, middle = pose[:3, :3], pose[:3, 3] + retreat
        nearest, place = tm.vec4(0.0, 0.0, 0.0, FAR), tm.vec4(0.0)
        for k in range(count):
            point = self.near[k]
            offset = point.xyz - middle
            bound = offset.norm() - self.tool.ball_mm - point.w
            if bound < nearest.w:
                if bound > INCREMENT_MM:
                    nearest.w = bound
                else:
                    local = rotation.transpose() @ offset
                    surface = self.tool.inner_surface(local, inset, radius)
                    if surface.w - point.w < nearest.w:
                        nearest = tm.vec4(surface.xyz, surface.w - point.w)
                        place = tm.vec4(local, point.w)
        return nearest, place
