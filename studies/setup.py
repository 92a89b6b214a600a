"""Which model computes a case or a scene, under which probe: the presets, and what may be changed of them."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from scenes.scene import Scene, with_options
from scenes.tissue import TISSUES
from ultrasound.array import Probe, load_probe


@dataclass(frozen=True)
class Setup:
    """How a case is computed, whichever it is; the defaults are the paper's: Table 1 and its calibration's steps.

    ``radius_mm`` and ``stiffness`` are shape matching's; ``cell_mm``, ``young_kpa`` and ``poisson`` the neo-Hookean
    model's, of which the last two are the case's own where they are None.
    """

    model: str = "shape-matching"
    radius_mm: float = 2.7
    stiffness: float = 0.95
    cell_mm: float = 3.5
    relaxation_factor: float = 1.0
    substeps: int = 3
    iterations: int = 9
    time_step_s: float = 1 / 60
    warm_up_steps: int = 120
    stage_steps: int = 90
    young_kpa: float | None = None
    poisson: float | None = None

    @property
    def size_name(self) -> str:
        """Which of the values says how fine the model is."""
        return TISSUES[self.model].SIZE

    @property
    def size_mm(self) -> float:
        """How fine the model is: width of a cell, or radius of a particle."""
        return getattr(self, self.size_name)

    def sized(self, size_mm: float) -> "Setup":
        """The same of another size."""
        values: dict[str, Any] = {self.size_name: size_mm}
        return replace(self, **values)


NEO_HOOKEAN = Setup("neo-hookean", cell_mm=3.5, relaxation_factor=1.7, substeps=1, iterations=4)
# Each model's presets, which hold for every case. The first model's are points of the front that ``study trade`` measures,
# the other's the paper's particles.
PRESETS = {
    "neo-hookean": {
        "fast": replace(NEO_HOOKEAN, cell_mm=5.0),
        "balanced": NEO_HOOKEAN,
        "accurate": replace(NEO_HOOKEAN, cell_mm=2.0, iterations=12),
    },
    "shape-matching": {
        "fast": Setup(radius_mm=3.3),
        "balanced": Setup(radius_mm=2.7),
        "accurate": Setup(radius_mm=2.2),
    },
}
# A setup's values that only some models have: of how the tissue is built, and of what it is made.
BUILT, MATERIAL = ("radius_mm", "stiffness", "cell_mm"), ("young_kpa", "poisson")
NOT_USED = {
    model: tuple(name for name in (*BUILT, *MATERIAL) if name not in section.model_fields)
    for model, section in TISSUES.items()
}
OPTION_OF = {"radius_mm": "radius", "cell_mm": "cell"}
QUALITIES = ("fast", "balanced", "accurate")


class SetupError(ValueError):
    """A setup that does not fit its model or case; the message is one line."""


def scene_of(scene: Scene, setup: Setup) -> Scene:
    """A scene with a setup's model, size and passes."""
    values: dict[str, float | int | str | None] = {
        "tissue.model": setup.model,
        f"tissue.{setup.size_name}": setup.size_mm,
        "solver.substeps": setup.substeps,
        "solver.iterations": setup.iterations,
        "solver.relaxation_factor": setup.relaxation_factor,
    }
    built = {f"tissue.{name}": getattr(setup, name) for name in BUILT if name not in NOT_USED[setup.model]}
    return with_options(scene, values | built)


def setup_of_scene(scene: Scene, substeps: int, iterations: int, relaxation_factor: float) -> Setup:
    """The setup that a scene is computed with when its steps have these passes."""
    tissue = scene.tissue
    built = {name: getattr(tissue, name) for name in BUILT if name not in NOT_USED[tissue.model]}
    return Setup(
        tissue.model, **built, substeps=substeps, iterations=iterations, relaxation_factor=relaxation_factor
    )


def choose_setup(model: str, quality: str, **changes: Any) -> Setup:
    """A preset with single values changed; None leaves what is there. Raises SetupError."""
    given = {name: value for name, value in changes.items() if value is not None}
    for name in given:
        if name in NOT_USED[model]:
            raise SetupError(
                f"--{OPTION_OF.get(name, name.replace('_', '-'))}: {model} has no such setting; leave it out"
            )
    return replace(PRESETS[model][quality], **given)


def probe_of(scene: Scene, folder: Path | None = None) -> Probe:
    """The probe that a scene names, with the scene's own depth and housing where it gives them. Raises ProbeError.

    A file is looked for in a folder, the scene's.
    """
    own = {"depth_mm": scene.image.depth_mm, "housing_mm": scene.transducer.size_mm}
    given = {key: value for key, value in own.items() if value is not None}
    return load_probe(scene.transducer.probe, folder).model_copy(update=given)
