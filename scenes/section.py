"""What every section of a scene file is, and the kinds of value that several have."""

from typing import Annotated

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

# TOML and JSON have lists where Python has tuples.
LIST = Field(strict=False)
Vector3 = Annotated[tuple[float, float, float], LIST]
Length = Annotated[float, Field(gt=0, le=500)]


def _not_zero(vector: Vector3) -> Vector3:
    if np.linalg.norm(vector) < 1e-9:
        raise ValueError("a direction must not be zero")
    return vector


Direction = Annotated[Vector3, AfterValidator(_not_zero)]


class Section(BaseModel):
    """Its keys are all that there are, and its values do not change. A text is no number."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=True)
