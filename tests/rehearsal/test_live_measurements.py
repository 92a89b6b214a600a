"""What is measured of a rehearsal, what becomes of a plan, and of a session that is opened in its midst."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from plan_ball import Z, case_of_ball, frame_at, guide_over_ball, plan_of, straight_pass, sweep_of

from rehearsal.loop.command import Move, Undo
from rehearsal.loop.frame import Applied, Checkpointed, Step
from rehearsal.loop.state import WholeState
from rehearsal.measurements import live_measurements
from rehearsal.measurements.live_measurements import MEASURE_S, LiveMeasurements
from rehearsal.measurements.tumour_measurements import Measurement
from rehearsal.sessions.packed_arrays import pack_seen
from rehearsal.sessions.session_file import Header, Log, SessionError
from render.viewer import View, ViewSettings
from ultrasound.probe import load_probe

PROBE, VIEW = load_probe("linear"), View(np.eye(4), {}, 40.0, 60.0)
FIRST, SECOND = straight_pass(4, step_mm=2.0), straight_pass(3, 20.0, 2.0)
pytestmark = pytest.mark.usefixtures("one_device")


@pytest.fixture
def anatomy() -> SimpleNamespace:
    """What is measured of an anatomy: a ball whose images are far beside it."""
    organ = trimesh.creation.icosphere(subdivisions=3, radius=25.0)
    tumour = trimesh.creation.icosphere(subdivisions=3, radius=6.0).apply_translation(12 * Z)
    plane = SimpleNamespace(rest_grid=lambda count: np.full((count, count, 3), 500.0, np.float32))
    return SimpleNamespace(
        case=case_of_ball(organ=organ, tumour=tumour, probe=PROBE),
        organ=organ,
        tumour=tumour,
        judgement=None,
        scanner=SimpleNamespace(plane=plane),
        pose=FIRST[0],
    )


@pytest.fixture
def measurements(monkeypatch, anatomy) -> LiveMeasurements:
    monkeypatch.setattr(live_measurements, "measure", lambda *_: Measurement(1.0, 20.0))
    return guided(anatomy)


def guided(anatomy) -> LiveMeasurements:
    guide = guide_over_ball(plan_of(sweep_of(FIRST, SECOND), margin_mm=8.0))
    return LiveMeasurements(anatomy, guide.manipulator, guide)


def observed(measurements: LiveMeasurements, *poses: np.ndarray) -> None:
    """A frame of a step to each pose, so long that each is measured."""
    for number, pose in enumerate(poses):
        step = Step(number, pose, pose, MEASURE_S, 4, 1.0)
        measurements.observe(frame_at(pose, number + 1, (number + 1) * MEASURE_S, step), PROBE)


def undone(at: int, time_s: float):
    return frame_at(FIRST[0], at + 1, time_s, Applied(at, Undo(), restored=0))


def test_the_guide_is_followed_and_its_figures_are_recorded(measurements):
    noted: list[dict] = []
    measurements.note = lambda number, reading: noted.append(reading)
    observed(measurements, *FIRST)
    assert [round(each["plan_followed"], 3) for each in noted] == [round(n / 7, 3) for n in (1, 2, 3, 4)]
    assert all(each["plan_off_mm"] == 0 and "seen_margin" in each for each in noted)
    view = measurements.onto(VIEW, ViewSettings())
    assert view.guidance.goal == pytest.approx(SECOND[0]) and view.findings["plan"] == "57 %"
    measurements.restart()
    assert measurements.guide.next_pose == 0
    measurements.guide = None
    assert measurements.onto(view, ViewSettings()).guidance is None
    assert "plan_followed" not in measurements.figures()


def test_what_a_session_holds_is_recalled_as_it_was_measured(measurements, anatomy, monkeypatch):
    # The first is no press: as it is noted it is 1 mm.
    squeezed = iter([1.00004, 0.3, 9.0, 0.2, 0.1])
    monkeypatch.setattr(
        live_measurements, "measure", lambda *_: Measurement(next(squeezed), 20.0, 5.0, 2.0, 1.0)
    )
    moves = [(number, Move(pose=pose, length_s=MEASURE_S)) for number, pose in enumerate(FIRST)]
    header = Header(anatomy="", scene={}, probe={}, arch="cpu", time_step_s=0.02)
    log = Log(header, [*moves, (4, Undo())], dict(enumerate(FIRST)))
    measurements.note = log.readings.__setitem__
    observed(measurements, *FIRST)
    measurements.observe(undone(4, 4 * MEASURE_S), PROBE)
    measurements.guide.follow(FIRST[-1])
    measurements.coverage.seen[measurements.coverage.targets["tumour"]] = True
    again = guided(anatomy)
    assert again.recall(log, 0) and not again.recall(log, 5) and again.course.duration_s == 0
    log.seen[5] = pack_seen(measurements.coverage.seen)
    assert again.recall(log, 5)
    assert again.figures() == measurements.figures() and again.summary(2) == measurements.summary(2)
    assert (again.course.presses, again.course.went_back, again.guide.next_pose) == (1, 1, 4)
    view = again.onto(VIEW, ViewSettings(show_seen=True))
    assert view.findings["tumour volume seen"] == "100 %" and view.seen["tumour"].any()
    del log.readings[1]["contact_mm2"]
    with pytest.raises(SessionError, match="without compression or contact"):
        guided(anatomy).recall(log, 5)


def test_after_an_undo_it_is_measured_anew_at_once(measurements, monkeypatch):
    depths = iter([9.0, 0.2])
    monkeypatch.setattr(live_measurements, "measure", lambda *_: Measurement(next(depths), 20.0))
    lines = np.ones(PROBE.number_of_scanlines, bool)
    looks = iter([lines, ~lines])
    monkeypatch.setattr(measurements.coverage, "add", lambda *_: next(looks))
    noted: list[float] = []
    measurements.note = lambda number, reading: noted.append(reading["compression_mm"])
    for frame in (frame_at(FIRST[0]), frame_at(FIRST[0], 1, 1 / 60), undone(1, 1 / 60)):
        measurements.observe(frame, PROBE)
    view = measurements.onto(VIEW, ViewSettings())
    assert view.findings["compression"] == "0.2 mm" and noted == [9.0, 0.2] and view.notes
    assert view.alert == ""


def test_a_session_that_begins_is_measured_with_what_touches_then(measurements, monkeypatch):
    """Though nothing is due at the time of its first frame."""
    given = []
    monkeypatch.setattr(
        live_measurements, "measure", lambda *asked: given.append(asked[-1]) or Measurement(1.0, 20.0)
    )
    touches = np.arange(PROBE.number_of_scanlines) < 30
    monkeypatch.setattr(measurements.coverage, "add", lambda *_: touches)
    begins = Checkpointed(0, WholeState(organ=None), begins=True)
    for _ in range(2):
        measurements.observe(frame_at(FIRST[0], 1, 1 / 60, begins), PROBE)
    assert len(given) == 2 and all(np.array_equal(each, touches) for each in given)


def test_another_plan_brings_its_margin_and_what_was_seen_stays(measurements, anatomy):
    volume = measurements.coverage.targets["margin"].sum()
    measurements.coverage.seen[measurements.coverage.targets["tumour"]] = True
    before = measurements.coverage
    measurements.follow(guide_over_ball(plan_of(margin_mm=8.0)))
    assert measurements.coverage is before
    measurements.follow(guide_over_ball(plan_of(margin_mm=2.0)))
    assert measurements.margin_mm == 2.0 and measurements.coverage.targets["margin"].sum() < volume / 2
    assert measurements.coverage.fraction("tumour") == 1.0 and measurements.guide.plan.margin_mm == 2.0
    assert LiveMeasurements(anatomy, measurements.manipulator).margin_mm == live_measurements.MARGIN_MM


@pytest.mark.parametrize(
    ("touching", "notes"), [(0, {"B-mode": "NO CONTACT"}), (9, {"B-mode": "NO CONTACT"}), (10, {})]
)
def test_an_image_is_said_to_have_no_contact_where_hardly_a_line_touches(
    measurements, monkeypatch, touching, notes
):
    touches = np.arange(PROBE.number_of_scanlines) < touching
    monkeypatch.setattr(measurements.coverage, "add", lambda *_: touches)
    measurements.observe(frame_at(FIRST[0]), PROBE)
    assert measurements.onto(VIEW, ViewSettings()).notes == notes


def test_the_panel_shows_each_figure_under_its_name_with_its_unit(measurements, monkeypatch):
    measurements.guide = None
    shares = dict(organ=0.123, tumour=0.456, margin=0.789)
    monkeypatch.setattr(measurements.coverage, "fraction", shares.get)
    always = {"compression": "8.3 mm", "contact": "123 mm2", "force": "0.52 N"}
    measurements.latest = Measurement(8.26, 123.4, force_n=0.517, torque_n_mm=9.9)
    assert measurements.findings() == always | {"organ seen": "12 %"}
    for share, shown in ((0.5, {}), (0.62, {"slip": "62 % of contact"})):
        measurements.latest = Measurement(8.26, 123.4, force_n=0.517, sliding_share=share)
        assert measurements.findings() == always | shown | {"organ seen": "12 %"}
    measurements.latest = Measurement(8.26, 123.4, 20.11, 7.27, 3.38, 0.37, -4.96, 0.517, 9.9)
    assert measurements.findings() == always | {
        "to tumour": "20.1 mm",
        "tumour depth": "7.3 mm",
        "tumour shift": "3.4 mm",
        "in view": "37 %",
        "margin": "-5.0 mm",
        "tumour volume seen": "46 %",
        "+8 mm seen": "79 %",
    }
    shown = measurements.onto(VIEW, ViewSettings())
    assert (shown.alert, shown.status) == ("compression", "TISSUE COMPRESSED BY 8 mm")
    # The scene's limit is 8 mm.
    measurements.latest = Measurement(8.0, 123.4)
    shown = measurements.onto(VIEW, ViewSettings())
    assert (shown.alert, shown.status) == ("", "")


@pytest.mark.parametrize(
    ("in_view", "margin", "shown"),
    [(0.5, -0.04, "0.0 mm"), (0.5, 0.0, "0.0 mm"), (0.5, -0.06, "-0.1 mm"), (0.0, 1.0, ""), (None, None, "")],
)
def test_a_margin_of_nothing_has_no_minus(measurements, in_view, margin, shown):
    measurements.latest = Measurement(1.0, 20.0, 5.0, 2.0, 1.0, in_view, margin)
    assert measurements.findings()["margin"] == shown
