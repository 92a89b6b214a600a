"""The paper's tissue model against a NumPy float64 oracle, and conservation of momentum."""

from itertools import pairwise

import numpy as np
import pytest
import taichi as ti
from conftest import rotation_about
from particle_tissue import tissue_of
from test_solver import solver_of

from sim.body import BodyState, ParticleBody
from sim.fields import array_of, fill
from sim.kernels import kernel
from sim.sampling import fill_body, group_into_patches, sample_clusters
from sim.shape_matching import ShapeMatching
from sim.shapes import Plane

# Positions up to 15 mm in float32 carry 1e-6 mm; a sum over 100 members and an SVD leave some ten times that.
ROUNDING_MM = 3e-5


@kernel
def project(model: ti.template(), stiffness: float, factor: float):
    model.begin(0.0)
    model.gather()
    model.project(stiffness, factor, 0.0)
    model.scatter()


def deformed(particles: np.ndarray) -> np.ndarray:
    """Positions bent, stretched, rotated and translated, with noise: no cluster moves rigidly."""
    random = np.random.default_rng(2)
    bent = particles + 0.02 * particles[:, [2, 0, 1]] ** 2 + random.normal(0, 0.2, particles.shape)
    return 1.1 * bent @ rotation_about([1, 2, 3], 70).T + [5.0, -3.0, 8.0]


def oracle(model: ShapeMatching, x: np.ndarray, step: float, mass: np.ndarray | float = 1.0) -> np.ndarray:
    """One iteration of Eqs. 8, 9, 12 and 7 in float64, cluster by cluster, for particles of a mass (n,)."""
    rest, patches = model.body.rest_points, model.patches
    shared = patches.cluster_counts[patches.of_particles()].astype(float)
    weight = mass / shared if model.relaxation == "local" else mass * np.ones(len(rest))
    of_patch = np.repeat(np.arange(len(patches)), patches.cluster_counts)
    total = np.zeros_like(x)
    for c in range(model.count):
        i = np.flatnonzero(np.isin(patches.of_particles(), of_patch[patches.clusters.indices == c]))
        m = weight[i, None]
        centre, centre0 = (m * x[i]).sum(0) / m.sum(), (m * rest[i]).sum(0) / m.sum()
        u, _, vt = np.linalg.svd((m * (x[i] - centre)).T @ (rest[i] - centre0))
        u[:, 2] *= np.sign(np.linalg.det(u @ vt))
        total[i] += (rest[i] - centre0) @ (u @ vt).T + centre - x[i]
    count = shared if model.relaxation == "local" else np.full(len(rest), shared.max())
    return x + step * total / count[:, None]


def moved_body(
    kept, mesh, relaxation: str, mass_scaling: float = 0.0
) -> tuple[ParticleBody, ShapeMatching, np.ndarray]:
    model = kept(solver_of, mesh, relaxation=relaxation, scaling=mass_scaling).model
    body = model.body
    x = deformed(body.rest_points).astype(np.float32)
    body.restore(BodyState(x, np.zeros_like(x)))
    model.update_frames()
    return body, model, x.astype(np.float64)


@pytest.mark.parametrize("relaxation", ["local", "global"])
@pytest.mark.parametrize(
    "stiffness, factor, scaling", [(1.0, 1.0, 0.0), (0.4, 1.0, 0.0), (0.9, 1.7, 0.0), (1.0, 1.0, 0.1)]
)
def test_an_iteration_matches_the_oracle(kept, block, relaxation, stiffness, factor, scaling):
    body, model, x = moved_body(kept, block, relaxation, scaling)
    mass = np.exp(-scaling * body.rest_points[:, 2])
    if scaling:
        fill((body.mass_scale, mass))
        assert np.abs(oracle(model, x, 1.0, mass) - oracle(model, x, 1.0)).max() > 100 * ROUNDING_MM
    project(model, stiffness, factor)
    wanted = oracle(model, x, stiffness * factor, mass)
    assert np.abs(wanted - x).max() > 0.3
    assert np.abs(array_of(body.predicted) - wanted).max() < ROUNDING_MM


@pytest.mark.parametrize("relaxation", ["local", "global"])
def test_an_iteration_conserves_linear_and_angular_momentum(kept, block, relaxation):
    body, model, x = moved_body(kept, block, relaxation)
    project(model, 0.8, 1.0)
    change = array_of(body.predicted) - x
    # Each of n particles contributes its rounding, which adds like a random walk; the angular sum has lever
    # arms.
    n = len(x)
    assert np.abs(change).sum() > 100
    assert np.abs(change.sum(axis=0)).max() < ROUNDING_MM * n**0.5 * 3
    turning = np.cross(x - x.mean(axis=0), change).sum(axis=0)
    assert np.abs(turning).max() < ROUNDING_MM * n**0.5 * 3 * np.abs(x - x.mean(axis=0)).max()


@pytest.mark.parametrize("relaxation", ["local", "global"])
def test_patches_follow_their_particles_after_contact(one_device, block, relaxation):
    model = tissue_of(block, shapes=[Plane(np.array([0.2, -0.1, 1.0]), -5.0)], relaxation=relaxation)
    patches, several = model.patches, model.patches.multi_count
    x = deformed(model.body.rest_points) * 0.9 - [4.0, -2.0, 7.0]
    model.body.restore(BodyState(x.astype(np.float32), np.zeros(x.shape, np.float32)))
    model.update_frames()

    @kernel
    def pressed(model: ti.template()):
        model.begin(0.0)
        model.contacts.find()
        model.gather()
        model.project(0.9, 1.0, 0.0)

    pressed(model)
    predicted = array_of(model.predicted)[:, :3].astype(float)
    touched = np.bincount(patches.of_particles(), array_of(model.contacts.touched) > 0)
    assert 10 < (touched[:several] > 0).sum() < several - 10
    centre = np.add.reduceat(predicted, patches.start[:-1]) / patches.sizes[:, None]
    assert np.abs(array_of(model.centre)[:, :3] - centre).max() < ROUNDING_MM
    share = 1 / patches.cluster_counts if relaxation == "local" else np.ones(len(patches))
    rest, moment = model.body.rest_points, array_of(model.moment)
    for p in range(several):
        of = slice(patches.start[p], patches.start[p + 1])
        wanted = share[p] * (rest[of] - rest[of].mean(axis=0)).T @ (predicted[of] - centre[p])
        # Each of a patch's particles rounds times its lever, which is at most 7 mm.
        assert np.abs(moment[p][:3, :3] - wanted).max() < 7 * patches.sizes[p] * ROUNDING_MM


def test_collapsed_flat_and_inverted_bodies_come_back_to_finite_shapes(kept, block):
    body, model, _ = moved_body(kept, block, "local")
    rest = body.rest_points
    for squash in (
        np.zeros((3, 3)),
        np.diag([1.0, 1.0, 0.0]),
        np.diag([1.0, 0.0, 0.0]),
        np.diag([1.0, 1.0, -1.0]),
    ):
        fill((body.predicted, (rest @ squash)))
        project(model, 1.0, 1.0)
        assert np.isfinite(array_of(body.predicted)).all()
        turned = array_of(model.frame)[:, :3, :3].astype(float)
        assert np.abs(np.linalg.det(turned) - 1).max() < 1e-5


def test_patches_have_each_membership_of_the_clusters(block):
    rest = fill_body(block, 2.0)
    arranged, patches = group_into_patches(rest, 3.33)
    assert sorted(map(tuple, arranged.particles)) == sorted(map(tuple, rest.particles))
    clusters = sample_clusters(rest.particles, 3.33 * 2.0)
    wanted = {
        frozenset(map(tuple, rest.particles[clusters.indices[a:b]])) for a, b in pairwise(clusters.indptr)
    }
    rows = [patches.clusters.indices[a:b] for a, b in pairwise(patches.clusters.indptr)]
    memberships: dict[int, set] = {}
    for particle, p in zip(arranged.particles, patches.of_particles(), strict=True):
        for c in rows[p]:
            memberships.setdefault(int(c), set()).add(tuple(particle))
    assert {frozenset(members) for members in memberships.values()} == wanted
    # No two patches are in the same clusters, and those with several particles come first.
    assert len({row.tobytes() for row in rows}) == len(patches)
    assert (patches.sizes[: patches.multi_count] > 1).all() and (
        patches.sizes[patches.multi_count :] == 1
    ).all()


def test_an_unknown_relaxation_is_refused_by_name(one_device, block):
    with pytest.raises(ValueError, match="'loose'.*local, global"):
        tissue_of(block, relaxation="loose")
