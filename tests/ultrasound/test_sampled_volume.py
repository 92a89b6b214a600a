"""A volume on the device: between voxels, at its border, one place or many, and its slope."""

import numpy as np
import pytest
import taichi as ti
import taichi.math as tm
import trimesh
from conftest import rotation_about
from scipy.interpolate import RegularGridInterpolator

from sim.fields import array_of, field_of, fill, zeros
from sim.kernels import kernel
from ultrasound.sampled_volume import LANES, Lanes, SampledVolume, distance_volume


@kernel
def sample_each(volume: ti.template(), points: ti.template(), values: ti.template()):
    for i in range(points.shape[0]):
        values[i] = volume.sample(points[i])


def sampled(volume: SampledVolume, points: np.ndarray, *parts: int) -> np.ndarray:
    """Values (n, *parts) at points (n, 3), each asked for by itself."""
    values = zeros(len(points), *parts, within=len(parts))
    sample_each(volume, field_of(points, 1), values)
    return array_of(values)


def test_a_volume_of_vectors_is_sampled_as_each_of_its_parts(device):
    voxels = np.random.default_rng(2).normal(size=(5, 4, 3, 2)).astype(np.float32)
    index_from_mm = np.eye(4)
    index_from_mm[:3, :3] = rotation_about([1, 2, 3], 30) * 0.8
    points = np.random.default_rng(3).uniform(-1.0, 4.0, (200, 3))
    whole = sampled(SampledVolume(voxels, index_from_mm), points, 2)
    apart = [sampled(SampledVolume(voxels[..., k], index_from_mm), points) for k in range(2)]
    # The compiler may fuse the same sums differently: rounding of values of 4, at a place rounded to 1e-6 of
    # a voxel.
    assert whole == pytest.approx(np.stack(apart, axis=1), abs=1e-5)
    assert (whole != -1000.0).any() and (whole == -1000.0).any()


@pytest.mark.parametrize("shape", [(6, 5, 4), (6, 1, 4)])
def test_places_sampled_together_have_the_values_that_they_have_alone(device, shape):
    index_from_mm = np.eye(4)
    index_from_mm[:3, :3] = rotation_about([1, 2, 3], 30) * 0.9
    volume = SampledVolume(
        np.random.default_rng(6).normal(size=shape).astype(np.float32), index_from_mm, outside=-7.0
    )
    starts = (
        np.random.default_rng(7).uniform(-0.8, np.array(shape) - 0.2, (400, 3))
        @ np.linalg.inv(index_from_mm[:3, :3]).T
    )
    # Half of the lines stay within a voxel, half cross several and the border, where the last half voxel
    # still counts.
    ways = np.random.default_rng(8).normal(size=(400, 3)) * np.where(np.arange(400) % 2, 0.01, 0.4)[:, None]
    places = (starts[:, None] + np.arange(LANES)[:, None] * ways[:, None]).astype(np.float32)
    together, alone = np.zeros((2, 400, LANES), np.float32)
    values = ti.types.ndarray(ti.f32, ndim=2)

    @kernel
    def ask(volume: ti.template(), places: ti.types.ndarray(ti.f32, ndim=3), together: values, alone: values):
        for i in range(places.shape[0]):
            x, y, z = Lanes(0.0), Lanes(0.0), Lanes(0.0)
            for lane in ti.static(range(LANES)):
                x[lane], y[lane], z[lane] = places[i, lane, 0], places[i, lane, 1], places[i, lane, 2]
                alone[i, lane] = volume.sample(tm.vec3(x[lane], y[lane], z[lane]))
            values_of_lanes = volume.sample_lanes(x, y, z, True)
            for lane in ti.static(range(LANES)):
                together[i, lane] = values_of_lanes[lane]

    ask(volume, places, together, alone)
    assert 0.1 < (alone == -7.0).mean() < 0.9 and np.abs(together - alone).max() < 1e-5


def differences(value: RegularGridInterpolator, middle, low, high) -> np.ndarray:
    """Of values at middles (n, 3), of which one coordinate in turn is low or high, over what is between."""
    columns = []
    for axis in range(3):
        before, behind = middle.copy(), middle.copy()
        before[:, axis], behind[:, axis] = low[:, axis], high[:, axis]
        columns.append((value(behind) - value(before)) / (high - low)[:, axis])
    return np.stack(columns, axis=1)


def test_the_gradient_of_a_volume_is_that_over_a_voxel_to_each_side_and_its_slope_that_within_a_cell(device):
    voxels = np.random.default_rng(4).normal(size=(6, 5, 4, 3)).astype(np.float32)
    index_from_mm = np.eye(4)
    index_from_mm[:3, :3] = rotation_about([3, 1, 2], 40) * [1.3, 0.7, 0.9]
    volume, first_part = SampledVolume(voxels, index_from_mm), SampledVolume(voxels[..., 0], index_from_mm)
    last = np.array([5.0, 4.0, 3.0])
    inside = np.random.default_rng(5).uniform(-0.45, last + 0.45, (300, 3))
    points = np.vstack([inside, last + 0.6]) @ np.linalg.inv(index_from_mm[:3, :3]).T
    place, gradient, slope = (zeros(len(points), 3, within=1) for _ in range(3))
    fill((place, points))

    @kernel
    def ask(
        volume: ti.template(),
        first_part: ti.template(),
        place: ti.template(),
        gradient: ti.template(),
        slope: ti.template(),
    ):
        for i in range(place.shape[0]):
            gradient[i] = volume.gradient(place[i])
            slope[i] = first_part.slope(place[i])

    ask(volume, first_part, place, gradient, slope)
    value = RegularGridInterpolator([np.arange(n) for n in (6, 5, 4)], voxels[..., 0].astype(float))
    middle = np.clip(inside, 0, last)
    along = differences(value, middle, np.maximum(inside - 1, 0), np.minimum(inside + 1, last))
    # Float32 of values of 4, in voxels of 0.7 mm at least.
    assert array_of(gradient)[:300] == pytest.approx(along @ index_from_mm[:3, :3], abs=3e-5)
    # A trilinear value is linear along each axis of its cell: so its slope is the difference of the cell's
    # two sides.
    cell = np.minimum(np.floor(middle), last - 1)
    within = differences(value, middle, cell, cell + 1)
    assert array_of(slope)[:300] == pytest.approx(within @ index_from_mm[:3, :3], abs=3e-5)
    assert (array_of(gradient)[300] == 0).all() and (array_of(slope)[300] == 0).all()


def test_a_volume_is_trilinear_between_voxels_and_ends_half_a_voxel_beyond(device):
    voxels = np.random.default_rng(1).normal(size=(5, 4, 3)).astype(np.float32)
    points = np.array([[0, 0, 0], [4, 3, 2], [1.25, 2.5, 0.75], [-0.4, 1, 1], [-0.6, 1, 1], [4.6, 3, 2]])
    cell = voxels[1:3, 2:4, 0:2].astype(float)
    mixed = np.einsum("ijk,i,j,k->", cell, [0.75, 0.25], [0.5, 0.5], [0.25, 0.75])
    wanted = [voxels[0, 0, 0], voxels[4, 3, 2], mixed, voxels[0, 1, 1], -7.0, -7.0]
    values = sampled(SampledVolume(voxels, np.eye(4), outside=-7.0), points)
    assert values == pytest.approx(np.array(wanted), abs=1e-5)


def test_a_volume_of_one_slice_is_sampled_within_its_thickness(device):
    volume = SampledVolume(np.full((3, 3, 1), 5.0, np.float32), np.eye(4))
    points = np.array([[1.2, 0.7, 0.3], [1.2, 0.7, 0.7]])
    assert sampled(volume, points) == pytest.approx([5.0, -1000.0])


def test_distance_volume_is_signed(device, ball):
    volume = distance_volume(trimesh.creation.icosphere(subdivisions=4, radius=10.0), 1.0)
    distance, axis = array_of(volume.voxels).reshape(volume.count), np.arange(volume.count[0]) - 16.0
    expected = np.linalg.norm(np.stack(np.meshgrid(axis, axis, axis, indexing="ij")), axis=0) - 10.0
    near = np.abs(expected) < 4.5
    # The facets lie up to 0.03 mm within the ball.
    assert np.abs(distance - expected)[near].max() < 0.04
    assert (distance[expected < -4.5] < -4.5).all() and (distance[expected > 4.5] > 4.4).all()
