"""A ball's lattice, points and membrane after a cut have what remains."""

import igl
import numpy as np
import pytest
import trimesh
from cut_ball import R, ball, cut_by, half_space
from test_lattice import OFFSET, F, most_missing

from rehearsal.resection.cut import Cut
from scenes.surfaces import signed_distance_from
from sim.lattice import (
    ERSATZ,
    Lattice,
    fill_with_cells,
    shape_functions,
    surface_patches,
    surface_points,
)
from sim.removed_tissue import RemovedTissue, lattice_without, patch_shares, points_without

ORGAN = ball(R, fine=3)
CELL_MM = 4.0
PART = ball(12.0, (0.0, 8.0, 5.0), fine=3)
WHOLE = fill_with_cells(ORGAN, CELL_MM, [PART])
CUTTERS = {
    "plane": half_space(11.0),
    "crater": ball(14.0, (0.0, 0.0, 24.0)),
    "deep": trimesh.creation.cylinder(9.0, 50.0, sections=48).apply_translation([0.0, 0.0, 18.0]),
}


def tissue_of(cut: Cut) -> RemovedTissue:
    return RemovedTissue(cut.specimen, cut.remnant, cut.on_remnant)


@pytest.fixture(scope="module", params=CUTTERS)
def tissue(request, one_device) -> RemovedTissue:
    return tissue_of(cut_by(ORGAN, CUTTERS[request.param]))


@pytest.fixture(scope="module")
def lattice(tissue) -> Lattice:
    return lattice_without(WHOLE, tissue, [PART])


def missing(tissue: RemovedTissue) -> float:
    """The largest error of the volume of the tissue that remains [mm^3].

    A cell's filled part is that of 6 x 6 x 6 samples, each with a linear share over its own width h: on a
    plane it is exact, on an edge between capsule and bed it is off by some h^2 of an edge's section, along
    its length; and that of the whole lattice.
    """
    h = CELL_MM / 6
    edge = 2 * np.pi * 15.0
    return (
        most_missing(ORGAN, CELL_MM) * 0.05
        + h**2 * edge
        + h**2 / 8 * 2 * abs(tissue.removed.integral_mean_curvature)
    )


def test_the_tissue_has_the_volume_and_the_centre_of_what_remains(tissue, lattice):
    remaining = tissue.remaining
    bound = missing(tissue)
    assert bound < 0.02 * ORGAN.volume < tissue.removed.volume
    assert abs(lattice.tissue.sum() - remaining.volume) < bound
    mass = lattice.node_mass(np.ones(len(lattice.cells)))
    centre = mass @ lattice.nodes / mass.sum()
    # What is missing is within the ball.
    assert np.abs(centre - remaining.center_mass).max() < bound / remaining.volume * R


def test_cells_away_from_the_cut_are_as_they_were(tissue, lattice):
    middle = WHOLE.nodes[WHOLE.cells].mean(axis=1)
    away = -signed_distance_from(tissue.removed, middle) < -CELL_MM * np.sqrt(3)
    assert away.sum() > 50
    for name in ("gradient", "volume", "hourglass", "tissue", "share"):
        np.testing.assert_array_equal(getattr(lattice, name)[away], getattr(WHOLE, name)[away])
    np.testing.assert_array_equal(lattice.cells, WHOLE.cells)
    np.testing.assert_array_equal(lattice.nodes, WHOLE.nodes)


def test_empty_cells_have_nothing_and_are_at_no_position(tissue, lattice):
    middle = WHOLE.nodes[WHOLE.cells].mean(axis=1)
    inside = -signed_distance_from(tissue.removed, middle) > CELL_MM * np.sqrt(3) / 2
    assert inside.sum() >= 3
    empty = lattice.volume == 0
    assert empty[inside].all()
    for name in ("gradient", "hourglass", "tissue", "share"):
        assert not getattr(lattice, name)[empty].any()
    assert set(lattice.index_of[lattice.index_of >= 0]) == set(np.flatnonzero(~empty))
    assert (lattice.tissue[~empty].sum(axis=1) > 0).all()
    # Cells with tissue are not stiffer than full ones, and the whole lattice has not changed.
    full = CELL_MM**3
    assert lattice.volume[~empty].min() > ERSATZ * full and lattice.volume.max() <= full * (1 + 1e-12)
    assert (WHOLE.volume > 0).all() and (WHOLE.index_of >= 0).sum() == len(WHOLE.cells)


def test_a_linear_field_has_its_gradient_and_no_hourglass_energy(lattice):
    field = WHOLE.nodes @ F.T + OFFSET
    corner = field[lattice.cells]
    is_filled = lattice.volume > 0
    gradient = np.einsum("mia,mib->mab", corner, lattice.gradient)[is_filled]
    np.testing.assert_allclose(gradient, np.broadcast_to(F, gradient.shape), atol=1e-12)
    inside = np.einsum("mia,mij,mja->m", corner, lattice.hourglass, corner)
    # Sums of squares of 30 mm, whose differences are rounded.
    assert np.abs(inside).max() < 1e-9 * (corner**2).sum(axis=(1, 2)).max()
    # Of a field that is not linear there is some, in each cell with tissue: never negative.
    wavy = np.random.default_rng(5).normal(size=WHOLE.nodes.shape)[lattice.cells]
    energy = np.einsum("mia,mij,mja->m", wavy, lattice.hourglass, wavy)
    assert energy.min() > -1e-12 and (energy[is_filled] > 0).all()


def test_the_elastic_volume_is_the_tissues_and_a_little_of_the_empty_part(lattice):
    is_filled = lattice.volume > 0
    tissue = lattice.tissue[is_filled].sum(axis=1)
    exact = tissue + ERSATZ * (CELL_MM**3 - tissue)
    np.testing.assert_allclose(lattice.volume[is_filled], exact, rtol=1e-12)


def test_a_part_keeps_its_share_of_what_remains(tissue, lattice):
    of_part = (lattice.share[:, 0] * lattice.tissue.sum(axis=1)).sum()
    left = trimesh.boolean.difference([PART, tissue.removed]).volume
    # Samples of cells that a part crosses are linear over their own width.
    h = CELL_MM / 6
    assert of_part == pytest.approx(left, abs=missing(tissue) + h * h / 8 * 2 * PART.integral_mean_curvature)


def test_points_of_removed_tissue_go_to_the_new_surface_and_have_its_area(tissue):
    spacing = CELL_MM / 2
    points, area = surface_points(ORGAN, spacing)
    moved, left = points_without(points, area, tissue, spacing)
    assert moved.shape == points.shape and left.shape == area.shape and left.min() >= 0
    gone = tissue.is_removed(points)
    assert 0 < gone.sum() < len(points)
    np.testing.assert_array_equal(moved[~gone], points[~gone])
    np.testing.assert_array_equal(left[~gone], area[~gone])
    # Each point of the new surface is on it, and together they have its area.
    new = tissue.new_surface()
    apart = igl.point_mesh_squared_distance(
        moved[gone], np.asarray(new.vertices), np.asarray(new.faces, np.int64)
    )[0]
    assert apart.max() < 1e-12
    assert left[gone].sum() == pytest.approx(new.area, rel=1e-9)
    # More points than the new surface needs have no area; fewer, of a narrow hole whose wall is larger than
    # what it takes of the capsule, are farther apart.
    needed = len(surface_points(new, spacing)[0])
    assert needed > gone.sum() or (left[gone] == 0).any()
    # A point at the edge stands for a piece of the capsule of which a part is removed: half a spacing on each
    # side.
    edge = 2 * np.pi * 18.0 * spacing
    assert left.sum() == pytest.approx(tissue.remaining.area, abs=edge)


@pytest.mark.parametrize("radius", [0.9, 0.3])
def test_a_hole_with_more_sides_than_it_takes_points_keeps_its_area(one_device, radius):
    """Its walls face six directions, and its mouth takes three points of the capsule or none: all stay."""
    hole = trimesh.creation.box([2 * radius, 2 * radius, 40.0]).apply_translation([0.3, 0.4, 28.0])
    narrow = tissue_of(cut_by(ORGAN, hole))
    points, area = surface_points(ORGAN, CELL_MM / 2)
    gone = narrow.is_removed(points)
    assert gone.sum() < 5
    moved, left = points_without(points, area, narrow, CELL_MM / 2)
    assert moved.shape == points.shape and np.isfinite(moved).all()
    assert left[gone].sum() == pytest.approx(narrow.new_surface().area if gone.any() else 0.0, rel=1e-9)
    np.testing.assert_array_equal(left[~gone], area[~gone])


def test_points_are_removed_by_the_surface_that_is_nearer(tissue):
    inside = np.array([[0.0, 0.0, R], [0.0, 0.0, -R], [R, 0.0, 0.0]])
    assert tissue.is_removed(inside).tolist() == [True, False, False]


def test_patches_keep_the_share_of_their_area_that_remains(tissue):
    share = patch_shares(ORGAN, WHOLE, tissue)
    area = surface_patches(ORGAN, CELL_MM, WHOLE.low_mm, WHOLE.cells, WHOLE.index_of)[2]
    assert share.shape == area.shape and share.min() == 0.0 and share.max() == 1.0
    capsule = trimesh.Trimesh(
        tissue.remaining.vertices, tissue.remaining.faces[~tissue.is_new], process=False
    )
    # Small faces count wholly or not, along the edge.
    edge = 2 * np.pi * 18.0 * CELL_MM / 4
    assert share @ area == pytest.approx(capsule.area, abs=edge)


def test_a_cut_with_faces_without_area_gives_points_that_are_numbers(tissue):
    """Boolean operations leave such faces; where one of them is alone, its points have no mean place."""
    new = tissue.new_surface()
    place = new.vertices[new.faces[0, 0]]
    flat = trimesh.Trimesh(
        np.vstack([new.vertices, np.tile(place - [0, 0, 3.0], (3, 1))]),
        np.vstack([new.faces, len(new.vertices) + np.arange(3)]),
        process=False,
    )
    points, area = surface_points(flat, 2.0)
    assert np.isfinite(points).all() and area.sum() == pytest.approx(new.area, rel=1e-9)


def test_the_corners_share_is_the_shape_function_at_the_centre_of_the_tissue(one_device):
    """Below the plane z = 11 a cell between 10.x and 14.x keeps its lower part, with its centre amid it."""
    cut = tissue_of(cut_by(ORGAN, CUTTERS["plane"]))
    lattice = lattice_without(WHOLE, cut, [PART])
    low = WHOLE.nodes[WHOLE.cells][:, 0]
    height = 11.0 - low[:, 2]
    crossed = (height > 0.5) & (height < CELL_MM - 0.5) & (np.linalg.norm(low, axis=1) < R - 3 * CELL_MM)
    assert crossed.sum() > 5
    share = lattice.tissue[crossed] / lattice.tissue[crossed].sum(axis=1, keepdims=True)
    part = height[crossed] / CELL_MM
    middle = np.column_stack([np.full((len(part), 2), 0.5), part / 2])
    # The layer of samples at the plane is filled by its share, and counts at its own middle: h^2 / 8 of a
    # cell.
    np.testing.assert_allclose(share, shape_functions(middle), atol=1 / 6**2 / 4 / part.min())
    np.testing.assert_allclose(lattice.tissue[crossed].sum(axis=1), CELL_MM**3 * part, rtol=1e-6)
