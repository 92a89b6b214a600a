"""A kernel takes fields and numbers of its object when it runs, and is compiled once for objects that are
alike.
"""

import gc
import weakref

import numpy as np
import pytest
import taichi as ti

from sim import kernels
from sim.fields import Field, array_of, field_of, fill, zeros
from sim.kernels import function, kernel

Numbers = ti.types.ndarray(ti.f32, ndim=2)


class Plain:
    """Adds what it has to each of its numbers."""

    def __init__(self, values: np.ndarray, shift: float = 0.0, turns: bool = False) -> None:
        self.values, self.count, self.shift, self.turns = field_of(values), len(values), shift, turns
        self.pair = 1, 0.25

    @ti.func
    def added(self):
        return self.shift + self.pair[0] * self.pair[1]

    @kernel
    def add(self, more: float):
        for i in range(self.count):
            self.values[i] = self.values[i] + more + self.added()
            if ti.static(self.turns):
                self.values[i] = -self.values[i]

    @kernel
    def total(self) -> float:
        total = 0.0
        for i in range(self.count):
            total += self.values[i]
        return total


class Owner:
    """An object within an object, and a list of them."""

    def __init__(self, parts: list[Plain]) -> None:
        self.parts, self.first = parts, parts[0]

    @kernel
    def add(self, which: ti.template(), into: ti.template()):
        for _ in range(1):
            for part in ti.static(self.parts):
                into[0] = into[0] + part.added()
            into[which] = into[which] + self.first.values[which]


class Other(Plain):
    @ti.func
    def added(self):
        return 100.0


def compiled(bound) -> int:
    return len(bound.__func__._compiled)


def test_objects_of_all_sizes_share_a_kernel_and_each_has_its_own_numbers(device):
    small, large = Plain(np.arange(3.0), 0.5), Plain(np.arange(1000.0), -2.0)
    before = compiled(small.add) if small.add.__func__._program else 0
    small.add(1.0)
    large.add(2.0)
    assert compiled(small.add) == max(before, 1)
    assert np.array_equal(array_of(small.values), np.arange(3) + 1.75)
    assert np.array_equal(array_of(large.values), np.arange(1000) + 0.25)
    assert small.total() == pytest.approx(3 + 3 * 1.75)


def test_numbers_and_fields_that_change_count_from_the_next_call(device):
    thing = Plain(np.zeros(4))
    thing.add(0.0)
    thing.shift, thing.count, thing.pair = 3.0, 2, (2, 0.5)
    thing.add(0.0)
    assert np.array_equal(array_of(thing.values), [4.25, 4.25, 0.25, 0.25])
    before, thing.values = thing.values, field_of(np.full(2, 10.0))
    thing.add(0.0)
    assert np.array_equal(array_of(thing.values), [14.0, 14.0])
    assert np.array_equal(array_of(before), [4.25, 4.25, 0.25, 0.25])


def test_a_flag_that_changes_is_another_kernel(device):
    thing = Plain(np.ones(2))
    thing.add(0.0)
    count = compiled(thing.add)
    thing.turns = True
    thing.add(0.0)
    assert np.array_equal(array_of(thing.values), [-1.5, -1.5]) and compiled(thing.add) == count + 1
    thing.turns = False
    thing.add(0.0)
    assert np.array_equal(array_of(thing.values), [-1.25, -1.25]) and compiled(thing.add) == count + 1


def test_objects_of_another_class_have_a_kernel_of_their_own(device):
    plain, other = Plain(np.zeros(1)), Other(np.zeros(1))
    plain.add(0.0)
    other.add(0.0)
    assert (array_of(plain.values)[0], array_of(other.values)[0]) == (0.25, 100.0)


def test_parts_in_lists_and_fields_and_numbers_as_parameters(device):
    parts = [Plain(np.array([5.0, 6.0]), 1.0), Plain(np.zeros(2), 2.0)]
    owner, into, others = Owner(parts), zeros(2), zeros(3)
    owner.add(1, into)
    owner.add(0, others)
    assert np.array_equal(array_of(into), [3.5, 6.0]) and np.array_equal(array_of(others), [8.5, 0.0, 0.0])
    # A longer list is another kernel; one of the same length with other objects is not.
    count = compiled(owner.add)
    Owner(parts[::-1]).add(1, into)
    assert compiled(owner.add) == count
    Owner([*parts, parts[0]]).add(1, into)
    assert compiled(owner.add) == count + 1 and array_of(into)[0] == 3.5 + 3.5 + 4.75


def test_an_object_and_its_fields_are_freed(device):
    thing = Plain(np.zeros(2))
    thing.add(1.0)
    owner, field = weakref.ref(thing), weakref.ref(thing.values)
    del thing
    gc.collect()
    assert owner() is None and field() is None


def test_a_value_that_is_neither_number_nor_field_is_named(device):
    class Wrong:
        def __init__(self) -> None:
            self.values, self.table = zeros(2), np.zeros(3)

        @kernel
        def copy(self):
            for i in range(2):
                self.values[i] = self.table[i]

    with pytest.raises(Exception, match="table"):
        Wrong().copy()


class Grid:
    """A field of two axes, and an array given at the call."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self.field: Field = zeros(*shape)
        self.rows, self.columns = shape

    @kernel
    def fill_and_copy(self, image: Numbers):
        for i, j in ti.ndrange(self.rows, self.columns):
            self.field[i, j] = 10.0 * i + j
            image[i, j] = self.field[i, j]


@pytest.mark.parametrize("shape", [(2, 3), (3, 2), (7, 1)])
def test_each_axis_may_have_any_length(device, shape):
    grid, image = Grid(shape), np.zeros(shape, np.float32)
    grid.fill_and_copy(image)
    wanted = 10.0 * np.arange(shape[0])[:, None] + np.arange(shape[1])
    assert np.array_equal(image, wanted) and np.array_equal(array_of(grid.field), wanted)
    for wrong in (image[:, ::-1][::-1] if min(shape) > 1 else image[::2], image.astype(float), image[0]):
        with pytest.raises(ValueError, match="expected float32 with 2 axes, contiguous"):
            grid.fill_and_copy(wrong)


def test_a_parameter_that_can_be_no_argument_is_refused():
    def move(self, by: ti.types.vector(3, ti.i32)):
        pass

    with pytest.raises(TypeError, match="expected numbers, vectors, matrices or arrays"):
        kernel(move)


def test_fields_of_other_kinds_are_other_kernels(device):
    thing = Plain(np.zeros(3))
    thing.add(1.0)
    count = compiled(thing.add)
    thing.values = field_of(np.arange(3))
    thing.add(1.75)
    # Integers are cut off.
    assert compiled(thing.add) == count + 1 and array_of(thing.values).tolist() == [2, 3, 4]
    fill((thing.values, np.zeros(3)))


TURN = ti.Matrix([[0.0, -1.0, 0.5], [1.0, 0.0, 0.25], [0.0, 0.5, 1.0]])


class Turned:
    """Points moved as a whole by a method that is a function of the compiled code, or a part of it."""

    def __init__(self, points: np.ndarray, serial: bool) -> None:
        self.points, self.serial = field_of(points, 1), serial
        self.turn, self.offset = TURN, ti.Vector([3.0, -2.0, 0.5])
        self.factor = zeros()
        self.part = Plain(np.arange(3.0), shift=0.5)
        fill((self.factor, np.array(2.0)))

    @function
    def move(self, first, by: float, twice: ti.template()):
        for i in range(first, self.points.shape[0]):
            self.points[i] = by * self.factor[None] * (self.turn @ self.points[i]) + self.offset
            if ti.static(twice):
                self.points[i] += self.part.added()
        self.double()

    @function
    def double(self):
        for _ in range(1):
            self.factor[None] = 2.0 * self.factor[None]
            if ti.static(self.part.turns):
                self.factor[None] = -self.factor[None]

    @kernel
    def run(self, first: int, by: float):
        if ti.static(self.serial):
            for _ in range(1):
                self.move(first, by, False)
                self.move(first + 1, 0.5 * by, True)
        else:
            self.move(first, by, False)
            self.move(first + 1, 0.5 * by, True)


@pytest.mark.parametrize("serial", [True, False])
def test_a_function_has_fields_numbers_and_matrices_of_its_object(device, serial):
    points = np.random.default_rng(3).normal(size=(7, 3)).round(2)
    moved = Turned(points, serial)
    turn, offset = np.array(moved.turn.to_list()), np.array(moved.offset.to_list())
    moved.run(2, 1.5)
    wanted = points.copy()
    wanted[2:] = 1.5 * 2 * wanted[2:] @ turn.T + offset
    wanted[3:] = 0.75 * 4 * wanted[3:] @ turn.T + offset + 0.75
    assert array_of(moved.points) == pytest.approx(wanted, abs=1e-4)
    assert array_of(moved.factor) == 8.0
    count = compiled(moved.run)
    moved.part.shift, moved.offset = -0.25, ti.Vector([0.0, 0.0, 0.0])
    moved.run(6, 1.0)
    wanted[6] = 8 * turn @ wanted[6]
    assert array_of(moved.points) == pytest.approx(wanted, abs=1e-3)
    assert compiled(moved.run) == count
    # A flag that only a function reads: two calls of it turn the sign twice, and what is between them once.
    moved.part.turns = True
    moved.run(6, 1.0)
    wanted[6] = 32 * turn @ wanted[6]
    assert array_of(moved.points) == pytest.approx(wanted, rel=1e-5, abs=1e-3)
    assert array_of(moved.factor) == 128.0 and compiled(moved.run) == count + 1


def test_where_counts_are_compiled_another_count_is_another_kernel(device, monkeypatch):
    monkeypatch.setattr(kernels, "has_constant_counts", lambda: True)
    owners = [Counted(3, 0.5), Counted(5, 0.5), Counted(5, 2.0)]
    for owner in owners:
        owner.add()
    assert [array_of(owner.values).tolist() for owner in owners] == [[3.5] * 3, [5.5] * 5, [7.0] * 5]
    owners[1].count = 2
    owners[1].add()
    assert array_of(owners[1].values).tolist() == [11.0] * 2 + [5.5] * 3
    # Of the three counts, and not of the number that is no count.
    assert compiled(owners[0].add) == 3


class Counted:
    """Adds a number and the length of its field to each of its first values."""

    def __init__(self, count: int, more: float) -> None:
        self.count, self.more, self.values = count, more, zeros(count)

    @kernel
    def add(self):
        for i in range(self.count):
            self.values[i] += self.more + self.values.shape[0]
