"""A scalar volume on the device, sampled in mm."""

import numpy as np
import taichi as ti
import taichi.math as tm
import trimesh

from sim.distance import signed_distance

AIR_HU = -1000.0
FAR_MM = 1e6


@ti.data_oriented
class Volume:
    """Voxels (nx, ny, nz) float32 with the affine map (4, 4) that takes mm to voxel indices.

    Index (0, 0, 0) is the centre of the first voxel. ``outside`` is the value beyond the outer half voxel.
    """

    def __init__(self, voxels: np.ndarray, index_from_mm: np.ndarray, outside: float = AIR_HU) -> None:
        self.shape = voxels.shape
        self.outside = float(outside)
        self.voxels = ti.field(ti.f32, self.shape)
        self.voxels.from_numpy(np.ascontiguousarray(voxels, np.float32))
        self.linear = ti.Matrix(index_from_mm[:3, :3].tolist())
        self.offset = ti.Vector(index_from_mm[:3, 3].tolist())

    @ti.func
    def sample(self, p):
        """Trilinear value at p [mm]."""
        at = self.linear @ p + self.offset
        last = tm.vec3(self.shape[0] - 1, self.shape[1] - 1, self.shape[2] - 1)
        value = self.outside
        if (at >= -0.5).all() and (at <= last + 0.5).all():
            clamped = ti.math.clamp(at, 0.0, last)
            base = ti.cast(clamped, ti.i32)
            t = clamped - base
            value = 0.0
            for corner in ti.static(ti.grouped(ti.ndrange(2, 2, 2))):
                weight = 1.0
                for axis in ti.static(range(3)):
                    weight *= t[axis] if ti.static(corner[axis] == 1) else 1.0 - t[axis]
                # At the last voxel the next one has no weight, but must be there.
                value += weight * self.voxels[ti.min(base + corner, ti.cast(last, ti.i32))]
        return value


def distance_volume(surface: trimesh.Trimesh, spacing_mm: float = 2.0, reach_mm: float = 6.0) -> Volume:
    """Signed distances [mm] to a closed surface, negative inside, as far as ``reach_mm`` around it; FAR_MM beyond."""
    low = surface.vertices.min(axis=0) - reach_mm
    shape = np.ceil((surface.vertices.max(axis=0) + reach_mm - low) / spacing_mm).astype(int) + 1
    points = low + spacing_mm * np.indices(shape).reshape(3, -1).T
    distance = signed_distance(surface.vertices, surface.faces, points)[0]
    index_from_mm = np.eye(4)
    index_from_mm[:3] /= spacing_mm
    index_from_mm[:3, 3] = -low / spacing_mm
    return Volume(distance.reshape(shape), index_from_mm, outside=FAR_MM)
