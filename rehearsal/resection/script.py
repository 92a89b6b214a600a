"""Actions of a resection at the times of a file of poses."""

from collections import deque
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from rehearsal.resection.cut import CutSettings
from render.viewer import Technique
from ultrasound.crater import Filling

Number = Annotated[float, Field(ge=-1e5, le=1e5)]


class ScriptedCut(BaseModel):
    """A cut in a file; see ``CutSettings``."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    technique: Technique = "enucleoresection"
    margin_mm: float = Field(5.0, ge=0, le=20)
    depth_mm: float | None = Field(None, gt=0, le=60)
    filling: Filling = "fluid"

    def settings(self) -> CutSettings:
        """As settings of a cut."""
        return CutSettings(self.technique, self.margin_mm, self.depth_mm, self.filling)


@dataclass(frozen=True)
class ScriptedAction:
    """At a time [s]: marks of the score, at the edges in the image or at places (LPS, mm), or a cut."""

    time_s: float
    score: Literal["image"] | list[tuple[float, float, float]] | None = None
    margin_mm: float = 5.0
    cut: CutSettings | None = None


class ResectionScript:
    """Actions in the order of their times."""

    def __init__(self, actions: list[ScriptedAction]) -> None:
        self._actions = deque(sorted(actions, key=lambda action: action.time_s))

    def is_due(self, time_s: float) -> bool:
        """Whether there is an action at or before a time [s]."""
        return bool(self._actions) and self._actions[0].time_s <= time_s + 1e-9

    def next(self) -> ScriptedAction:
        """The next action, which is no longer there afterwards."""
        return self._actions.popleft()
