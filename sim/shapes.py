"""Rigid shapes that particles touch: planes, signed distance fields, static triangle meshes and convex tools.

Every shape answers ``surface(p)`` with the outward unit normal (x, y, z) and the signed distance (w) [mm] of
the nearest surface, negative inside and ``FAR`` where the shape is out of reach, and ``motion(p)`` with how far
its material at p moved in this substep [mm]. ``moves`` says whether it ever does.
"""

import igl
import numpy as np
import taichi as ti
import taichi.math as tm

from sim.distance import signed_distance

FAR = 1e6
FACE, EDGE, VERTEX = 0, 1, 4
HAIR = 1e-3
Points = ti.types.ndarray(ti.f32, ndim=2)
Rows = ti.types.ndarray(ti.i32, ndim=2)
Floats = ti.types.ndarray(ti.f32, ndim=1)
Integers = ti.types.ndarray(ti.i32, ndim=1)


@ti.data_oriented
class Static:
    """A shape that does not move."""

    moves = False

    @ti.func
    def motion(self, p):
        return tm.vec3(0.0)


@ti.data_oriented
class Plane(Static):
    """Half-space below the points with normal . x = offset [mm]."""

    def __init__(self, normal: np.ndarray, offset_mm: float) -> None:
        normal = np.asarray(normal, float)
        self.normal = ti.Vector((normal / np.linalg.norm(normal)).tolist())
        self.offset = float(offset_mm / np.linalg.norm(normal))

    @ti.func
    def surface(self, p):
        return tm.vec4(self.normal, self.normal.dot(p) - self.offset)


@ti.data_oriented
class SignedDistanceField(Static):
    """Distances [mm] on a regular grid, negative inside, linear in between; out of reach beyond the grid.

    ``distance`` (nx, ny, nz); ``origin_mm`` (3,) is the centre of its first entry, ``spacing_mm`` (3,).
    """

    def __init__(self, distance: np.ndarray, origin_mm: np.ndarray, spacing_mm: np.ndarray) -> None:
        self.shape = distance.shape
        self.distance = ti.field(ti.f32, self.shape)
        self.distance.from_numpy(np.ascontiguousarray(distance, np.float32))
        self.origin = ti.Vector([float(v) for v in origin_mm])
        self.spacing = ti.Vector([float(v) for v in spacing_mm])

    @ti.func
    def surface(self, p):
        at = (p - self.origin) / self.spacing
        base = ti.cast(ti.floor(at), ti.i32)
        result = tm.vec4(0.0, 0.0, 0.0, FAR)
        last = ti.Vector([self.shape[0] - 2, self.shape[1] - 2, self.shape[2] - 2])
        if (base >= 0).all() and (base <= last).all():
            t = at - base
            value, gradient = 0.0, tm.vec3(0.0)
            for corner in ti.static(ti.grouped(ti.ndrange(2, 2, 2))):
                w, sign = tm.vec3(0.0), tm.vec3(0.0)
                for axis in ti.static(range(3)):
                    w[axis] = t[axis] if ti.static(corner[axis] == 1) else 1.0 - t[axis]
                    sign[axis] = 1.0 if ti.static(corner[axis] == 1) else -1.0
                d = self.distance[base + corner]
                value += w.x * w.y * w.z * d
                gradient += d * sign * tm.vec3(w.y * w.z, w.x * w.z, w.x * w.y) / self.spacing
            length = gradient.norm()
            if length > 1e-6:
                result = tm.vec4(gradient / length, value)
        return result


@ti.data_oriented
class ConvexTool:
    """A rigid tool that moves: the intersection of half-spaces normal . x <= offset in its own frame.

    ``normals`` (k, 3) unit, ``offsets_mm`` (k,). ``move`` sets its pose at the start and end of a substep. With an
    edge radius it is all that a ball of this radius covers which stays within the half-spaces.
    """

    moves = True

    def __init__(self, normals: np.ndarray, offsets_mm: np.ndarray, edge_radius_mm: float = 0.0) -> None:
        self.count = len(normals)
        self.edge_radius = float(edge_radius_mm)
        # The half-spaces of the core, in which the ball's centre stays.
        self.half_space = ti.Vector.field(4, ti.f32, self.count)
        core = np.column_stack([normals, np.asarray(offsets_mm, float) - self.edge_radius])
        self.half_space.from_numpy(core.astype(np.float32))
        self.pose = ti.Matrix.field(4, 4, ti.f32, ())
        self.step_back = ti.Matrix.field(4, 4, ti.f32, ())
        self.move(np.eye(4), np.eye(4))

    @staticmethod
    def cuboid(size_mm: np.ndarray, edge_radius_mm: float = 0.0) -> "ConvexTool":
        """Three parallel pairs of orthogonal half-spaces about the origin (the paper's transducer).

        Edges and corners are rounded inside ``size_mm`` (3,). Raises ValueError where the size leaves no room for that.
        """
        half = np.asarray(size_mm, float) / 2
        if not 0 <= edge_radius_mm <= half.min():
            raise ValueError(f"an edge radius of {edge_radius_mm:g} mm: expected 0 to {half.min():g} mm")
        offsets = np.concatenate([half, half])
        return ConvexTool(np.concatenate([np.eye(3), -np.eye(3)]), offsets, edge_radius_mm)

    def move(self, before: np.ndarray, now: np.ndarray) -> None:
        """Poses (4, 4), world from tool [mm], at the start and at the end of the substep."""
        self._set_pose(ti.Matrix(now.tolist()), ti.Matrix((before @ np.linalg.inv(now) - np.eye(4)).tolist()))

    @ti.kernel
    def _set_pose(self, pose: tm.mat4, step_back: tm.mat4):
        self.pose[None] = pose
        self.step_back[None] = step_back

    @ti.func
    def way_out(self, p, k):
        """The nearest point to p outside half-space k, which is out of the tool, and a hair more."""
        pose = self.pose[None]
        plane = self.half_space[k]
        local = pose[:3, :3].transpose() @ (p - pose[:3, 3])
        return p + (plane.w + self.edge_radius - plane.xyz.dot(local) + HAIR) * (pose[:3, :3] @ plane.xyz)

    @ti.func
    def motion(self, p):
        return -(self.step_back[None] @ tm.vec4(p, 1.0)).xyz

    @ti.func
    def surface(self, p):
        pose = self.pose[None]
        rotation = pose[:3, :3]
        local = rotation.transpose() @ (p - pose[:3, 3])
        depth, normal = -FAR, tm.vec3(0.0)
        nearest = local
        for k in range(self.count):
            plane = self.half_space[k]
            d = plane.xyz.dot(local) - plane.w
            if d > depth:
                depth, normal = d, plane.xyz
            # One sweep of projections is the nearest point of a cuboid, and of any tool near its faces.
            nearest -= ti.max(plane.xyz.dot(nearest) - plane.w, 0.0) * plane.xyz
        outward = local - nearest
        distance = outward.norm()
        if distance > 1e-4:
            depth, normal = distance, outward / distance
        return tm.vec4(rotation @ normal, depth - self.edge_radius)


@ti.data_oriented
class TriangleMesh(Static):
    """A closed static triangle mesh [mm], outward-facing; exact distance and sign (Baerentzen & Aanaes 2005).

    A grid of cells lists the triangles that can be nearest to a point of the cell, as far as ``reach_mm`` outside
    the surface; cells deep inside list the nearest one of their centre, which is a way out.
    """

    def __init__(
        self, vertices: np.ndarray, faces: np.ndarray, reach_mm: float, cell_mm: float = 2.0
    ) -> None:
        vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
        low = vertices.min(axis=0) - reach_mm - cell_mm
        high = vertices.max(axis=0) + reach_mm + cell_mm
        self.cell_mm = cell_mm
        self.shape = tuple(int(v) for v in np.ceil((high - low) / cell_mm))
        self.origin = ti.Vector(low.tolist())
        self.cell = ti.Vector.field(3, ti.i32, self.shape)
        self._store_geometry(vertices, faces)
        self._list_triangles(vertices, faces, low, reach_mm)

    def _list_triangles(
        self, vertices: np.ndarray, faces: np.ndarray, low: np.ndarray, reach_mm: float
    ) -> None:
        centres = low + self.cell_mm * (np.indices(self.shape).reshape(3, -1).T + 0.5)
        signed, nearest = signed_distance(vertices, faces, centres)
        half_diagonal = self.cell_mm * np.sqrt(3) / 2
        near = np.abs(signed) <= half_diagonal + np.where(signed > 0, reach_mm, half_diagonal)
        deep = ~near & (signed < 0)
        # The nearest triangle of any point of a cell is at most this far from the cell's centre.
        bound = np.where(near, np.abs(signed) + 2 * half_diagonal, -1.0).astype(np.float32)
        count = np.zeros(len(centres), np.int32)
        self._count_listed(centres.astype(np.float32), bound, count)
        count[deep] = 1
        last = np.cumsum(count, dtype=np.int32)
        # Away from the surface the whole cell is on one side; near it the triangles decide.
        side = np.where(np.abs(signed) > half_diagonal, np.sign(signed), 0)
        cells = np.column_stack([last - count, last, side]).astype(np.int32)
        listed = np.zeros(last[-1], np.int32)
        distance = np.zeros(last[-1], np.float32)
        self._fill_listed(centres.astype(np.float32), bound, cells, listed, distance)
        listed[last[deep] - 1] = nearest[deep]
        # Nearest first: the walk along a row ends as soon as the rest cannot be nearer.
        order = np.lexsort((distance, np.repeat(np.arange(len(count)), count)))
        self.cell.from_numpy(cells.reshape(*self.shape, 3))
        self.listed = ti.field(ti.i32, len(listed))
        self.listed.from_numpy(listed[order])
        self.listed_distance = ti.field(ti.f32, len(listed))
        self.listed_distance.from_numpy(distance[order])

    @ti.func
    def distance_within(self, p, bound, f):
        """Distance of triangle f from p [mm], FAR where it is more than the bound."""
        distance = FAR
        around = self.sphere[f]
        if (p - around.xyz).norm() <= bound + around.w:
            distance = from_triangle(p, self.corner[f, 0], self.corner[f, 1], self.corner[f, 2])[0].norm()
        return distance if distance <= bound else FAR

    @ti.kernel
    def _count_listed(self, centres: Points, bound: Floats, count: Integers):
        for cell in range(bound.shape[0]):
            if bound[cell] >= 0.0:
                p = tm.vec3(centres[cell, 0], centres[cell, 1], centres[cell, 2])
                for f in range(self.corner.shape[0]):
                    if self.distance_within(p, bound[cell], f) < FAR:
                        count[cell] += 1

    @ti.kernel
    def _fill_listed(self, centres: Points, bound: Floats, cells: Rows, listed: Integers, distance: Floats):
        for cell in range(bound.shape[0]):
            if bound[cell] >= 0.0:
                p = tm.vec3(centres[cell, 0], centres[cell, 1], centres[cell, 2])
                at = cells[cell, 0]
                for f in range(self.corner.shape[0]):
                    d = self.distance_within(p, bound[cell], f)
                    if d < FAR:
                        listed[at] = f
                        distance[at] = d
                        at += 1

    def _store_geometry(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        """Corners and the pseudonormals of each face: of itself, its edges (01, 12, 20) and its vertices."""
        face_normal = igl.per_face_normals(vertices, faces, np.zeros(3))
        vertex_normal = np.asarray(
            igl.per_vertex_normals(vertices, faces, igl.PER_VERTEX_NORMALS_WEIGHTING_TYPE_ANGLE)
        )
        edge_sum: dict[tuple[int, int], np.ndarray] = {}
        for normal, face in zip(face_normal, faces, strict=True):
            for a, b in zip(face, np.roll(face, -1), strict=True):
                key = (min(a, b), max(a, b))
                edge_sum[key] = edge_sum.get(key, np.zeros(3)) + normal
        edges = np.array(
            [[edge_sum[min(a, b), max(a, b)] for a, b in zip(f, np.roll(f, -1), strict=True)] for f in faces]
        )
        # Two faces folded onto each other leave no direction between them.
        edges /= np.maximum(np.linalg.norm(edges, axis=2, keepdims=True), 1e-12)
        normals = np.concatenate([face_normal[:, None], edges, vertex_normal[faces]], axis=1)
        corners = vertices[faces]
        middle = corners.mean(axis=1)
        extent = np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1)
        self.sphere = ti.Vector.field(4, ti.f32, len(faces))
        self.sphere.from_numpy(np.column_stack([middle, extent]).astype(np.float32))
        self.corner = ti.Vector.field(3, ti.f32, (len(faces), 3))
        self.corner.from_numpy(corners.astype(np.float32))
        self.normal = ti.Vector.field(3, ti.f32, (len(faces), 7))
        self.normal.from_numpy(normals.astype(np.float32))

    @ti.func
    def surface(self, p):
        cell = ti.cast(ti.floor((p - self.origin) / self.cell_mm), ti.i32)
        result = tm.vec4(0.0, 0.0, 0.0, FAR)
        size = ti.Vector([self.shape[0], self.shape[1], self.shape[2]])
        if (cell >= 0).all() and (cell < size).all():
            entry = self.cell[cell]
            from_centre = (p - (self.origin + self.cell_mm * (cell + 0.5))).norm()
            distance, towards, normal = FAR, tm.vec3(0.0), tm.vec3(0.0)
            k = entry[0]
            while k < entry[1]:
                if self.listed_distance[k] > distance + from_centre:
                    break
                f = self.listed[k]
                away, feature = from_triangle(p, self.corner[f, 0], self.corner[f, 1], self.corner[f, 2])
                d = away.norm()
                if d < distance:
                    distance, towards, normal = d, away, self.normal[f, feature]
                k += 1
            if entry[1] > entry[0]:
                side = 1.0 if towards.dot(normal) >= 0.0 else -1.0
                if entry[2] != 0:
                    side = ti.cast(entry[2], ti.f32)
                # On the surface itself the direction has no digits left, the pseudonormal has.
                if distance > 1e-4:
                    normal = side * towards / distance
                result = tm.vec4(normal, side * distance)
        return result


@ti.func
def from_triangle(p, a, b, c):
    """Vector from the nearest point of triangle abc to p, and the feature it lies on (Ericson 2005, 5.1.5)."""
    ab, ac, ap, bp, cp = b - a, c - a, p - a, p - b, p - c
    d1, d2 = ab.dot(ap), ac.dot(ap)
    d3, d4 = ab.dot(bp), ac.dot(bp)
    d5, d6 = ab.dot(cp), ac.dot(cp)
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    nearest, feature = a, VERTEX
    if d1 <= 0.0 and d2 <= 0.0:
        nearest, feature = a, VERTEX
    elif d3 >= 0.0 and d4 <= d3:
        nearest, feature = b, VERTEX + 1
    elif d6 >= 0.0 and d5 <= d6:
        nearest, feature = c, VERTEX + 2
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        nearest, feature = a + d1 / (d1 - d3) * ab, EDGE
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        nearest, feature = b + (d4 - d3) / ((d4 - d3) + (d5 - d6)) * (c - b), EDGE + 1
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        nearest, feature = a + d2 / (d2 - d6) * ac, EDGE + 2
    else:
        nearest, feature = a + (vb * ab + vc * ac) / (va + vb + vc), FACE
    return p - nearest, feature
