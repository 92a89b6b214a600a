"""Arrays written to the device and read again are unchanged."""

import numpy as np
import pytest
import taichi as ti

from sim.fields import array_of, field_of, fill, fill_evenly, fill_part, part_of, zeros


@pytest.mark.parametrize("within", [0, 1, 2])
@pytest.mark.parametrize("kind", [np.float64, np.float32, np.int64, np.uint8, bool])
def test_a_field_holds_an_array(device, kind, within):
    values = np.random.default_rng(0).integers(0, 2 if kind is bool else 100, (5, 4, 3)).astype(kind)
    field = field_of(values, within)
    assert (field.shape, field.element) == (values.shape[: 3 - within], values.shape[3 - within :])
    array = array_of(field)
    assert array.dtype == (np.float32 if np.issubdtype(kind, np.floating) else np.int32)
    assert np.array_equal(array, values)


def test_the_order_in_memory_does_not_matter(device):
    values = np.arange(12.0).reshape(3, 4)
    assert np.array_equal(array_of(field_of(values.T)), values.T)


def test_new_fields_are_zero_and_can_be_filled_evenly(device):
    field = zeros(4, 3, 2, within=1, kind=ti.i32)
    assert field.shape == (4, 3) and array_of(field).shape == (4, 3, 2) and not array_of(field).any()
    fill_evenly(field, 7)
    assert (array_of(field) == 7).all()


def test_an_array_read_is_a_copy(device):
    field = field_of(np.arange(4.0))
    before = array_of(field)
    fill((field, np.zeros(4)))
    assert np.array_equal(before, np.arange(4.0))


def test_an_array_of_another_shape_is_not_written(device):
    with pytest.raises(ValueError, match=r"shape \(3,\) for a field of shape \(4,\)"):
        fill((field_of(np.arange(4.0)), np.zeros(3)))


@pytest.mark.parametrize("within", [0, 1])
def test_a_box_of_a_grid_is_read_and_written_alone(device, within):
    shape, element = (4, 3, 5), (2,) * within
    values = np.random.default_rng(0).normal(size=(*shape, *element)).astype(np.float32)
    field, box = field_of(values.reshape(-1, *element), within), (slice(1, 3), slice(0, 2), slice(2, 5))
    part = part_of(field, shape, box)
    assert np.array_equal(part, values[box])
    fill_part(field, shape, box, 2 * part)
    # What was read is a copy.
    assert np.array_equal(part, values[box])
    values[box] *= 2
    assert np.array_equal(array_of(field).reshape(values.shape), values)
