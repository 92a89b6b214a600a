"""The paper's tissue model: position-based dynamics with clustered shape matching (Eqs. 8-12; Mueller et al.
2005).

The clusters overlap, and each is matched rigidly to its rest shape. The model computes on patches, groups of
particles that are in the same clusters: a cluster's moments are sums of its patches' moments, and one
averaged frame moves a whole patch.
"""

from typing import Any, ClassVar

import numpy as np
import taichi as ti
import taichi.math as tm
import trimesh

from sim.body import ParticleBody
from sim.device import is_too_small
from sim.fields import field_of, fields_of, zeros
from sim.kernels import function, kernel
from sim.linear_algebra import four, rotation_near, row
from sim.particle_contact import REACH_RADII, ShapeContacts
from sim.sampling import Patches, RestBody, fill_body, group_into_patches
from sim.skinning import ClusterCarrier, ClusterInterpolation
from sim.tissue_model import ModelInputs

RELAXATIONS = ("local", "global")
# With fewer particles, starting threads takes a CPU longer than they save.
PARALLEL_PARTICLES = 100_000


class ShapeMatching:
    """Clusters of a body's particles and their current frames.

    ``relaxation`` is how a particle's goals are combined (Eq. 7): ``local`` divides by the number of clusters
    that the particle is in, ``global`` by the largest such number of all particles. Both conserve linear and
    angular momentum, by the masses with which the clusters are fitted: under ``local`` a particle in n
    clusters counts with 1/n of its mass in each, under ``global`` with its whole mass.

    Of each patch: ``patch_rest``, its centre [mm] and mass, in units of a particle's, at rest; ``centre``
    now; ``moment``, rows that are the columns of the sum of m (x - centre) (x0 - centre0)^T; ``goal``, as
    ``frame``, the sum over its clusters. Of each cluster: ``cluster_rest``; ``frame``, rows that are the
    columns of the rotation R, then the translation T [mm] of x = R x0 + T. ``local`` (n,) are the particles'
    rest positions relative to their patches' centres, with 1 as the fourth entry.
    """

    EMBEDDING_CELL_RATIO: ClassVar[float] = 2.0

    @classmethod
    def make(cls, inputs: ModelInputs) -> "ShapeMatching":
        """Clusters of the particles that fill the organ; the organ may already be a RestBody.

        Raises SamplingError.
        """
        rest = inputs.organ if isinstance(inputs.organ, RestBody) else fill_organ(inputs.organ, inputs.tissue)
        sorted_rest, patches = group_into_patches(rest, inputs.tissue.cluster_spacing)
        body = ParticleBody(sorted_rest, inputs.mass_scaling_per_mm)
        contacts = ShapeContacts(body, inputs.shapes, inputs.friction) if inputs.shapes else None
        return cls(body, patches, contacts, inputs.relaxation, inputs.serial)

    @staticmethod
    def reach_mm(tissue: Any) -> float:
        """Distance [mm] within which particles need the distance to a shape."""
        return REACH_RADII * tissue.radius_mm

    def __init__(
        self,
        body: ParticleBody,
        patches: Patches,
        contacts: ShapeContacts | None = None,
        relaxation: str = "local",
        serial: bool | None = None,
    ) -> None:
        if relaxation not in RELAXATIONS:
            raise ValueError(f"relaxation is {relaxation!r}: expected one of {', '.join(RELAXATIONS)}")
        self.body = body
        self.contacts: Any = contacts
        self.has_contacts = contacts is not None
        self.serial = is_too_small(body.count, PARALLEL_PARTICLES) if serial is None else serial
        self.patches = patches
        self.patch_count = len(patches)
        self.multi_count = patches.multi_count
        self.count = patches.clusters.shape[1]
        self.relaxation = relaxation
        self._allocate(patches)
        self._store_rest(patches)
        self.carrier = ClusterCarrier(ClusterInterpolation(self.rest_centres), self.frame)
        self.update_frames()

    def _allocate(self, patches: Patches) -> None:
        members = patches.clusters.T.tocsr()
        row = np.repeat(np.arange(self.count), np.diff(members.indptr))
        multi = np.bincount(row, members.indices < patches.multi_count, minlength=self.count)
        self.patch_start, self.cluster_start, self.cluster_list = fields_of(
            patches.start, patches.clusters.indptr, patches.clusters.indices
        )
        self.member_start, self.member, self.multi_end = fields_of(
            members.indptr, members.indices, members.indptr[:-1] + multi.astype(np.int32)
        )
        self.predicted = zeros(self.body.count, 4, within=1)
        self.goal = zeros(self.patch_count, 4, 4, within=2)
        self.centre = zeros(self.patch_count, 4, within=1)
        self.moment = zeros(self.patch_count, 4, 4, within=2)
        self.sum = zeros(self.count, 4, 4, within=2)
        if self.has_contacts:
            self.touched = zeros(self.patch_count, kind=ti.i32)
            self.patch = field_of(patches.of_particles())
        self.frame = zeros(self.count, 4, 4, within=2)

    def _store_rest(self, patches: Patches) -> None:
        shared, sizes = patches.cluster_counts, patches.sizes
        # Global relaxation divides by the largest number of goals; the goals that a particle lacks are no
        # displacement.
        share, goals = 1.0 / shared, shared
        if self.relaxation == "global":
            share, goals = np.ones(len(shared)), np.full(len(shared), shared.max())
        rest = self.body.rest_points
        centre = np.add.reduceat(rest, patches.start[:-1]) / sizes[:, None]
        mass = share * sizes
        row = np.repeat(np.arange(len(patches)), shared)
        member = patches.clusters.indices
        total = np.bincount(member, mass[row])
        moment = [np.bincount(member, (mass * centre[:, axis])[row]) for axis in range(3)]
        self.rest_centres = np.stack(moment, axis=1) / total[:, None]
        local = rest - np.repeat(centre, sizes, axis=0)
        self.local, self.patch_centre, self.patch_scale, self.patch_rest, self.cluster_rest = fields_of(
            np.pad(local, ((0, 0), (0, 1)), constant_values=1.0),
            np.pad(centre, ((0, 0), (0, 1))),
            np.column_stack([share, share / mass, 1.0 / goals, shared / goals]),
            np.column_stack([centre, mass]),
            np.column_stack([self.rest_centres, total]),
            within=1,
        )

    def counts(self) -> dict[str, int]:
        """Particles, clusters, and memberships of particles in clusters."""
        memberships = int(self.patches.sizes @ self.patches.cluster_counts)
        return dict(particles=self.body.count, clusters=self.count, memberships=memberships)

    @ti.func
    def begin(self, dt: float):
        """Update masses and rest centres, where the masses are scaled: they have just changed."""
        if ti.static(self.body.mass_scaled):
            self.update_patch_masses()
            self.update_cluster_masses()

    @ti.func
    def update_patch_masses(self):
        """Masses and rest centres of the patches, by the scaled masses of their particles."""
        for p in range(self.patch_count):
            first, last = self.patch_start[p], self.patch_start[p + 1]
            moment, mass = tm.vec4(0.0), 0.0
            for k in range(first, last):
                scale = self.body.mass_scale[k]
                moment += scale * self.local[k]
                mass += scale
            share = self.patch_scale[p].x
            self.patch_rest[p] = tm.vec4(self.patch_centre[p].xyz + moment.xyz / mass, mass * share)
            self.patch_scale[p].y = 1.0 / mass

    @ti.func
    def update_cluster_masses(self):
        """Masses and rest centres of the clusters, by their patches'."""
        for c in range(self.count):
            first, last = self.member_start[c], self.member_start[c + 1]
            origin = self.patch_rest[self.member[first]]
            moment, mass = tm.vec3(0.0), 0.0
            for k in range(first, last):
                rest = self.patch_rest[self.member[k]]
                moment += rest.w * (rest - origin).xyz
                mass += rest.w
            self.cluster_rest[c] = tm.vec4(origin.xyz + moment / mass, mass)

    @ti.func
    def project(self, stiffness: float, relaxation_factor: float, dt: float):
        """One iteration over all clusters: fit them, then move the particles to their goals."""
        self.fit(False)
        self.average()
        self.move_to_goals(stiffness * relaxation_factor)
        if ti.static(self.has_contacts):
            self.push_out(relaxation_factor)

    @function
    def gather(self):
        """Read the predicted positions, and mark the patches that touch a shape."""
        self.sum_patches()
        if ti.static(self.has_contacts):
            for p in range(self.patch_count):
                self.touched[p] = 0
            for i in range(self.body.count):
                if self.contacts.touched[i] > 0:
                    self.touched[self.patch[i]] = 1

    @function
    def sum_patches(self):
        """Centres and moments of the patches at the predicted positions."""
        for p in range(self.multi_count):
            first, last = self.patch_start[p], self.patch_start[p + 1]
            reference = four(self.body.predicted[first])
            sums = tm.mat4(0.0)
            for k in range(first, last):
                predicted, at = four(self.body.predicted[k]), self.local[k]
                self.predicted[k] = predicted
                sums += self.moment_of(k, at, predicted - reference)
            self.add_moment(p, reference, tm.mat4(0.0), sums)
        for p in range(self.multi_count, self.patch_count):
            k = self.patch_start[p]
            self.predicted[k] = four(self.body.predicted[k])
            self.centre[p] = self.predicted[k]

    @function
    def scatter(self):
        """Write the predicted positions."""
        for k in range(self.body.count):
            self.body.predicted[k] = self.predicted[k].xyz

    @ti.func
    def moment_of(self, k, at, moved):
        """Contribution of particle k, ``local`` at a place and displaced by ``moved``, to its patch's moment
        (rows: columns of the moment) and sum (last row).
        """
        if ti.static(self.body.mass_scaled):
            moved *= self.body.mass_scale[k]
        return ti.Matrix.rows([at.x * moved, at.y * moved, at.z * moved, moved])

    @ti.func
    def add_moment(self, p, centre, moment, sums):
        """Centre and moment of patch p from sums over its particles' displacements, which keeps digits in
        float32.
        """
        scale, total = self.patch_scale[p], row(sums, 3)
        if ti.static(self.body.mass_scaled):
            sums -= (self.patch_rest[p] - self.patch_centre[p]).outer_product(total)
        self.moment[p] = moment + scale.x * sums
        self.centre[p] = centre + scale.y * total

    @function
    def fit(self, from_scratch: ti.template()):
        """Least-squares rigid frames of the clusters (Eq. 8), from their last rotations or from scratch.

        A loop for the sums, whose lengths differ, and one for the rotations, so that the second is
        vectorised.
        """
        for c in range(self.count):
            first, last = self.member_start[c], self.member_start[c + 1]
            reference = self.centre[self.member[first]]
            centre0 = self.cluster_rest[c]
            x, y, z, total = tm.vec4(0.0), tm.vec4(0.0), tm.vec4(0.0), tm.vec4(0.0)
            multi_end = self.multi_end[c]
            for k in range(first, multi_end):
                moment = self.moment[self.member[k]]
                at, moved = self.apart(self.member[k], centre0, reference)
                x += row(moment, 0) + at.x * moved
                y += row(moment, 1) + at.y * moved
                z += row(moment, 2) + at.z * moved
                total += moved
            for k in range(multi_end, last):
                at, moved = self.apart(self.member[k], centre0, reference)
                x += at.x * moved
                y += at.y * moved
                z += at.z * moved
                total += moved
            self.sum[c] = ti.Matrix.rows([x, y, z, reference + total / centre0.w])
        for c in range(self.count):
            fitted = self.sum[c]
            guess = tm.eye(3)
            if ti.static(not from_scratch):
                guess = self.frame[c][:3, :3].transpose()
            rotation = rotation_near(guess, fitted[:3, :3].transpose())
            origin = fitted[3, :3] - rotation @ self.cluster_rest[c].xyz
            for axis in ti.static(range(3)):
                for k in ti.static(range(3)):
                    self.frame[c][axis, k] = rotation[k, axis]
                self.frame[c][3, axis] = origin[axis]

    @ti.func
    def apart(self, p, centre0, reference):
        """Offset of patch p's centre from a cluster's at rest, and its offset from a reference now, times
        its mass.
        """
        rest = self.patch_rest[p]
        return rest - centre0, rest.w * (self.centre[p] - reference)

    @function
    def average(self):
        """Averaged frame of each patch's clusters: the mean of R_c x0 + T_c is (mean R_c) x0 + mean T_c
        (Eq. 7).
        """
        for p in range(self.patch_count):
            frame = tm.mat4(0.0)
            for k in range(self.cluster_start[p], self.cluster_start[p + 1]):
                frame += self.frame[self.cluster_list[k]]
            x, y, z, centre = row(frame, 0), row(frame, 1), row(frame, 2), self.patch_centre[p]
            origin = row(frame, 3) + centre.x * x + centre.y * y + centre.z * z
            self.goal[p] = self.patch_scale[p].z * ti.Matrix.rows([x, y, z, origin])

    @function
    def move_to_goals(self, step: float):
        """Move each predicted position by ``step`` times the averaged displacement to its goals (Eqs. 9
        and 12).
        """
        for p in range(self.multi_count):
            keep = 1.0 - step * self.patch_scale[p].w
            frame = step * self.goal[p]
            x, y, z, origin = row(frame, 0), row(frame, 1), row(frame, 2), row(frame, 3)
            reference = self.centre[p]
            sums = tm.mat4(0.0)
            for k in range(self.patch_start[p], self.patch_start[p + 1]):
                at = self.local[k]
                predicted = keep * self.predicted[k] + at.x * x + at.y * y + at.z * z + origin
                self.predicted[k] = predicted
                sums += self.moment_of(k, at, predicted - reference)
            self.add_moment(p, reference, tm.mat4(0.0), sums)
        for p in range(self.multi_count, self.patch_count):
            k = self.patch_start[p]
            keep = 1.0 - step * self.patch_scale[p].w
            self.predicted[k] = keep * self.predicted[k] + step * row(self.goal[p], 3)
            self.centre[p] = self.predicted[k]

    @function
    def push_out(self, relaxation_factor: float):
        """Push particles that touch a shape out of it."""
        for p in range(self.patch_count):
            if self.touched[p] > 0:
                sums = tm.mat4(0.0)
                for k in range(self.patch_start[p], self.patch_start[p + 1]):
                    if self.contacts.touched[k] > 0:
                        predicted = self.predicted[k]
                        change = four(self.contacts.pushed(k, predicted.xyz, relaxation_factor))
                        self.predicted[k] = predicted + change
                        sums += self.moment_of(k, self.local[k], change)
                moment = tm.mat4(0.0)
                if p < self.multi_count:
                    moment = self.moment[p]
                self.add_moment(p, self.centre[p], moment, sums)

    @kernel
    def update_frames(self):
        """Fit the frames to the current positions, for the carrier, independently of earlier frames."""
        if ti.static(self.serial):
            ti.loop_config(serialize=True)
            for _ in range(1):
                self.refit()
        else:
            self.refit()

    @ti.func
    def refit(self):
        self.sum_patches()
        self.fit(True)


def fill_organ(organ: trimesh.Trimesh, tissue: Any) -> RestBody:
    """The organ [mm] filled with a tissue's particles; takes seconds. Raises SamplingError."""
    return fill_body(organ, tissue.radius_mm, tissue.volume_sampling, tissue.surface_samples_per_mm2)
