"""Times of a cut: from the request to the cut applied, of its parts, of the judgement, and of a step before and after it."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from rehearsal.pressed_organ import PressedOrgan
from rehearsal.rehearsal import Rehearsal
from rehearsal.resection.cut import CutSettings, cut_organ
from rehearsal.resection.proposal import marks_around
from rehearsal.resection.resection_state import NO_RESECTION, CutRequest, Resection
from rehearsal.resection.score_line import score_line
from rehearsal.stopwatch import timed
from studies.resection.cut_lines import line_over
from ultrasound.crater import Crater

REPEATS = 7
MARGIN_MM = 5.0
# No two cuts are the same, so that none is one that was made before.
DIFFERENT_MM = 0.01
# Steps before and after the cut are timed in turn, in so many rounds of so many.
ROUNDS, STEPS = 5, 60


@dataclass
class CutTimes:
    """Durations [ms] of each repeat, by name."""

    ms: dict[str, list[float]] = field(default_factory=dict)

    def measure(self, name: str, call: Callable[[], object]) -> None:
        """Call and add the duration."""
        timed(call, self.ms.setdefault(name, []))

    def medians(self) -> dict[str, float]:
        """The median of each [ms]."""
        return {name: round(float(np.median(values)), 2) for name, values in self.ms.items()}


def cut_times(rehearsal: Rehearsal) -> CutTimes:
    """Cut and undo several times, then step. The rehearsal has a tumour and a scanner. Raises ResectionError."""
    times = CutTimes()
    assert rehearsal.scanner is not None
    # What images need is there before the first cut.
    volumes = rehearsal.scanner.volumes
    _ = volumes.ct, volumes.organ, volumes.tissue
    for repeat in range(REPEATS):
        rehearsal.reset()
        marked, cut = _resections(rehearsal, MARGIN_MM + DIFFERENT_MM * repeat)
        rehearsal.set_resection(marked)
        times.measure("request to cut applied", partial(rehearsal.set_resection, cut))
        times.measure("judgement", lambda: rehearsal.judgement)
        times.measure("undo", partial(rehearsal.set_resection, marked))
        _time_parts(rehearsal, cut, times)
    _time_steps(rehearsal, cut, times)
    return times


def _resections(rehearsal: Rehearsal, margin_mm: float) -> tuple[Resection, Resection]:
    """The score around the tumour, and with the cut."""
    organ, tumour = rehearsal.whole_organ, rehearsal.whole_tumour
    assert tumour is not None
    line = line_over(organ, tumour, margin_mm)
    marked = NO_RESECTION.with_marks(marks_around(organ, tumour, margin_mm, line.direction))
    settings = CutSettings("enucleoresection", margin_mm)
    seen = np.ones(len(tumour.vertices), bool)
    request = CutRequest.of(settings, seen, rehearsal.body.snapshot().position)
    return marked, replace(marked, cut=request)


def _time_parts(rehearsal: Rehearsal, resection: Resection, times: CutTimes) -> None:
    """The parts of the cut one by one, on the whole organ, which is whole again afterwards."""
    organ, tumour, scanner = rehearsal.whole_organ, rehearsal.whole_tumour, rehearsal.scanner
    assert tumour is not None and scanner is not None and resection.cut is not None
    settings = resection.cut.settings
    times.measure("- line", lambda: score_line(organ, resection.points()))
    line = score_line(organ, resection.points())
    points = np.asarray(tumour.vertices)
    times.measure("- specimen and remnant", lambda: cut_organ(organ, line, settings, points))
    made = cut_organ(organ, line, settings, points)
    times.measure("- tissue and contacts", lambda: PressedOrgan.apply_cut(rehearsal, made))
    crater = Crater(made.specimen, settings.filling)
    times.measure("- crater in the image", lambda: scanner.volumes.set_crater(crater))
    rehearsal.apply_cut(None)


def _time_steps(rehearsal: Rehearsal, cut: Resection, times: CutTimes) -> None:
    whole = replace(cut, cut=None)
    for _ in range(ROUNDS):
        for name, resection in (("step before the cut", whole), ("step after the cut", cut)):
            rehearsal.reset()
            rehearsal.set_resection(resection)
            for _ in range(STEPS):
                step = rehearsal.timed_step(rehearsal.pose)
                times.ms.setdefault(name, []).append(step.took_ms)
