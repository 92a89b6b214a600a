"""Particles and clusters by the paper's greedy method."""

from types import SimpleNamespace

import igl
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from sim.lattice import fill_with_cells
from sim.sampling import SamplingError, fill_body, occupied_voxels, sample_clusters


def test_particles_keep_their_distance_and_leave_no_room(ball):
    radius, factor = 2.0, 4
    particles = fill_body(ball, radius, factor).particles
    nearest = cKDTree(particles).query(particles, 2)[0][:, 1]
    assert nearest.min() >= radius - 1e-9
    origin, occupied = occupied_voxels(ball.vertices, ball.faces, radius / factor)
    samples = origin + radius / factor * np.argwhere(occupied)
    assert cKDTree(particles).query(samples)[0].max() < radius
    assert np.linalg.norm(particles, axis=1).max() <= 12.0


def test_occupied_voxels_have_the_volume_of_the_surface(ball):
    # Voxels cut by the surface count by their centres: the error of the sum is far below one layer of them.
    pitch = 0.5
    occupied = occupied_voxels(ball.vertices, ball.faces, pitch)[1]
    assert occupied.sum() * pitch**3 == pytest.approx(ball.volume, rel=0.01)


def test_voxels_are_centred_in_the_surfaces_bounds(ball):
    ball = ball.copy().apply_translation([3.0, -1.0, 2.0])
    for pitch in (0.7, 1.0):
        origin, occupied = occupied_voxels(ball.vertices, ball.faces, pitch)
        last = origin + pitch * (np.array(occupied.shape) - 1)
        # As far within the bounds on one side as on the other, and no more than half a voxel.
        assert origin - ball.bounds[0] == pytest.approx(ball.bounds[1] - last, abs=1e-9)
        assert (origin - ball.bounds[0] <= pitch / 2 + 1e-9).all()


def test_surface_samples_are_as_many_as_asked_for(ball):
    # So few that none is within the radius of another.
    particles = fill_body(ball, 0.7, 1, surface_samples_per_mm2=0.01).particles
    on = np.abs(igl.signed_distance(particles, ball.vertices, ball.faces)[0]) < 1e-6
    assert on.sum() == int(0.01 * ball.area) == 18


def test_surface_samples_put_particles_on_the_surface(ball):
    particles = fill_body(ball, 2.0, 4, surface_samples_per_mm2=2.0).particles
    depth = np.abs(igl.signed_distance(particles, ball.vertices, ball.faces)[0])
    assert (depth < 1e-6).sum() > 200
    assert cKDTree(particles).query(particles, 2)[0][:, 1].min() >= 2.0 - 1e-9


def test_clusters_cover_and_overlap(ball):
    particles = fill_body(ball, 1.5, 4).particles
    spacing = 3.33 * 1.5
    clusters = sample_clusters(particles, spacing)
    shared = np.bincount(clusters.indices, minlength=len(particles))
    assert shared.min() >= 1 and shared.mean() > 2
    for c in range(clusters.shape[0]):
        row = clusters.indices[clusters.indptr[c] : clusters.indptr[c + 1]]
        assert (np.diff(row) > 0).all()
        members = particles[row]
        assert cKDTree(members).query_ball_point(members, spacing, return_length=True).max() == len(members)


def test_a_body_touches_where_its_surface_does(ball):
    body = fill_body(ball, 2.0)
    # The ball is a polyhedron: its surface lies up to 0.1 mm inside the sphere.
    depth = 12.0 - np.linalg.norm(body.particles, axis=1)
    assert np.abs(body.contact_radius - np.minimum(depth, 2.0)).max() < 0.1


def test_a_radius_too_large_is_refused(ball):
    with pytest.raises(SamplingError, match="choose a smaller radius"):
        fill_body(ball, 30.0)


def test_counts_on_a_real_kidney_are_those_of_the_papers_scale(data):
    # The paper's Fig. 5 has about 15 000 particles and 400 clusters at 2.2 mm for a kidney of this size: at
    # 3.3 mm 4500.
    kidney = trimesh.load_mesh(data / "truth" / "kits040" / "kidney.stl")
    particles = fill_body(kidney, 3.3).particles
    assert len(particles) == pytest.approx(4614, rel=0.01)
    assert 100 < sample_clusters(particles, 3.33 * 3.3).shape[0] < 450


def test_too_little_memory_is_refused_with_the_amount_needed(ball, monkeypatch):
    def free(count):
        monkeypatch.setattr("psutil.virtual_memory", lambda: SimpleNamespace(available=count))

    # A box of 24 mm in voxels of 0.5 mm: 48 each way, of 80 bytes.
    free(80 * 48**3 - 1)
    with pytest.raises(
        SamplingError, match=r"of 2 mm radius need 0\.0 GB .*, and 0\.0 GB are free: choose larger"
    ):
        fill_body(ball, 2.0, 4)
    free(80 * 48**3)
    assert len(fill_body(ball, 2.0, 4).particles) > 100
    free(9000 * ball.volume / 8 - 1)
    with pytest.raises(SamplingError, match="cells of 2 mm need"):
        fill_with_cells(ball, 2.0)
    free(9000 * ball.volume / 8 + 1)
    assert fill_with_cells(ball, 2.0).cell_mm == 2
