"""Particles that are in the same clusters: one affine map moves all of them to their averaged goals (NumPy, at build time)."""

from dataclasses import dataclass, replace

import numpy as np

from sim.body import RestBody
from sim.sampling import Clusters, offsets_of, sample_clusters


@dataclass(frozen=True)
class Patches:
    """Particles ``start[p]`` to ``start[p + 1]`` of a body are patch p; row p of ``clusters`` lists the clusters it is in.

    The ``several`` first patches have more than one particle, the others one. Where a kidney has five memberships of particles in
    clusters, it has two of patches.
    """

    start: np.ndarray
    clusters: Clusters

    def __len__(self) -> int:
        return len(self.start) - 1

    @property
    def several(self) -> int:
        """How many patches have more than one particle."""
        return int((self.sizes > 1).sum())

    @property
    def sizes(self) -> np.ndarray:
        """How many particles each has (p,)."""
        return np.diff(self.start)

    @property
    def shared(self) -> np.ndarray:
        """How many clusters each is in (p,)."""
        return np.diff(self.clusters.offsets)

    def of_particles(self) -> np.ndarray:
        """The patch of each particle (n,)."""
        return np.repeat(np.arange(len(self), dtype=np.int32), self.sizes)


def arrange(rest: RestBody, cluster_spacing: float) -> tuple[RestBody, Patches]:
    """A body's clusters, ``cluster_spacing`` radii apart, as patches; and the body with its particles in their order.

    Patches of several particles and of one come in the order of their first particles, so that neighbours in space stay
    neighbours in memory.
    """
    clusters = sample_clusters(rest.particles, cluster_spacing * rest.radius_mm)
    rows = clusters.transposed(len(rest.particles))
    number: dict[bytes, int] = {}
    patch = np.empty(len(rest.particles), np.int64)
    for i in range(len(patch)):
        row = rows.members[rows.offsets[i] : rows.offsets[i + 1]]
        patch[i] = number.setdefault(row.tobytes(), len(number))
    sequence = np.argsort(np.bincount(patch) == 1, kind="stable")
    patch = np.argsort(sequence)[patch]
    order = np.argsort(patch, kind="stable")
    found = list(number)
    members = [np.frombuffer(found[p], rows.members.dtype) for p in sequence]
    shared = Clusters(offsets_of([len(row) for row in members]), np.concatenate(members))
    arranged = replace(rest, particles=rest.particles[order], contact_radius=rest.contact_radius[order])
    return arranged, Patches(offsets_of(np.bincount(patch)), shared)
