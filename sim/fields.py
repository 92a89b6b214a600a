"""Arrays on the device."""

import numpy as np
import taichi as ti


def field_of(values: np.ndarray, within: int = 0) -> ti.Field:
    """A field that holds an array: floats as f32, all else as i32.

    The last ``within`` axes are those of each element: 0 for scalars, 1 for vectors, 2 for matrices.
    """
    values = np.asarray(values)
    kind, number = (ti.f32, np.float32) if values.dtype.kind == "f" else (ti.i32, np.int32)
    shape, element = values.shape[: values.ndim - within], values.shape[values.ndim - within :]
    make = (ti.field, ti.Vector.field, ti.Matrix.field)[within]
    field = make(*element, kind, shape)
    field.from_numpy(np.ascontiguousarray(values, number))
    return field
