"""What the user can change while a rehearsal runs: sections of the scene, the probe, those of the window."""

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field

from errors import UserError
from rehearsal.build_solver import step_settings
from rehearsal.case import Case
from render.keys import default_keys
from render.viewer import RESECTION, WindowSettings
from scenes.scene import Gravity, Image, SolverSection
from scenes.tissue import NeoHookeanTissue, Tissue
from settings import Control, Key, Section, SettingError, settings_in, with_values
from ultrasound.target import Target


class PlanSettings(Section):
    """What the next plan is made for, and the margin of plan and cut."""

    margin_mm: Annotated[float, Control("Margin", RESECTION, is_whole=True)] = Field(5.0, ge=0, le=20)
    plan_for: Annotated[Target, Key("Space", "Plan", "target: tumour and margin, tumour, kidney")] = "margin"


class LiveSettings(WindowSettings):
    """A session records those with a control or a key, by their paths."""

    tissue: Tissue = NeoHookeanTissue()
    solver: SolverSection = SolverSection()
    gravity: Gravity = Gravity()
    image: Image = Image()
    plan: PlanSettings = PlanSettings()


def with_recorded(settings: LiveSettings, values: Mapping[str, Any]) -> LiveSettings:
    """The settings with values of a session, by path. Raises UserError where they cannot be so."""
    try:
        return with_values(settings, values)
    except SettingError as error:
        raise UserError(f"the session sets {error}; its file is damaged") from None


DEFAULT_KEYS = default_keys(settings_in(LiveSettings))


def initial_settings(case: Case) -> LiveSettings:
    """Those of scene and probe, with the solver's defaults where the scene leaves these open."""
    scene = case.scene
    step = step_settings(scene.tissue, scene.solver)
    solver = scene.solver.model_copy(update=dict(substeps=step.substeps, iterations=step.iterations))
    return LiveSettings(
        probe=case.probe, tissue=scene.tissue, solver=solver, gravity=scene.gravity, image=scene.image
    )
