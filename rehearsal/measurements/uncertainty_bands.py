"""The bands of ``study uncertainty`` for the panel: how far a measurement may differ, because the
patient's tissue is not known.
"""

from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from errors import UserError, explained
from text_files import TextError, read_json


class UncertaintyError(UserError):
    """A file of bands that cannot be used; the message is one line."""


class Band(BaseModel):
    """5th, 50th and 95th percentile [mm or N]."""

    model_config = ConfigDict(allow_inf_nan=False)

    low: float
    median: float
    high: float


class UncertaintyBands(BaseModel):
    """What the panel needs of uncertainty.json: the bands of each quantity at each depth of a press of
    this anatomy.
    """

    model_config = ConfigDict(allow_inf_nan=False)

    nephron_uncertainty: Literal[1]
    anatomy: str
    indentations_mm: list[float] = Field(min_length=1)
    bands: list[dict[str, Band]]

    @model_validator(mode="after")
    def _one_for_each_depth(self) -> "UncertaintyBands":
        if len(self.bands) != len(self.indentations_mm):
            raise ValueError(
                f"{len(self.bands)} bands for {len(self.indentations_mm)} depths: expected one for each"
            )
        if sorted(self.indentations_mm) != self.indentations_mm or self.indentations_mm[0] <= 0:
            raise ValueError(f"indentations_mm = {self.indentations_mm}: expected ascending depths")
        return self

    def around(self, name: str, value: float, indentation_mm: float) -> tuple[float, float] | None:
        """The 90 % band around a value at a depth, between the depths of the study; None for a quantity
        that it does not have.
        """
        if not all(name in row for row in self.bands):
            return None
        bands = [row[name] for row in self.bands]
        depths = [0.0, *self.indentations_mm]
        below = np.interp(indentation_mm, depths, [0.0, *(band.low - band.median for band in bands)])
        above = np.interp(indentation_mm, depths, [0.0, *(band.high - band.median for band in bands)])
        return value + float(below), value + float(above)


def read_bands(path: Path) -> UncertaintyBands:
    """Read uncertainty.json. Raises UncertaintyError that names the file and what to do."""
    again = "make it with: app.py study uncertainty"
    try:
        return UncertaintyBands.model_validate(read_json(path))
    except (FileNotFoundError, NotADirectoryError):
        raise UncertaintyError(
            f"{path}: no such file, which the scene names as uncertainty; {again}"
        ) from None
    except TextError as error:
        raise UncertaintyError(f"{path}: cannot be read as JSON ({error}); {again}") from None
    except ValidationError as error:
        raise UncertaintyError(f"{path}: {explained(error)}; {again}") from None
