"""Kinds of value that several sections of a scene file have."""

from typing import Annotated

import numpy as np
from pydantic import AfterValidator, Field

# TOML and JSON have lists where Python has tuples.
LIST = Field(strict=False)
Vector3 = Annotated[tuple[float, float, float], LIST]
Length = Annotated[float, Field(gt=0, le=500)]


def _not_zero(vector: Vector3) -> Vector3:
    if np.linalg.norm(vector) < 1e-9:
        raise ValueError("a direction must not be zero")
    return vector


Direction = Annotated[Vector3, AfterValidator(_not_zero)]
