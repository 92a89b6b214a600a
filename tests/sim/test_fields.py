"""Arrays written to the device and read again are unchanged."""

import numpy as np
import pytest
import taichi as ti
from taichi.lang import impl

from sim import fields
from sim.fields import FieldSet, array_of, empty_fields, field_of, fields_of, fill


@pytest.mark.parametrize("within", [0, 1, 2])
@pytest.mark.parametrize("kind", [np.float64, np.float32, np.int64, np.uint8, bool])
def test_a_field_holds_an_array(one_device, kind, within):
    values = np.random.default_rng(0).integers(0, 2 if kind is bool else 100, (5, 4, 3)).astype(kind)
    field = field_of(values, within)
    assert field.shape == values.shape[: 3 - within]
    found = field.to_numpy()
    assert found.dtype == (np.float32 if np.issubdtype(kind, np.floating) else np.int32)
    assert np.array_equal(found, values)


def test_the_order_in_memory_does_not_matter(one_device):
    values = np.arange(12.0).reshape(3, 4)
    assert np.array_equal(field_of(values.T).to_numpy(), values.T)


def test_arrays_written_together_are_unchanged(one_device):
    random = np.random.default_rng(1)
    counts, places, turns = (
        random.integers(-9, 9, 7),
        random.normal(size=(4, 5, 3)),
        random.normal(size=(6, 2, 4)),
    )
    made = ti.field(ti.i32, 7), ti.Vector.field(3, ti.f32, (4, 5)), ti.Matrix.field(2, 4, ti.f32, 6)
    fill(*zip(made, (counts, places, turns), strict=True))
    for field, values in zip(made, (counts, places, turns), strict=True):
        assert np.array_equal(field.to_numpy(), values.astype(field.to_numpy().dtype))
    whole, broken = fields_of(counts, 0.5 * counts)
    assert np.array_equal(whole.to_numpy(), counts) and np.array_equal(broken.to_numpy(), 0.5 * counts)


@pytest.mark.parametrize("shape", [(), (1,), (7,), (3, 5), (6, 1, 9)])
def test_values_read_from_memory_are_those_that_taichi_reads(one_device, shape):
    random = np.random.default_rng(2)
    fields = [
        (ti.field(ti.f32, shape), shape),
        (ti.Vector.field(3, ti.i32, shape), (*shape, 3)),
        (ti.Matrix.field(3, 2, ti.f32, shape), (*shape, 3, 2)),
    ]
    for field, whole in fields:
        values = random.integers(-99, 99, whole)
        field.from_numpy(values.astype(np.float32 if field.dtype == ti.f32 else np.int32))
        assert np.array_equal(array_of(field), values) and array_of(field).shape == whole
        fill((field, 2 * values))
        assert np.array_equal(field.to_numpy(), 2 * values)


def test_a_new_field_has_its_values_once_any_kernel_runs(one_device):
    """Also one that was built before and does not use the field: GGUI reads memory itself after such a kernel."""
    old = field_of(np.ones(3))

    @ti.kernel
    def double():
        for i in old:
            old[i] = 2 * old[i]

    double()
    new, values = field_of(np.zeros(4)), np.arange(4.0)
    fill((new, values), (new, 2 * values))
    values[:] = -1.0
    double()
    # Where a view is, the values were written: later ones go straight there.
    assert new in fields._VIEWS and np.array_equal(fields._VIEWS[new], [0, 2, 4, 6])
    assert np.array_equal(array_of(old), [4, 4, 4])


def test_an_array_read_is_a_copy(one_device):
    field = field_of(np.arange(4.0))
    before = array_of(field)
    fill((field, np.zeros(4)))
    assert np.array_equal(before, np.arange(4.0))


def test_an_array_of_another_shape_is_not_written(one_device):
    with pytest.raises(ValueError, match=r"shape \(3,\) for a field of shape \(4,\)"):
        fill((field_of(np.arange(4.0)), np.zeros(3)))


@pytest.mark.parametrize("first", ["plane", "push", "turn", "count"])
def test_fields_of_a_struct_are_read_separately(one_device, first):
    """For each field that is read first."""
    shapes = {"plane": (4,), "count": (), "turn": (2, 3), "push": (3,)}
    kinds = {
        "plane": ti.math.vec4,
        "count": ti.i32,
        "turn": ti.types.matrix(2, 3, ti.f32),
        "push": ti.math.vec3,
    }
    beside, contact = ti.field(ti.i32, 3), ti.Struct.field(kinds, shape=(5, 2))
    random = np.random.default_rng(3)
    values = {name: random.integers(-99, 99, (5, 2, *shape)) for name, shape in shapes.items()}
    for name in (first, *values):
        fill((getattr(contact, name), values[name]))
    fill((beside, np.arange(3)))
    assert beside.to_numpy().tolist() == [0, 1, 2]
    for name, wanted in values.items():
        assert np.array_equal(getattr(contact, name).to_numpy(), wanted)
        assert np.array_equal(array_of(getattr(contact, name)), wanted)


def test_fields_of_a_set_are_freed_and_others_stay(device):
    # Taichi holds 512 trees of fields.
    kept = field_of(np.arange(6.0).reshape(2, 3), 1)
    for number in range(700):
        with FieldSet() as fields:
            (vectors,), (numbers,) = empty_fields((5, 3), within=1), empty_fields((4,))
        if number % 100 == 0:
            fill((vectors, np.full((5, 3), float(number))), (numbers, np.full(4, -1.0)))
            assert (array_of(vectors) == number).all() and (array_of(numbers) == -1.0).all()
        fields.free()
        # It reads the fields that it has not checked yet when it next runs a kernel.
        assert not impl.get_runtime().matrix_fields
    assert np.array_equal(array_of(kept), np.arange(6.0).reshape(2, 3))


def test_freed_fields_leave_compiled_kernels_as_they_are(device):
    """Compiled anew after each free, they took 9 MB that were never given back."""
    kept = field_of(np.arange(3.0))

    @ti.kernel
    def double(of: ti.template()):
        for k in of:
            of[k] *= 2.0

    double(kept)
    with FieldSet() as fields:
        array_of(field_of(np.ones(5)))
    fields.free()
    assert len(double._primal.compiled_kernels) == 1
    with FieldSet():
        others = field_of(np.ones(5))
    double(kept)
    double(others)
    assert np.array_equal(array_of(kept), [0.0, 4.0, 8.0])
    assert np.array_equal(array_of(others), np.full(5, 2.0))
