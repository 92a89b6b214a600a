"""The file of a planned resection: proposals, the best first, with their figures.

JSON; patient coordinates LPS, mm.
"""

from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    JsonValue,
    ValidationError,
    field_validator,
    model_validator,
)

from errors import UserError, explained
from rehearsal.planning.plan_file import is_plan
from rehearsal.resection.judgement import Judgement
from rehearsal.resection.proposal import Proposal, cost_ml
from rehearsal.resection.resection_state import Number
from render.viewer import Technique
from text_files import TextError, read_text
from version import FORMAT, of_this_format

# The first bytes of a plan contain this.
MARK = '"nephron_resection"'
# Figures of a cut that are compared with those of the plan: how they are called, and their units.
COMPARED = {
    "parenchyma_removed_ml": ("parenchyma", "ml"),
    "collecting_system_opened_mm2": ("collecting system opened", "mm2"),
    "margin_min_mm": ("least margin", "mm"),
    "positive_margin_mm2": ("positive margin", "mm2"),
}
# A difference that is written as zero is not written.
LEAST_SHOWN = 0.05
Place = tuple[Number, Number, Number]


class ResectionPlanError(UserError):
    """A plan of a resection that cannot be used; the message is one line."""


class _FileModel(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class PlannedCut(_FileModel):
    """A technique and a closed line on the capsule at rest; ``cost_ml`` see ``proposal.cost_ml``,
    ``figures`` those of ``Judgement.report``.
    """

    technique: Technique
    cost_ml: float
    direction: Place
    marks_mm: Annotated[list[Place], Field(min_length=3, max_length=200)]
    line_mm: Annotated[list[Place], Field(min_length=3, max_length=10_000)]
    figures: dict[str, JsonValue]

    @field_validator("figures")
    @classmethod
    def _check_compared(cls, figures: dict[str, JsonValue]) -> dict[str, JsonValue]:
        for name in COMPARED:
            if not isinstance(figures.get(name, ""), int | float | None):
                raise ValueError(f"{name} is no number")
        return figures


class ResectionPlan(_FileModel):
    """``version`` is the Nephron that made it, ``anatomy`` the fingerprint of the patient's files."""

    nephron_resection: int = FORMAT
    version: str | None = None
    anatomy: str
    margin_mm: float = Field(ge=0, le=30)
    cuts: list[PlannedCut] = Field(min_length=1)

    @model_validator(mode="before")
    @classmethod
    def _has_this_format(cls, values: Any) -> Any:
        return of_this_format(values, "nephron_resection")

    @property
    def best(self) -> PlannedCut:
        """The first of the cuts."""
        return self.cuts[0]

    def compared(self, judgement: Judgement) -> dict[str, Any]:
        """A rehearsed cut against the best planned one: what both cost, and how much more the rehearsed
        one took away.
        """
        planned, figures, made = self.best, self.best.figures, judgement.report()
        return dict(
            planned_technique=planned.technique,
            planned_cost_ml=round(planned.cost_ml, 2),
            cost_ml=round(cost_ml(judgement, self.margin_mm), 2),
            **{f"{name}_more": _more(made[name], figures[name]) for name in COMPARED},
        )


def against_plan(compared: dict[str, Any]) -> str:
    """What ``ResectionPlan.compared`` found, in words: both costs, and in which figures the cut differs
    from the planned one.
    """
    differing = [
        f"{word} {more:+.1f} {unit}"
        for name, (word, unit) in COMPARED.items()
        if abs(more := compared[f"{name}_more"] or 0.0) >= LEAST_SHOWN
    ]
    costs = (
        f"cost {compared['cost_ml']:.1f} points, planned {compared['planned_cost_ml']:.1f} by "
        f"{compared['planned_technique']}"
    )
    return f"{costs}: {', '.join(differing)}" if differing else costs


def _more(made: float | None, planned: JsonValue) -> float | None:
    """How much more was made than planned; None for what is not labelled."""
    return round(made - planned, 3) if made is not None and isinstance(planned, int | float) else None


def planned_cut(proposal: Proposal, origin: np.ndarray) -> PlannedCut:
    """A proposal as a file has it; ``origin`` (3,) [mm] is where its coordinates are zero in the patient."""

    def places(points: np.ndarray) -> list[Place]:
        return [(x, y, z) for x, y, z in np.round(points + origin, 3).tolist()]

    x, y, z = np.round(proposal.cut.line.direction, 4).tolist()
    return PlannedCut(
        technique=proposal.settings.technique,
        cost_ml=round(proposal.cost_ml, 3),
        direction=(x, y, z),
        marks_mm=places(proposal.cut.line.marks),
        line_mm=places(proposal.cut.line.points),
        figures=proposal.judgement.report(),
    )


def is_resection_plan(path: Path) -> bool:
    """Whether a file begins as a plan of a resection does."""
    return is_plan(path, MARK)


def read_resection_plan(path: Path) -> ResectionPlan:
    """Read a plan. Raises ResectionPlanError."""
    try:
        return ResectionPlan.model_validate_json(read_text(path))
    except (FileNotFoundError, NotADirectoryError):
        raise ResectionPlanError(f"{path}: no such plan of a resection") from None
    except TextError as error:
        raise ResectionPlanError(f"{path}: cannot be read as a plan of a resection ({error})") from None
    except ValidationError as error:
        raise ResectionPlanError(
            f"{path}: not a plan of a resection of this version ({explained(error)}); expected a file that "
            "app.py plan --resect wrote"
        ) from None
