"""Fields: arrays on the device, which kernels read and write (``sim.kernels``), and copies of them to and
from NumPy.

A kernel does not depend on the size of a field, so that one kernel serves the fields of all patients.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import taichi as ti

from sim.device import on_cpu


class Field:
    """An array of numbers, vectors or matrices: ``element`` is the shape of one of them, ``shape`` that of
    the field, ``kind`` f32 or i32.

    ``memory`` is a NumPy array (*shape, *element) on a CPU, else a Taichi ndarray; new fields are zero.
    """

    def __init__(self, shape: Sequence[int], within: int = 0, kind: type = ti.f32) -> None:
        split = len(shape) - within
        self.shape, self.element = tuple(map(int, shape[:split])), tuple(map(int, shape[split:]))
        self.kind = kind
        # Those of the array in kernels: functions take no array without axes.
        self.lengths = self.shape or (1,)
        if on_cpu():
            self.memory = np.zeros((*self.shape, *self.element), np.float32 if kind == ti.f32 else np.int32)
        else:
            make = (ti.ndarray, ti.Vector.ndarray, ti.Matrix.ndarray)[within]
            self.memory = make(*self.element, kind, self.lengths)

    if TYPE_CHECKING:
        # In kernels alone.
        def __getitem__(self, at: Any) -> Any: ...
        def __setitem__(self, at: Any, value: Any) -> None: ...


def zeros(*shape: int, within: int = 0, kind: type = ti.f32) -> Field:
    """A field of zeros.

    The last ``within`` axes are those of an element: 0 for numbers, 1 for vectors, 2 for matrices.
    """
    return Field(shape, within, kind)


def field_of(values: np.ndarray, within: int = 0) -> Field:
    """A field with the values of an array, floats as f32, others as i32; ``within`` as for ``zeros``."""
    values = np.asarray(values)
    field = Field(values.shape, within, ti.f32 if values.dtype.kind == "f" else ti.i32)
    fill((field, values))
    return field


def fields_of(*arrays: np.ndarray, within: int = 0) -> list[Field]:
    """``field_of`` for each array."""
    return [field_of(values, within) for values in arrays]


def fill(*pairs: tuple[Field, np.ndarray]) -> None:
    """Write arrays into fields. Raises ValueError if the shapes differ."""
    for field, values in pairs:
        values, shape = np.asarray(values), (*field.shape, *field.element)
        if values.shape != shape:
            raise ValueError(f"an array of shape {values.shape} for a field of shape {shape}")
        if isinstance(field.memory, np.ndarray):
            field.memory[...] = values
        else:
            kind = np.float32 if field.kind == ti.f32 else np.int32
            values = np.ascontiguousarray(values, kind).reshape(*field.lengths, *field.element)
            field.memory.from_numpy(values)


def fill_evenly(field: Field, value: float) -> None:
    """Write one number into all of a field."""
    fill((field, np.broadcast_to(value, (*field.shape, *field.element))))


def part_of(field: Field, shape: tuple[int, ...], box: tuple[slice, ...]) -> np.ndarray:
    """A copy of the values in a box of a field (n,) that is a grid of a shape, in C order."""
    return _grid(field, shape)[box].copy()


def fill_part(field: Field, shape: tuple[int, ...], box: tuple[slice, ...], values: np.ndarray) -> None:
    """Write values into a box of a field (n,) that is a grid of a shape, in C order."""
    grid = _grid(field, shape)
    grid[box] = values
    if not isinstance(field.memory, np.ndarray):
        fill((field, grid.reshape(*field.shape, *field.element)))


def _grid(field: Field, shape: tuple[int, ...]) -> np.ndarray:
    """The values as a grid: on the CPU its own memory, elsewhere a copy."""
    memory = field.memory if isinstance(field.memory, np.ndarray) else array_of(field)
    return memory.reshape(*shape, *field.element)


def array_of(field: Field) -> np.ndarray:
    """A copy of the values of a field, of shape (*field, *element)."""
    if isinstance(field.memory, np.ndarray):
        return field.memory.copy()
    return field.memory.to_numpy().reshape(*field.shape, *field.element)
