"""The attempts of a session side by side: the figures of each cut, as rows of a table.

A cut that was undone stays in the list, and its state can be restored.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from rehearsal.deformed_anatomy import DeformedAnatomy
from rehearsal.loop.frame import Frame
from rehearsal.resection.judgement import NOT_LABELLED, Judgement, shown
from rehearsal.resection.proposal import cost_ml
from rehearsal.resection.resection_plan import ResectionPlan
from rehearsal.resection.resection_state import Attempt
from rehearsal.result_files import counted
from render.viewer import Technique, TextTable
from ultrasound.probe import Probe

# A figure that cannot be had.
UNKNOWN = "-"
HEADINGS = (
    *("attempt", "technique", "margin asked, mm", "least kept, mm", "mean kept, mm"),
    *("parenchyma removed, ml", "collecting system opened, mm2", "vessels divided"),
)


@dataclass(frozen=True)
class AttemptFigures:
    """What an attempt took and kept. Figures are None where there is no tumour to judge by, those of
    collecting system and vessels also where none is labelled; ``points`` and ``planned_points`` (see
    ``proposal.cost_ml``) where there is no plan.
    """

    number: int
    technique: Technique
    margin_asked_mm: float
    margin_min_mm: float | None = None
    margin_mean_mm: float | None = None
    parenchyma_removed_ml: float | None = None
    collecting_system_opened_mm2: float | None = None
    vessels_divided: int | None = None
    points: float | None = None
    planned_points: float | None = None

    def row(self) -> tuple[str, ...]:
        """As texts, in the order of ``HEADINGS``; the points follow where there is a plan."""
        is_judged = self.margin_min_mm is not None
        opened, divided = self.collecting_system_opened_mm2, self.vessels_divided
        missing = NOT_LABELLED if is_judged else UNKNOWN
        return (
            str(self.number),
            self.technique,
            f"{self.margin_asked_mm:g}",
            _shown(self.margin_min_mm),
            _shown(self.margin_mean_mm),
            _shown(self.parenchyma_removed_ml),
            missing if opened is None else shown(opened, "").strip(),
            missing if divided is None else str(divided),
            *([] if self.planned_points is None else [_shown(self.points)]),
        )


class AttemptFigureList:
    """An ``Observer`` that has the figures of all attempts of the session, in their order, and the present
    one.
    """

    def __init__(self, anatomy: DeformedAnatomy, plan: ResectionPlan | None = None) -> None:
        self._anatomy, self._plan = anatomy, plan
        self._figures: dict[Attempt, AttemptFigures] = {}

    def observe(self, frame: Frame, probe: Probe) -> None:
        """As ``Observer.observe``: judge the attempts that are new."""
        self._figures = {
            attempt: self._figures.get(attempt) or self._judged(attempt) for attempt in frame.attempts
        }

    @property
    def figures(self) -> list[AttemptFigures]:
        """Of all attempts."""
        return list(self._figures.values())

    def report(self) -> list[dict[str, Any]]:
        """The figures of all attempts, for ``report.json``."""
        return [asdict(figures) for figures in self.figures]

    def table(self) -> TextTable:
        """All attempts; the present one is marked."""
        present = self._anatomy.frame.present_attempt
        return table_of(self.figures, None if present is None else present.number)

    def _judged(self, attempt: Attempt) -> AttemptFigures:
        request = attempt.resection.cut
        if request is None:
            raise ValueError("expected an attempt with a cut")
        judgement = self._anatomy.judgement_of(attempt.resection)[0]
        how = request.settings.technique, request.settings.margin_mm
        return figures_of_attempt(attempt.number, *how, judgement, self._plan)


def figures_of_attempt(
    number: int,
    technique: Technique,
    margin_asked_mm: float,
    judgement: Judgement | None,
    plan: ResectionPlan | None = None,
) -> AttemptFigures:
    """The figures of an attempt, as far as it was judged."""
    planned = None if plan is None else round(plan.best.cost_ml, 2)
    if judgement is None:
        return AttemptFigures(number, technique, margin_asked_mm, planned_points=planned)
    report = judgement.report()
    vessels = judgement.vessels
    return AttemptFigures(
        number,
        technique,
        margin_asked_mm,
        report["margin_min_mm"],
        report["margin_mean_mm"],
        report["parenchyma_removed_ml"],
        report["collecting_system_opened_mm2"],
        None if vessels is None else len(vessels),
        None if plan is None else round(cost_ml(judgement, plan.margin_mm), 2),
        planned,
    )


def table_of(attempts: Sequence[AttemptFigures], present: int | None = None) -> TextTable:
    """Attempts as the rows of a table; ``present`` is the number of the one whose cut the tissue has."""
    planned = attempts[0].planned_points if attempts else None
    points = () if planned is None else (f"points (plan {planned:.1f})",)
    numbers = [attempt.number for attempt in attempts]
    marked = numbers.index(present) if present in numbers else None
    title = f"{counted(len(attempts), 'attempt')}" if attempts else "No attempt yet: a cut is one"
    return TextTable(title, (*HEADINGS, *points), tuple(attempt.row() for attempt in attempts), marked)


def attempts_text(attempts: Sequence[AttemptFigures]) -> str:
    """The attempts for the terminal, a line each; empty without any."""
    return "\n".join(f"attempt {attempt.number:<3} {_in_words(attempt)}" for attempt in attempts)


def _in_words(attempt: AttemptFigures) -> str:
    how = f"{attempt.technique}, margin asked {attempt.margin_asked_mm:g} mm"
    if attempt.margin_min_mm is None:
        return f"{how}: not judged"
    opened, divided = attempt.collecting_system_opened_mm2, attempt.vessels_divided
    points = ""
    if attempt.points is not None:
        points = f"; {attempt.points:.1f} points, planned {attempt.planned_points:.1f}"
    return (
        f"{how}: {attempt.margin_min_mm:.1f} mm least, {attempt.margin_mean_mm:.1f} mm mean; parenchyma "
        f"{attempt.parenchyma_removed_ml:.1f} ml; collecting system "
        f"{NOT_LABELLED if opened is None else shown(opened, 'mm2') + ' opened'}; vessels "
        f"{NOT_LABELLED if divided is None else f'{divided} divided'}{points}"
    )


def _shown(value: float | None) -> str:
    return UNKNOWN if value is None else f"{value:.1f}"
