"""Self-contact: neighbours, displacements and friction, against float64 oracles."""

from itertools import pairwise

import numpy as np
import pytest
import taichi as ti
import trimesh
from lattice_tissue import position
from test_particle_contact import begin
from test_solver import solver_of

from sim.fields import array_of, fill
from sim.kernels import kernel
from sim.shapes import Plane
from sim.solver import Solver, StepSettings


def two_blocks(pairs: bool, scaling: float = 0.0, floor: bool = True) -> Solver:
    """One block over another, on a floor."""
    lower = trimesh.creation.box([12.0, 12.0, 8.0])
    upper = lower.copy()
    # Clusters reach 5 mm: nearer bodies would share clusters.
    upper.apply_translation([0, 0, 14.0])
    shapes = [Plane(np.array([0.0, 0.0, 1.0]), -4.0)] * floor
    both = trimesh.util.concatenate([lower, upper])
    return solver_of(both, shapes, radius=1.5, scaling=scaling, pairs=pairs)


def of_upper(solver: Solver) -> np.ndarray:
    """Mask (n,) of the upper block's particles."""
    return solver.body.rest_points[:, 2] > 7


def test_particles_that_share_no_cluster_keep_their_distance(kept):
    height = {}
    for pairs in (False, True):
        solver = kept(two_blocks, pairs)
        upper = of_upper(solver)
        for _ in range(40):
            solver.step(StepSettings(iterations=30))
        x = position(solver)
        height[pairs] = x[upper][:, 2].mean() - x[~upper][:, 2].mean()
        if pairs:
            # The lowest layer, a twelfth of the block, holds its weight, g h^2 = 0.3 mm a substep, in 30
            # iterations that share each push between two: 0.3 * 12 / 30 * 2 mm short of the distance, at the
            # averaged pushes.
            assert np.linalg.norm(x[upper][:, None] - x[~upper][None], axis=2).min() > 0.75 * 1.5
    assert height[True] == pytest.approx(8.0, abs=1.5)
    assert height[False] < 4.0


def test_neighbours_are_all_that_are_near_in_ascending_order(kept):
    solver = kept(two_blocks, True)
    upper = of_upper(solver)
    x = position(solver)
    x[upper, 2] -= 7.0
    fill((solver.body.position, x))
    begin(solver, [0.0, 0.0, 0.0])
    count, rows = array_of(solver.self_contacts.neighbour_count), array_of(solver.self_contacts.neighbour)
    apart = np.linalg.norm(x[:, None] - x[None], axis=2)
    patches = solver.model.patches
    of_patch = [set(patches.clusters.indices[a:b]) for a, b in pairwise(patches.clusters.indptr)]
    clusters = [of_patch[p] for p in patches.of_particles()]
    for i in range(len(x)):
        near = [
            j
            for j in np.flatnonzero(apart[i] < solver.self_contacts.reach)
            if j != i and not clusters[i] & clusters[j]
        ]
        assert rows[i, : count[i]].tolist() == near[:24]
    assert count.max() > 5


def pairs_pass(solver: Solver, moved: np.ndarray, factor: float) -> tuple[np.ndarray, int, int]:
    """Predicted positions (n, 3) after one iteration over pairs in float64, and how many pairs stick and
    slide.
    """
    pairs, body = solver.self_contacts, solver.body
    x = moved + array_of(body.position)
    # The lower is the heavier, against gravity along -z.
    mass = np.exp(-body.mass_scaling_per_mm * x[:, 2])
    row, count = array_of(pairs.neighbour), array_of(pairs.neighbour_count)
    change, touching, sticks, slides = np.zeros_like(x), np.zeros(len(x)), 0, 0
    for i in range(len(x)):
        for j in row[i, : count[i]]:
            away = x[i] - x[j]
            gap = np.linalg.norm(away)
            depth = pairs.distance - gap
            if depth > 0:
                normal = away / gap if gap > 0 else np.array([0.0, 0.0, np.sign(i - j)])
                slip = (np.eye(3) - np.outer(normal, normal)) @ (moved[i] - moved[j])
                most = pairs.friction * depth
                sticks, slides = (
                    sticks + (np.linalg.norm(slip) < most),
                    slides + (np.linalg.norm(slip) > most),
                )
                rubbed = slip * min(1.0, most / max(np.linalg.norm(slip), 1e-12))
                change[i] += mass[j] / (mass[i] + mass[j]) * (depth * normal - rubbed)
                touching[i] += 1
    share = touching.max() if pairs.relax_globally else np.maximum(touching, 1)[:, None]
    return x + factor * change / share, sticks, slides


@pytest.mark.parametrize("relaxation, scaling", [("local", 0.0), ("global", 0.0), ("local", 0.5)])
def test_an_iteration_over_pairs_matches_the_oracle(one_device, relaxation, scaling):
    lower = trimesh.creation.box([9.0, 9.0, 6.0])
    upper = lower.copy().apply_translation([0, 0, 12.0])
    both = trimesh.util.concatenate([lower, upper])
    solver = solver_of(both, radius=1.5, relaxation=relaxation, scaling=scaling, pairs=True)
    body, pairs = solver.body, solver.self_contacts
    x, random = position(solver), np.random.default_rng(5)
    over = x[:, 2] > 6
    x[over] -= [0.4, 0.3, 6.2]
    # Two are at the same point, and stay there.
    x[x[:, 2].argmax()] = x[x[:, 2].argmin()]
    top, bottom = np.flatnonzero((x == x[x[:, 2].argmin()]).all(axis=1))
    moved = random.normal(0, 0.05, x.shape) * random.uniform(0, 1, (len(x), 1)) ** 3
    moved[top] = moved[bottom]
    fill((body.velocity, (moved / 0.01)))

    @kernel
    def project(pairs: ti.template()):
        pairs.project(1.3)

    # The second time a particle has fewer contacts at most, and nothing is left of the first.
    most = []
    for lift, least in ((0.0, 10), (1.2, 1)):
        x[over, 2] += lift
        fill((body.position, x))
        begin(solver, [0.0, 0.0, -1e-3], 0.01)
        moved = array_of(body.predicted).astype(float) - array_of(body.position)
        wanted, sticks, slides = pairs_pass(solver, moved, 1.3)
        assert sticks > least and slides > least
        project(pairs)
        most.append(int(array_of(pairs.most_contacts)))
        # Float32 positions of 10 mm carry 1e-6 mm; a normal of two that are 1 mm apart, as much of its own.
        assert np.abs(array_of(body.predicted) - wanted).max() < 1e-5
    assert most[0] > most[1]
