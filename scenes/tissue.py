"""The tissue models that a scene can name, and their parameters."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Field, SerializeAsAny

from scenes.section import LIST
from settings import Control, Section

QUALITIES = ("fast", "balanced", "accurate")
# The parts of an organ that can have their own material; where two overlap, the later one counts.
PartName = Literal["sinus", "vessel", "urine", "cyst", "tumour"]
# The default tissue of a scene.
USUAL = "neo-hookean"


class TissueSection(Section):
    """The section ``[tissue]`` of a scene file. Each subclass is a tissue model that a scene can name;
    ``TISSUES`` lists them.

    ``size_key`` is the key of the resolution, ``piece_name`` what has that size, among the model's counts.
    ``report_line`` has names of keys and counts. ``step_defaults`` are the model's own defaults of the
    solver's section, where these are not the paper's; ``presets`` has what each quality changes of keys and
    step, from coarse to fine.
    """

    size_key: ClassVar[str]
    piece_name: ClassVar[str]
    report_line: ClassVar[str]
    step_defaults: ClassVar[Mapping[str, Any]] = {}
    presets: ClassVar[Mapping[str, Mapping[str, Any]]]
    supports_self_contact: ClassVar[bool] = False
    supports_attachment: ClassVar[bool] = False

    model: Annotated[str, "--model"]
    """Tissue model."""

    def __hash__(self) -> int:
        # Lists and tables among the values have no hash of their own.
        return hash(self.model_dump_json())

    @property
    def size_mm(self) -> float:
        """The resolution [mm]."""
        return getattr(self, self.size_key)


class PartMaterial(Section):
    """The material of a part of the organ; what is left out is typical of it
    (``mechanical_tissues.toml``).
    """

    young_kpa: float | None = Field(None, gt=0, le=1e6)
    poisson: float | None = Field(None, ge=0, le=0.4999)
    density_g_cm3: float | None = Field(None, gt=0, le=20)


class Prony(Section):
    """A term of relaxation: a modulus relative to that at rest, which decays with this time constant."""

    modulus_ratio: float = Field(gt=0, le=100)
    time_s: float = Field(ge=0.01, le=1e4)


class NeoHookeanTissue(TissueSection):
    """Tissue true to a material, on cubic cells. Smaller cells are truer and slower; the material stays the
    same.

    ``parts`` have their own materials, ``young_kpa`` to ``density_g_cm3`` are those of the parenchyma.
    ``capsule_n_mm`` is the stiffness of the capsule, modulus times thickness; 0: none. ``prony``: the terms
    of its relaxation. The presets are points of the front that ``study trade`` measures.
    """

    size_key, piece_name = "cell_mm", "cells"
    report_line = (
        "neo-Hookean, E {young_kpa:g} kPa, nu {poisson:g}: {cells} cells of {cell_mm:g} mm, {nodes} nodes"
    )
    step_defaults: ClassVar = dict(
        substeps=1, iterations=4, relaxation_factor=1.7, stabilisation_iterations=0
    )
    presets: ClassVar = dict(fast=dict(cell_mm=5.0), balanced={}, accurate=dict(cell_mm=2.0, iterations=12))
    supports_attachment = True

    model: Annotated[Literal["neo-hookean"], "--model"] = "neo-hookean"
    """Tissue model."""
    cell_mm: Annotated[float, "--cell"] = Field(3.5, ge=0.5, le=20)
    """Width of a cell in mm."""
    young_kpa: Annotated[float, "--young-kpa", Control("Young", "Tissue", 1, 100)] = Field(15.0, gt=0, le=1e6)
    """Young's modulus in kPa."""
    poisson: Annotated[float, "--poisson"] = Field(0.45, ge=0, le=0.4999)
    """Poisson's ratio."""
    density_g_cm3: float = Field(1.05, gt=0, le=20)
    parts: dict[PartName, PartMaterial] = Field(default_factory=dict)
    capsule_n_mm: float = Field(0.0, ge=0, le=100)
    prony: Annotated[tuple[Prony, ...], LIST] = Field((), max_length=3)


class ShapeMatchingTissue(TissueSection):
    """The paper's tissue model and its sampling; the defaults are the paper's, but for the stiffness, which
    it fits.

    Particles are ``radius_mm`` apart, chosen from voxels of ``radius_mm / volume_sampling``; clusters are
    ``cluster_spacing`` radii apart and reach as far. The tissue's stiffness depends on all of these and on
    the solver's iterations, not on ``stiffness`` alone: that is this method's limitation. Nor does
    ``density_g_cm3`` change its motion, for all particles weigh the same. The presets are the paper's
    particles.
    """

    size_key, piece_name = "radius_mm", "particles"
    report_line = (
        "shape matching, stiffness {stiffness:g}: {particles} particles of {radius_mm:g} mm, {clusters} "
        "clusters, "
        "{memberships} memberships"
    )
    presets: ClassVar = dict(fast=dict(radius_mm=3.3), balanced={}, accurate=dict(radius_mm=2.2))
    supports_self_contact = True

    model: Annotated[Literal["shape-matching"], "--model"]
    """Tissue model."""
    radius_mm: Annotated[float, "--radius"] = Field(2.7, ge=0.5, le=20)
    """Particle radius in mm."""
    stiffness: Annotated[float, "--stiffness", Control("Stiffness", "Tissue", 0.1)] = Field(0.95, ge=0, le=1)
    """Cluster stiffness, 0 to 1."""
    density_g_cm3: float = Field(1.05, gt=0, le=20)
    volume_sampling: float = Field(4.0, ge=1, le=8)
    cluster_spacing: float = Field(3.33, ge=1, le=20)
    surface_samples_per_mm2: float = Field(0.0, ge=0, le=10)


# The tissue models by name; rehearsal/build_solver.py has the class of sim/ that computes each.
TISSUES: dict[str, type[TissueSection]] = {
    "neo-hookean": NeoHookeanTissue,
    "shape-matching": ShapeMatchingTissue,
}


def _of_its_model(values: Any) -> Any:
    """A scene's values as the section of the model that they name."""
    if not isinstance(values, dict):
        return values
    name = values.get("model", USUAL)
    if not isinstance(name, str) or name not in TISSUES:
        raise ValueError(f"tissue.model = {name!r}: the model should be one of {', '.join(TISSUES)}")
    return TISSUES[name].model_validate(values)


Tissue = Annotated[SerializeAsAny[TissueSection], BeforeValidator(_of_its_model)]
