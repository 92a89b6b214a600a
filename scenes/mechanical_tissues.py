"""The table of mechanical properties: ranges and typical values by part of the kidney."""

import tomllib
from functools import cache
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator

from scenes.section import LIST
from settings import Section

TABLE = Path(__file__).parent / "mechanical_tissues.toml"


def _ascending(values: tuple[float, float, float]) -> tuple[float, float, float]:
    if not values[0] <= values[1] <= values[2]:
        raise ValueError(f"{values}: expected low, typical and high value in this order")
    return values


Range = Annotated[tuple[float, float, float], LIST, AfterValidator(_ascending)]


class PartProperties(Section):
    """Young's modulus [kPa], Poisson's ratio and density [g/cm^3] of a part."""

    young_kpa: Range
    poisson: Range
    density_g_cm3: Range


class MechanicalProperties(Section):
    """Low, typical and high values: stiffness of capsule and pedicle [N/mm], Young's modulus of perirenal
    fat [kPa], stiffness of a layer of it [kPa/mm], friction, and the parts' own.
    """

    capsule_n_mm: Range
    pedicle_n_mm: Range
    fat_young_kpa: Range
    fat_kpa_mm: Range
    friction: Range
    parts: dict[str, PartProperties]


@cache
def mechanical_properties() -> MechanicalProperties:
    """The table."""
    return MechanicalProperties.model_validate(tomllib.loads(TABLE.read_text("utf-8")))
