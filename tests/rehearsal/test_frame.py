"""The loops around a rehearsal, with a fake one: what goes to the link and into files."""

import json
import socket
from dataclasses import replace
from pathlib import PurePosixPath
from types import SimpleNamespace

import numpy as np
import pytest
from click.exceptions import Exit

import app
from rehearsal import frame, headless, run
from rehearsal.commands import rehearse_command
from rehearsal.frame import FrameLoop
from rehearsal.frame_view import probe_as_set
from render.keys import DEFAULT_KEYS, Keys
from render.viewer import Controls, Settings, View
from render.window import NoVulkan
from scenes.scene import EMBEDDED
from scenes.shell_quoting import pasted
from ultrasound.probe import load_probe

STEP_S = 0.25


class Moments:
    """A driver, a rehearsal and its instruments in one, of which each moment is one mm further; a replay that sets the depth."""

    def __init__(self) -> None:
        self.probe, self.origin = load_probe("linear"), np.array([100.0, 200.0, 300.0])
        self.settings, self.notice, self.status, self.moment = SimpleNamespace(time_step_s=STEP_S), "", "", 0

    @property
    def session(self) -> SimpleNamespace:
        return SimpleNamespace(time_s=self.moment * STEP_S)

    def move(self, controls: Controls) -> np.ndarray:
        self.moment += 1
        controls.settings.depth_mm = 50 + self.moment
        return np.eye(4)

    def image_plane(self) -> SimpleNamespace:
        place = np.eye(4)
        place[0, 3] = self.moment
        return SimpleNamespace(world_from_plane=place)

    def take_view(self, rehearsal, settings, pose, tally) -> View:
        tally.step_ms.append(1.0)
        grey = np.full((4, 4), self.moment + 100 * (pose is None), np.uint8)
        probe = probe_as_set(self.probe, settings)
        width, depth, _ = probe.extent_mm
        return View(np.eye(4), {"B-mode": grey, "CT": 255 - grey}, width, depth)

    def rest_grid(self) -> None: ...
    def stepped(self, step_ms: float) -> str:
        return ""

    def watch(self, *_) -> str:
        return ""

    def onto(self, view: View, settings: Settings) -> View:
        return replace(view, alert="read")

    def take_said(self) -> str:
        return ""

    def figures(self) -> dict:
        return {}


class Nothing:
    """A tally of nothing."""

    def __init__(self, build_s: float) -> None:
        self.step_ms: list[float] = []

    def watch(self, rehearsal: Moments) -> None: ...
    def report(self, rehearsal: Moments, arch: str) -> dict:
        return {}


@pytest.fixture
def sent() -> list:
    return []


@pytest.fixture
def looping(monkeypatch, tmp_path, sent) -> FrameLoop:
    moments = Moments()
    monkeypatch.setattr(frame, "take_view", moments.take_view)
    link = SimpleNamespace(show=sent.append)
    return FrameLoop(moments, None, tmp_path, Nothing(0.0), *[moments] * 4, frozen=False, link=link)


def test_each_frame_goes_to_the_link_as_it_is_shown(looping, sent):
    settings = Settings()
    views = [looping.frame(Controls(settings)) for _ in range(3)]
    for number, (live, view) in enumerate(zip(sent, views, strict=True), 1):
        assert live.grey is view.pictures["B-mode"] and live.time_s == number * STEP_S
        assert (
            np.array_equal(live.probe_in_patient[:3, 3], [100.0 + number, 200.0, 300.0])
            and view.alert == "read"
        )
        # The depth that the replay has just set, not that of the frame before.
        assert live.image_to_probe[1, 1] == pytest.approx(view.depth_mm / 4) == (50 + number) / 4


def test_a_frozen_picture_is_sent_as_the_scanner_is_set_and_one_looked_back_at_is_not(looping, sent):
    settings = Settings()
    looping.frame(Controls(settings))
    looping.cine.frames.append(looping.cine.frames[-1])
    settings.depth_mm = 80
    looping.frame(Controls(settings, freeze=True))
    assert sent[-1].grey[0, 0] == 101 and sent[-1].image_to_probe[1, 1] == 20 and len(sent) == 2
    looping.frame(Controls(settings, cine=-1))
    assert len(sent) == 2


def test_what_the_guard_put_back_is_told_and_stands_in_the_panel_for_a_while(looping, monkeypatch, capsys):
    clock = [100.0]
    monkeypatch.setattr(frame, "perf_counter", lambda: clock[0])
    looping.rehearsal.notice = "Tissue put back"
    shown = [looping.frame(Controls(Settings())).status]
    looping.rehearsal.notice = ""
    for clock[0] in (103.9, 104.1):
        shown.append(looping.frame(Controls(Settings())).status)
    assert (
        shown == ["TISSUE PUT BACK", "TISSUE PUT BACK", ""] and capsys.readouterr().out == "Tissue put back\n"
    )


def test_a_sweep_that_is_recorded_stands_in_the_panel_beside_all_else(looping, monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(frame, "perf_counter", lambda: clock[0])
    looping.sweeping = SimpleNamespace(status="RECORDING 3 s", watch=lambda *_: "")
    looping.plans = SimpleNamespace(status="PLANNING; {next_plan} stops", watch=lambda *_: "")
    controls = Controls(Settings())
    assert looping.frame(controls).status == "RECORDING 3 s   PLANNING; Backspace stops"
    looping.driver.status = "TRACKING LOST"
    assert looping.frame(controls).status == "RECORDING 3 s   TRACKING LOST   PLANNING; Backspace stops"
    looping._say("undo: {undo}")
    assert looping.frame(controls).status == "RECORDING 3 s   Undo: U"
    clock[0] += 2.1
    assert looping.frame(Controls(Settings(), freeze=True)).status == (
        "RECORDING 3 s   FROZEN   PLANNING; Backspace stops"
    )


def test_what_is_wrong_with_the_tissue_stands_before_all_that_is_technical(looping, monkeypatch):
    monkeypatch.setattr(frame, "perf_counter", lambda: 100.0)
    monkeypatch.setattr(Moments, "onto", lambda each, view, settings: replace(view, status="SQUEEZED"))
    looping.sweeping = SimpleNamespace(status="RECORDING 3 s", watch=lambda *_: "")
    looping.plans = SimpleNamespace(status="PLANNING", watch=lambda *_: "")
    looping.driver.status = "LESS EXACT"
    controls = Controls(Settings())
    assert looping.frame(controls).status == "SQUEEZED   RECORDING 3 s   LESS EXACT   PLANNING"
    looping._say("undo")
    assert looping.frame(controls).status == "SQUEEZED   RECORDING 3 s   Undo"
    looping._said_until, looping._put_back_until = 0.0, 104.0
    status = looping.frame(Controls(Settings(), freeze=True)).status
    assert status == "TISSUE PUT BACK   SQUEEZED   RECORDING 3 s   FROZEN   PLANNING"


def test_a_frozen_picture_keeps_its_caliper_and_a_live_one_until_the_probe_moves(looping, monkeypatch):
    take_view, at = looping.rehearsal.take_view, np.eye(4)
    monkeypatch.setattr(
        frame, "take_view", lambda *told: replace(take_view(*told), transducer_pose=at.copy())
    )
    place = (1.0, 2.0)
    assert looping.frame(Controls(Settings(), pointed_mm=place)).caliper_mm == (place,)
    assert looping.frame(Controls(Settings(), pointed_mm=place)).caliper == "0.0 mm"
    at[0, 3] = 5.0
    assert looping.frame(Controls(Settings(), freeze=True)).caliper == "0.0 mm"
    assert looping.frame(Controls(Settings(), freeze=True)).caliper_mm == ()


def test_the_clock_is_the_sessions_and_says_where_it_is_slow(looping):
    told = []
    for looping.rate in (1.0, 0.15, 0.89 / STEP_S, 0.91 / STEP_S):
        view = looping.frame(Controls(Settings()))
        told.append((view.clock, view.pace))
    assert told == [("0.2 s", "0.2 x real"), ("0.5 s", "0.04 x real"), ("0.8 s", "0.9 x real"), ("1.0 s", "")]
    looping.rate = 1.0
    frozen = looping.frame(Controls(Settings(), freeze=True))
    assert (frozen.clock, frozen.pace) == ("1.0 s", "") and "time" not in frozen.readouts


def test_without_contact_whoever_leads_by_hand_is_told_how_to_press(looping, monkeypatch):
    monkeypatch.setattr(Moments, "onto", lambda each, view, _: replace(view, notes={"B-mode": "NO CONTACT"}))
    monkeypatch.setattr(frame, "UserInput", SimpleNamespace)
    looping.keys = Keys({**DEFAULT_KEYS, "push": "Return"})
    monkeypatch.setattr(frame, "ReplayInput", Moments)
    by_hand, tracked = (SimpleNamespace(is_by_hand=each) for each in (True, False))
    told = []
    for looping.driver.live in (None, by_hand, tracked):
        told.append(looping.frame(Controls(Settings())).notes["B-mode"])
    assert told == ["NO CONTACT", "NO CONTACT\nLeft button or Return presses", "NO CONTACT"]
    looping.driver.live = by_hand
    frozen = looping.frame(Controls(Settings(), freeze=True))
    assert frozen.notes["B-mode"] == "NO CONTACT"


def test_without_a_link_the_loop_goes_on(looping, sent):
    looping.link = None
    looping.frame(Controls(Settings()))
    assert sent == []


def test_the_export_key_saves_the_tissue_beside_its_picture_and_says_what_it_cannot_give(
    looping, monkeypatch, tmp_path, capsys
):
    begins: list[str] = []
    monkeypatch.setattr(frame, "save_surfaces", lambda rehearsal, out, begin: begins.append(begin))
    settings = Settings()
    for _ in range(2):
        controls = Controls(settings, export=True)
        looping._save(controls, looping.frame(controls))
    looping.cine.frames.append(looping.cine.frames[-1])
    looping._save(Controls(settings, export=True), looping.frame(Controls(settings, freeze=True)))
    assert begins == ["001-", "002-", "003-"] and (tmp_path / "003-b-mode.dcm").is_file()
    assert looping.frame(Controls(settings)).status == "Saved 003"
    # What is looked back at lay otherwise than the tissue does now.
    before = replace(looping.frame(Controls(settings, cine=-1)), notes={"B-mode": "NO CONTACT"})
    looping._save(Controls(settings, export=True), before)
    assert len(begins) == 3 and (tmp_path / "004-b-mode.png").is_file()
    missing = (
        "echo black: the probe does not touch the organ",
        "no organ (PLY), which has moved since: F goes on",
    )
    assert looping.frame(Controls(settings)).status == "   ".join(["Saved 004", *missing])
    assert capsys.readouterr().out.endswith(f"\n{'; '.join(missing)}\n")
    looping._save(Controls(settings, export=True), replace(before, pictures={"CT": before.pictures["CT"]}))
    assert looping.frame(Controls(settings)).status == f"Saved 005   {missing[1]}"


@pytest.mark.parametrize("earlier", [True, False])
def test_pictures_of_an_earlier_run_are_not_replaced_without_a_word(monkeypatch, tmp_path, capsys, earlier):
    monkeypatch.setattr(headless, "open_viewer", lambda *_, **__: None)
    picture = tmp_path / "slices" / "00004.png"
    picture.parent.mkdir()
    if earlier:
        picture.touch()
    headless.Pictures(Moments(), 3, tmp_path)
    said = f"Replacing the pictures of an earlier run in {tmp_path}.\n" if earlier else ""
    assert capsys.readouterr().out == said and not picture.exists()


def test_without_a_window_pictures_go_to_the_link_and_the_tissue_into_the_folder(monkeypatch, tmp_path, sent):
    def no_viewer(rehearsal, visible):
        raise NoVulkan("no Vulkan")

    moments, saved = Moments(), []
    monkeypatch.setattr(headless, "open_viewer", no_viewer)
    monkeypatch.setattr(headless, "take_view", moments.take_view)
    monkeypatch.setattr(headless, "Tally", Nothing)
    monkeypatch.setattr(headless, "summary", lambda report: "")
    monkeypatch.setattr(headless, "save_surfaces", lambda rehearsal, out: saved.append((moments.moment, out)))
    link = SimpleNamespace(show=sent.append)
    headless.run_headless(moments, moments, 3, Settings(), moments, "cpu", tmp_path, 0.0, True, link)
    assert [live.grey[0, 0] for live in sent] == [1, 2, 3] and sent[-1].time_s == 3 * STEP_S
    assert [live.image_to_probe[1, 1] for live in sent] == [51 / 4, 52 / 4, 53 / 4]
    assert saved == [(3, tmp_path)] and json.loads((tmp_path / "report.json").read_text()) == {"reading": {}}


def test_without_pictures_none_is_taken_and_the_rest_is_written(monkeypatch, tmp_path):
    moments, done = Moments(), []
    monkeypatch.setattr("rehearsal.frame_view.timed", lambda act, ms: ms.append(1.0) or act())
    monkeypatch.setattr(headless, "Tally", Nothing)
    monkeypatch.setattr(headless, "summary", lambda report: "")
    monkeypatch.setattr(headless, "save_surfaces", lambda rehearsal, out: done.append("surfaces"))
    moments.advance = lambda pose: done.append("step")
    moments.update_surfaces = lambda: done.append("carried")
    # The plane of the depth that the replay has just set.
    moments.find_plane = lambda probe: done.append(probe.depth_mm)
    moments.watch = lambda *told: done.append("watched") if told else ""
    monkeypatch.setattr(Nothing, "watch", lambda tally, rehearsal: done.append("tallied"))
    move = moments.move
    # The last moment is a way back: nothing is stepped, and the tool is not yet where the tissue has it.
    moments.move = lambda controls: None if move(controls) is not None and moments.moment == 3 else np.eye(4)
    headless.run_headless(moments, moments, 3, Settings(), moments, "cpu", tmp_path, 0.0, draws=False)
    steps = [["step", "carried", depth_mm, "tallied", "watched"] for depth_mm in (51, 52)]
    assert done == [*steps[0], *steps[1], 53, "watched", "surfaces"]
    assert [path.name for path in tmp_path.iterdir()] == ["report.json"]


def test_ctrl_c_in_a_run_says_so_before_how_it_went(monkeypatch, capsys):
    monkeypatch.setattr(run.RehearsalRun, "_end", lambda each, bookmarks: print(f"{bookmarks} bookmarks"))
    monkeypatch.setattr(run, "LiveMeasurements", lambda rehearsal, guide: None)
    driver = SimpleNamespace(session=SimpleNamespace(time_s=1.25), bookmarks=3)
    each = run.RehearsalRun(Moments(), None, "cpu", None)
    with pytest.raises(Exit) as ended, each._summed_up(driver, None):
        raise KeyboardInterrupt
    assert ended.value.exit_code == 130
    assert capsys.readouterr().out == "\nStopped at 1.2 s; until then:\n3 bookmarks\n"
    with each._summed_up(driver, None):
        pass
    assert capsys.readouterr().out == "3 bookmarks\n"


@pytest.mark.parametrize(
    ("scene", "words"),
    [
        (None, ["--replay", "a/session-001.jsonl"]),
        (PurePosixPath("my patients/a"), ["my patients/a", "--replay", "a/session-001.jsonl"]),
    ],
)
def test_at_the_end_stands_the_command_that_replays_it(monkeypatch, capsys, scene, words):
    monkeypatch.setattr(
        run,
        "LiveMeasurements",
        lambda rehearsal, guide: SimpleNamespace(guide=None, summary=lambda bookmarks: {}),
    )
    monkeypatch.setattr(run, "summary_text", lambda summary: "")
    each = run.RehearsalRun(Moments(), None, "cpu", None, scene=scene)
    recording = SimpleNamespace(path=PurePosixPath("a/session-001.jsonl"), fault="")
    each.recorded = SimpleNamespace(recording=recording, close=lambda summary: None)
    each._end(0)
    assert capsys.readouterr().out.endswith(f"replay it with: {pasted('rehearse', *words)}\n")


def test_a_run_hands_its_link_on_with_a_window_and_without(monkeypatch, tmp_path, sent):
    link, given = SimpleNamespace(show=sent.append), []
    viewer = SimpleNamespace(close=lambda: None, settings=Settings())
    monkeypatch.setattr(run, "LiveMeasurements", lambda rehearsal, guide: None)
    monkeypatch.setattr(run, "open_viewer", lambda rehearsal, **_: viewer)
    monkeypatch.setattr(run, "settings_of", lambda rehearsal: Settings())
    looping = SimpleNamespace(run=lambda: None)
    monkeypatch.setattr(run, "FrameLoop", lambda *_, keys, link: given.append(link) or looping)
    monkeypatch.setattr(run, "run_headless", lambda *arguments: given.append(arguments[-1]))
    monkeypatch.setattr(run, "Session", lambda rehearsal, seen: None)
    for name in ("_live", "_record", "_end"):
        monkeypatch.setattr(run.RehearsalRun, name, lambda *_: SimpleNamespace(bookmarks=0))
    each = run.RehearsalRun(Moments(), None, "cpu", tmp_path, link=link)
    each.in_window(None, 0.0)
    each.headless(None, 0.0, 1.0, 0.0)
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
        reached.append(each.link is not None and each.link.port == port and each.scene == scene)

    monkeypatch.setattr(rehearse_command, "start_taichi", lambda arch: "cpu")
    monkeypatch.setattr(rehearse_command, "built", lambda *_: None)
    monkeypatch.setattr(rehearse_command, "compile_picture", lambda rehearsal: None)
    monkeypatch.setattr(run, "LiveMeasurements", lambda rehearsal, guide: None)
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
    with socket.create_server(("127.0.0.1", port)):
        capsys.readouterr()
        assert app.main(line) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and f"port {port} cannot be opened" in told and reached == [True]
