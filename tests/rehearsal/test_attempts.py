"""Attempts of a resection: what is kept of each cut, how its state is restored, and the table of them."""

from dataclasses import replace

import numpy as np
import pytest
from coarse_patient import coarse_patient
from settings_at_start import settings_with

from rehearsal.announcements import Announcements
from rehearsal.loop.command import Checkpoint, Command, GoTo, Mark, Move, Reset, Undo
from rehearsal.notices import Notices
from rehearsal.rehearsal import Rehearsal
from rehearsal.resection.attempts import (
    HEADINGS,
    AttemptFigureList,
    AttemptFigures,
    attempts_text,
    figures_of_attempt,
    table_of,
)
from rehearsal.resection.cut import CutSettings
from rehearsal.resection.operation import cut_command
from rehearsal.resection.proposal import line_around
from rehearsal.resection.resection_page import report_of
from rehearsal.resection.resection_plan import PlannedCut, ResectionPlan
from rehearsal.sessions.recorder import SessionRecorder, header_of, next_path
from rehearsal.sessions.replay import Replay, ReplayCheck
from rehearsal.sessions.session_file import read_log
from rehearsal.sources.user import UserSource
from render.viewer import Controls

pytestmark = pytest.mark.usefixtures("arrays_stored")

MARGIN_MM = 5.0
CUT = CutSettings("enucleoresection", MARGIN_MM)
NARROW = CutSettings("enucleoresection", 2.0)
FIGURES = AttemptFigures(1, "wedge", 5.0, 4.93, 5.61, 12.34, 0.0, 2)
UNLABELLED = replace(FIGURES, number=2, collecting_system_opened_mm2=None, vessels_divided=None)


@pytest.fixture(scope="module")
def patient(one_device):
    return coarse_patient()


@pytest.fixture
def rehearsal(patient) -> Rehearsal:
    patient[0].reset()
    return patient[0]


@pytest.fixture(scope="module")
def marks(patient) -> np.ndarray:
    case = patient[0].case
    return line_around(case.organ, case.tumour, MARGIN_MM, np.array([0.65, -0.75, 0.12])).marks


def scored(marks: np.ndarray) -> Mark:
    return Mark(places_mm=marks.tolist())


def cut(rehearsal: Rehearsal, settings: CutSettings = CUT) -> Command:
    return cut_command(rehearsal.anatomy, settings, None)


def stayed(rehearsal: Rehearsal, steps: int = 3) -> list[Move]:
    return [Move(pose=rehearsal.frame.pose)] * steps


def listed(rehearsal: Rehearsal) -> AttemptFigureList:
    attempts = AttemptFigureList(rehearsal.anatomy)
    attempts.observe(rehearsal.frame, rehearsal.case.probe)
    return attempts


def test_attempts_stay_and_can_be_restored_bit_for_bit_also_in_a_replay(patient, rehearsal, marks, tmp_path):
    case, organ = rehearsal.case, rehearsal.organ
    header = header_of(case, patient[1], "x64", organ.model.serial, case.scene.solver.time_step_s, None)
    recorder = SessionRecorder(tmp_path / "session", header, Notices())

    def done(*commands: Command) -> str:
        recorder.observe(rehearsal.do(*commands))
        return organ.digest()

    done(*stayed(rehearsal), scored(marks))
    first = done(cut(rehearsal))
    report = report_of(rehearsal.anatomy)
    done(*stayed(rehearsal))
    done(Undo())
    second = done(cut(rehearsal, NARROW))
    narrow = report_of(rehearsal.anatomy)
    before_reset = done(*stayed(rehearsal))
    done(Reset())
    assert rehearsal.frame.resection.marks == () and rehearsal.anatomy.cut is None
    attempts = rehearsal.frame.attempts
    assert [attempt.number for attempt in attempts] == [1, 2] and rehearsal.frame.present_attempt is None
    # The figures of both are those of their reports, though the tissue has neither cut now.
    for figures, of_cut in zip(listed(rehearsal).report(), (report, narrow), strict=True):
        assert all(figures[name] == of_cut[name] for name in figures.keys() & of_cut.keys())
        assert figures["vessels_divided"] == len(of_cut["vessels"])
    assert done(Undo()) == before_reset and len(rehearsal.frame.resection.marks) == len(marks)
    done(*stayed(rehearsal, 40))
    middle_s = rehearsal.frame.time_s - 0.1
    for attempt, digest, is_cut in ((attempts[0], first, report), (attempts[1], second, narrow)):
        assert done(GoTo(state=attempt.state)) == digest and report_of(rehearsal.anatomy) == is_cut
        assert rehearsal.frame.present_attempt == attempt
    last = done(*stayed(rehearsal), Checkpoint())
    figures = listed(rehearsal).figures
    recorder.close({})
    log = read_log(recorder.path)
    for at_s in (0.0, middle_s):
        rehearsal.reset()
        assert rehearsal.frame.attempts == ()
        replay, check = Replay(log, one_by_one=True), ReplayCheck(log, Notices())
        rehearsal.do(*replay.begin(rehearsal.frame.positions, at_s))
        # A later start finds both in the file.
        assert len(rehearsal.frame.attempts) == (2 if at_s else 0)
        while not replay.is_over:
            rehearsal.do(*replay.commands(rehearsal.frame, Controls(settings_with()), 1.0))
            check.observe(rehearsal.frame, case.probe)
        assert check.differs_s is None and organ.digest() == last
        assert rehearsal.frame.attempts == attempts and listed(rehearsal).figures == figures


def test_the_key_goes_to_the_last_attempt_then_on_and_round(rehearsal, marks):
    source = UserSource(rehearsal.anatomy, rehearsal.manipulator, Notices(), waits=True)

    def pressed() -> int | None:
        for did in ({"next_attempt": True}, {}):
            given = Controls(settings_with(), **did)
            rehearsal.do(*source.commands(rehearsal.frame, given, 1 / 60))
            if did:
                present = rehearsal.frame.present_attempt
        return None if present is None else present.number

    assert pressed() is None
    assert source.notices.present() == ["No attempt yet: {cut_out} cuts along the score"]
    rehearsal.do(scored(marks), cut(rehearsal))
    rehearsal.do(Undo())
    rehearsal.do(cut(rehearsal, NARROW))
    rehearsal.do(Undo())
    assert [pressed() for _ in range(3)] == [2, 1, 2]
    assert source.notices.present() == [f"Attempt {number} of 2" for number in (2, 1, 2)]


def test_a_reset_names_what_it_takes_away(rehearsal, marks):
    notices = Notices()
    announcements = Announcements(rehearsal.anatomy, notices)

    def said(*commands: Command) -> str:
        announcements.observe(rehearsal.do(*commands), rehearsal.case.probe)
        return "; ".join(notices.present())

    said()
    assert said(Reset()) == "reset: tissue and probe; {undo} brings them back"
    said(scored(marks[:2]))
    assert said(Reset()) == "reset: tissue, probe and 2 marks; {undo} brings them back"
    said(scored(marks))
    assert said(cut(rehearsal)).startswith("Attempt 1 is kept: {show_attempts}")
    assert said(Reset()) == f"reset: tissue, probe, {len(marks)} marks and the cut; {{undo}} brings them back"


def test_figures_compare_with_a_plan_where_there_is_one(rehearsal, marks):
    rehearsal.do(scored(marks), cut(rehearsal))
    judgement, report = rehearsal.anatomy.judgement, report_of(rehearsal.anatomy)
    places, of_plan = [(0.0, 0.0, 0.0)] * 3, judgement.report()
    planned = PlannedCut(
        technique="wedge", cost_ml=9.5, direction=(0, 0, 1), marks_mm=places, line_mm=places, figures=of_plan
    )
    plan = ResectionPlan(anatomy="a", margin_mm=MARGIN_MM, cuts=[planned])
    figures = figures_of_attempt(1, "enucleoresection", MARGIN_MM, judgement, plan)
    # The weights of docs/resection.md; the margin is kept.
    vessels = sum(vessel["diameter_mm"] ** 2 for vessel in report["vessels"]) / 9
    expected = report["parenchyma_removed_ml"] + report["collecting_system_opened_mm2"] / 100 + vessels
    assert figures.points == pytest.approx(expected, abs=0.3) and figures.planned_points == 9.5
    table = table_of([figures], 1)
    assert table.headings[-1] == "points (plan 9.5)" and table.rows[0][-1] == f"{figures.points:.1f}"
    assert attempts_text([figures]).endswith(f"{figures.points:.1f} points, planned 9.5")


def test_a_table_has_a_row_of_texts_for_each_attempt_and_marks_the_present_one():
    unjudged = AttemptFigures(3, "enucleation", 0.0)
    table = table_of([FIGURES, UNLABELLED, unjudged], present=2)
    assert table.headings == HEADINGS and table.marked == 1 and table.title == "3 attempts"
    assert table.rows[0] == ("1", "wedge", "5", "4.9", "5.6", "12.3", "0", "2")
    assert table.rows[1][-2:] == ("not labelled", "not labelled")
    assert table.rows[2] == ("3", "enucleation", "0", *"-----")
    assert table_of([FIGURES]).marked is None and table_of([]).rows == ()
    lines = attempts_text([FIGURES, unjudged]).splitlines()
    assert "4.9 mm least, 5.6 mm mean; parenchyma 12.3 ml" in lines[0] and lines[1].endswith("not judged")


def test_a_session_has_a_number_that_no_page_of_a_resection_has(tmp_path):
    assert next_path(tmp_path).name == "session-001.jsonl"
    (tmp_path / "session-001.jsonl").touch()
    (tmp_path / "resection-002.png").touch()
    assert next_path(tmp_path).name == "session-003.jsonl"
