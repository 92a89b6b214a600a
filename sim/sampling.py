"""Sampling of particles in a closed surface, and of overlapping clusters of the particles (NumPy, at build
time).

The paper's greedy method (Camara et al. 2016, "Collision and data preparation"): samples at the voxels of a
fine voxelisation, optionally also on the surface; then one particle at a time, each removing the samples
nearer than the radius. The clusters are chosen among the particles in the same way.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import igl
import numpy as np
import psutil
import trimesh
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from errors import UserError
from sim.signed_distance import signed_distance

# Memory of one voxel during the inside test: index and position in 64 bits, and the result.
VOXEL_BYTES = 80


class SamplingError(UserError):
    """The surface cannot be filled with particles or cells; the message says why and what to change."""


@dataclass(frozen=True)
class RestBody:
    """A body of particles at rest.

    particles (n, 3) float64 [mm], in the frame of the surface, all of one mass; contact_radius (n,) [mm]:
    smallest allowed distance of a particle's centre from a shape.
    """

    particles: np.ndarray
    radius_mm: float
    contact_radius: np.ndarray


@dataclass(frozen=True)
class Patches:
    """Groups of particles that are in the same clusters: one affine map moves all particles of a patch to
    their goals.

    Particles ``start[p]`` to ``start[p + 1]`` of a body are patch p; row p of ``clusters`` lists the clusters
    it is in. The ``multi_count`` first patches have more than one particle, the others one. In a kidney,
    patches have 2.5 times fewer memberships in clusters than particles have.
    """

    start: np.ndarray
    clusters: csr_array

    def __len__(self) -> int:
        return len(self.start) - 1

    @property
    def multi_count(self) -> int:
        """Number of patches with more than one particle."""
        return int((self.sizes > 1).sum())

    @property
    def sizes(self) -> np.ndarray:
        """Number of particles of each patch (p,)."""
        return np.diff(self.start)

    @property
    def cluster_counts(self) -> np.ndarray:
        """Number of clusters that each patch is in (p,)."""
        return np.diff(self.clusters.indptr)

    def of_particles(self) -> np.ndarray:
        """Patch of each particle (n,)."""
        return np.repeat(np.arange(len(self), dtype=np.int32), self.sizes)


def fill_body(
    surface: trimesh.Trimesh,
    radius_mm: float,
    volume_sampling: float = 4.0,
    surface_samples_per_mm2: float = 0.0,
) -> RestBody:
    """Particles that fill a closed surface [mm], no two nearer than ``radius_mm``, along a space-filling
    curve.

    The voxels are ``radius_mm / volume_sampling`` wide. Samples on the surface come before those inside, so
    that thin parts keep their boundary. A particle touches a shape where the surface above it does: its
    contact radius is its depth under the surface, at most the particle radius. So a body in a mould of its
    own shape is at rest. Raises SamplingError when nothing fits, or when there is not enough memory.
    """
    vertices, faces = surface.vertices, surface.faces
    pitch = radius_mm / volume_sampling
    count = float(np.prod(np.ceil(np.ptp(vertices, axis=0) / pitch)))
    check_memory(VOXEL_BYTES * count, f"particles of {radius_mm:g} mm radius", "choose larger ones")
    origin, occupied = occupied_voxels(vertices, faces, pitch)
    outer = _surface_particles(vertices, faces, radius_mm, surface_samples_per_mm2)
    _clear_near(occupied, origin, pitch, outer, radius_mm)
    particles = np.concatenate([outer, origin + pitch * _greedy_voxels(occupied, volume_sampling)])
    if len(particles) < 4:
        raise SamplingError(
            f"a particle radius of {radius_mm:g} mm leaves {len(particles)} particles in the organ: "
            f"expected at least 4, choose a smaller radius"
        )
    particles = particles[np.argsort(morton_codes(particles, radius_mm), kind="stable")]
    depth = -signed_distance(vertices, faces, particles)[0]
    return RestBody(particles, radius_mm, np.clip(depth, 0.0, radius_mm))


def sample_clusters(particles: np.ndarray, spacing_mm: float) -> csr_array:
    """Clusters of the particles (n, 3) [mm]: centres greedily chosen ``spacing_mm`` apart, members within it
    (as in FleX).

    Row c has the particles of cluster c, ascending. The greedy choice leaves no particle farther than the
    spacing from a centre, so the clusters cover the body and overlap.
    """
    rows = [near for _, near in _greedy(particles, spacing_mm)]
    members = np.concatenate(rows)
    offsets = np.cumsum([0, *map(len, rows)])
    return csr_array((np.ones(len(members), bool), members, offsets), shape=(len(rows), len(particles)))


def group_into_patches(rest: RestBody, cluster_spacing: float) -> tuple[RestBody, Patches]:
    """The body with its particles sorted by patch, and the patches of its clusters, ``cluster_spacing`` radii
    apart.

    Patches with several particles come first; otherwise they keep the order of their first particles, so that
    neighbours in space stay neighbours in memory.
    """
    rows = sample_clusters(rest.particles, cluster_spacing * rest.radius_mm).T.tocsr()
    number: dict[bytes, int] = {}
    patch = np.empty(len(rest.particles), np.int64)
    for i in range(len(patch)):
        row = rows.indices[rows.indptr[i] : rows.indptr[i + 1]]
        patch[i] = number.setdefault(row.tobytes(), len(number))
    first = np.unique(patch, return_index=True)[1]
    sequence = np.argsort(np.bincount(patch) == 1, kind="stable")
    patch = np.argsort(sequence)[patch]
    order = np.argsort(patch, kind="stable")
    arranged = replace(rest, particles=rest.particles[order], contact_radius=rest.contact_radius[order])
    return arranged, Patches(np.cumsum([0, *np.bincount(patch)]), rows[first[sequence]])


def check_memory(needed_bytes: float, what: str, advice: str) -> None:
    """Raise SamplingError where ``what`` needs more memory than is free."""
    free = psutil.virtual_memory().available
    if needed_bytes > free:
        raise SamplingError(
            f"{what} need {needed_bytes / 1e9:.1f} GB in this organ, and {free / 1e9:.1f} GB are free: "
            f"{advice}"
        )


def occupied_voxels(vertices: np.ndarray, faces: np.ndarray, pitch: float) -> tuple[np.ndarray, np.ndarray]:
    """Centre (3,) [mm] of voxel 0, and the mask (nx, ny, nz) of voxels whose centre is inside the surface."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    shape = np.maximum(np.ceil((high - low) / pitch).astype(int), 1)
    origin = (low + high) / 2 - pitch * (shape - 1) / 2
    centres = origin + pitch * np.indices(shape).reshape(3, -1).T
    winding = igl.fast_winding_number(
        np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int64), centres
    )
    return origin, (winding > 0.5).reshape(shape)


def morton_codes(points: np.ndarray, cell_mm: float) -> np.ndarray:
    """Morton codes (n,) of points (n, 3) [mm]: sorted by them, neighbours in space are neighbours in
    memory.
    """
    cells = ((points - points.min(axis=0)) / cell_mm).astype(np.uint64)
    code = np.zeros(len(points), np.uint64)
    for bit in range(16):
        for axis in range(3):
            code |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return code


def _greedy_voxels(occupied: np.ndarray, reach: float) -> np.ndarray:
    """Indices (n, 3) of voxels chosen in scan order, each removing those nearer than ``reach`` voxels."""
    pad = int(np.ceil(reach))
    padded = np.pad(occupied, pad)
    offset = np.arange(-pad, pad + 1)
    squared = (np.stack(np.meshgrid(offset, offset, offset, indexing="ij")) ** 2).sum(axis=0)
    keep = squared >= reach**2 - 1e-9
    buffer = bytearray(np.ascontiguousarray(padded, np.uint8).tobytes())
    free = np.frombuffer(buffer, np.uint8).reshape(padded.shape)
    taken = []
    at = buffer.find(1)
    while at >= 0:
        i, j, k = np.unravel_index(at, padded.shape)
        taken.append((i - pad, j - pad, k - pad))
        free[i - pad : i + pad + 1, j - pad : j + pad + 1, k - pad : k + pad + 1] *= keep
        at = buffer.find(1, at + 1)
    return np.array(taken, np.float64).reshape(-1, 3)


def _surface_particles(
    vertices: np.ndarray, faces: np.ndarray, radius_mm: float, per_mm2: float
) -> np.ndarray:
    """Particles (n, 3) [mm] on the surface, greedily chosen from random samples of uniform density."""
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    count = int(per_mm2 * area.sum())
    if count == 0:
        return np.zeros((0, 3))
    random = np.random.default_rng(0)
    chosen = corners[random.choice(len(faces), count, p=area / area.sum())]
    u, v = random.random((2, count, 1))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    samples = chosen[:, 0] + u * (chosen[:, 1] - chosen[:, 0]) + v * (chosen[:, 2] - chosen[:, 0])
    return samples[[i for i, _ in _greedy(samples, radius_mm)]]


def _greedy(points: np.ndarray, spacing_mm: float) -> Iterator[tuple[int, np.ndarray]]:
    """Points chosen in their order, none within the spacing of an earlier one, and all points within it,
    ascending.
    """
    tree, free = cKDTree(points), np.ones(len(points), bool)
    for i in range(len(points)):
        if free[i]:
            near = np.sort(tree.query_ball_point(points[i], spacing_mm))
            free[near] = False
            yield i, near


def _clear_near(
    occupied: np.ndarray, origin: np.ndarray, pitch: float, points: np.ndarray, radius_mm: float
) -> None:
    """Clear in place the occupied voxels nearer than the radius to any of the points (n, 3) [mm]."""
    if len(points):
        voxels = np.argwhere(occupied)
        distance, _ = cKDTree(points).query(origin + pitch * voxels)
        near = voxels[distance < radius_mm]
        occupied[near[:, 0], near[:, 1], near[:, 2]] = False
