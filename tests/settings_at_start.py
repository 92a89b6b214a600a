"""Settings of a window without a patient."""

from typing import Any

from rehearsal.live_settings import LiveSettings
from scenes.scene import SolverSection
from settings import with_values
from ultrasound.probe import load_probe


def settings_with(values: dict[str, Any] | None = None) -> LiveSettings:
    """The settings of the linear probe and the embedded patient's tissue, some changed by their paths."""
    solver = SolverSection(substeps=1, iterations=4)
    return with_values(LiveSettings(probe=load_probe("linear"), solver=solver), values or {})
