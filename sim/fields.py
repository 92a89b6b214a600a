"""Arrays on the device. To make a kernel takes longer than what it writes: arrays that come together are written by one."""

import numpy as np
import taichi as ti

from sim.device import on_cpu


def field_of(values: np.ndarray, within: int = 0) -> ti.Field:
    """A field that holds an array: floats as f32, all else as i32.

    The last ``within`` axes are those of each element: 0 for scalars, 1 for vectors, 2 for matrices.
    """
    return fields_of(values, within=within)[0]


def fields_of(*arrays: np.ndarray, within: int = 0) -> list[ti.Field]:
    """``field_of`` each of some arrays."""
    arrays = tuple(map(np.asarray, arrays))
    fields = [_empty(values, within) for values in arrays]
    fill(*zip(fields, arrays, strict=True))
    return fields


def _empty(values: np.ndarray, within: int) -> ti.Field:
    kind = ti.f32 if values.dtype.kind == "f" else ti.i32
    shape, element = values.shape[: values.ndim - within], values.shape[values.ndim - within :]
    make = (ti.field, ti.Vector.field, ti.Matrix.field)[within]
    return make(*element, kind, shape)


def fill(*pairs: tuple[ti.Field, np.ndarray]) -> None:
    """Write arrays into fields of their shapes."""
    fields = tuple(field for field, _ in pairs)
    arrays = [
        np.ascontiguousarray(values, np.float32 if field.dtype == ti.f32 else np.int32)
        for field, values in pairs
    ]
    if on_cpu():
        _copy(np.concatenate([values.reshape(-1).view(np.int32) for values in arrays]), fields)
        return
    for field, values in zip(fields, arrays, strict=True):
        field.from_numpy(values)


@ti.kernel
def _copy(values: ti.types.ndarray(dtype=ti.i32, ndim=1), fields: ti.template()):
    # Taichi's own copy runs on all cores, and a kernel for that takes twice as long to make and to load.
    ti.loop_config(serialize=True)
    for _ in range(1):
        at = 0
        for k in ti.static(range(len(fields))):
            field = ti.static(fields[k])
            for i in ti.grouped(ti.ndrange(*field.shape)):
                if ti.static(isinstance(field, ti.ScalarField)):
                    field[i] = ti.bit_cast(values[at], field.dtype)
                    at += 1
                else:
                    for p, q in ti.static(ti.ndrange(field.n, field.m)):
                        if ti.static(field.ndim == 1):
                            field[i][p] = ti.bit_cast(values[at], field.dtype)
                        else:
                            field[i][p, q] = ti.bit_cast(values[at], field.dtype)
                        at += 1
