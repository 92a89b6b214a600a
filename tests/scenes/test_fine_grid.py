"""The finer grid of thick slices: linear, in place, and labels without stairs."""

from itertools import permutations

import numpy as np
import pytest
import trimesh
from conftest import rotation_about
from scipy import ndimage

from scenes.tissue_classes.fine_grid import (
    LONGEST_MM,
    SURFACE_MM,
    SurfaceGrid,
    box_around,
    coarse_distance,
    fine_factors,
    fine_index_from_mm,
    refined,
    refined_labels,
    signed_distance_of,
    surface_box,
)

THICK = (0.8, 0.8, 5.0)
MIDDLE = np.array([29.3, 28.1, 29.0])


def affine(spacing, turn=None, origin=(-30.0, 12.0, 7.0)) -> np.ndarray:
    """``index_from_mm`` of voxels of a spacing, turned."""
    mm_from_index = np.eye(4)
    mm_from_index[:3, :3] = (np.eye(3) if turn is None else turn) * np.array(spacing)
    mm_from_index[:3, 3] = origin
    return np.linalg.inv(mm_from_index)


def centres(spacing, factors=(1, 1, 1), extent_mm=60.0) -> np.ndarray:
    """Centres (nx, ny, nz, 3) [mm] of a grid of a spacing, divided, whose first coarse voxel has its
    centre at 0.
    """
    spacing, factors = np.array(spacing), np.array(factors)
    count = np.ceil(extent_mm / spacing).astype(int) * factors
    return ((np.moveaxis(np.indices(count), 0, -1) + 0.5) / factors - 0.5) * spacing


def ball(places: np.ndarray, radius=18.0) -> np.ndarray:
    """Distance [mm] from a ball."""
    return np.linalg.norm(places - MIDDLE, axis=-1) - radius


def cylinder(places: np.ndarray, radius=8.0) -> np.ndarray:
    """Distance [mm] from a long cylinder, oblique to all axes."""
    axis = np.array([1.0, 0.5, 2.0]) / np.linalg.norm([1.0, 0.5, 2.0])
    return np.linalg.norm(np.cross(places - MIDDLE, axis), axis=-1) - radius


@pytest.mark.parametrize("spacing", [THICK, (1.6, 1.61, 3.2), (0.5, 3.0, 1.5)])
def test_voxels_are_divided_into_as_few_as_are_short_enough(spacing):
    factors = fine_factors(np.array(spacing))
    assert (spacing / factors <= LONGEST_MM + 1e-5).all()
    divided = factors > 1
    assert (np.array(spacing)[divided] / (factors[divided] - 1) > LONGEST_MM).all()


def test_a_place_keeps_its_hu_on_the_finer_grid():
    """Of HU that change linearly along all axes of oblique voxels, each finer voxel has those of its
    place.
    """
    spacing, shape, turn = (0.9, 2.5, 5.0), (9, 7, 6), rotation_about([1, 2, 3], 40)
    factors, to_index = fine_factors(np.array(spacing)), affine(spacing, turn)
    slope, base = np.array([3.0, -2.0, 1.5]), 40.0

    def hu(places):
        return places @ slope + base

    def places_of(shape, index_from_mm):
        index = np.moveaxis(np.indices(shape), 0, -1)
        return (index - index_from_mm[:3, 3]) @ np.linalg.inv(index_from_mm[:3, :3]).T

    fine = refined(hu(places_of(shape, to_index)), factors)
    to_fine = fine_index_from_mm(to_index, factors)
    wanted = hu(places_of(fine.shape, to_fine))
    # Beyond the middles of the outer voxels nothing is known: half of a coarse voxel is left out.
    inner = tuple(slice(f // 2 + 1, -(f // 2) - 1) for f in factors)
    assert fine.shape == tuple(np.array(shape) * factors) and fine[inner].size > 500
    assert fine[inner] == pytest.approx(wanted[inner], abs=1e-3)
    # The corner where both grids begin is the same place.
    corners = [np.linalg.inv(each) @ [-0.5, -0.5, -0.5, 1.0] for each in (to_index, to_fine)]
    assert corners[0] == pytest.approx(corners[1], abs=1e-9)


def test_refined_is_linear_and_within_the_values_around():
    first, second = np.random.default_rng(0).normal(0, 100, (2, 5, 6, 7)).astype(np.float32)
    factors = np.array([1, 2, 4])
    both = refined(2 * first - 3 * second, factors)
    assert both == pytest.approx(2 * refined(first, factors) - 3 * refined(second, factors), abs=1e-2)
    assert refined(first, factors).max() <= first.max() and refined(first, factors).min() >= first.min()
    # Against scipy's spline of first order in float64, at the places of the finer voxels.
    at = np.stack(
        np.meshgrid(
            *((np.arange(n * f) + 0.5) / f - 0.5 for n, f in zip(first.shape, factors, strict=True)),
            indexing="ij",
        )
    )
    wanted = ndimage.map_coordinates(first.astype(float), at, order=1, mode="nearest")
    assert refined(first, factors) == pytest.approx(wanted, abs=1e-3)


def test_labels_of_voxels_that_are_short_enough_stay_as_they_are():
    labels = np.random.default_rng(1).integers(0, 3, (6, 7, 8)).astype(np.uint8)
    assert refined_labels(labels, np.array([1, 1, 1]), np.ones(3)) is labels


@pytest.mark.parametrize("spacing", [*permutations(THICK), (0.7, 0.7, 3.0)][::2])
@pytest.mark.parametrize("solid", [ball, cylinder])
def test_labels_of_thick_slices_keep_their_volume_and_their_border_without_a_stair(spacing, solid):
    factors = fine_factors(np.array(spacing))
    labels = (solid(centres(spacing)) < 0).astype(np.uint8)
    fine, away = refined_labels(labels, factors, np.array(spacing)) > 0, solid(centres(spacing, factors))
    stair = labels.repeat(factors[0], 0).repeat(factors[1], 1).repeat(factors[2], 2) > 0
    wrong, wrong_of_stair = fine != (away < 0), stair != (away < 0)
    # One piece without holes.
    assert ndimage.label(fine)[1] == 1 and ndimage.label(~fine)[1] == ndimage.label(away >= 0)[1]
    # A chord between slices is inside a convex body, by its sagitta: for the ball 5^2 / (8 * 18), for the
    # cylinder, which the slices cut in ellipses, as much over 8 mm; and half of the longest side of a fine
    # voxel on average not at all.
    radius = 18.0 if solid is ball else 8.0
    sagitta = max(spacing) ** 2 / 8 / radius
    lost = (2 if solid is cylinder else 3) * sagitta / radius
    share = fine.sum() / (away < 0).sum()
    assert 1 - lost - 0.01 < share < 1.01
    # Fewer voxels are on the wrong side than of the stair, and none farther than half of a slice. Of slices
    # of 3 mm, in halves, the border moves by less than a voxel.
    assert wrong.sum() < (0.75 if max(spacing) > 4 else 1.0) * wrong_of_stair.sum()
    assert np.abs(away[wrong]).max() < max(spacing) / 2


def test_two_labels_side_by_side_leave_no_gap_between_them():
    spacing = np.array(THICK)
    places, factors = centres(spacing), fine_factors(spacing)
    tilted = places @ [0.6, 0.0, 0.8] < 0.6 * 29 + 0.8 * 29
    labels = np.where(ball(places) < 0, np.where(tilted, 1, 2), 0).astype(np.uint8)
    fine, fine_places = refined_labels(labels, factors, spacing), centres(spacing, factors)
    deep = ball(fine_places) < -3.0
    # What is at equal distances from both is in neither: it would be a sheet of another tissue.
    assert (fine[deep] > 0).mean() > 0.995
    far = deep & (np.abs(fine_places @ [0.6, 0.0, 0.8] - 0.6 * 29 - 0.8 * 29) > 2.5)
    assert (fine[far] == np.where(fine_places @ [0.6, 0.0, 0.8] < 0.6 * 29 + 0.8 * 29, 1, 2)[far]).all()


@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), THICK])
@pytest.mark.parametrize("axis", range(3))
def test_distances_are_zero_halfway_between_a_voxel_inside_and_one_outside(spacing, axis):
    mask = np.zeros((12, 12, 12), bool)
    mask[tuple(slice(None) if k != axis else slice(6, None) for k in range(3))] = True
    along = signed_distance_of(mask, np.array(spacing))[
        tuple(5 if k != axis else slice(None) for k in range(3))
    ]
    assert along[5] > 0 > along[6] and along[5] == pytest.approx(-along[6])
    assert np.diff(along[6:]) == pytest.approx(-spacing[axis]) and np.diff(along[:6]) == pytest.approx(
        -spacing[axis]
    )


def test_the_box_around_a_mask_has_a_margin_within_the_grid():
    mask = np.zeros((10, 12, 14), bool)
    mask[1:4, 5, 11:14] = True
    assert box_around(mask, 2) == (slice(0, 6), slice(3, 8), slice(9, 14))


@pytest.mark.parametrize(
    "turn", [np.eye(3), np.diag([-1.0, 1.0, 1.0])[[2, 0, 1]], rotation_about([1, 2, 3], 40)]
)
def test_distances_from_a_surface_are_those_of_its_place_in_any_grid(turn):
    surface = trimesh.creation.icosphere(subdivisions=4, radius=18.0)
    spacing, shape = (1.2, 1.0, 1.5), (60, 64, 48)
    to_index = affine(spacing, turn, origin=(0.0, 0.0, 0.0))
    to_index[:3, 3] = (np.array(shape) - 1) / 2
    box, grid = surface_box(surface, to_index, shape, 6.0), SurfaceGrid(surface, 6.0)
    found = grid.at_voxels(grid.distance, box, to_index)
    index = np.moveaxis(np.indices(shape), 0, -1)[box]
    away = np.linalg.norm((index - to_index[:3, 3]) @ np.linalg.inv(to_index[:3, :3]).T, axis=-1) - 18.0
    near = np.abs(away) < 5.0
    # Facets are up to 0.07 mm inside the ball; a chord of the distance over the grid's diagonal is 3
    # SURFACE_MM^2 / (8 * 13) off.
    assert np.abs(found - away)[near].max() < 0.07 + 3 * SURFACE_MM**2 / (8 * 13) + 0.02
    # All of the ball and its margin is in the box.
    whole = np.moveaxis(np.indices(shape), 0, -1)
    inside = np.linalg.norm((whole - to_index[:3, 3]) @ np.linalg.inv(to_index[:3, :3]).T, axis=-1) < 23.0
    assert inside[box].sum() == inside.sum()


@pytest.mark.parametrize("spacing", [(0.8, 0.5, 1.0), (0.66, 1.0, 0.45)])
def test_depth_by_cells_is_in_place(spacing):
    """Below the surface of a ball, of which each of its voxels knows its depth; cells have two to four
    voxels along an axis.
    """
    places = centres(spacing, extent_mm=59.0)
    depth = coarse_distance(ball(places) < 0, np.array(spacing))
    away = depth + ball(places)
    inside = ball(places) < -1
    # From centre to centre of cells it is up to half a cell more than from the surface; that is found to half
    # a cell's diagonal.
    assert np.abs(away[inside]).max() < 2.1 * (1 + np.sqrt(3)) / 2
    assert 0 < away[inside].mean() < 2.1 / 2
    assert places[depth >= 5].mean(axis=0) == pytest.approx(MIDDLE, abs=0.1)
