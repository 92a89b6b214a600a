"""The tissue models as a scene names them: what each is told, and which there are."""

from typing import Annotated, Any, ClassVar, Literal, TypeAlias, get_args

from pydantic import Discriminator, Field, Tag

from scenes.section import Section

Stiffness = Annotated[float, Field(ge=0, le=1)]


class TissueSection(Section):
    """What every model is told. ``SIZE`` is the key that says how fine it is, ``PIECES`` what that is the size of."""

    SIZE: ClassVar[str]
    PIECES: ClassVar[str]

    model: str

    @property
    def size_mm(self) -> float:
        """How fine the model is [mm]."""
        return getattr(self, self.SIZE)


class NeoHookeanTissue(TissueSection):
    """Tissue true to a material, on cubic cells. Smaller cells are truer and slower; the material stays the same."""

    SIZE, PIECES = "cell_mm", "cells"

    model: Literal["neo-hookean"] = "neo-hookean"
    cell_mm: float = Field(3.5, ge=0.5, le=20)
    young_kpa: float = Field(15.0, gt=0, le=1e6)
    poisson: float = Field(0.45, ge=0, le=0.4999)
    density_g_cm3: float = Field(1.05, gt=0, le=20)


class ShapeMatchingTissue(TissueSection):
    """The paper's tissue model and its sampling; the defaults are the paper's, but for the stiffness, which it fits.

    Particles are ``radius_mm`` apart, chosen from voxels of ``radius_mm / volume_sampling``; clusters are
    ``cluster_spacing`` radii apart and reach as far. The tissue's stiffness depends on all of these and on the
    solver's iterations, not on ``stiffness`` alone: that is this method's limitation. Nor does ``density_g_cm3`` change
    its motion, for all particles weigh the same.
    """

    SIZE, PIECES = "radius_mm", "particles"

    model: Literal["shape-matching"]
    radius_mm: float = Field(2.7, ge=0.5, le=20)
    stiffness: Stiffness = 0.95
    density_g_cm3: float = Field(1.05, gt=0, le=20)
    volume_sampling: float = Field(4.0, ge=1, le=8)
    cluster_spacing: float = Field(3.33, ge=1, le=20)
    surface_samples_per_mm2: float = Field(0.0, ge=0, le=10)


# All models: a new one is added here, under its name.
AnyTissue: TypeAlias = (
    Annotated[NeoHookeanTissue, Tag("neo-hookean")] | Annotated[ShapeMatchingTissue, Tag("shape-matching")]
)
TISSUES: dict[str, type[TissueSection]] = {
    tag.tag: section for section, tag in map(get_args, get_args(AnyTissue))
}


def _model_of(values: Any) -> str | None:
    name = values.get("model", "neo-hookean") if isinstance(values, dict) else getattr(values, "model", None)
    return name if name in TISSUES else None


Tissue = Annotated[
    AnyTissue,
    Discriminator(
        _model_of,
        custom_error_type="unknown_model",
        custom_error_message=f"the model should be one of {', '.join(TISSUES)}",
    ),
]
