"""Rigid shapes for contact: planes, signed distance fields, convex tools; and the time of impact with static
shapes.

Every shape has ``surface(p)``: outward unit normal (x, y, z) and signed distance (w) [mm] of the nearest
surface, negative inside and ``FAR`` out of reach; ``motion(p)``: displacement of its material at p in this
substep [mm]; ``is_beyond(p, distance)``: whether a quick test finds p farther away than a distance [mm]; and
``moves``: whether it can move. StaticShape shapes also have ``clearance(p)``: a lower bound of the distance
[mm] of the surface from p at any distance, negative inside.
"""

from itertools import combinations

import numpy as np
import taichi as ti
import taichi.math as tm

from sim.fields import array_of, field_of, fill, zeros
from sim.signed_distance import distance_grid

FAR = 1e6
# A point moved outside a half-space is this far outside [mm].
OUTSIDE_MM = 1e-3
OUTSIDE_GRID_CELLS = 0.5
# Spacing of a distance grid: on average within 0.005 mm of a support's surface, except at sharp edges.
GRID_MM = 1.0
MOST_SUBSTEPS = 100
# Contacts have a bit of a signed word for each shape.
MOST_SHAPES = 31
# A path ends this deep in a shape [mm], so that a body can slide along it; thinner shapes stop nothing fast.
IMPACT_DEPTH_MM = 1.0
# Each step of sphere tracing is as long as the clearance; only paths along a surface need many.
TRACING_STEPS = 32
LEAST_STEP_MM = 0.01
# Of Newton's method for the way out of a tool along its axis.
WAY_OUT_ITERATIONS = 4


class StaticShape:
    """A shape that does not move."""

    moves = False

    @ti.func
    def motion(self, p):
        return tm.vec3(0.0)

    @ti.func
    def is_beyond(self, p, distance):
        return False


class Plane(StaticShape):
    """Half-space below the points with normal . x = offset [mm]."""

    def __init__(self, normal: np.ndarray, offset_mm: float) -> None:
        normal = np.asarray(normal, float)
        self.normal = ti.Vector((normal / np.linalg.norm(normal)).tolist())
        self.offset = float(offset_mm / np.linalg.norm(normal))

    @ti.func
    def surface(self, p):
        return tm.vec4(self.normal, self.clearance(p))

    @ti.func
    def clearance(self, p):
        return self.normal.dot(p) - self.offset


class SignedDistanceField(StaticShape):
    """Distances [mm] on a regular grid, negative inside, linear in between; out of reach beyond the grid.

    ``distance`` (nx, ny, nz); ``origin_mm`` (3,) is the centre of its first entry, ``spacing_mm`` (3,).
    """

    def __init__(self, distance: np.ndarray, origin_mm: np.ndarray, spacing_mm: np.ndarray) -> None:
        self.shape = distance.shape
        self.distance = field_of(distance)
        self.origin = ti.Vector([float(v) for v in origin_mm])
        self.spacing = ti.Vector([float(v) for v in spacing_mm])

    @staticmethod
    def of_surface(vertices: np.ndarray, faces: np.ndarray, reach_mm: float) -> "SignedDistanceField":
        """Distances up to ``reach_mm`` around a closed surface of vertices (v, 3) [mm] and faces (f, 3)."""
        distance, origin = distance_grid(vertices, faces, GRID_MM, reach_mm)
        return SignedDistanceField(distance, origin, np.full(3, GRID_MM))

    @ti.func
    def surface(self, p):
        at = (p - self.origin) / self.spacing
        base = ti.cast(ti.floor(at), ti.i32)
        result = tm.vec4(0.0, 0.0, 0.0, FAR)
        last = ti.Vector([self.shape[0] - 2, self.shape[1] - 2, self.shape[2] - 2])
        if (base >= 0).all() and (base <= last).all():
            t = at - base
            # Interpolate along x, then y, then z: values at the remaining ends, and their differences.
            value, slope = ti.Matrix.zero(ti.f32, 2, 2), ti.Matrix.zero(ti.f32, 2, 2)
            for j, k in ti.static(ti.ndrange(2, 2)):
                low = self.distance[base + ti.Vector([0, j, k])]
                slope[j, k] = self.distance[base + ti.Vector([1, j, k])] - low
                value[j, k] = low + t.x * slope[j, k]
            along_x, along_y = slope[0, :] + t.y * (slope[1, :] - slope[0, :]), value[1, :] - value[0, :]
            ends = value[0, :] + t.y * along_y
            along = tm.vec3(interpolated(along_x, t.z), interpolated(along_y, t.z), ends[1] - ends[0])
            gradient = along / self.spacing
            length = gradient.norm()
            if length > 1e-6:
                result = tm.vec4(gradient / length, interpolated(ends, t.z))
        return result

    @ti.func
    def clearance(self, p):
        last = ti.Vector([self.shape[0] - 1, self.shape[1] - 1, self.shape[2] - 1])
        at = (p - self.origin) / self.spacing
        inside = tm.clamp(at, 0.0, ti.cast(last, ti.f32))
        # Outside the grid: the distance to it, and a little more to step into it.
        beyond = ((at - inside) * self.spacing).norm()
        clearance = beyond + OUTSIDE_GRID_CELLS * self.spacing.min()
        if beyond == 0.0:
            base = ti.min(ti.cast(inside, ti.i32), last - 1)
            t = inside - base
            clearance = 0.0
            for corner in ti.static(ti.grouped(ti.ndrange(2, 2, 2))):
                weight = 1.0
                for k in ti.static(range(3)):
                    weight *= t[k] if corner[k] == 1 else 1.0 - t[k]
                clearance += weight * self.distance[base + corner]
        return clearance


@ti.func
def interpolated(ends, t):
    """Linear interpolation between two ends."""
    return ends[0] + t * (ends[1] - ends[0])


class ConvexTool:
    """A rigid tool that moves: the intersection of half-spaces normal . x <= offset in its own frame.

    ``normals`` (k, 3) unit, ``offsets_mm`` (k,). With an edge radius, it is the union of all balls of this
    radius inside the half-spaces: edges and corners are rounded.
    """

    moves = True

    def __init__(self, normals: np.ndarray, offsets_mm: np.ndarray, edge_radius_mm: float = 0.0) -> None:
        self.count = len(normals)
        self.edge_radius = float(edge_radius_mm)
        # The half-spaces of the balls' centres.
        core = np.column_stack([normals, np.asarray(offsets_mm, float) - self.edge_radius])
        self.half_space = field_of(core, 1)
        self.ball_mm = self.edge_radius + _farthest_vertex(core)
        # Radius of the ball about the origin that is inside.
        self.inner_ball_mm = float(np.min(offsets_mm))
        self.pose = zeros(4, 4, within=2)
        self.step_back = zeros(4, 4, within=2)
        self.path = zeros(MOST_SUBSTEPS, 2, 4, 4, within=2)
        self.move(np.eye(4), np.eye(4))

    @staticmethod
    def cuboid(size_mm: np.ndarray, edge_radius_mm: float = 0.0) -> "ConvexTool":
        """A cuboid of ``size_mm`` (3,) about the origin (the paper's transducer), its edges rounded.

        Raises ValueError for an edge radius larger than half of the smallest side.
        """
        half = np.asarray(size_mm, float) / 2
        if not 0 <= edge_radius_mm <= half.min():
            raise ValueError(f"an edge radius of {edge_radius_mm:g} mm: expected 0 to {half.min():g} mm")
        offsets = np.concatenate([half, half])
        return ConvexTool(np.concatenate([np.eye(3), -np.eye(3)]), offsets, edge_radius_mm)

    def follow(self, poses: np.ndarray) -> None:
        """Set the poses (substeps + 1, 4, 4), world from tool [mm], at the start of a time step and at the
        end of each substep.

        Raises ValueError for more than MOST_SUBSTEPS substeps and for poses that are not finite.
        """
        if not 1 <= len(poses) - 1 <= MOST_SUBSTEPS:
            raise ValueError(f"{len(poses) - 1} substeps: expected 1 to {MOST_SUBSTEPS}")
        if not np.isfinite(poses).all():
            raise ValueError("a pose of the tool is not finite: expected rigid matrices in mm")
        self.last_pose = poses[-1]
        back = poses[:-1] @ np.linalg.inv(poses[1:]) - np.eye(4)
        path = np.zeros((MOST_SUBSTEPS, 2, 4, 4))
        path[: len(back)] = np.stack([poses[1:], back], axis=1)
        fill((self.path, path))

    def move(self, before: np.ndarray, now: np.ndarray) -> None:
        """Set the poses (4, 4), world from tool [mm], at the start and at the end of the substep."""
        self.follow(np.stack([before, now]))
        pose, step_back = array_of(self.path)[0]
        fill((self.pose, pose), (self.step_back, step_back))

    @ti.func
    def start_substep(self, substep):
        """Take the pose at the end of a substep."""
        self.pose[None] = self.path[substep, 0]
        self.step_back[None] = self.path[substep, 1]

    @ti.func
    def outside(self, p, k):
        """The point nearest to p that is OUTSIDE_MM outside half-space k, and so outside the tool."""
        pose = self.pose[None]
        plane = self.half_space[k]
        local = pose[:3, :3].transpose() @ (p - pose[:3, 3])
        return p + (plane.w + self.edge_radius - plane.xyz.dot(local) + OUTSIDE_MM) * (
            pose[:3, :3] @ plane.xyz
        )

    @ti.func
    def motion(self, p):
        return -(self.step_back[None] @ tm.vec4(p, 1.0)).xyz

    @ti.func
    def is_beyond(self, p, distance):
        return self.is_beyond_at(self.pose[None], p, distance)

    @ti.func
    def is_beyond_at(self, pose, p, distance):
        """``is_beyond`` with the tool at a pose."""
        from_middle = p - pose[:3, 3]
        beyond = from_middle.norm_sqr() > (self.ball_mm + distance) ** 2
        if not beyond:
            local = pose[:3, :3].transpose() @ from_middle
            for k in range(self.count):
                plane = self.half_space[k]
                beyond |= plane.xyz.dot(local) - plane.w > distance + self.edge_radius
        return beyond

    @ti.func
    def surface(self, p):
        pose = self.pose[None]
        rotation = pose[:3, :3]
        surface = self.surface_from(rotation.transpose() @ (p - pose[:3, 3]))
        return tm.vec4(rotation @ surface.xyz, surface.w)

    @ti.func
    def surface_from(self, local):
        """``surface`` in the tool's own frame."""
        return self.rounded_surface(local, 0.0, self.edge_radius)

    @ti.func
    def inner_surface(self, local, inset: float, radius: float):
        """``surface``, in the tool's own frame, of a smaller tool: its faces an inset [mm] inside this one's,
        its edges rounded by a radius [mm].
        """
        return self.rounded_surface(local, inset + radius - self.edge_radius, radius)

    @ti.func
    def rounded_surface(self, local, inset: float, radius: float):
        """The outward normal and signed distance [mm] of all balls of a radius whose centres are in the
        half-spaces, these moved inwards by an inset [mm].
        """
        depth, normal = -FAR, tm.vec3(0.0)
        nearest = local
        for k in range(self.count):
            plane = self.half_space[k]
            plane.w -= inset
            d = plane.xyz.dot(local) - plane.w
            if d > depth:
                depth, normal = d, plane.xyz
            # One projection on each half-space gives the nearest point of a cuboid, and of any tool near its
            # faces.
            nearest -= ti.max(plane.xyz.dot(nearest) - plane.w, 0.0) * plane.xyz
        outward = local - nearest
        distance = outward.norm()
        if distance > 1e-4:
            depth, normal = distance, outward / distance
        return tm.vec4(normal, depth - radius)

    @ti.func
    def way_out(self, local, inset: float, radius: float, depth: float):
        """How far [mm] the tool must move along its z axis until a point, local to it, is no deeper than a
        depth [mm] in ``inner_surface``; 0 where it is not.
        """
        way = FAR
        for k in range(self.count):
            plane = self.half_space[k]
            if plane.z < -1e-3:
                offset = plane.w + self.edge_radius - inset - depth
                way = ti.min(way, (offset - plane.xyz.dot(local)) / -plane.z)
        # The distance is convex along the axis: Newton's method from outside stays there.
        for _ in range(WAY_OUT_ITERATIONS):
            surface = self.inner_surface(local - tm.vec3(0.0, 0.0, way), inset, radius)
            if surface.z < -1e-3:
                way += ti.max(surface.w + depth, 0.0) / surface.z
        return ti.max(way, 0.0)

    @ti.func
    def entered(self, start, p, least_mm: float):
        """The half-space by which a point that has moved from a start to p has entered the tool, while that
        moved too: outward normal, and offset of normal . x = offset [mm]; zero where it was not deeper in it
        than ``least_mm``.
        """
        pose = self.pose[None]
        rotation = pose[:3, :3]
        local = rotation.transpose() @ (p - pose[:3, 3])
        path = local - rotation.transpose() @ (start + self.motion(p) - pose[:3, 3])
        enters, leaves, side = -FAR, 1.0, tm.vec4(0.0)
        for k in range(self.count):
            plane = self.half_space[k]
            after = plane.xyz.dot(local) - plane.w - self.edge_radius
            before = after - plane.xyz.dot(path)
            if before > 0.0 and after > 0.0:
                leaves = -FAR
            elif before > 0.0:
                share = before / (before - after)
                if share > enters:
                    normal = rotation @ plane.xyz
                    enters, side = share, tm.vec4(normal, normal.dot(p) - after)
            elif after > 0.0:
                leaves = ti.min(leaves, before / (before - after))
        result = tm.vec4(0.0)
        if 0.0 <= enters <= leaves:
            half_way = self.surface_from(local - (1.0 - 0.5 * (enters + leaves)) * path).w
            if ti.min(half_way, self.surface_from(local).w) < -least_mm:
                result = side
        return result

    @ti.func
    def carried(self, plane):
        """A plane, normal and offset [mm], moved with the tool in this substep."""
        back = self.step_back[None]
        turned = back[:3, :3].transpose() @ plane.xyz + plane.xyz
        return tm.vec4(turned, plane.w - plane.xyz.dot(back[:3, 3]))


def check_count(shapes: list) -> None:
    """Raises ValueError for more shapes than contacts have bits for."""
    if len(shapes) > MOST_SHAPES:
        raise ValueError(f"{len(shapes)} shapes: expected at most {MOST_SHAPES}, tools included")


class TimeOfImpact:
    """Time of impact with the static shapes, as a fraction of a path, by sphere tracing (Hart 1996)."""

    def __init__(self, shapes: list) -> None:
        self.shapes = [shape for shape in shapes if not shape.moves]

    @ti.func
    def fraction(self, start, path, free: float):
        """Fraction of a path [mm] from a start up to the first shape; 1 for paths not longer than ``free``
        [mm].
        """
        length = path.norm()
        fraction = 1.0
        if length > free:
            travelled = 0.0
            for _ in range(TRACING_STEPS):
                if travelled < length:
                    step = self.clearance(start + travelled / length * path) + IMPACT_DEPTH_MM
                    travelled += step if step > LEAST_STEP_MM else 0.0
            fraction = ti.min(1.0, ti.max(travelled, free) / length)
        return fraction

    @ti.func
    def clearance(self, p):
        """Lower bound of the distance [mm] from p to the nearest shape."""
        clearance = FAR
        for s in ti.static(range(len(self.shapes))):
            clearance = ti.min(clearance, self.shapes[s].clearance(p))
        return clearance


def _farthest_vertex(half_spaces: np.ndarray) -> float:
    """Distance [mm] from the origin of the farthest vertex of an intersection of half-spaces (k, 4),
    normal and offset.
    """
    triples = np.array(list(combinations(half_spaces, 3)))
    crossing = triples[np.abs(np.linalg.det(triples[:, :, :3])) > 1e-9]
    vertex = np.linalg.solve(crossing[:, :, :3], crossing[:, :, 3:])[:, :, 0]
    inside = (vertex @ half_spaces[:, :3].T <= half_spaces[:, 3] + 1e-6).all(axis=1)
    return float(np.linalg.norm(vertex[inside], axis=1).max())
