"""One path from file and options to the solver: sections of a scene -> ``Setup`` (presets, changes) ->
``StepSettings`` of sim/.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from errors import UserError, meant
from scenes.scene import OPTIONS, Scene, SolverSection, with_options
from scenes.tissue import QUALITIES, TISSUES
from ultrasound.probe import Probe, ProbeError, changed_probe, load_probe

# The paper's Table 1, where a tissue model has no choice of its own.
PAPER_STEP: dict[str, Any] = dict(substeps=3, iterations=9, relaxation_factor=1.0)
# The settings of the solver's section that a setup always has.
STEP = tuple(PAPER_STEP)


class SetupError(UserError):
    """A setup that does not fit its model or case."""


@dataclass(frozen=True)
class Setup:
    """A scene's sections of tissue (a ``TissueSection``) and solver, for any case; what the tissue leaves
    open of the material is the case's own.

    The lengths of warm-up and stage are the paper's.
    """

    tissue: Any
    solver: SolverSection
    warm_up_steps: int = 120
    stage_steps: int = 90

    @property
    def model(self) -> str:
        """The name of the tissue model."""
        return self.tissue.model

    @property
    def size_mm(self) -> float:
        """The resolution: width of a cell, or radius of a particle."""
        return self.tissue.size_mm

    @property
    def substeps(self) -> int:
        return self.solver.substeps or PAPER_STEP["substeps"]

    @property
    def iterations(self) -> int:
        return self.solver.iterations or PAPER_STEP["iterations"]

    @property
    def relaxation_factor(self) -> float:
        return self.solver.relaxation_factor or PAPER_STEP["relaxation_factor"]

    def sized(self, size_mm: float) -> "Setup":
        """The same with another resolution."""
        return self.but(**{self.tissue.size_key: size_mm})

    def but(self, **values: Any) -> "Setup":
        """The same with some values changed, by their names in any of the sections.

        Raises SetupError for an unknown one.
        """
        own = {name: values.pop(name) for name in ("warm_up_steps", "stage_steps") if name in values}
        step = {name: values.pop(name) for name in SolverSection.model_fields if name in values}
        for name in values:
            if name not in type(self.tissue).model_fields:
                raise SetupError(f"{option_of(name)}: {self.model} has no such setting; leave it out")
        tissue = self.tissue.model_dump(exclude_unset=True) | {"model": self.model} | values
        solver = self.solver.model_dump(exclude_unset=True) | step
        return replace(
            self,
            tissue=type(self.tissue).model_validate(tissue),
            solver=SolverSection.model_validate(solver),
            **own,
        )


def setup_of(model: str, **values: Any) -> Setup:
    """A tissue model with its own choice of a step, and some values changed. Raises SetupError."""
    section = TISSUES[model]
    step = PAPER_STEP | {name: value for name, value in section.step_defaults.items() if name in STEP}
    tissue = section.model_validate({"model": model})
    return Setup(tissue, SolverSection.model_validate(step)).but(**values)


# Each model's presets, which hold for every case.
PRESETS: Mapping[str, Mapping[str, Setup]] = {
    model: {quality: setup_of(model, **section.presets[quality]) for quality in QUALITIES}
    for model, section in TISSUES.items()
}


def option_of(name: str) -> str:
    """The command line's name for a value of a tissue."""
    return OPTIONS.get(f"tissue.{name}", f"--{name.replace('_', '-')}")


def scene_of(scene: Scene, setup: Setup) -> Scene:
    """A scene with a setup's model, resolution and step; what its tissue leaves open stays the scene's."""
    step = {f"solver.{name}": getattr(setup, name) for name in STEP}
    values = setup.tissue.model_dump(exclude_unset=True) | {setup.tissue.size_key: setup.size_mm}
    tissue = {f"tissue.{name}": value for name, value in values.items()}
    return with_options(scene, tissue | step | {"tissue.model": setup.model})


def with_quality(scene: Scene, quality: str | None) -> Scene:
    """A scene with the resolution and step of its model's preset, if one is chosen. Raises SetupError."""
    if quality is None:
        return scene
    if quality not in QUALITIES:
        raise SetupError(f"quality = {quality!r}: there is no such preset; {meant(quality, QUALITIES)}")
    return scene_of(scene, PRESETS[scene.tissue.model][quality])


def choose_setup(model: str, quality: str, **changes: Any) -> Setup:
    """A preset with single values changed; None changes nothing. Raises SetupError."""
    return PRESETS[model][quality].but(
        **{name: value for name, value in changes.items() if value is not None}
    )


def probe_of(scene: Scene) -> Probe:
    """The probe that a scene names, with the scene's depth and housing if it has them. Raises ProbeError."""
    own = {"depth_mm": scene.image.depth_mm, "housing_mm": scene.transducer.size_mm}
    changes = {key: value for key, value in own.items() if value is not None}
    probe = load_probe(scene.transducer.probe)
    try:
        return changed_probe(probe, **changes)
    except ProbeError as error:
        keys = {"depth_mm": "image.depth_mm", "housing_mm": "transducer.size_mm"}
        values = " and ".join(
            f"{keys[key]} = {list(value) if isinstance(value, tuple) else value}"
            for key, value in changes.items()
        )
        raise ProbeError(
            f"{values} does not fit the probe {probe.transducer_name}: {error}; change it, or leave it out"
        ) from None
