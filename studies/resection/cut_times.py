"""Times of a cut: from the request until it is shown, of its parts, its judgement, and of steps."""

from collections import defaultdict

import numpy as np

from rehearsal.deformed_anatomy import DeformedAnatomy
from rehearsal.loop.command import CutOut, Mark, Move, Undo
from rehearsal.rehearsal import Rehearsal
from rehearsal.resection.cut import CutSettings, cut_organ
from rehearsal.resection.operation import cut_command
from rehearsal.resection.proposal import marks_around
from rehearsal.resection.score_line import ResectionError, score_line
from rehearsal.stopwatch import timed
from studies.resection.planned_cuts import line_over
from ultrasound.anatomy_volumes import AnatomyVolumes
from ultrasound.crater import Crater

REPEATS = 7
MARGIN_MM = 5.0
# No two cuts are the same, so that none is one that was made before.
DIFFERENT_MM = 0.01
# Steps before and after the cut are timed in turn, in so many rounds of so many.
ROUNDS, STEPS = 5, 60
# Durations [ms] of each repeat, by name.
Times = dict[str, list[float]]


def cut_times(rehearsal: Rehearsal) -> Times:
    """Cut and undo several times, then step. Needs a tumour and a scanner. Raises ResectionError."""
    times, anatomy = defaultdict[str, list[float]](list), rehearsal.anatomy
    assert anatomy.scanner is not None
    # What images need is there before the first cut.
    volumes = anatomy.scanner.volumes
    _ = volumes.ct, volumes.organ, volumes.tissue
    for repeat in range(REPEATS):
        settings = CutSettings("enucleoresection", MARGIN_MM + DIFFERENT_MM * repeat)
        mark, cut = commands(anatomy, settings)
        rehearsal.reset()
        rehearsal.do(mark)
        frame = timed(lambda: rehearsal.do(cut), times["request to cut applied"])
        if frame.notices:
            raise ResectionError(frame.notices[0])
        timed(lambda: anatomy.judgement, times["judgement"])
        timed(lambda: rehearsal.do(Undo()), times["undo"])
        _time_parts(rehearsal, volumes, settings, times)
    _time_steps(rehearsal, mark, cut, times)
    return times


def commands(anatomy: DeformedAnatomy, settings: CutSettings) -> tuple[Mark, CutOut]:
    """The score around the tumour and the cut along it; all of the tumour counts as seen."""
    organ, tumour = anatomy.case.organ, anatomy.case.tumour
    assert tumour is not None
    direction = line_over(organ, tumour, settings.margin_mm).direction
    marks = marks_around(organ, tumour, settings.margin_mm, direction)
    return Mark(places_mm=marks.tolist()), cut_command(anatomy, settings, None)


def _time_parts(rehearsal: Rehearsal, volumes: AnatomyVolumes, settings: CutSettings, times: Times) -> None:
    """The parts of the cut one by one, on the whole organ, which is whole again afterwards."""
    organ, tumour = rehearsal.case.organ, rehearsal.case.tumour
    assert tumour is not None
    marks, seen = rehearsal.frame.resection.points(), np.asarray(tumour.vertices)
    line = timed(lambda: score_line(organ, marks), times["- line"])
    made = timed(lambda: cut_organ(organ, line, settings, seen), times["- specimen and remnant"])
    timed(lambda: rehearsal.organ.apply_cut(made), times["- tissue and contacts"])
    crater = Crater(made.specimen, settings.filling)
    timed(lambda: volumes.set_crater(crater), times["- crater in the image"])
    rehearsal.organ.apply_cut(None)
    volumes.set_crater(None)


def _time_steps(rehearsal: Rehearsal, mark: Mark, cut: CutOut, times: Times) -> None:
    operations = {"step before the cut": (), "step after the cut": (mark, cut)}
    for _ in range(ROUNDS):
        for name, operation in operations.items():
            rehearsal.reset()
            rehearsal.do(*operation)
            stay = Move(pose=rehearsal.organ.pose)
            frame = rehearsal.do(*[stay] * STEPS)
            times[name] += [step.took_ms for step in frame.steps]
