"""Which model computes a case, and with what: the presets and what may be changed of them."""

from dataclasses import dataclass, replace
from typing import Any


@dataclass(frozen=True)
class Setup:
    """How a case is computed, whichever it is; the defaults are the paper's: Table 1 and its calibration's steps.

    ``young_kpa`` and ``poisson`` are the case's own where they are None; shape matching has neither.
    """

    model: str = "shape-matching"
    radius_mm: float = 2.7
    stiffness: float = 0.95
    relaxation_factor: float = 1.0
    substeps: int = 3
    iterations: int = 9
    time_step_s: float = 1 / 60
    warm_up_steps: int = 120
    stage_steps: int = 90
    young_kpa: float | None = None
    poisson: float | None = None


# Each model's presets, which hold for every case and are fitted to none.
PRESETS = {
    "shape-matching": {
        "fast": Setup(radius_mm=3.3),
        "balanced": Setup(radius_mm=2.7),
        "accurate": Setup(radius_mm=2.2),
    },
}
# What a setup's values mean nothing to.
NOT_USED = {"shape-matching": ("young_kpa", "poisson")}
QUALITIES = ("fast", "balanced", "accurate")


class SetupError(ValueError):
    """A setup that does not fit its model or case; the message is one line."""


def choose_setup(model: str, quality: str, **changes: Any) -> Setup:
    """A preset with single values changed; None leaves what is there. Raises SetupError."""
    given = {name: value for name, value in changes.items() if value is not None}
    for name in given:
        if name in NOT_USED[model]:
            raise SetupError(f"--{name.replace('_', '-')}: {model} has no such setting; leave it out")
    return replace(PRESETS[model][quality], **given)
