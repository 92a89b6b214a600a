"""A volume out of tracked pictures."""

import numpy as np
import pytest
from conftest import rotation_about
from numpy.typing import ArrayLike

from ultrasound.reconstruction import (
    MAX_VOXELS,
    METHODS,
    SMOOTHING_VOXELS,
    Reconstruction,
    VoxelBox,
)

VOXEL = 0.5
both_methods = pytest.mark.parametrize("method", METHODS)


def box_of(x: int, y: int, z: int) -> VoxelBox:
    return VoxelBox(np.array([-7.0, 12.0, 30.0]), VOXEL, (x, y, z))


def points(method: str, values: ArrayLike, at: ArrayLike, box: VoxelBox, reach_mm: float = 0.0):
    """The volume of values at places given in voxels of the box."""
    gathered = Reconstruction(box, method)
    gathered.add_points(np.array(values), box.origin_mm + VOXEL * np.array(at, float))
    return gathered.volume(reach_mm)


def oblique(pixel_mm: float, picture: float = 0.0) -> np.ndarray:
    """A picture's pose (4, 4) along none of the box's axes, so many pixels on from the first."""
    pose = np.eye(4)
    pose[:3, :3] = rotation_about([1, 2, 3], 50) * pixel_mm
    pose[:3, 3] = pose[:3, 2] * picture + [-2.0, 17.0, 39.0]
    return pose


def test_a_box_holds_its_corners_and_ends_less_than_a_voxel_beyond():
    corners = np.random.default_rng(0).uniform(-30, 50, (9, 3))
    box = VoxelBox.around(corners, 0.7)
    last = box.origin_mm + 0.7 * (np.array(box.shape) - 1)
    np.testing.assert_array_equal(box.origin_mm, corners.min(axis=0))
    assert (last >= corners.max(axis=0)).all() and (last < corners.max(axis=0) + 0.7).all()


def test_a_boxs_places_are_where_its_indices_are():
    box = box_of(3, 4, 5)
    homogeneous = np.append(box.places()[2, 1, 4], 1.0)
    np.testing.assert_allclose(homogeneous[:3], [-6.0, 12.5, 32.0])
    np.testing.assert_allclose(box.index_from_mm @ homogeneous, [2, 1, 4, 1], atol=1e-12)


@both_methods
def test_columns_and_rows_go_where_the_matrix_takes_them(method):
    image = np.random.default_rng(1).integers(1, 255, (4, 6)).astype(np.uint8)
    box = box_of(5, 8, 7)
    # Columns along -y, rows along z, from voxel (3, 6, 2); a third of a voxel off along x.
    place = np.zeros((4, 4))
    place[1, 0], place[2, 1], place[3, 3] = -VOXEL, VOXEL, 1.0
    place[:3, 3] = box.origin_mm + VOXEL * np.array([3 + 1 / 3, 6, 2])
    gathered = Reconstruction(box, method)
    gathered.add(image, place)
    values, known = gathered.volume(0.0)
    expected = np.zeros(box.shape)
    expected[3, 6:0:-1, 2:6] = image.T
    np.testing.assert_allclose(values, expected, rtol=1e-5)
    np.testing.assert_array_equal(known, expected > 0)


def test_nearest_is_the_mean_of_the_pixels_in_a_voxel():
    values, _ = points(
        "nearest", [10, 20, 60, 7], [[1.4, 1, 1], [0.6, 1, 1], [1, 0.51, 1.49], [1.6, 1, 1]], box_of(3, 3, 3)
    )
    assert values[1, 1, 1] == 30 and values[2, 1, 1] == 7 and np.count_nonzero(values) == 2


def test_smooth_shares_a_pixel_out_by_trilinear_weights():
    at = np.array([[1.2, 1.3, 0.9], [1.7, 1.1, 1.4], [0.8, 1.0, 1.0]])
    grey = np.array([10.0, 90.0, 200.0])
    values, known = points("smooth", grey, at, box_of(4, 4, 4))
    assert np.argwhere(known).tolist() == [[1, 1, 1], [2, 1, 1]]
    for voxel in np.argwhere(known):
        weights = np.prod(np.maximum(1 - np.abs(at - voxel), 0), axis=1)
        assert values[tuple(voxel)] == pytest.approx(weights @ grey / weights.sum(), rel=1e-6)


@both_methods
def test_what_falls_outside_the_box_or_nowhere_is_left_out(method):
    shape = np.array([3, 4, 5])
    for axis in range(3):
        at = np.ones((5, 3))
        at[:, axis] = [-0.51, -0.49, shape[axis] - 0.51, shape[axis] - 0.49, np.nan]
        values, known = points(method, [1, 2, 3, 4, 5], at, box_of(*shape))
        line = np.moveaxis(values, axis, 0)[:, 1, 1]
        assert line[[0, -1]] == pytest.approx([2, 3]) and known.sum() == 2 and not values[~known].any()


@both_methods
def test_points_are_as_the_pixels_of_a_picture_that_the_mask_says(method):
    draw = np.random.default_rng(2)
    image, mask = draw.integers(0, 255, (30, 40)).astype(np.uint8), draw.random((30, 40)) < 0.6
    pose = oblique(0.3)
    one, other = Reconstruction(box_of(40, 40, 40), method), Reconstruction(box_of(40, 40, 40), method)
    one.add(image, pose, mask)
    row, column = np.nonzero(mask)
    other.add_points(image[mask], np.stack([column, row, 0 * row, 0 * row + 1], axis=1) @ pose[:3].T)
    for a, b in zip(one.volume(1.0), other.volume(1.0), strict=True):
        # Places are computed in another order, and differ by the last bits.
        np.testing.assert_allclose(a, b, atol=1e-3)
    assert one.volume(1.0)[1].any()


def slabs(method: str, planes: dict[int, float], reach_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Pictures of one grey value each, at these indices along x, with a rim of 3 voxels about them."""
    box = box_of(22, 26, 24)
    y, z = (a.ravel() for a in np.mgrid[3:23, 3:21])
    at = np.concatenate([np.stack([np.full(y.size, x), y, z], axis=1) for x in planes])
    return points(method, np.repeat(list(planes.values()), y.size), at, box, reach_mm)


@both_methods
def test_gaps_between_pictures_are_filled_and_nothing_beyond_them(method):
    _, known = slabs(method, {2: 1.0, 6: 2.0, 12: 3.0, 20: 4.0}, reach_mm=1.5)
    # The ball of 3 voxels finds room from 12 to 20, just not from 6 to 12, and enters the gaps by 3 voxels
    # from the rim.
    assert known[2:13, 6:20, 6:18].all() and not known[13:20].any() and known[20, 3:23, 3:21].all()
    scanned = np.zeros_like(known)
    scanned[2:21, 3:23, 3:21] = True
    assert not (known & ~scanned).any()


@both_methods
@pytest.mark.parametrize("first, last, reach_mm", [(1, 20, 1.5), (3, 5, 0.0)])
def test_what_is_farther_apart_than_the_reach_stays_apart_at_the_boxs_border_too(
    method, first, last, reach_mm
):
    _, known = slabs(method, {first: 10.0, last: 60.0}, reach_mm)
    assert known[[first, last], 3:23, 3:21].all() and known.sum() == 2 * 20 * 18


def test_nearest_fills_a_gap_with_the_nearest_picture():
    values, _ = slabs("nearest", {3: 10.0, 8: 60.0}, reach_mm=1.5)
    np.testing.assert_array_equal(values[3:9, 12, 12], [10, 10, 10, 60, 60, 60])


def test_smooth_goes_straight_from_one_picture_to_the_next_and_rounds_the_corners():
    """Knutsson's normalised convolution of what is known, in the holes alone."""
    places, greys = [1, 6, 11, 16], [5.0, 55.0, 105.0, 25.0]
    values, _ = slabs("smooth", dict(zip(places, greys, strict=True)), reach_mm=1.5)
    known = np.arange(1, 17)
    lines = np.interp(known, places, greys)
    weight = np.exp(-0.5 * ((known[:, None] - known) / SMOOTHING_VOXELS) ** 2)
    weight[np.abs(known[:, None] - known) > 3 * SMOOTHING_VOXELS + 0.5] = 0.0
    wanted = np.where(np.isin(known, places), lines, weight @ lines / weight.sum(axis=1))
    np.testing.assert_allclose(values[known, 12, 12], wanted, rtol=1e-5)
    # Where all is straight, it is kept; a corner is rounded.
    assert wanted[6] == pytest.approx(lines[6]) and abs(wanted[9] - lines[9]) > 1


@both_methods
def test_an_oblique_sweep_does_not_grow_by_more_than_half_a_voxel(method):
    box = box_of(64, 64, 64)
    gathered = Reconstruction(box, method)
    for picture in range(0, 36, 5):
        gathered.add(np.full((49, 41), 99, np.uint8), oblique(0.25, picture))
    _, known = gathered.volume(1.5)
    # In the sweep's own axes it is a block of 10 x 12 x 8.75 mm.
    size, start = np.array([10, 12, 8.75]), oblique(0.25)
    own = (box.places() - start[:3, 3]) @ np.linalg.inv(start[:3, :3]).T * 0.25
    beyond = np.linalg.norm(np.maximum(own - size, 0) + np.minimum(own, 0), axis=-1)
    # A voxel with a pixel in it is no farther from that than half its diagonal.
    assert beyond[known].max() <= VOXEL * np.sqrt(3) / 2
    assert known[(np.minimum(own, size - own).min(axis=-1) > 1.5)].all()


@both_methods
def test_no_picture_gives_no_volume(method):
    values, known = Reconstruction(box_of(4, 5, 6), method).volume(1.0)
    assert values.shape == (4, 5, 6) and values.dtype == np.float32 and not values.any() and not known.any()


def test_what_does_not_fit_is_refused():
    for words, refused in [
        ("larger voxels", lambda: VoxelBox.around(np.array([[0, 0, 0], [1, 1, np.inf]]), 0.5)),
        ("larger voxels", lambda: VoxelBox.around(np.array([[0, 0, 0], [MAX_VOXELS, 0, 0]]), 1.0)),
        ("larger voxels", lambda: VoxelBox.around(np.array([[0, 0, 0], [1e300] * 3]), 0.5)),
        ("voxel along each axis", lambda: box_of(3, 0, 5)),
    ]:
        with pytest.raises(ValueError, match=words):
            refused()
