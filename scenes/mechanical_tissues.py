"""The table of mechanical properties: ranges and typical values by part of the kidney."""

import tomllib
from functools import cache
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field, TypeAdapter

from scenes.section import Section

TABLE = Path(__file__).parent / "mechanical_tissues.toml"


def _ascending(values: tuple[float, float, float]) -> tuple[float, float, float]:
    if not values[0] <= values[1] <= values[2]:
        raise ValueError(f"{values}: expected low, typical and high value in this order")
    return values


Range = Annotated[tuple[float, float, float], AfterValidator(_ascending)]


class MechanicalProperties(Section):
    """Low, typical and high values of a part."""

    young_kpa: Range
    poisson: Annotated[Range, Field(min_length=3)]
    density_g_cm3: Range


@cache
def mechanical_properties() -> dict[str, MechanicalProperties]:
    """The table, by part."""
    return TypeAdapter(dict[str, MechanicalProperties]).validate_python(
        tomllib.loads(TABLE.read_text("utf-8"))
    )
