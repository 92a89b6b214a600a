"""The loops around a rehearsal, with a fake one: what goes to the link and into files."""

import gc
import json
import socket
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from click.exceptions import Exit
from null_viewer import NullViewer
from rehearsal.frame import PREPARING, Frames, WindowFrames
from test_openigtlink import LiveImage

import app
from rehearsal import frame, headless, opening, run
from rehearsal.asked_files import AskedFiles
from rehearsal.commands.rehearse_options import RehearseOptions
from rehearsal.measurements.run_report import Tally
from rehearsal.notices import Notices
from rehearsal.pressed_organ import Step
from rehearsal.resection.resection_state import NO_RESECTION
from render.keys import DEFAULT_KEYS, Keys
from render.viewer import Controls, Settings, View
from render.window import NoVulkan
from scenes.scene import EMBEDDED, SceneError, load_scene
from scenes.terminal import shell_command
from ultrasound.probe import load_probe

STEP_S = 0.25
FILES = AskedFiles(Path(), load_scene(EMBEDDED), load_probe("linear"), Keys())


class Fake:
    """A rehearsal, its solver, its input source and its measurements in one: each step is 1 mm further, and sets the depth as a replay
    does."""

    def __init__(self) -> None:
        self.probe, self.origin = load_probe("linear"), np.array([100.0, 200.0, 300.0])
        self.settings, self.notice, self.status, self.steps = SimpleNamespace(time_step_s=STEP_S), "", "", 0
        self.pose, self.latest, self.geometry_version = np.eye(4), None, 0
        self.resection, self.cut, self.judgement, self.whole_tumour = NO_RESECTION, None, None, None

    @property
    def session(self) -> SimpleNamespace:
        return SimpleNamespace(time_s=self.steps * STEP_S, rollbacks=0)

    def next_pose(self, controls: Controls) -> np.ndarray:
        self.steps += 1
        controls.settings.depth_mm = 50 + self.steps
        return np.eye(4)

    def wrench(self) -> None:
        return None

    def image_plane(self) -> SimpleNamespace:
        place = np.eye(4)
        place[0, 3] = self.steps
        return SimpleNamespace(world_from_plane=place)

    def image_view(self, rehearsal, probe, settings, tally, shape=None, time_s=0.0, persistence=None) -> View:
        grey = np.full(shape or (4, 4), self.steps, np.uint8)
        width, depth, _ = probe.extent_mm
        return View(np.eye(4), {"B-mode": grey, "CT": 255 - grey}, width, depth)

    def timed_step(self, pose: np.ndarray) -> Step:
        return Step(pose, STEP_S, 4, 1.0, self.notice)

    def drive(self, solver: "Fake", controls: Controls, elapsed_s: float) -> None:
        self.on_step(self.timed_step(self.next_pose(controls)))

    def collect(self) -> None: ...
    def pause(self) -> None: ...
    def while_running(self) -> None: ...
    def count(self, *_) -> None: ...
    def update_surfaces(self) -> None: ...
    def rest_grid(self) -> None: ...
    def after_step(self, step: Step) -> None: ...
    def after_frame(self) -> None: ...
    def watch(self, *_, **__) -> str:
        return ""

    def onto(self, view: View, settings: Settings) -> View:
        return replace(view, alert="measured")

    def figures(self) -> dict:
        return {}


class FakeTally:
    """A tally of nothing."""

    def __init__(self) -> None:
        self.step_ms: list[float] = []
        self.slice_ms: list[float] = []

    def watch(self, rehearsal: Fake) -> None: ...
    def report(self, rehearsal: Fake, arch: str) -> dict:
        return {}


@pytest.fixture
def sent() -> list:
    return []


@pytest.fixture
def looping(monkeypatch, tmp_path, sent) -> WindowFrames:
    fake = Fake()
    monkeypatch.setattr(frame, "image_view", fake.image_view)
    return WindowFrames(
        *(fake, fake, fake, FakeTally(), SimpleNamespace(send=lambda *live: sent.append(LiveImage(*live)))),
        **dict(solver=fake, viewer=NullViewer(), out=tmp_path, notices=Notices(), sweeping=fake, plans=fake),
    )


def next_view(frames: WindowFrames, controls: Controls) -> View:
    frames.drive(controls)
    return frames.next_view(controls)


class Ordered(Fake):
    """Notes what is done; as a viewer too, with scripted controls."""

    def __init__(self, script: list[Controls]) -> None:
        super().__init__()
        self.script, self.done = script, []

    @property
    def running(self) -> bool:
        return bool(self.script)

    def read_controls(self) -> Controls:
        self.done.append("|")
        return self.script.pop(0)

    def drive(self, solver: Fake, controls: Controls, elapsed_s: float) -> None:
        # An undo changes the state at once.
        self.pose = np.eye(4) if controls.undo else self.pose
        self.done.append("undo" if controls.undo else "input")

    def collect(self) -> None:
        self.on_step(self.timed_step(self.next_pose(Controls(Settings()))))
        self.pose = np.eye(4)
        self.done.append("state")

    def image_view(self, *given) -> View:
        self.done.append("image")
        return super().image_view(*given)

    def watch(self, *_, **__) -> str:
        # A new measurement every second time.
        measured = self.done.count("measure") % 2 == 0
        self.latest = object() if measured else self.latest
        self.done.append("measure")
        return ""

    def draw_scene(self, view: View, may_wait: bool) -> None:
        self.done.append("3D may wait" if may_wait else "3D")

    def draw(self, view: View) -> None:
        self.done.append("draw")


def test_a_state_is_measured_once_while_the_next_step_is_made_unless_it_has_changed(monkeypatch, looping):
    live, undo = Controls(Settings()), Controls(Settings(), undo=True)
    ordered = Ordered([live, live, live, undo, live])
    monkeypatch.setattr(frame, "image_view", ordered.image_view)
    looping.rehearsal = looping.source = looping.measurements = looping.solver = looping.viewer = ordered
    ordered.on_step = looping.take
    looping._measured = lambda view, *_: SimpleNamespace(view=view)
    looping.run()
    frames = [frame.split() for frame in " ".join(ordered.done).replace("may wait", "later").split("|")[1:]]
    assert frames == [
        ["input", "state", "image", "measure", "draw"],
        ["input", "3D", "state", "image", "draw"],
        ["input", "measure", "3D", "state", "image", "draw"],
        ["measure", "undo", "3D", "state", "image", "measure", "draw"],
        ["input", "3D", "state", "image", "draw", "measure"],
    ]


def test_the_first_image_of_a_new_kind_is_announced_over_the_last_one(looping):
    plain, flow = Settings(), Settings(doppler="colour")
    shown = []
    looping.viewer = NullViewer(script=[Controls(each) for each in (plain, plain, flow, flow, plain)])
    looping.viewer.draw = lambda view: (
        shown.append((int(view.images["CT"][0, 0]), view.status == PREPARING)),
        looping.viewer.close() if len(shown) == 6 else None,
    )
    looping.run()
    first = shown[0][0]
    assert shown == [
        (first - n, announced)
        for n, announced in [(0, False), (1, False), (1, True), (2, False), (3, False), (4, False)]
    ]


def test_surfaces_that_were_built_anew_are_drawn_anew_also_of_the_same_cut(monkeypatch, looping):
    changed, settings = [], Settings()
    monkeypatch.setattr(frame, "geometry_of", lambda rehearsal: rehearsal.geometry_version)
    looping.viewer.change_geometry = changed.append
    for version in (0, 0, 2, 2, 3):
        looping.rehearsal.geometry_version = version
        next_view(looping, Controls(settings))
    assert changed == [2, 3]


def test_each_frame_goes_to_the_link_as_it_is_shown(looping, sent):
    settings = Settings()
    views = [next_view(looping, Controls(settings)) for _ in range(3)]
    for number, (live, view) in enumerate(zip(sent, views, strict=True), 1):
        assert live.grey is view.images["B-mode"] and live.time_s == number * STEP_S
        assert (
            np.array_equal(live.probe_in_patient[:3, 3], [100.0 + number, 200.0, 300.0])
            and view.alert == "measured"
        )
        # The depth that the replay has just set, not that of the frame before.
        assert live.image_to_probe[1, 1] == pytest.approx(view.depth_mm / 4) == (50 + number) / 4


def test_a_frozen_picture_is_sent_as_the_scanner_is_set_and_one_looked_back_at_is_not(looping, sent):
    settings = Settings()
    next_view(looping, Controls(settings))
    looping.cine.frames.append(looping.cine.frames[-1])
    settings.depth_mm = 80
    next_view(looping, Controls(settings, freeze=True))
    assert sent[-1].grey[0, 0] == 1 and sent[-1].image_to_probe[1, 1] == 20 and len(sent) == 2
    next_view(looping, Controls(settings, cine=-1))
    assert len(sent) == 2


def test_a_restored_state_is_a_notice_and_stands_in_the_panel_for_a_while(looping, monkeypatch, capsys):
    clock = [100.0]
    monkeypatch.setattr(frame, "perf_counter", lambda: clock[0])
    looping.rehearsal.notice = "Tissue restored"
    shown = [next_view(looping, Controls(Settings())).status]
    looping.rehearsal.notice = ""
    for clock[0] in (103.9, 104.1):
        shown.append(next_view(looping, Controls(Settings())).status)
    assert (
        shown == ["STATE RESTORED", "STATE RESTORED", ""] and capsys.readouterr().out == "Tissue restored\n"
    )


def test_warnings_of_the_import_stay_until_they_are_acknowledged(looping, monkeypatch, capsys):
    marked = []
    monkeypatch.setattr(frame, "acknowledge", lambda *what: marked.append(what))
    looping.warnings, looping.folder = ("12 % of the rim is fat",), looping.out / "patient"
    for _ in range(2):
        assert next_view(looping, Controls(Settings())).warnings == (
            "Shift+I: I have checked this in check.png",
            "Import: 12 % of the rim is fat",
        )
    assert marked == []
    after = next_view(looping, Controls(Settings(), acknowledge=True))
    assert after.warnings == () and marked == [(looping.folder, ("12 % of the rim is fat",))]
    assert "acknowledged" in after.status and "acknowledged" in capsys.readouterr().out
    next_view(looping, Controls(Settings(), acknowledge=True))
    assert len(marked) == 1


@pytest.mark.parametrize("error", [OSError(30, "Read-only file system"), SceneError("Read-only: damaged")])
def test_warnings_that_cannot_be_acknowledged_stay(looping, monkeypatch, error):
    def refuse(folder, shown):
        raise error

    monkeypatch.setattr(frame, "acknowledge", refuse)
    looping.warnings = ("a warning",)
    view = next_view(looping, Controls(Settings(), acknowledge=True))
    assert len(view.warnings) == 2 and "Read-only" in view.status


def test_a_sweep_that_is_recorded_stands_in_the_panel_beside_all_else(looping, monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(frame, "perf_counter", lambda: clock[0])
    looping.sweeping = SimpleNamespace(status="RECORDING 3 s", watch=lambda *_: "")
    looping.plans = SimpleNamespace(status="PLANNING; {next_plan} stops", watch=lambda *_: "")
    controls = Controls(Settings())
    assert next_view(looping, controls).status == "RECORDING 3 s   PLANNING; Backspace stops"
    looping.source.status = "TRACKING LOST"
    assert next_view(looping, controls).status == "RECORDING 3 s   TRACKING LOST   PLANNING; Backspace stops"
    looping.notices.post("undo: {undo}", in_terminal=False)
    assert next_view(looping, controls).status == "RECORDING 3 s   Undo: U"
    clock[0] += 2.1
    assert next_view(looping, Controls(Settings(), freeze=True)).status == (
        "RECORDING 3 s   FROZEN   PLANNING; Backspace stops"
    )


def test_images_have_the_pixels_of_their_boxes_unless_they_are_sent_or_recorded(looping, monkeypatch):
    controls, of_boxes = Controls(Settings()), (12, 7)
    looping.viewer = SimpleNamespace(
        image_shape=lambda count, width_mm, depth_mm: (
            of_boxes if (count, width_mm < depth_mm) == (2, True) else None
        )
    )
    assert next_view(looping, controls).images["CT"].shape == (4, 4)
    looping.link = None
    assert next_view(looping, controls).images["CT"].shape == of_boxes
    looping.sweeping = SimpleNamespace(status="RECORDING 0 s", watch=lambda *_: "")
    assert next_view(looping, controls).images["CT"].shape == (4, 4)


def test_notices_name_the_users_keys_on_the_screen_and_in_the_terminal(looping, capsys):
    looping.keys = Keys(of=DEFAULT_KEYS | {"sweep": "Space", "plan_for": "L"})
    looping.notices.post("sweep-001: {sweep} ends it")
    assert next_view(looping, Controls(Settings())).status == "Sweep-001: Space ends it"
    assert capsys.readouterr().out == "sweep-001: Space ends it\n"


def test_what_is_wrong_with_the_tissue_stands_before_all_that_is_technical(looping, monkeypatch):
    monkeypatch.setattr(frame, "perf_counter", lambda: 100.0)
    monkeypatch.setattr(Fake, "onto", lambda each, view, settings: replace(view, status="SQUEEZED"))
    looping.sweeping = SimpleNamespace(status="RECORDING 3 s", watch=lambda *_: "")
    looping.plans = SimpleNamespace(status="PLANNING", watch=lambda *_: "")
    looping.source.status = "REDUCED ITERATIONS"
    controls = Controls(Settings())
    assert next_view(looping, controls).status == "SQUEEZED   RECORDING 3 s   REDUCED ITERATIONS   PLANNING"
    looping.notices.post("undo", in_terminal=False)
    assert next_view(looping, controls).status == "SQUEEZED   RECORDING 3 s   Undo"
    looping._notice_until, looping._restored_until = 0.0, 104.0
    status = next_view(looping, Controls(Settings(), freeze=True)).status
    assert status == "STATE RESTORED   SQUEEZED   RECORDING 3 s   FROZEN   PLANNING"


def test_a_frozen_picture_keeps_its_caliper_and_a_live_one_until_the_probe_moves(looping, monkeypatch):
    image_view, at = looping.rehearsal.image_view, np.eye(4)
    monkeypatch.setattr(
        frame, "image_view", lambda *given: replace(image_view(*given), transducer_pose=at.copy())
    )
    place = (1.0, 2.0)
    assert next_view(looping, Controls(Settings(), pointed_mm=place)).caliper_mm == (place,)
    assert next_view(looping, Controls(Settings(), pointed_mm=place)).caliper == "0.0 mm"
    at[0, 3] = 5.0
    assert next_view(looping, Controls(Settings(), freeze=True)).caliper == "0.0 mm"
    assert next_view(looping, Controls(Settings(), freeze=True)).caliper_mm == ()


def test_the_clock_is_the_sessions_and_says_where_it_is_slow(looping):
    told, rates = [], []
    looping.times.rates = lambda recent_s: rates[-1]
    for factor in (0.25, 0.04, 0.89, 0.91):
        rates.append((10.0, factor))
        view = next_view(looping, Controls(Settings()))
        told.append((view.clock, view.pace))
    assert told == [("0.2 s", "0.2 x real"), ("0.5 s", "0.04 x real"), ("0.8 s", "0.9 x real"), ("1.0 s", "")]
    rates.append((10.0, 0.25))
    frozen = next_view(looping, Controls(Settings(), freeze=True))
    assert (frozen.clock, frozen.pace) == ("1.0 s", "") and "time" not in frozen.readouts


def test_the_texts_around_the_image_are_its_settings_and_times():
    own = dict(gain_percent=63.0, dyn_range_db=72.0, frequency_mhz=9.5, velocity_scale_cm_s=18.0)
    probe = load_probe("linear").model_copy(update=own)
    settings = Settings(window_hu=360, level_hu=35, clamped=True, mode="both", doppler="colour")
    b_mode = "9.5 MHz   G 63 %   DR 72 dB   speckle   hilum clamped"
    assert frame.captions(probe, settings)[1:] == (b_mode, "W 360   L 35 HU")
    assert frame.scale_texts(probe, settings) == ("+18", "-18")
    model = SimpleNamespace(counts=lambda: dict(elements=9000, nodes=9999))
    rehearsal = SimpleNamespace(model=model, indentation_mm=lambda: -2.0)
    # Medians of the last thirty.
    tally = Tally(0.0, step_ms=[90.0] * 40 + [4.0] * 14 + [5.0] * 2 + [99.0] * 14, slice_ms=[7.0, 8.0, 30.0])
    shown = {"step": "5.0 ms", "image": "8.0 ms", "elements": "9000", "indentation": "0.0 mm"}
    assert frame.readouts(rehearsal, tally) == shown


def test_the_latency_is_the_median_of_the_last_frames(looping):
    looping.times.latency_ms.extend([500.0] * 30 + [40.0] * 9 + [50.0] * 2 + [900.0] * 9)
    looping.times.rates = lambda recent_s: (23.6, 1.0)
    assert looping._speeds() == {"frames": "24 /s", "latency": "50 ms"}


def test_without_contact_whoever_leads_by_hand_is_told_how_to_press(looping, monkeypatch):
    monkeypatch.setattr(Fake, "onto", lambda each, view, _: replace(view, notes={"B-mode": "NO CONTACT"}))
    monkeypatch.setattr(frame, "UserInput", SimpleNamespace)
    looping.keys = Keys({**DEFAULT_KEYS, "push": "Return"})
    monkeypatch.setattr(frame, "ReplayInput", Fake)
    by_hand, tracked = (SimpleNamespace(is_manual=each) for each in (True, False))
    notes = []
    for looping.source.user_input in (None, by_hand, tracked):
        notes.append(next_view(looping, Controls(Settings())).notes["B-mode"])
    assert notes == ["NO CONTACT", "NO CONTACT\nLeft button or Return presses", "NO CONTACT"]
    looping.source.user_input = by_hand
    frozen = next_view(looping, Controls(Settings(), freeze=True))
    assert frozen.notes["B-mode"] == "NO CONTACT"


def test_without_a_link_the_loop_goes_on(looping, sent):
    looping.link = None
    next_view(looping, Controls(Settings()))
    assert sent == []


def test_the_export_key_saves_the_tissue_beside_its_picture_and_says_what_it_cannot_give(
    looping, monkeypatch, tmp_path, capsys
):
    begins: list[str] = []
    monkeypatch.setattr(frame, "save_surfaces", lambda rehearsal, out, begin: begins.append(begin))
    saved: list[View] = []
    save = frame.save_view
    monkeypatch.setattr(frame, "save_view", lambda view, *given: saved.append(view) or save(view, *given))
    settings, looping.link = Settings(), None
    for _ in range(2):
        looping._export(settings, next_view(looping, Controls(settings)))
    looping.cine.frames.append(looping.cine.frames[-1])
    looping._export(settings, next_view(looping, Controls(settings, freeze=True)))
    assert begins == ["001-", "002-", "003-"] and (tmp_path / "003-b-mode.dcm").is_file()
    assert next_view(looping, Controls(settings)).status == "Saved 003"
    # What is looked back at lay otherwise than the tissue does now.
    before = replace(next_view(looping, Controls(settings, cine=-1)), notes={"B-mode": "NO CONTACT"})
    looping._export(settings, before)
    assert len(begins) == 3 and (tmp_path / "004-b-mode.png").is_file()
    # Of the live image all pixels are computed; the earlier one is saved as it was shown.
    assert [view.images["CT"].shape for view in saved] == [
        (4, 4),
        (4, 4),
        (4, 4),
        looping.viewer.image_shape(2, 1.0, 1.0),
    ]
    missing = (
        "B-mode image black: the probe does not touch the organ",
        "no organ (PLY), which has moved since: F continues",
    )
    assert next_view(looping, Controls(settings)).status == "   ".join(["Saved 004", *missing])
    assert capsys.readouterr().out.endswith(f"\n{'; '.join(missing)}\n")
    looping._export(settings, replace(before, images={"CT": before.images["CT"]}))
    assert next_view(looping, Controls(settings)).status == f"Saved 005   {missing[1]}"


@pytest.mark.parametrize("earlier", [True, False])
def test_pictures_of_an_earlier_run_are_not_replaced_without_a_word(monkeypatch, tmp_path, capsys, earlier):
    monkeypatch.setattr(headless, "open_viewer", lambda *_, **__: None)
    picture = tmp_path / "slices" / "00004.png"
    picture.parent.mkdir()
    if earlier:
        picture.touch()
    headless.Pictures(Fake(), 3, tmp_path)
    said = f"Replacing the pictures of an earlier run in {tmp_path}.\n" if earlier else ""
    assert capsys.readouterr().out == said and not picture.exists()


def test_without_a_window_pictures_go_to_the_link_and_the_tissue_into_the_folder(monkeypatch, tmp_path, sent):
    def no_viewer(rehearsal, visible):
        raise NoVulkan("no Vulkan")

    fake, saved = Fake(), []
    monkeypatch.setattr(headless, "open_viewer", no_viewer)
    monkeypatch.setattr(frame, "image_view", fake.image_view)
    monkeypatch.setattr(headless, "summary", lambda report: "")
    monkeypatch.setattr(headless, "save_surfaces", lambda rehearsal, out: saved.append((fake.steps, out)))
    frames = Frames(
        fake, fake, fake, FakeTally(), SimpleNamespace(send=lambda *live: sent.append(LiveImage(*live)))
    )
    headless.run_headless(frames, Notices(), 3, Settings(), "cpu", tmp_path)
    assert [live.grey[0, 0] for live in sent] == [1, 2, 3] and sent[-1].time_s == 3 * STEP_S
    assert [live.image_to_probe[1, 1] for live in sent] == [51 / 4, 52 / 4, 53 / 4]
    assert saved == [(3, tmp_path)] and json.loads((tmp_path / "report.json").read_text()) == {"reading": {}}


def test_without_pictures_none_is_taken_and_the_rest_is_written(monkeypatch, tmp_path):
    fake, done = Fake(), []
    monkeypatch.setattr(headless, "summary", lambda report: "")
    monkeypatch.setattr(headless, "save_surfaces", lambda rehearsal, out: done.append("surfaces"))
    timed_step = fake.timed_step
    fake.timed_step = lambda pose: done.append("step") or timed_step(pose)
    fake.update_surfaces = lambda: done.append("surfaces moved")
    # The plane of the depth that the replay has just set.
    fake.find_plane = lambda probe: done.append(probe.depth_mm)
    fake.watch = lambda *given, **_: done.append("measured")
    monkeypatch.setattr(FakeTally, "watch", lambda tally, rehearsal: done.append("tallied"))
    next_pose = fake.next_pose
    # The last frame is a rollback: nothing is stepped, and the tool is not yet where the tissue has it.
    fake.next_pose = lambda controls: (
        None if next_pose(controls) is not None and fake.steps == 3 else np.eye(4)
    )
    frames = Frames(fake, fake, fake, FakeTally())
    headless.run_headless(frames, Notices(), 3, Settings(), "cpu", tmp_path, draws=False)
    steps = [["step", "surfaces moved", depth_mm, "tallied", "measured"] for depth_mm in (51, 52)]
    assert done == [*steps[0], *steps[1], 53, "measured", "surfaces"]
    assert [path.name for path in tmp_path.iterdir()] == ["report.json"]


def test_ctrl_c_in_a_run_says_so_before_how_it_went(monkeypatch, capsys):
    monkeypatch.setattr(run.RehearsalRun, "_end", lambda each, bookmarks: print(f"{bookmarks} bookmarks"))
    monkeypatch.setattr(run, "LiveMeasurements", lambda rehearsal, guide, bands: None)
    driver = SimpleNamespace(session=SimpleNamespace(time_s=1.25), bookmarks=3)
    each = run.RehearsalRun(Fake(), None, "cpu", RehearseOptions(), FILES)
    with pytest.raises(Exit) as ended, each._summarised(driver, None):
        raise KeyboardInterrupt
    assert ended.value.exit_code == 130
    assert capsys.readouterr().out == "\nStopped at 1.2 s; until then:\n3 bookmarks\n"
    with each._summarised(driver, None):
        pass
    assert capsys.readouterr().out == "3 bookmarks\n"


@pytest.mark.parametrize(
    ("scene", "words"),
    [
        (EMBEDDED, ["--replay", "a/session-001.jsonl"]),
        (Path("my patients/a"), ["my patients/a", "--replay", "a/session-001.jsonl"]),
    ],
)
def test_at_the_end_stands_the_command_that_replays_it(monkeypatch, capsys, scene, words):
    monkeypatch.setattr(
        run,
        "LiveMeasurements",
        lambda rehearsal, guide, bands: SimpleNamespace(guide=None, summary=lambda bookmarks: {}),
    )
    monkeypatch.setattr(run, "summary_text", lambda summary: "")
    each = run.RehearsalRun(Fake(), None, "cpu", RehearseOptions(scene=scene), FILES)
    path = Path("a/session-001.jsonl")
    each.recorder = SimpleNamespace(path=path, fault="", close=lambda summary: None)
    each._end(0)
    assert capsys.readouterr().out.endswith(f"replay it with: {shell_command('rehearse', *words)}\n")


def test_a_run_hands_its_link_on_with_a_window_and_without(monkeypatch, tmp_path, sent):
    link, given = SimpleNamespace(send=lambda *live: sent.append(LiveImage(*live))), []
    viewer = SimpleNamespace(settings=Settings())
    monkeypatch.setattr(run, "LiveMeasurements", lambda rehearsal, guide, bands: None)
    monkeypatch.setattr(run, "initial_settings", lambda rehearsal: Settings())
    looping = SimpleNamespace(run=lambda: None)
    looping.plans = looping.sweeping = SimpleNamespace(stop=lambda: None, end=lambda: "")
    monkeypatch.setattr(run, "WindowFrames", lambda *fixed, **_: given.append(fixed[4]) or looping)
    monkeypatch.setattr(run, "run_headless", lambda frames, *_: given.append(frames.link))
    monkeypatch.setattr(run, "Session", lambda rehearsal, coverage: None)
    for name in ("_user_input", "_record", "_end", "_about_patient"):
        monkeypatch.setattr(run.RehearsalRun, name, lambda *_: SimpleNamespace(bookmarks=0))
    asked = RehearseOptions(out=tmp_path, seconds=1.0)
    each = run.RehearsalRun(Fake(), None, "cpu", asked, FILES, viewer, Fake(), link)
    each.in_window()
    each.headless()
    assert given == [link, link]


def test_the_command_opens_the_link_for_as_long_as_it_runs_and_names_its_scene(monkeypatch, tmp_path, capsys):
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        port = listening.getsockname()[1]
    reached: list[bool] = []
    scene = tmp_path / "scene.toml"
    scene.write_bytes(EMBEDDED.read_bytes())

    def headless_run(each: run.RehearsalRun, *_) -> None:
        socket.create_connection(("127.0.0.1", port), 5).close()
        reached.append(each.link is not None and each.link.port == port and each.asked.scene == scene)
        assert gc.get_freeze_count() > 0

    monkeypatch.setattr(opening, "start_taichi", lambda arch: "cpu")
    monkeypatch.setattr(opening, "built_headless", lambda *_: None)
    monkeypatch.setattr(opening, "compile_picture", lambda rehearsal: None)
    monkeypatch.setattr(run, "LiveMeasurements", lambda rehearsal, guide, bands: None)
    monkeypatch.setattr(run.RehearsalRun, "headless", headless_run)
    line = [
        "rehearse",
        str(scene),
        "--headless",
        "--out",
        str(tmp_path),
        "--arch",
        "cpu",
        "--link",
        "--link-port",
        str(port),
    ]
    assert app.main(line) == 0 and reached == [True]
    # Taichi stores its kernels when it is deleted, and what is frozen never is.
    assert gc.get_freeze_count() == 0
    with socket.create_server(("127.0.0.1", port)):
        capsys.readouterr()
        assert app.main(line) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and f"port {port} cannot be opened" in told and reached == [True]
