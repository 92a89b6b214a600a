"""A scalar volume on the device, sampled in mm."""

import numpy as np
import taichi as ti
import taichi.math as tm
import trimesh

from sim.fields import field_of, fill_part, part_of
from sim.signed_distance import distance_grid

AIR_HU = -1000.0
# Pixels of a row that are computed together (SIMD).
LANES = 8
Lanes = ti.types.vector(LANES, ti.f32)
FAR_MM = 1e6


class SampledVolume:
    """Voxels (nx, ny, nz) float32 with the affine map (4, 4) that takes mm to voxel indices.

    Index (0, 0, 0) is the centre of the first voxel. ``outside`` is the value beyond the outer half voxel.
    With a last axis (nx, ny, nz, c) every voxel holds a vector of c values, which are sampled together.
    """

    def __init__(self, voxels: np.ndarray, index_from_mm: np.ndarray, outside: float = AIR_HU) -> None:
        # Interpolation reads one voxel beyond the last, with weight 0.
        thin = [(0, 1 if n == 1 else 0) for n in voxels.shape[:3]]
        filled = np.pad(np.asarray(voxels, np.float32), thin + [(0, 0)] * (voxels.ndim - 3), mode="edge")
        self.shape, self.count = voxels.shape[:3], filled.shape[:3]
        self.index_from_mm = index_from_mm
        self.outside = float(outside)
        self.next_x, self.next_y = self.count[1] * self.count[2], self.count[2]
        flat = filled.reshape(-1, *voxels.shape[3:])
        self.voxels = field_of(flat, voxels.ndim - 3)
        self.linear = ti.Matrix(index_from_mm[:3, :3].tolist())
        self.offset = ti.Vector(index_from_mm[:3, 3].tolist())

    @property
    def voxel_mm(self) -> float:
        """Mean distance of neighbouring voxels."""
        return float(np.linalg.norm(np.linalg.inv(self.index_from_mm[:3, :3]), axis=0).mean())

    def values(self, box: tuple[slice, slice, slice]) -> np.ndarray:
        """A copy of the voxels in a box."""
        return part_of(self.voxels, self.count, box)

    def set_values(self, box: tuple[slice, slice, slice], values: np.ndarray) -> None:
        """Replace the voxels in a box."""
        fill_part(self.voxels, self.count, box, values)

    @ti.func
    def cell_at(self, p):
        """The first of the eight voxels around p [mm], the offsets to the next ones (0 to 1), and whether p
        is inside.
        """
        at = self.linear @ p + self.offset
        last = tm.vec3(self.shape[0] - 1, self.shape[1] - 1, self.shape[2] - 1)
        inside = (at >= -0.5).all() and (at <= last + 0.5).all()
        clamped = tm.clamp(at, 0.0, last)
        most = ti.Vector([self.count[0] - 2, self.count[1] - 2, self.count[2] - 2])
        base = ti.min(ti.cast(clamped, ti.i32), most)
        return base.x * self.next_x + base.y * self.next_y + base.z, clamped - base, inside

    @ti.func
    def sample(self, p):
        """The trilinear value at p [mm]."""
        first, t, inside = self.cell_at(p)
        value = self.voxels[0] * 0.0 + self.outside
        if inside:
            x, y = self.next_x, self.next_y
            low = tm.mix(self.along_z(first, t.z), self.along_z(first + y, t.z), t.y)
            high = tm.mix(self.along_z(first + x, t.z), self.along_z(first + x + y, t.z), t.y)
            value = tm.mix(low, high, t.x)
        return value

    @ti.func
    def sample_lanes(self, x, y, z, in_line):
        """Trilinear values at LANES points [mm]; ``in_line``: they are evenly spaced on a line."""
        a, o = self.linear, self.offset
        first_i, along_i, off_i = self.lanes_along(0, a[0, 0] * x + a[0, 1] * y + a[0, 2] * z + o[0])
        first_j, along_j, off_j = self.lanes_along(1, a[1, 0] * x + a[1, 1] * y + a[1, 2] * z + o[1])
        first_k, along_k, off_k = self.lanes_along(2, a[2, 0] * x + a[2, 1] * y + a[2, 2] * z + o[2])
        first = first_i * self.next_x + first_j * self.next_y + first_k
        low, high = Lanes(0.0), Lanes(0.0)
        if in_line and first[0] == first[LANES - 1]:
            # An image has many pixels per voxel: where both ends are in one cell, all points between are.
            low = self.between(first[0], along_j, along_k)
            high = self.between(first[0] + self.next_x, along_j, along_k)
        else:
            low = self.lanes_between(first, along_j, along_k)
            high = self.lanes_between(first + self.next_x, along_j, along_k)
        value = low + along_i * (high - low)
        off = ti.max(ti.max(off_i, off_j), off_k)
        return ti.select(off <= 0.5, value, self.outside)

    @ti.func
    def lanes_along(self, axis: ti.template(), at):
        """Along one axis: the voxels before the points [voxels], the offsets to the next, the distances
        outside.
        """
        clamped = ti.min(ti.max(at, 0.0), float(self.shape[axis] - 1))
        base = ti.min(ti.cast(clamped, ti.i32), self.count[axis] - 2)
        return base, clamped - base, ti.abs(at - clamped)

    @ti.func
    def between(self, voxel, tj, tk):
        """Values at lanes between the four voxels of a plane, of which this is the first."""
        a, b = self.voxels[voxel], self.voxels[voxel + 1]
        c, d = self.voxels[voxel + self.next_y], self.voxels[voxel + self.next_y + 1]
        low, high = a + tk * (b - a), c + tk * (d - c)
        return low + tj * (high - low)

    @ti.func
    def lanes_between(self, first, tj, tk):
        """As ``between``, each lane with its own voxels."""
        a, b = self.lanes_of(first), self.lanes_of(first + 1)
        c, d = self.lanes_of(first + self.next_y), self.lanes_of(first + self.next_y + 1)
        low, high = a + tk * (b - a), c + tk * (d - c)
        return low + tj * (high - low)

    @ti.func
    def lanes_of(self, at):
        """The voxels of the lanes."""
        return Lanes([self.voxels[at[lane]] for lane in ti.static(range(LANES))])

    @ti.func
    def along_z(self, voxel, t):
        """The value between a voxel and the next along z, at a fraction of their distance."""
        return tm.mix(self.voxels[voxel], self.voxels[voxel + 1], t)

    @ti.func
    def gradient(self, p):
        """The gradient [1/mm] of the first trilinear value at p [mm], over a voxel to each side; zero
        outside.

        The derivative of the trilinear value itself is constant along its axis in each cell: of a thin
        interface it gives a wrong direction.
        """
        at = self.linear @ p + self.offset
        last = tm.vec3(self.shape[0] - 1, self.shape[1] - 1, self.shape[2] - 1)
        along = tm.vec3(0.0)
        if (at >= -0.5).all() and (at <= last + 0.5).all():
            for axis in ti.static(range(3)):
                low, high = tm.clamp(at, 0.0, last), tm.clamp(at, 0.0, last)
                low[axis] = ti.max(at[axis] - 1.0, 0.0)
                high[axis] = ti.min(at[axis] + 1.0, last[axis])
                change = self.first_value(high) - self.first_value(low)
                along[axis] = change / ti.max(high[axis] - low[axis], 0.5)
        return self.linear.transpose() @ along

    @ti.func
    def slope(self, p):
        """The gradient [1/mm] of the trilinear value at p [mm] of a volume of scalars, within its cell; zero
        outside.
        """
        first, t, inside = self.cell_at(p)
        along = tm.vec3(0.0)
        if inside:
            low, high = tm.vec4(0.0), tm.vec4(0.0)
            for k in ti.static(range(4)):
                voxel = first + ti.static(k // 2) * self.next_x + ti.static(k % 2) * self.next_y
                low[k], high[k] = self.voxels[voxel], self.voxels[voxel + 1]
            v = tm.mix(low, high, t.z)
            rise = high - low
            along = tm.vec3(
                tm.mix(v.z - v.x, v.w - v.y, t.y),
                tm.mix(v.y - v.x, v.w - v.z, t.x),
                tm.mix(tm.mix(rise.x, rise.y, t.y), tm.mix(rise.z, rise.w, t.y), t.x),
            )
        return self.linear.transpose() @ along

    @ti.func
    def first_value(self, at):
        """The first trilinear value at an index within the grid."""
        most = ti.Vector([self.count[0] - 2, self.count[1] - 2, self.count[2] - 2])
        base = ti.min(ti.cast(at, ti.i32), most)
        t = at - base
        first = base.x * self.next_x + base.y * self.next_y + base.z
        low, high = tm.vec4(0.0), tm.vec4(0.0)
        for k in ti.static(range(4)):
            voxel = first + ti.static(k // 2) * self.next_x + ti.static(k % 2) * self.next_y
            low[k], high[k] = self.voxels[voxel][0], self.voxels[voxel + 1][0]
        ends = tm.mix(low, high, t.z)
        return tm.mix(tm.mix(ends.x, ends.y, t.y), tm.mix(ends.z, ends.w, t.y), t.x)


def distance_volume(
    surface: trimesh.Trimesh, spacing_mm: float = 2.0, reach_mm: float = 6.0
) -> SampledVolume:
    """Signed distances [mm] to a closed surface, negative inside, up to ``reach_mm`` around it; FAR_MM
    beyond.
    """
    distance, low = distance_grid(surface.vertices, surface.faces, spacing_mm, reach_mm)
    index_from_mm = np.eye(4)
    index_from_mm[:3] /= spacing_mm
    index_from_mm[:3, 3] = -low / spacing_mm
    return SampledVolume(distance, index_from_mm, outside=FAR_MM)
