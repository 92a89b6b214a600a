"""The loops with a window and without one, over a fake organ: order of a frame, panel, link, files."""

import gc
import json
import socket
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from click.exceptions import Exit
from fake_organ import STEP_S, fake_timeline
from null_viewer import NullViewer
from settings_at_start import settings_with
from test_openigtlink import LiveImage
from user_at_ball import ball_manipulator

import app
from rehearsal import headless, opening, run, window_loop, window_panel
from rehearsal.announcements import Announcements
from rehearsal.commands.rehearse_options import RehearseOptions
from rehearsal.imaging import captions, readouts, scale_texts
from rehearsal.input_files import InputFiles
from rehearsal.live_settings import DEFAULT_KEYS
from rehearsal.loop.command import BeginAction, Bookmark, CutOut, Move, NewSession, SetValues, Undo
from rehearsal.loop.frame import Frame, Step
from rehearsal.machine_signs import machine_signs
from rehearsal.notices import Notices
from rehearsal.real_time.pace import SEPARATOR, Pace
from rehearsal.window_loop import PREPARING, WindowLoop
from rehearsal.window_panel import WindowPanel
from render.viewer import Controls, TextTable, View, ViewSettings
from render.window import NoVulkan
from scenes.scene import EMBEDDED, AnatomyFiles, SceneError, load_scene
from scenes.terminal import shell_command
from settings import with_values
from ultrasound.probe import load_probe

FILES = InputFiles(Path(), load_scene(EMBEDDED), load_probe("linear"), DEFAULT_KEYS)


class FakeAnatomy:
    """What a frame shows of a fake organ."""

    scanner = cut = judgement = None

    def __init__(self) -> None:
        solver = SimpleNamespace(time_step_s=STEP_S)
        transducer = SimpleNamespace(compression_warning_mm=8.0)
        scene = SimpleNamespace(solver=solver, transducer=transducer, title="fake")
        self.case = SimpleNamespace(probe=load_probe("linear"), scene=scene, tumour=None)
        self.shown: list[Frame] = []

    def show(self, frame: Frame) -> None:
        self.frame = frame
        self.shown.append(frame)

    @property
    def pose(self) -> np.ndarray:
        return self.frame.pose

    @property
    def geometry(self) -> Any:
        return self.frame.geometry

    def probe_in_patient(self) -> np.ndarray:
        return self.pose

    def find_plane(self, probe) -> None: ...
    def rest_grid(self) -> None: ...
    def tumour_outline(self) -> None: ...


class FakeMeasurements:
    """Notes what it observes."""

    guide = latest = None

    def __init__(self) -> None:
        self.observed: list[tuple[int, float]] = []
        self.manipulator = ball_manipulator()
        self.coverage = SimpleNamespace(is_seen=lambda points: np.ones(len(points), bool))
        self.note = None
        self.alert = {"alert": "measured"}

    def observe(self, frame: Frame, probe) -> None:
        self.observed.append((frame.number, probe.depth_mm))

    def onto(self, view: View, shown: ViewSettings) -> View:
        return replace(view, **self.alert)

    def figures(self) -> dict:
        return {}


class OneMove:
    """A ``Source``: a move for each frame, and before it what ``also`` has."""

    status = ""

    def __init__(self) -> None:
        self.also: list = []

    def commands(self, frame: Frame, controls: Controls, elapsed_s: float) -> list:
        also, self.also = self.also, []
        pose = np.eye(4)
        pose[0, 3] = frame.number
        return [] if controls.frozen else [*also, Move(pose=pose)]


def grey_view(anatomy: FakeAnatomy, settings, ms=None, shape=None, persistence=None) -> View:
    """Images as bright as the number of the frame, at its pose."""
    grey = np.full(shape or (4, 4), anatomy.frame.number % 256, np.uint8)
    if ms is not None:
        ms.append(1.0)
    width, depth, _ = settings.probe.extent_mm
    return View(anatomy.pose, {"B-mode": grey, "CT": 255 - grey}, width, depth)


class Looping:
    """A window's loop over a fake organ, frame by frame."""

    def __init__(self, out: Path, link: Any = None, warnings: tuple[str, ...] = ()) -> None:
        self.notices, self.viewer = Notices(), NullViewer(script=iter(lambda: self.controls, None))
        self.controls = Controls(self.viewer.settings)
        self.stepper = fake_timeline()
        self.stepper.submit(NewSession(pose=np.eye(4)))
        self.anatomy, self.measurements, self.source = FakeAnatomy(), FakeMeasurements(), OneMove()
        self.anatomy.show(self.stepper.newest())
        announcements = Announcements(self.anatomy, self.notices)
        resection = SimpleNamespace(update=lambda *_: None, score=lambda _: None, figures=lambda _: {})
        self.plans = SimpleNamespace(status="", control=lambda controls: None)
        self.panel = WindowPanel(
            *(self.anatomy, self.source, self.measurements, resection, self.plans),
            *(self.notices, out, DEFAULT_KEYS, {"nodes": 7}, link, warnings),
        )
        observers = [self.measurements, announcements]
        self.loop = WindowLoop(
            *(self.viewer, self.stepper, self.source, self.anatomy, self.measurements, observers, self.panel)
        )
        self.drawn: list[View] = []
        self.viewer.draw = self.drawn.append

    def next(self, **did: Any) -> View:
        """The view of a frame in which the user did something."""
        running = iter((True, False))
        settings = did.pop("settings", self.viewer.settings)
        self.controls = Controls(settings, **did)
        self.viewer.__class__ = type("Once", (NullViewer,), {"running": property(lambda _: next(running))})
        self.loop.run()
        return self.drawn[-1]


@pytest.fixture(autouse=True)
def grey(monkeypatch) -> None:
    for module in (window_loop, window_panel, headless):
        monkeypatch.setattr(module, "image_view", grey_view)


@pytest.fixture
def sent() -> list:
    return []


@pytest.fixture
def looping(tmp_path, sent) -> Looping:
    return Looping(tmp_path, SimpleNamespace(send=lambda *live: sent.append(LiveImage(*live))))


def test_each_frame_is_observed_once_while_the_anatomy_shows_it(tmp_path):
    looping = Looping(tmp_path)
    shown_when: list[bool] = []
    observe = looping.measurements.observe
    looping.measurements.observe = lambda frame, probe: (
        shown_when.append(looping.anatomy.frame is frame),
        observe(frame, probe),
    )
    script = [Controls(looping.viewer.settings, quit=n == 4) for n in range(5)]
    looping.viewer._script = iter(script)
    looping.loop.run()
    assert looping.measurements.observed == [(number, 60.0) for number in range(1, 6)] and all(shown_when)
    assert [int(view.images["B-mode"][0, 0]) for view in looping.drawn if view.status != PREPARING] == [
        1,
        2,
        3,
        4,
        5,
    ]


def test_frozen_the_solver_makes_no_step_and_what_changes_the_tissue_ends_it(looping):
    first = looping.next()
    numbers = []
    for did in (
        dict(freeze=True),
        {},
        dict(undo=True),
        dict(freeze=True),
        dict(cut_out=True),
        dict(freeze=True),
    ):
        looping.next(**did)
        numbers.append(looping.anatomy.frame.number)
    assert numbers == [1, 1, 2, 2, 3, 3] and first.images["CT"][0, 0] == 254


def test_the_settings_of_a_replay_are_the_windows(looping):
    looping.source.also = [SetValues(values={"probe.depth_mm": 44.0, "probe.gain_percent": 63.0})]
    looping.next()
    probe = looping.viewer.settings.probe
    assert (probe.depth_mm, probe.gain_percent) == (44.0, 63.0)
    looping.next()
    assert looping.measurements.observed[-1] == (2, 44.0)


def test_the_first_image_of_a_new_kind_is_announced_over_the_last_one(looping):
    looping.next()
    settings = looping.viewer.settings
    drawn = []
    for change in (
        {},
        # It is beside the B-mode image by now.
        {"image.mode": "ct"},
        # Nothing of it is seen over a CT.
        {"scanner.doppler": "colour"},
        {"image.mode": "both"},
        {"scanner.doppler": "power"},
        {"scanner.doppler": "colour"},
        {"probe.compound_angles": 3},
    ):
        settings = with_values(settings, change)
        looping.drawn.clear()
        looping.loop._announce_new_kind(View(np.eye(4), {}, 1.0, 1.0), settings)
        drawn.append([view.status for view in looping.drawn])
    assert drawn == [[], [], [], [PREPARING], [PREPARING], [], [PREPARING]]


def test_a_geometry_of_another_version_is_drawn_anew_and_earlier_images_are_forgotten(looping, monkeypatch):
    changed: list[Any] = []
    looping.viewer.change_geometry = changed.append
    monkeypatch.setattr(window_loop, "drawn_geometry", lambda anatomy: anatomy.geometry.version)
    timeline = looping.stepper
    looping.next()
    whole, cine = timeline.geometry, looping.panel.cine
    timeline.geometry, looping.anatomy.cut = replace(whole, version=1), "a cut"
    looping.next()
    assert changed == [1] and looping.panel.cine is not cine
    assert looping.viewer.settings.view.phase == "Inspect"
    timeline.geometry, looping.anatomy.cut = whole, None
    looping.next()
    assert changed == [1, 0] and looping.viewer.settings.view.phase == "Excise"


def test_each_frame_goes_to_the_link_as_it_is_shown(looping, sent):
    for _ in range(3):
        looping.next()
    assert [live.grey[0, 0] for live in sent] == [1, 2, 3]
    assert [live.time_s for live in sent] == pytest.approx([STEP_S, 2 * STEP_S, 3 * STEP_S])
    assert [live.probe_in_patient[0, 3] for live in sent] == [0.0, 1.0, 2.0]


def test_a_frozen_image_is_sent_as_the_scanner_is_set_and_an_earlier_one_is_not(looping, sent):
    for _ in range(3):
        looping.next()
    looping.panel.cine.frames.append(looping.panel.cine.frames[-1])
    looping.next(freeze=True)
    assert len(sent) == 4 and sent[-1].grey[0, 0] == 3
    looping.next(cine=-1)
    assert len(sent) == 4


def test_images_have_the_pixels_of_their_boxes_unless_they_are_sent_or_recorded(looping):
    of_boxes = (12, 7)
    looping.viewer.image_shape = lambda count, width_mm, depth_mm: of_boxes
    assert looping.next().images["CT"].shape == (4, 4)
    looping.panel.link = None
    assert looping.next().images["CT"].shape == of_boxes
    looping.panel.sweeping = SimpleNamespace(status="Recording 0 s", add=lambda *_: "")
    assert looping.next().images["CT"].shape == (4, 4)


# Announcements


def test_what_is_done_is_said_with_the_frame_in_which_it_was(looping):
    said = []
    for also in ([BeginAction()], [Undo()], [Bookmark()], [Undo(), Undo()]):
        looping.source.also = also
        looping.next()
        said.append("".join(looping.notices.present()))
    assert said == ["", "undo", "Bookmark 1", "Nothing to undoNothing to undo"]


def test_a_restored_state_is_a_message_on_the_screen_and_in_the_terminal(looping, capsys):
    looping.stepper.organ.notice = "The tissue was restored"
    looping.next()
    looping.stepper.organ.notice = ""
    view = looping.next()
    assert view.messages == ("The tissue was restored",) and view.status == ""
    assert capsys.readouterr().out.count("The tissue was restored") == 1


def test_a_pace_that_differs_is_said_once(tmp_path, capsys):
    announcements = Announcements(None, Notices())
    step = Step(0, np.eye(4), np.eye(4), STEP_S, 4, 1.0)
    frame = replace(fake_timeline().newest(), events=(step,))
    for pace in ("", "Longer steps 1/30 s", "Longer steps 1/15 s", ""):
        announcements.observe(replace(frame, pace=pace), None)
    assert announcements.notices.present() == []
    assert capsys.readouterr().out == "Longer steps 1/30 s\nSteps as they are set again.\n"


def test_notices_name_the_users_keys_on_the_screen_and_in_the_terminal(looping, capsys):
    looping.panel.keys = replace(DEFAULT_KEYS, of=DEFAULT_KEYS.of | {"sweep": "Space", "plan_for": "L"})
    looping.notices.post("sweep-001: {sweep} ends it")
    assert looping.next().messages == ("Sweep-001: Space ends it",)
    assert capsys.readouterr().out == "sweep-001: Space ends it\n"


# The panel


def test_what_is_wrong_with_the_image_is_over_it_and_the_machine_has_signs(looping):
    looping.measurements.alert = {"status": "COMPRESSED"}
    looping.panel.sweeping = SimpleNamespace(status="Recording 3 s", add=lambda *_: "")
    looping.plans.status, looping.source.status = "Planning 12 %", "TRACKING LOST"
    pace, newest = "Longer steps 1/15 s   Reduced iterations 2 of 8", looping.stepper.newest
    looping.stepper.newest = lambda wait_s=0.0: replace(newest(wait_s), pace=pace)
    view = looping.next()
    assert view.status == "COMPRESSED   TRACKING LOST"
    signs = ["Recording 3 s", "Longer steps 1/15 s", "Reduced iterations 2 of 8", "Planning 12 %"]
    assert [sign.text for sign in view.signs] == signs
    assert [sign.is_recording for sign in view.signs] == [True, False, False, False]
    assert "L ends it" in view.signs[0].meaning and "Backspace stops it" in view.signs[3].meaning
    looping.notices.post("undo", in_terminal=False)
    # A message does not take the place of a state.
    view = looping.next()
    assert view.messages == ("Undo",) and [sign.text for sign in view.signs] == signs
    # No step is made, of whatever length.
    frozen = looping.next(freeze=True)
    assert frozen.status == "COMPRESSED   FROZEN"
    assert [sign.text for sign in frozen.signs] == ["Recording 3 s", "Planning 12 %"]


def test_a_cut_has_a_sign_until_it_is_made_or_refused(looping):
    submit, waiting = looping.stepper.submit, list[CutOut]()
    looping.stepper.submit = lambda command: (
        waiting.append(command) if isinstance(command, CutOut) else submit(command)
    )
    looping.source.also = [CutOut(technique="wedge", margin_mm=5.0, seen="")]
    signs = [[sign.text for sign in looping.next().signs]]
    looping.source.also = []
    signs.append([sign.text for sign in looping.next().signs])
    submit(waiting.pop())
    signs.append([sign.text for sign in looping.next().signs])
    assert signs == [["Cutting"], ["Cutting"], []]


def test_each_state_of_the_machine_has_a_sentence():
    pace = Pace(1 / 60)
    pace.level = len(pace.levels) - 1
    states = [*pace.text(8).split(SEPARATOR), "Recording 3 s", "Replay 3 s: K takes control", "Planning 3 %"]
    states.append("Cutting")
    assert len(states) == 6 and len({sign.meaning for sign in machine_signs(states)}) == 6
    assert machine_signs(["", ""]) == ()


def test_guidance_along_a_plan_is_in_the_place_of_the_hint_while_scanning(looping):
    asked = []
    looping.measurements.guide = SimpleNamespace(
        next_in_words=lambda side, has_keys: (
            asked.append((side, has_keys)) or "tilt: {tilt_forward}\nTo go: 3"
        )
    )
    looping.anatomy.case.scene.anatomy = AnatomyFiles(phantom=True)
    assert looping.next().hint == "tilt: C\nTo go: 3"
    # No mouse and keys move this probe.
    assert asked[-1] == ("left", False)
    settings = with_values(looping.viewer.settings, {"view.phase": "Score"})
    assert looping.next(settings=settings).hint == "This patient has no tumour: there is nothing to cut out."
    looping.measurements.guide.next_in_words = lambda side, has_keys: ""
    settings = with_values(settings, {"view.phase": "Scan"})
    assert looping.next(settings=settings).hint.startswith("The probe follows the mouse")


def test_messages_that_were_read_are_in_the_log(looping):
    for text in ("undo", "another"):
        looping.notices.post(text, in_terminal=False)
    assert looping.next().messages == ("Undo", "Another")
    view = looping.next(dismiss=True)
    assert view.messages == () and view.log == (("0 s", "Undo"), ("0 s", "Another"))


def test_warnings_of_the_import_stay_until_they_are_acknowledged(tmp_path, monkeypatch, capsys):
    acknowledged: list[tuple] = []
    looping = Looping(tmp_path, warnings=("one", "two"))
    monkeypatch.setattr(window_panel, "acknowledge", lambda *given: acknowledged.append(given))
    how, *shown = looping.next().warnings
    assert "I have checked this in check.png" in how and shown == ["Import: one", "Import: two"]
    assert looping.next(acknowledge=True).warnings == ()
    assert acknowledged == [(Path(), ("one", "two"))]
    assert "warnings of the import acknowledged" in capsys.readouterr().out
    looping.next(acknowledge=True)
    assert len(acknowledged) == 1


@pytest.mark.parametrize("error", [OSError(30, "Read-only file system"), SceneError("no such scene")])
def test_warnings_that_cannot_be_acknowledged_stay(tmp_path, monkeypatch, error):
    def fails(*_) -> None:
        raise error

    looping = Looping(tmp_path, warnings=("one",))
    monkeypatch.setattr(window_panel, "acknowledge", fails)
    view = looping.next(acknowledge=True)
    assert len(view.warnings) == 2
    assert view.messages == (f"Not saved: {getattr(error, 'strerror', None) or error}",)


def test_the_table_of_attempts_is_shown_and_hidden_by_its_key(looping):
    assert looping.next().table is None
    shown = looping.next(show_attempts=True).table
    assert shown.rows == () and shown.title.startswith("No attempt yet")
    assert looping.next().table == shown and looping.next(show_attempts=True).table is None
    kept = TextTable("1 attempt", ("attempt",), (("1",),), 0)
    looping.panel.attempts = SimpleNamespace(table=lambda: kept)
    table = looping.next(show_attempts=True).table
    assert table.title == "1 attempt   Shift+N returns to the next attempt" and table.rows == kept.rows


def test_a_frozen_image_keeps_its_caliper_and_a_live_one_until_the_probe_moves(looping):
    looping.source.commands = lambda frame, controls, elapsed_s: []
    place = (1.0, 2.0)
    assert looping.next(pointed_mm=place).caliper_mm == (place,)
    assert looping.next(pointed_mm=place).caliper == "0.0 mm"
    looping.stepper.organ.pose = np.eye(4) + np.eye(4, k=3)
    assert looping.next(freeze=True).caliper == "0.0 mm"
    assert looping.next(freeze=True).caliper_mm == ()


def test_the_clock_is_the_sessions_and_says_where_it_is_slow(looping):
    shown, rates = [], []
    looping.loop.times.rates = lambda recent_s: rates[-1]
    for factor in (0.25, 0.04, 0.89, 0.91):
        rates.append((10.0, factor))
        view = looping.next()
        shown.append((view.clock, view.pace))
    assert shown == [
        ("0.1 s", "0.2 x real"),
        ("0.2 s", "0.04 x real"),
        ("0.4 s", "0.9 x real"),
        ("0.5 s", ""),
    ]
    rates.append((10.0, 0.25))
    frozen = looping.next(freeze=True)
    assert (frozen.clock, frozen.pace) == ("0.5 s", "")


def test_the_texts_around_the_image_are_its_settings_and_times():
    own = dict(gain_percent=63.0, dyn_range_db=72.0, frequency_mhz=9.5, velocity_scale_cm_s=18.0)
    values = {f"probe.{name}": value for name, value in own.items()}
    values |= {"image.window_hu": 360.0, "image.level_hu": 35.0, "scanner.clamped": True}
    settings = settings_with(values)
    b_mode = "9.5 MHz   G 63 %   DR 72 dB   speckle   hilum clamped"
    assert captions(settings)[1:] == (b_mode, "W 360   L 35 HU")
    assert scale_texts(settings.probe, "colour") == ("+18", "-18")
    # Medians of the last thirty.
    step_ms, image_ms = [90.0] * 40 + [4.0] * 14 + [5.0] * 2 + [99.0] * 14, [7.0, 8.0, 30.0]
    shown = {"step": "5.0 ms", "image": "8.0 ms", "elements": "9000", "indentation": "0.0 mm"}
    assert readouts(dict(elements=9000, nodes=9999), step_ms, image_ms, -2.0) == shown


def test_the_latency_is_the_median_of_the_last_frames(looping):
    looping.loop.times.latency_ms.extend([500.0] * 30 + [40.0] * 9 + [50.0] * 2 + [900.0] * 9)
    looping.loop.times.rates = lambda recent_s: (23.6, 1.0)
    shown = looping.next().readouts
    assert (shown["frames"], shown["latency"], shown["nodes"]) == ("24 /s", "50 ms", "7")


def test_without_contact_whoever_moves_the_probe_by_hand_is_told_how_to_press(looping, monkeypatch):
    looping.measurements.alert = {"notes": {"B-mode": "NO CONTACT"}}
    monkeypatch.setattr(window_panel, "UserSource", SimpleNamespace)
    looping.panel.keys = replace(DEFAULT_KEYS, of=DEFAULT_KEYS.of | {"push": "Return"})
    notes = []
    by_hand, tracked = (SimpleNamespace(is_manual=manual, status="") for manual in (True, False))
    for source in (looping.source, by_hand, tracked):
        looping.panel.source = source
        notes.append(looping.next().notes["B-mode"])
    assert notes == ["NO CONTACT", "NO CONTACT\nLeft button or Return presses", "NO CONTACT"]
    looping.panel.source = by_hand
    assert looping.next(freeze=True).notes["B-mode"] == "NO CONTACT"


def test_the_export_key_saves_the_tissue_beside_its_images_and_says_what_it_cannot_give(
    looping, monkeypatch, tmp_path, capsys
):
    begins: list[str] = []
    monkeypatch.setattr(window_panel, "save_surfaces", lambda anatomy, out, begin: begins.append(begin))
    saved: list[View] = []
    save = window_panel.save_view
    monkeypatch.setattr(
        window_panel, "save_view", lambda view, *given: saved.append(view) or save(view, *given)
    )
    looping.panel.link = None
    looping.next(export=True)
    assert looping.next().messages == ("Saved 001",) and begins == ["001-"]
    assert (tmp_path / "001-b-mode.dcm").is_file()
    looping.panel.cine.frames.append(looping.panel.cine.frames[-1])
    looping.next(freeze=True)
    looping.panel.cine.frames[0] = replace(
        looping.panel.cine.frames[0],
        view=replace(looping.panel.cine.frames[0].view, notes={"B-mode": "NO CONTACT"}),
    )
    # What is looked back at was deformed otherwise than the tissue is now.
    looping.next(cine=-len(looping.panel.cine.frames), export=True)
    missing = (
        "B-mode image black: the probe does not touch the organ",
        "no organ (PLY), which has moved since: F continues",
    )
    said = "; ".join(["saved 002", *missing])
    assert said.capitalize()[:9] + said[9:] in looping.next().messages
    assert capsys.readouterr().out.endswith(f"\n{said}\n") and begins == ["001-"]
    # Of the live image all pixels are computed; the earlier one is saved as it was shown.
    assert [view.images["CT"].shape for view in saved] == [(4, 4), looping.viewer.image_shape(2, 1.0, 1.0)]


# Without a window


@pytest.mark.parametrize("earlier", [True, False])
def test_pictures_of_an_earlier_run_are_not_replaced_without_a_word(monkeypatch, tmp_path, capsys, earlier):
    monkeypatch.setattr(headless, "open_viewer", lambda *_, **__: None)
    picture = tmp_path / "slices" / "00004.png"
    picture.parent.mkdir()
    if earlier:
        picture.touch()
    anatomy = FakeAnatomy()
    anatomy.show(fake_timeline().newest())
    headless.Pictures(anatomy, 3, tmp_path)
    said = f"Replacing the pictures of an earlier run in {tmp_path}.\n" if earlier else ""
    assert capsys.readouterr().out == said and not picture.exists()


class FakeRehearsal:
    """A fake organ with its stepper and its anatomy."""

    def __init__(self) -> None:
        self.timeline, self.anatomy = fake_timeline(), FakeAnatomy()
        self.do()

    @property
    def frame(self) -> Frame:
        return self.anatomy.frame

    def do(self) -> Frame:
        self.anatomy.show(self.timeline.newest())
        return self.anatomy.frame


@pytest.mark.parametrize("draws", [True, False])
def test_without_a_window_images_go_to_the_link_and_the_tissue_into_the_folder(
    monkeypatch, tmp_path, sent, draws
):
    def no_viewer(anatomy, visible):
        raise NoVulkan("no Vulkan")

    saved = []
    monkeypatch.setattr(headless, "open_viewer", no_viewer)
    monkeypatch.setattr(headless, "summary", lambda report: "")
    monkeypatch.setattr(
        headless, "save_surfaces", lambda anatomy, out: saved.append((anatomy.frame.number, out))
    )
    tally = SimpleNamespace(slice_ms=[], add=lambda rehearsal, frame: None, report=lambda *_: {})
    resection = SimpleNamespace(update=lambda *_: None, score=lambda _: None)
    source, measurements = OneMove(), FakeMeasurements()
    source.also = [SetValues(values={"probe.depth_mm": 44.0})]
    link = SimpleNamespace(send=lambda *live: sent.append(LiveImage(*live)))
    loop = headless.HeadlessLoop(
        *(
            FakeRehearsal(),
            source,
            measurements,
            [measurements],
            settings_with(),
            tally,
            Notices(),
            resection,
            link,
        )
    )
    headless.run_headless(loop, 3, "cpu", tmp_path, draws)
    assert [live.grey[0, 0] for live in sent] == ([1, 2, 3] if draws else [])
    assert measurements.observed == [(1, 44.0), (2, 44.0), (3, 44.0)]
    assert saved == [(3, tmp_path)] and json.loads((tmp_path / "report.json").read_text()) == {"reading": {}}


# A run


def fake_run(**asked: Any) -> run.RehearsalRun:
    anatomy = FakeAnatomy()
    anatomy.show(fake_timeline().newest())
    built = run.Built(anatomy, None, ball_manipulator(), {"nodes": 7}, True)
    return run.RehearsalRun(built, None, "cpu", RehearseOptions(**asked), FILES)


@pytest.fixture
def bare_run(monkeypatch) -> None:
    """A run that measures nothing."""
    measures = SimpleNamespace(guide=None, summary=lambda bookmarks: {})
    monkeypatch.setattr(run, "LiveMeasurements", lambda *_: measures)
    monkeypatch.setattr(run, "ResectionView", lambda *_: None)


@pytest.mark.usefixtures("bare_run")
def test_ctrl_c_in_a_run_says_so_before_how_it_went(monkeypatch, capsys):
    monkeypatch.setattr(run.RehearsalRun, "_end", lambda each: print("the summary"))
    each = fake_run()
    with pytest.raises(Exit) as ended, each._summarised(None):
        raise KeyboardInterrupt
    assert ended.value.exit_code == 130
    assert capsys.readouterr().out == "\nStopped at 0.0 s; until then:\nthe summary\n"
    with each._summarised(None):
        pass
    assert capsys.readouterr().out == "the summary\n"


@pytest.mark.usefixtures("bare_run")
@pytest.mark.parametrize(
    ("scene", "words"),
    [
        (EMBEDDED, ["--replay", "a/session-001.jsonl"]),
        (Path("my patients/a"), ["my patients/a", "--replay", "a/session-001.jsonl"]),
    ],
)
def test_at_the_end_stands_the_command_that_replays_it(monkeypatch, capsys, scene, words):
    monkeypatch.setattr(run, "summary_text", lambda summary: "")
    monkeypatch.setattr(run.RehearsalRun, "_save_report", lambda *given: None)
    each = fake_run(scene=scene)
    recorder = SimpleNamespace(path=Path("a/session-001.jsonl"), fault="")
    each.recording = SimpleNamespace(close=lambda stepper, summary: recorder)
    each._end()
    assert capsys.readouterr().out.endswith(f"replay it with: {shell_command('rehearse', *words)}\n")


@pytest.mark.usefixtures("bare_run")
def test_the_command_opens_the_link_for_as_long_as_it_runs_and_names_its_scene(monkeypatch, tmp_path, capsys):
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        port = listening.getsockname()[1]
    reached: list[bool] = []
    scene = tmp_path / "scene.toml"
    scene.write_bytes(EMBEDDED.read_bytes())

    def headless_run(each: run.RehearsalRun, *_) -> None:
        socket.create_connection(("127.0.0.1", port), 5).close()
        reached.append(each.link is not None and each.link.port == port and each.options.scene == scene)
        assert gc.get_freeze_count() > 0

    monkeypatch.setattr(opening, "start_taichi", lambda arch: "cpu")
    monkeypatch.setattr(opening, "built_headless", lambda *_: fake_run().built)
    monkeypatch.setattr(opening, "compile_picture", lambda anatomy: None)
    monkeypatch.setattr(run.RehearsalRun, "headless", headless_run)
    options = ["--out", str(tmp_path), "--arch", "cpu", "--link", "--link-port", str(port)]
    line = ["rehearse", str(scene), "--headless", *options]
    assert app.main(line) == 0 and reached == [True]
    # Taichi stores its kernels when it is deleted, and what is frozen never is.
    assert gc.get_freeze_count() == 0
    with socket.create_server(("127.0.0.1", port)):
        capsys.readouterr()
        assert app.main(line) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and f"port {port} cannot be opened" in told and reached == [True]
