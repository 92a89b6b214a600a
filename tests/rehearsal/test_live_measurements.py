"""What the instruments read off a rehearsal, and make of a plan and of a session that is opened in its midst."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from plan_ball import Z, over_ball, plan_of, straight_pass, sweep_of

from rehearsal.measurements import live_measurements
from rehearsal.measurements.live_measurements import LiveMeasurements
from rehearsal.measurements.tumour_measurements import Measurement
from rehearsal.planning.plan_guidance import PlanGuidance
from rehearsal.sessions.packed_arrays import pack_seen
from rehearsal.sessions.session_file import Event, Log, SessionError
from render.viewer import Settings, View
from ultrasound.probe import load_probe

FIRST, SECOND = straight_pass(4, step_mm=2.0), straight_pass(3, 20.0, 2.0)


@pytest.fixture
def rehearsal() -> SimpleNamespace:
    organ = trimesh.creation.icosphere(subdivisions=3, radius=25.0)
    tumour = trimesh.creation.icosphere(subdivisions=3, radius=6.0).apply_translation(12 * Z)
    image = SimpleNamespace(coupling_gap_mm=None)
    scene = SimpleNamespace(image=image, transducer=SimpleNamespace(compression_warning_mm=8.0))
    plane = SimpleNamespace(rest_grid=lambda count: np.full((count, count, 3), 500.0, np.float32))
    return SimpleNamespace(
        **vars(over_ball())
        | dict(
            organ=organ,
            tumour=tumour,
            whole_organ=organ,
            whole_tumour=tumour,
            cut=None,
            judgement=None,
            scene=scene,
            probe=load_probe("linear"),
        ),
        scanner=SimpleNamespace(plane=plane),
        pose=FIRST[0],
    )


@pytest.fixture
def watching(monkeypatch, rehearsal) -> LiveMeasurements:
    monkeypatch.setattr(live_measurements, "measure", lambda *_: Measurement(1.0, 20.0))
    return LiveMeasurements(
        rehearsal, PlanGuidance(rehearsal, plan_of(sweep_of(FIRST, SECOND), margin_mm=8.0))
    )


def test_the_instruments_watch_the_guide_and_record_it(watching, rehearsal, one_device):
    noted: list[dict] = []
    session = SimpleNamespace(
        time_s=0.0, kept_states={}, rolled_back_to=None, note=lambda name, figures: noted.append(figures)
    )
    for pose in FIRST:
        rehearsal.pose = pose
        watching.watch(session, rehearsal.probe)
        session.time_s += live_measurements.MEASURE_S
    assert [round(each["plan_followed"], 3) for each in noted] == [round(n / 7, 3) for n in (1, 2, 3, 4)]
    assert all(each["plan_off_mm"] == 0 and "seen_margin" in each for each in noted)
    view = watching.onto(View(np.eye(4), {}, 40.0, 60.0), Settings())
    assert view.guidance.goal == pytest.approx(SECOND[0]) and view.findings["plan"] == "57 %"
    watching.restart()
    assert watching.guide.next_pose == 0
    watching.guide = None
    assert watching.onto(view, Settings()).guidance is None and "plan_followed" not in watching.figures()


def test_what_a_session_holds_is_recalled_as_it_was_watched(watching, rehearsal, one_device, monkeypatch):
    # The first is no press: as it is noted it is 1 mm.
    squeezed = iter([1.00004, 0.3, 9.0, 0.2])
    monkeypatch.setattr(
        live_measurements, "measure", lambda *_: Measurement(next(squeezed), 20.0, 5.0, 2.0, 1.0)
    )
    events: dict[int, list] = {}
    session = SimpleNamespace(step_index=0, time_s=0.0, kept_states={}, rolled_back_to=None)
    session.note = lambda kind, value: events.setdefault(session.step_index, []).append(
        Event(at=session.step_index, kind=kind, value=value)
    )
    for session.step_index, rehearsal.pose in enumerate(FIRST, 1):
        session.time_s += live_measurements.MEASURE_S
        watching.watch(session, rehearsal.probe)
        watching.count(rehearsal.pose, live_measurements.MEASURE_S)
    watching.count(None, live_measurements.MEASURE_S)
    watching.coverage.seen[watching.coverage.targets["tumour"]] = True
    lengths_s = np.full(5, live_measurements.MEASURE_S)
    log = Log(None, np.stack([*FIRST, np.full((4, 4), np.nan)]), lengths_s, events)
    again = LiveMeasurements(rehearsal, PlanGuidance(rehearsal, watching.guide.plan))
    assert again.recall(log, 0) and not again.recall(log, 5) and again.course.duration_s == 0
    log.seen[5] = pack_seen(watching.coverage.seen)
    assert again.recall(log, 5)
    assert again.figures() == watching.figures() and again.summary(2) == watching.summary(2)
    assert (again.course.presses, again.course.went_back, again.guide.next_pose) == (1, 1, 4)
    view = again.onto(View(np.eye(4), {}, 40.0, 60.0), Settings(show_seen=True))
    assert view.findings["tumour volume seen"] == "100 %" and view.seen["tumour"].any()
    del log.events[1][0].value["contact_mm2"]
    with pytest.raises(SessionError, match="without compression or contact"):
        LiveMeasurements(rehearsal).recall(log, 5)


def test_a_way_back_is_looked_at_and_read_anew_at_once(watching, rehearsal, one_device, monkeypatch):
    depths = iter([9.0, 0.2])
    monkeypatch.setattr(live_measurements, "measure", lambda *_: Measurement(next(depths), 20.0))
    lines = np.ones(rehearsal.probe.number_of_scanlines, bool)
    looks = iter([lines, ~lines])
    monkeypatch.setattr(watching.coverage, "add", lambda *_: next(looks))
    noted: list[float] = []
    session = SimpleNamespace(time_s=0.0, kept_states={}, rolled_back_to=None)
    session.note = lambda kind, figures: noted.append(figures["compression_mm"])
    for session.time_s, is_rollback in ((0.0, False), (1 / 60, False), (1 / 45, True)):
        watching.watch(session, rehearsal.probe, is_rollback)
    view = watching.onto(View(np.eye(4), {}, 40.0, 60.0), Settings())
    assert view.findings["compression"] == "0.2 mm" and noted == [9.0, 0.2] and view.notes
    assert view.alert == ""


def test_a_session_that_begins_is_read_with_what_touches_then(watching, rehearsal, one_device, monkeypatch):
    """Though its first moment is none at which it would be looked."""
    given = []
    monkeypatch.setattr(
        live_measurements, "measure", lambda *asked: given.append(asked[-1]) or Measurement(1.0, 20.0)
    )
    touches = np.arange(rehearsal.probe.number_of_scanlines) < 30
    monkeypatch.setattr(watching.coverage, "add", lambda *_: touches)
    for _ in range(2):
        session = SimpleNamespace(time_s=1 / 60, kept_states={}, rolled_back_to=None, note=lambda *_: None)
        watching.watch(session, rehearsal.probe)
        watching.restart()
    assert len(given) == 2 and all(np.array_equal(each, touches) for each in given)


def test_another_plan_brings_its_margin_and_what_was_seen_stays(watching, rehearsal, one_device):
    volume = watching.coverage.targets["margin"].sum()
    watching.coverage.seen[watching.coverage.targets["tumour"]] = True
    before = watching.coverage
    watching.follow(PlanGuidance(rehearsal, plan_of(margin_mm=8.0)))
    assert watching.coverage is before
    watching.follow(PlanGuidance(rehearsal, plan_of(margin_mm=2.0)))
    assert watching.margin_mm == 2.0 and watching.coverage.targets["margin"].sum() < volume / 2
    assert watching.coverage.fraction("tumour") == 1.0 and watching.guide.plan.margin_mm == 2.0
    assert LiveMeasurements(rehearsal).margin_mm == live_measurements.MARGIN_MM


@pytest.mark.parametrize(
    ("touching", "notes"), [(0, {"B-mode": "NO CONTACT"}), (9, {"B-mode": "NO CONTACT"}), (10, {})]
)
def test_an_echo_is_said_to_be_black_where_hardly_a_line_touches(
    one_device, watching, rehearsal, monkeypatch, touching, notes
):
    touches = np.arange(rehearsal.probe.number_of_scanlines) < touching
    monkeypatch.setattr(watching.coverage, "add", lambda *_: touches)
    watching.watch(
        SimpleNamespace(time_s=0.0, kept_states={}, rolled_back_to=None, note=lambda *_: None),
        rehearsal.probe,
    )
    assert watching.onto(View(np.eye(4), {}, 40.0, 60.0), Settings()).notes == notes


def test_the_panel_shows_each_figure_under_its_name_with_its_unit(
    one_device, watching, rehearsal, monkeypatch
):
    watching.guide = None
    shares = dict(organ=0.123, tumour=0.456, margin=0.789)
    monkeypatch.setattr(watching.coverage, "fraction", shares.get)
    always = {"compression": "8.3 mm", "contact": "123 mm2", "force": "0.52 N"}
    watching.latest = Measurement(8.26, 123.4, force_n=0.517, torque_n_mm=9.9)
    assert watching.findings() == always | {"organ seen": "12 %"}
    watching.latest = Measurement(8.26, 123.4, 20.11, 7.27, 3.38, 0.37, -4.96, 0.517, 9.9)
    assert watching.findings() == always | {
        "to tumour": "20.1 mm",
        "tumour depth": "7.3 mm",
        "tumour shift": "3.4 mm",
        "in view": "37 %",
        "margin": "-5.0 mm",
        "tumour volume seen": "46 %",
        "+8 mm seen": "79 %",
    }
    shown = watching.onto(View(np.eye(4), {}, 40.0, 60.0), Settings())
    assert (shown.alert, shown.status) == ("compression", "TISSUE COMPRESSED BY 8 mm")
    # The scene's limit is 8 mm.
    watching.latest = Measurement(8.0, 123.4)
    shown = watching.onto(View(np.eye(4), {}, 40.0, 60.0), Settings())
    assert (shown.alert, shown.status) == ("", "")


@pytest.mark.parametrize(
    ("in_view", "margin", "shown"),
    [(0.5, -0.04, "0.0 mm"), (0.5, 0.0, "0.0 mm"), (0.5, -0.06, "-0.1 mm"), (0.0, 1.0, ""), (None, None, "")],
)
def test_a_margin_of_nothing_has_no_minus(one_device, watching, in_view, margin, shown):
    watching.latest = Measurement(1.0, 20.0, 5.0, 2.0, 1.0, in_view, margin)
    assert watching.findings()["margin"] == shown
