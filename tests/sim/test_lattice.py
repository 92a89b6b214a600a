"""A lattice of cut cells against the closed surface that it fills: sums, linear fields, interpolation."""

import igl
import numpy as np
import pytest
import trimesh

from sim.lattice import (
    CORNERS,
    ERSATZ,
    EXTRAPOLATED_CELLS,
    fill_with_cells,
    surface_points,
)
from sim.sampling import SamplingError

# A linear field, its gradient F and its offset.
F = np.array([[1.1, 0.2, -0.3], [0.1, 0.8, 0.4], [-0.2, 0.3, 1.3]])
OFFSET = np.array([5.0, -3.0, 8.0])


def rotated_block() -> trimesh.Trimesh:
    mesh = trimesh.creation.box([24.0, 20.0, 16.0])
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.radians(35), [1, 2, 3], [3, 1, 0]))
    return mesh


@pytest.fixture(params=["ball", "block", "rotated"])
def mesh(request, ball, block) -> trimesh.Trimesh:
    return {"ball": ball, "block": block, "rotated": rotated_block()}[request.param]


def most_missing(mesh: trimesh.Trimesh, cell_mm: float) -> float:
    """The largest error of the tissue's volume [mm^3].

    Distances are interpolated linearly over h = cell / 2, which is off by h^2 / 8 times the second
    derivatives at most: the two curvatures of the surface. Over the surface that sums to twice the integral
    of the mean curvature, which is known for edges too (their length times their angle).
    """
    return (cell_mm / 2) ** 2 / 8 * 2 * mesh.integral_mean_curvature


def signed(mesh: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """libigl's signed distance [mm], negative inside."""
    return igl.signed_distance(points, np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64))[0]


@pytest.mark.parametrize("cell_mm", [4.0, 3.0, 1.5])
def test_tissue_has_the_surfaces_volume_and_centre(mesh, cell_mm):
    lattice = fill_with_cells(mesh, cell_mm)
    bound = most_missing(mesh, cell_mm)
    assert bound < 0.03 * mesh.volume
    # The surface is offset until the volume is right; edges take a few more iterations.
    assert abs(lattice.tissue.sum() - mesh.volume) < 0.05 * bound
    mass = lattice.node_mass(np.ones(len(lattice.cells)))
    centre = mass @ lattice.nodes / mass.sum()
    # Bound of the centre: all missing volume on one side, at half of the size.
    reach = mesh.extents.max() / 2
    assert np.abs(centre - mesh.center_mass).max() < bound / mesh.volume * reach / 4


def test_empty_space_in_cut_cells_has_little_stiffness(mesh):
    lattice = fill_with_cells(mesh, 3.0)
    tissue = lattice.tissue.sum()
    cells = len(lattice.cells) * 3.0**3
    assert lattice.volume.sum() == pytest.approx(tissue + ERSATZ * (cells - tissue), rel=1e-12)
    assert lattice.volume.min() > ERSATZ * 3.0**3 and lattice.volume.max() <= 3.0**3 * (1 + 1e-12)
    assert lattice.tissue.min() > 0


def test_cells_are_cubes_and_cover_the_organ(mesh):
    lattice = fill_with_cells(mesh, 3.0)
    corner = lattice.nodes[lattice.cells]
    assert np.abs(corner - corner[:, :1] - 3.0 * CORNERS).max() < 1e-12
    centres = lattice.low_mm + 3.0 * (np.argwhere(lattice.index_of >= 0) + 0.5)
    assert np.abs(corner.mean(axis=1) - centres).max() < 1e-12
    assert (lattice.index_of[lattice.index_of >= 0] == np.arange(len(lattice.cells))).all()
    # A sliver thinner than a sample may have no cell.
    points = np.random.default_rng(1).uniform(*mesh.bounds, (4000, 3))
    points = points[signed(mesh, points) < -3.0 / 6]
    place = np.floor((points - lattice.low_mm) / 3.0).astype(int)
    assert len(points) > 500 and (lattice.index_of[tuple(place.T)] >= 0).all()
    assert len(np.unique(lattice.cells)) == len(lattice.nodes)


def test_linear_fields_have_exactly_their_gradient_and_no_hourglass(mesh):
    lattice = fill_with_cells(mesh, 3.0)
    moved = lattice.nodes @ F.T + OFFSET
    corner = moved[lattice.cells]
    # Sums of 8 products of up to 30 mm and 1 / 3 mm in float64; 1e-16 times that.
    assert np.abs(np.einsum("mia,mib->mab", corner, lattice.gradient) - F).max() < 1e-13
    assert np.abs(lattice.gradient.sum(axis=1)).max() < 1e-14
    assert np.abs(lattice.hourglass @ corner).max() < 1e-14 * np.abs(lattice.hourglass).max() * 30 * 8 * 10


def test_hourglass_is_the_energy_left_out_by_the_mean_gradient(block):
    # In a whole cell of width h, u = x y has |grad u|^2 = x^2 + y^2 about its mean: h^5 / 6 over the cell;
    # the 6 x 6 midpoints of an edge leave h^2 / 12 / 36 of each square out, h^3 times. All other modes are
    # larger.
    h = 4.0
    lattice = fill_with_cells(block, h)
    whole = np.flatnonzero(lattice.volume > h**3 * (1 - 1e-12))
    assert len(whole) > 20
    x = h * (CORNERS - 0.5)
    energy = (x[:, 0] * x[:, 1]) @ lattice.hourglass[whole] @ (x[:, 0] * x[:, 1])
    assert energy == pytest.approx(h**5 / 6 * (1 - 1 / 36), rel=1e-12)
    values = np.linalg.eigvalsh(lattice.hourglass)
    assert values.min() > -1e-12 * h
    # Only translations and the three linear fields have no energy.
    assert (values[:, 3] < 1e-12 * h).all() and (values[:, 4] > 1e-4 * lattice.volume / h**2).all()


def test_interpolation_is_exact_for_linear_fields_inside(mesh):
    lattice = fill_with_cells(mesh, 3.0)
    points = np.random.default_rng(3).uniform(*mesh.bounds, (2000, 3))
    points = np.concatenate([points[signed(mesh, points) < 0], mesh.vertices])
    nodes, weights = lattice.interpolation.attach(points)
    assert np.abs(weights.sum(axis=1) - 1).max() < 1e-13
    carried = np.einsum("pk,pkd->pd", weights, (lattice.nodes @ F.T + OFFSET)[nodes])
    assert np.abs(carried - points @ F.T - OFFSET).max() < 1e-12


def test_points_outside_all_cells_move_with_the_nearest_cell(ball):
    lattice = fill_with_cells(ball, 3.0)
    points = np.random.default_rng(6).uniform(-16, 16, (500, 3))
    nodes, _ = lattice.interpolation.attach(points)
    low, high = (lattice.nodes[lattice.cells].min(axis=1), lattice.nodes[lattice.cells].max(axis=1))
    apart = np.linalg.norm(points[:, None] - (low + high) / 2, axis=2)
    inside = ((points[:, None] >= low) & (points[:, None] <= high)).all(axis=2)
    nearest = np.where(inside.any(axis=1), inside.argmax(axis=1), apart.argmin(axis=1))
    assert 100 < inside.any(axis=1).sum() < 400
    assert np.array_equal(nodes, lattice.cells[nearest])


def test_extrapolation_ends_after_a_cell(ball):
    lattice = fill_with_cells(ball, 3.0)
    direction = np.random.default_rng(4).normal(size=(300, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    linear = lattice.nodes @ F.T + OFFSET
    for distance, exact in ((1.0, True), (200.0, False)):
        points = (12.0 + distance) * direction
        nodes, weights = lattice.interpolation.attach(points)
        assert np.abs(weights.sum(axis=1) - 1).max() < 1e-12
        # Trilinear weights at a place of -1 to 2 are products of three of at most 2.
        assert np.abs(weights).max() <= (1 + EXTRAPOLATED_CELLS) ** 3 + 1e-12
        carried = np.einsum("pk,pkd->pd", weights, linear[nodes])
        assert (np.abs(carried - points @ F.T - OFFSET).max() < 1e-11) == exact
        # The bound also applies to a displacement that varies from cell to cell.
        wave = np.sin(lattice.nodes)
        assert np.abs(np.einsum("pk,pkd->pd", weights, wave[nodes])).max() < 27.0


def test_surface_points_are_on_the_surface_and_their_areas_sum_to_its_area(mesh):
    points, area = surface_points(mesh, 2.0)
    assert area.sum() == pytest.approx(mesh.area, rel=1e-12) and area.min() > 0
    assert np.abs(signed(mesh, points)).max() < 1e-12
    # A cube of 2 mm is cut by at most about three faces' worth of its own; a face at 45 degrees has sqrt(3)
    # of it.
    assert area.max() < 3 * 2.0**2
    assert 0.5 * mesh.area / 2.0**2 < len(points) < 3 * mesh.area / 2.0**2
    # No position on the surface is farther from a point than a cube's diagonal and the half triangle it may
    # reach out.
    samples = trimesh.sample.sample_surface(mesh, 2000, seed=1)[0]
    nearest = np.linalg.norm(samples[:, None] - points[None], axis=2).min(axis=1)
    assert nearest.max() < 2.0 * np.sqrt(3) + 1.0


def test_a_thin_plate_has_points_on_both_of_its_sides():
    plate = trimesh.creation.box([20.0, 20.0, 0.5])
    points, area = surface_points(plate, 4.0)
    for side in (-0.25, 0.25):
        assert area[np.abs(points[:, 2] - side) < 1e-9].sum() >= 400.0 - 1e-9


def test_pressure_at_the_surface_points_has_the_resultant_of_the_surface(ball):
    # Pressure on a closed surface has no resultant; on its lower half it has pressure times the disc's area.
    points, area = surface_points(ball, 2.0)
    normal = points / np.linalg.norm(points, axis=1, keepdims=True)
    below = points[:, 2] < 0
    disc = np.pi * 12.0**2
    # A point of a cube of 2 mm at the rim is on one side or the other: the rim's half strip, where normals
    # are flat.
    assert abs((area[:, None] * normal).sum(axis=0)).max() < 0.01 * disc
    assert -(area * normal[:, 2])[below].sum() == pytest.approx(disc, rel=0.03)


@pytest.mark.parametrize(
    ("extents", "cell_mm", "words"),
    [
        ((30.0, 30.0, 0.5), 5.0, "choose smaller ones"),
        ((0.8, 0.8, 0.8), 20.0, "fill 0 % of"),
        ((24.0, 24.0, 24.0), 0.2, "choose larger ones"),
        ((1000.0, 1000.0, 1000.0), 0.5, "choose larger ones"),
    ],
)
def test_cells_too_large_or_too_many_are_refused(extents, cell_mm, words):
    with pytest.raises(SamplingError, match=words):
        fill_with_cells(trimesh.creation.box(extents), cell_mm)
