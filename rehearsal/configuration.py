"""Which tissue computes a case or a scene, under which probe: the presets, and what may be changed of them."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from errors import UserError
from scenes.scene import OPTIONS, Scene, with_options
from scenes.tissue import QUALITIES, TISSUES
from ultrasound.probe import Probe, load_probe


@dataclass(frozen=True)
class Setup:
    """How a case is computed, whichever it is; the defaults are the paper's: Table 1 and its calibration's steps.

    ``tissue`` is its model's section of a scene file, a ``TissueSection``; what that leaves open of the material is the case's own.
    """

    tissue: Any
    relaxation_factor: float = 1.0
    substeps: int = 3
    iterations: int = 9
    time_step_s: float = 1 / 60
    warm_up_steps: int = 120
    stage_steps: int = 90

    @property
    def model(self) -> str:
        """Its tissue's name."""
        return self.tissue.model

    @property
    def size_mm(self) -> float:
        """How fine the model is: width of a cell, or radius of a particle."""
        return self.tissue.size_mm

    def sized(self, size_mm: float) -> "Setup":
        """The same of another size."""
        return self.but(**{self.tissue.SIZE: size_mm})

    def but(self, **values: Any) -> "Setup":
        """The same with some values changed, of its own or of its tissue. Raises SetupError for one that is of neither."""
        own = {name: values.pop(name) for name in OWN if name in values}
        for name in values:
            if name not in type(self.tissue).model_fields:
                raise SetupError(f"{option_of(name)}: {self.model} has no such setting; leave it out")
        told = self.tissue.model_dump(exclude_unset=True) | {"model": self.model} | values
        return replace(self, tissue=type(self.tissue).model_validate(told), **own)


# The values of a setup that are not its tissue's.
OWN = tuple(field.name for field in fields(Setup))[1:]


class SetupError(UserError):
    """A setup that does not fit its model or case; the message is one line."""


def setup_of(model: str, **values: Any) -> Setup:
    """A model's own choice of step and all else, but for some values. Raises SetupError."""
    section = TISSUES[model]
    usual = {name: value for name, value in section.STEP.items() if name in OWN}
    return Setup(section.model_validate({"model": model}), **usual).but(**values)


# Each model's presets, which hold for every case.
PRESETS: Mapping[str, Mapping[str, Setup]] = {
    model: {quality: setup_of(model, **section.PRESETS[quality]) for quality in QUALITIES}
    for model, section in TISSUES.items()
}


def option_of(name: str) -> str:
    """The command line's name for a value of a tissue."""
    return OPTIONS.get(f"tissue.{name}", f"--{name.replace('_', '-')}")


def scene_of(scene: Scene, setup: Setup) -> Scene:
    """A scene with a setup's model, size and passes; what its tissue leaves open stays the scene's."""
    passes = {
        f"solver.{name}": getattr(setup, name) for name in ("substeps", "iterations", "relaxation_factor")
    }
    told = setup.tissue.model_dump(exclude_unset=True) | {setup.tissue.SIZE: setup.size_mm}
    tissue = {f"tissue.{name}": value for name, value in told.items()}
    return with_options(scene, tissue | passes | {"tissue.model": setup.model})


def with_quality(scene: Scene, quality: str | None) -> Scene:
    """A scene with the size and passes of its model's preset, where one is asked for."""
    return scene if quality is None else scene_of(scene, PRESETS[scene.tissue.model][quality])


def setup_of_scene(scene: Scene, substeps: int, iterations: int, relaxation_factor: float) -> Setup:
    """The setup that a scene is computed with when its steps have these passes."""
    return Setup(scene.tissue, relaxation_factor, substeps, iterations)


def choose_setup(model: str, quality: str, **changes: Any) -> Setup:
    """A preset with single values changed; None leaves what is there. Raises SetupError."""
    return PRESETS[model][quality].but(
        **{name: value for name, value in changes.items() if value is not None}
    )


def probe_of(scene: Scene) -> Probe:
    """The probe that a scene names, with the scene's own depth and housing where it gives them. Raises ProbeError."""
    own = {"depth_mm": scene.image.depth_mm, "housing_mm": scene.transducer.size_mm}
    given = {key: value for key, value in own.items() if value is not None}
    return load_probe(scene.transducer.probe).model_copy(update=given)
