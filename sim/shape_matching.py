"""The paper's tissue model: overlapping clusters, each matched rigidly to its rest shape (Eqs. 8-12)."""

import numpy as np
import taichi as ti
import taichi.math as tm
from scipy.spatial import cKDTree

from sim.body import ParticleBody
from sim.rotation import nearest_rotation
from sim.sampling import Clusters, sample_clusters

RELAXATIONS = ("local", "global")
# Points are carried by this many clusters at most.
MOST_FRAMES = 4
# Keeps the weight of a point on a cluster's very origin finite.
LEAST_SQUARED_MM2 = 1e-6


@ti.data_oriented
class ShapeMatching:
    """Clusters of a body's particles and their current frames.

    ``relaxation`` says how a particle's goals are combined (Eq. 7): ``local`` divides by the number of clusters
    that hold the particle, ``global`` by the largest such number of all particles. Each keeps the body's linear
    and angular momentum because of the masses with which the clusters are fitted: under ``local`` a particle
    gives each of its n clusters 1/n of its mass, under ``global`` the whole of it to each.
    """

    def __init__(self, body: ParticleBody, cluster_spacing: float = 3.33, relaxation: str = "local") -> None:
        if relaxation not in RELAXATIONS:
            raise ValueError(f"relaxation is {relaxation!r}: expected one of {', '.join(RELAXATIONS)}")
        rest = body.rest_points
        clusters = sample_clusters(rest, cluster_spacing * body.radius_mm)
        self.body = body
        self.groups = ((0, body.count),)
        self.count = len(clusters)
        self.membership_count = len(clusters.members)
        self._allocate(clusters, clusters.transposed(body.count))
        self._weigh(rest, clusters, relaxation)
        self.update_frames()

    def _allocate(self, clusters: Clusters, memberships: Clusters) -> None:
        self.member_offset = _int_field(clusters.offsets)
        self.member = _int_field(clusters.members)
        self.cluster_offset = _int_field(memberships.offsets)
        self.cluster = _int_field(memberships.members)
        self.rotation = ti.Matrix.field(3, 3, ti.f32, self.count)
        self.translation = ti.Vector.field(3, ti.f32, self.count)
        self.rest_centre = ti.Vector.field(3, ti.f32, self.count)
        self.weight = ti.field(ti.f32, self.body.count)
        self.averaging = ti.field(ti.f32, self.body.count)

    def _weigh(self, rest: np.ndarray, clusters: Clusters, relaxation: str) -> None:
        shared = np.bincount(clusters.members, minlength=len(rest)).astype(float)
        weight = 1.0 / shared if relaxation == "local" else np.ones(len(rest))
        averaging = np.ones(len(rest)) if relaxation == "local" else shared / shared.max()
        row = np.repeat(np.arange(len(clusters)), np.diff(clusters.offsets))
        w = weight[clusters.members]
        moment = [np.bincount(row, w * rest[clusters.members, axis]) for axis in range(3)]
        self.rest_centres = np.stack(moment, axis=1) / np.bincount(row, w)[:, None]
        self.weight.from_numpy(weight.astype(np.float32))
        self.averaging.from_numpy(averaging.astype(np.float32))
        self.rest_centre.from_numpy(self.rest_centres.astype(np.float32))

    def counts(self) -> dict[str, int]:
        """Particles, clusters, and memberships of the ones in the others."""
        return dict(particles=self.body.count, clusters=self.count, memberships=self.membership_count)

    @ti.func
    def begin(self, dt: float):
        pass

    @ti.func
    def project(self, first, last, stiffness: float, relaxation_factor: float, dt: float):
        """One pass over all clusters on the estimates: fit them, then move particles to their goals."""
        self.fit()
        self.move_to_goals(stiffness * relaxation_factor)

    @ti.func
    def fit(self):
        """Least-squares rigid frames of the clusters (Eq. 8), as x = rotation x0 + translation.

        Positions enter relative to the cluster's first particle, so that float32 keeps its digits wherever the
        body is.
        """
        for c in range(self.count):
            first, last = self.member_offset[c], self.member_offset[c + 1]
            reference = self.body.estimate[self.member[first]]
            centre0 = self.rest_centre[c]
            total = 0.0
            mean, mean0 = tm.vec3(0.0), tm.vec3(0.0)
            moment = tm.mat3(0.0)
            for k in range(first, last):
                i = self.member[k]
                w = self.weight[i]
                if ti.static(self.body.mass_scaled):
                    w *= self.body.mass_scale[i]
                p = self.body.estimate[i] - reference
                q = self.body.rest[i] - centre0
                total += w
                mean += w * p
                mean0 += w * q
                moment += w * p.outer_product(q)
            mean /= total
            mean0 /= total
            moment -= total * mean.outer_product(mean0)
            rotation = nearest_rotation(moment)
            self.rotation[c] = rotation
            self.translation[c] = reference + mean - rotation @ (centre0 + mean0)

    @ti.func
    def move_to_goals(self, step: float):
        """Move each estimate by ``step`` times the averaged way to its goals (Eqs. 9, 12 and 7).

        The mean of the goals R_c x0 + T_c is (mean R_c) x0 + mean T_c: no data per membership is needed.
        """
        for i in range(self.body.count):
            first, last = self.cluster_offset[i], self.cluster_offset[i + 1]
            rotation = tm.mat3(0.0)
            translation = tm.vec3(0.0)
            for k in range(first, last):
                c = self.cluster[k]
                rotation += self.rotation[c]
                translation += self.translation[c]
            goal = (rotation @ self.body.rest[i] + translation) / ti.cast(last - first, ti.f32)
            x = self.body.estimate[i]
            self.body.estimate[i] = x + step * self.averaging[i] * (goal - x)

    @ti.kernel
    def update_frames(self):
        """Fit the frames to where the particles are now, for ``carry``."""
        self.fit()

    def attach(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The up to four nearest clusters of points (n, 3) [mm] and their weights (Kavan 2014).

        Weights fall off with the inverse square of the distance from point to cluster origin and sum to 1.
        """
        frames = min(MOST_FRAMES, self.count)
        distance, nearest = cKDTree(self.rest_centres).query(points, list(range(1, frames + 1)))
        weight = 1.0 / (distance**2 + LEAST_SQUARED_MM2)
        return nearest, weight / weight.sum(axis=1, keepdims=True)

    @ti.kernel
    def carry(self, rest: ti.template(), frame: ti.template(), weight: ti.template(), out: ti.template()):
        """Points carried by weighted frames (weighted matrix blending)."""
        for v in rest:
            x = tm.vec3(0.0)
            for k in ti.static(range(frame.n)):
                c = frame[v][k]
                x += weight[v][k] * (self.rotation[c] @ rest[v] + self.translation[c])
            out[v] = x


def _int_field(values: np.ndarray) -> ti.Field:
    field = ti.field(ti.i32, len(values))
    field.from_numpy(np.asarray(values, np.int32))
    return field
