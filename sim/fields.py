"""Arrays on the device."""

import numpy as np
import taichi as ti

from sim.device import on_cpu


def field_of(values: np.ndarray, within: int = 0) -> ti.Field:
    """A field that holds an array: floats as f32, all else as i32.

    The last ``within`` axes are those of each element: 0 for scalars, 1 for vectors, 2 for matrices.
    """
    values = np.asarray(values)
    kind = ti.f32 if values.dtype.kind == "f" else ti.i32
    shape, element = values.shape[: values.ndim - within], values.shape[values.ndim - within :]
    make = (ti.field, ti.Vector.field, ti.Matrix.field)[within]
    field = make(*element, kind, shape)
    fill(field, values)
    return field


def fill(field: ti.Field, values: np.ndarray) -> None:
    """Write an array into a field of its shape."""
    values = np.ascontiguousarray(values, np.float32 if field.dtype == ti.f32 else np.int32)
    if on_cpu():
        _copy(values, field)
    else:
        field.from_numpy(values)


@ti.kernel
def _copy(values: ti.types.ndarray(), field: ti.template()):
    # Taichi's own copy runs on all cores, and a kernel for that takes twice as long to make and to load.
    ti.loop_config(serialize=True)
    for i in ti.grouped(ti.ndrange(*field.shape)):
        if ti.static(isinstance(field, ti.ScalarField)):
            field[i] = values[i]
        elif ti.static(field.ndim == 1):
            for p in ti.static(range(field.n)):
                field[i][p] = values[i, p]
        else:
            for p, q in ti.static(ti.ndrange(field.n, field.m)):
                field[i][p, q] = values[i, p, q]
