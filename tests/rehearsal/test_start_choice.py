"""A choice on the start screen by click and key, with a window that only hands over what is pressed."""

import os
from collections.abc import Callable
from pathlib import Path
from time import monotonic

import numpy as np
import pytest
from ball_patient import folder_of_ball
from recorded_session import header

from rehearsal.commands.rehearse_options import RehearseOptions
from rehearsal.loop.command import Move
from rehearsal.sessions.session_file import EndLine, Log, SessionError
from rehearsal.start_screen import patient_page, start_page
from rehearsal.start_screen.background_task import BackgroundTask
from rehearsal.start_screen.import_tasks import survey
from rehearsal.start_screen.patient_page import PatientPage
from rehearsal.start_screen.start_page import StartChoice, StartScreen
from render.start_screen import DrawnScreen
from render.viewer import KeyOrClick
from render.window_layout import WindowLayout
from scenes.anatomy import fingerprint, load_anatomy
from scenes.scene import EMBEDDED, load_scene

END_S = 60.0


class ScriptedViewer:
    """A window whose user presses what a script has, one a frame; then it is closed."""

    layout = WindowLayout(1280, 720)

    def __init__(self, *script: KeyOrClick | Callable[[], KeyOrClick | None]) -> None:
        self._script, self.images, self.running = list(script), [], True

    def show_image(self, image: np.ndarray) -> None:
        self.images.append(image)

    def presses(self) -> list[KeyOrClick]:
        if not self._script:
            self.running = False
            return []
        step = self._script[0]
        press = step() if callable(step) else step
        if press is None:
            return []
        self._script.pop(0)
        return [press]


class NoTask:
    """A background task that never ends."""

    is_done, step, fault, result = False, "", "", None

    def __init__(self, *arguments) -> None: ...

    def update(self) -> None: ...

    def stop(self) -> None: ...


def keys(*names: str) -> list[KeyOrClick]:
    return [KeyOrClick(name) for name in names]


def centre(screen: DrawnScreen, action: str) -> KeyOrClick:
    """A click on an action."""
    box = screen.boxes[action]
    return KeyOrClick(place=(box.left + box.width / 2, box.top + box.height / 2))


@pytest.fixture(autouse=True)
def fast(monkeypatch):
    monkeypatch.setattr(start_page, "REFRESH_S", 0.0)


@pytest.fixture
def patients(tmp_path):
    """A folder with two patients: the newer one is the first after the embedded one."""
    folder = tmp_path / "patients"
    for name, age_s in (("a", 0), ("b", 1000)):
        (folder / name).mkdir(parents=True)
        folder_of_ball(folder / name)
        then = 1_700_000_000 - age_s
        os.utime(folder / name / "scene.toml", (then, then))
    return folder


@pytest.fixture
def page(patients, tmp_path, monkeypatch):
    monkeypatch.setattr(patient_page, "BackgroundTask", NoTask)
    return PatientPage(patients, tmp_path / "out")


class TestPatient:
    def test_return_takes_the_embedded_patient(self, page):
        assert StartScreen(ScriptedViewer(*keys("Return")), page).choice() == StartChoice(EMBEDDED)

    @pytest.mark.parametrize(
        ("pressed", "name"),
        [(("Right",), "a"), (("Down",), "b"), (("Right", "Left", "Down", "Up", "Right"), "a")],
    )
    def test_arrows_choose(self, page, patients, pressed, name):
        choice = StartScreen(ScriptedViewer(*keys(*pressed, "Return")), page).choice()
        assert choice == StartChoice(patients / name)

    def test_a_click_chooses(self, page, patients):
        viewer = ScriptedViewer(lambda: centre(page.drawn(viewer.layout, ""), "patient 2"))
        assert StartScreen(viewer, page).choice() == StartChoice(patients / "b")

    def test_a_click_beside_everything_does_nothing(self, page):
        viewer = ScriptedViewer(KeyOrClick(place=(2.0, 2.0)), *keys("Return"))
        assert StartScreen(viewer, page).choice() == StartChoice(EMBEDDED)

    def test_esc_quits_and_so_does_closing_the_window(self, page):
        assert StartScreen(ScriptedViewer(*keys("Esc", "Return")), page).choice() is None
        assert StartScreen(ScriptedViewer(*keys("Down")), page).choice() is None

    def test_the_frame_follows_the_arrows(self, page):
        viewer = ScriptedViewer(*keys("Right", "Down"))
        StartScreen(viewer, page).choice()
        before, after = viewer.images[0], viewer.images[1]
        changed = (before != after).any(axis=2)
        boxes = page.drawn(viewer.layout, "").boxes
        assert changed[boxes["patient 0"].slices].any() and changed[boxes["patient 1"].slices].any()

    def test_a_damaged_patient_is_not_opened_and_the_reason_is_shown(self, page, patients):
        (patients / "a" / "scene.toml").write_text("nonsense = ")
        viewer = ScriptedViewer(*keys("Right", "Return"))
        assert StartScreen(viewer, page).choice() is None
        assert "import the patient again" in page._message
        assert (viewer.images[-1] != viewer.images[1]).any()

    def test_more_patients_than_fit_are_on_further_pages(self, page, patients):
        for number in range(9):
            (patients / f"c{number}").mkdir()
            folder_of_ball(patients / f"c{number}")
        seen = set()

        def see() -> KeyOrClick:
            seen.update(action for action in page.drawn(viewer.layout, "").boxes if "patient" in action)
            return KeyOrClick("N")

        viewer = ScriptedViewer(see, see)
        StartScreen(viewer, page).choice()
        assert seen == {f"patient {n}" for n in range(12)}


class TestFolder:
    @pytest.fixture
    def choosing(self, monkeypatch):
        """Have the dialogue end with a path, or with None."""

        def choose(path: Path | None, fault: str = "") -> None:
            class Dialog:
                is_done = True

                def __init__(self, command) -> None:
                    self.path, self.fault = path, fault

                def update(self) -> None: ...

                def stop(self) -> None: ...

            monkeypatch.setattr(patient_page, "FileDialog", Dialog)
            monkeypatch.setattr(patient_page, "dialog_command", lambda *_, **__: ["dialog"])

        return choose

    def test_a_folder_elsewhere_is_opened(self, page, choosing, tmp_path):
        (tmp_path / "elsewhere").mkdir()
        folder_of_ball(tmp_path / "elsewhere")
        choosing(tmp_path / "elsewhere")
        viewer = ScriptedViewer(*keys("O", "Down"))
        assert StartScreen(viewer, page).choice() == StartChoice(tmp_path / "elsewhere")

    def test_a_cancelled_dialogue_changes_nothing(self, page, choosing):
        choosing(None)
        viewer = ScriptedViewer(*keys("O", "Up", "Up"))
        assert StartScreen(viewer, page).choice() is None and page._message == ""

    def test_a_folder_of_something_else_is_refused_in_words(self, page, choosing, tmp_path):
        choosing(tmp_path)
        viewer = ScriptedViewer(*keys("O", "Up", "Up"))
        assert StartScreen(viewer, page).choice() is None and "no patient's folder" in page._message

    def test_without_a_dialogue_the_command_is_named(self, page, monkeypatch):
        monkeypatch.setattr(patient_page, "dialog_command", lambda *_, **__: None)
        StartScreen(ScriptedViewer(*keys("O", "Up")), page).choice()
        assert "install" in page._message and "python app.py rehearse FOLDER" in page._message


class TestSession:
    @pytest.fixture
    def session(self, patients, tmp_path):
        """A session of patient b, of 3 s."""
        scene = load_scene(patients / "b" / "scene.toml")
        of, out = header(), tmp_path / "out"
        of.anatomy = fingerprint(load_anatomy(scene, patients / "b"))
        out.mkdir()
        path = out / "session-001.jsonl"
        path.write_text(
            f"{of.model_dump_json()}\n{EndLine(summary=dict(duration_s=3.0)).model_dump_json()}\n"
        )
        return path

    def surveyed(self, patients, monkeypatch) -> None:
        """Have the survey in this process, and of the patients in the folder alone."""

        class Here(NoTask):
            def __init__(self, function, scenes) -> None:
                self.is_done = True
                self.result = function([scene for scene in scenes if scene != EMBEDDED], lambda step: None)

        monkeypatch.setattr(patient_page, "BackgroundTask", Here)

    @pytest.mark.parametrize(("button", "at_s"), [("replay 0", 0.0), ("go on 0", 3.0)])
    def test_its_patient_is_found_and_it_is_replayed_or_goes_on(
        self, page, patients, session, monkeypatch, button, at_s
    ):
        # Both patients have the same anatomy, but one is larger.
        self.enlarge(patients / "a")
        self.surveyed(patients, monkeypatch)
        log = Log(header(), [(0, Move(pose=np.eye(4), length_s=3.0))])
        monkeypatch.setattr(patient_page, "read_log", lambda path: log)
        viewer = ScriptedViewer(*keys("Up"), lambda: centre(page.drawn(viewer.layout, ""), button))
        assert StartScreen(viewer, page).choice() == StartChoice(patients / "b", session, at_s)

    def enlarge(self, folder: Path) -> None:
        import trimesh

        organ = trimesh.load(folder / "organ.stl")
        organ.apply_scale(1.1).export(folder / "organ.stl")

    def test_one_of_nobody_here_has_no_buttons(self, page, patients, session, monkeypatch):
        for name in "ab":
            self.enlarge(patients / name)
        self.surveyed(patients, monkeypatch)
        viewer = ScriptedViewer(*keys("Up", "Up"))
        StartScreen(viewer, page).choice()
        assert not [action for action in page.drawn(viewer.layout, "").boxes if action.startswith("replay")]

    def test_a_damaged_one_is_refused_in_words(self, page, patients, session, monkeypatch):
        self.surveyed(patients, monkeypatch)

        def damaged(path: Path) -> Log:
            raise SessionError("line 7 cannot be read")

        monkeypatch.setattr(patient_page, "read_log", damaged)
        viewer = ScriptedViewer(*keys("Up"), lambda: centre(page.drawn(viewer.layout, ""), "replay 0"))
        assert StartScreen(viewer, page).choice() is None and page._message == "line 7 cannot be read"


def test_the_survey_of_a_process_of_its_own_leaves_out_what_cannot_be_read(patients):
    (patients / "a" / "organ.stl").write_text("nonsense")
    task = BackgroundTask(survey, [patients / "a", patients / "b"])
    end = monotonic() + END_S
    while not task.is_done and monotonic() < end:
        task.update()
    task.stop()
    scene = load_scene(patients / "b" / "scene.toml")
    expected = fingerprint(load_anatomy(scene, patients / "b"))
    assert {path: of.anatomy for path, of in task.result.items()} == {patients / "b": expected}


@pytest.mark.parametrize(
    ("changed", "is_open"),
    [
        ({}, True),
        (dict(out=Path("b"), arch="cpu", gamepad=True, keys=Path("k.toml"), link=True, rate=500.0), True),
        (dict(scene=Path("patients/a")), False),
        (dict(track=Path("t.json")), False),
        (dict(replay=Path("s.jsonl")), False),
        (dict(plan=Path("p.json")), False),
        (dict(headless=True), False),
        (dict(quality="fast"), False),
        (dict(budget_ms=5.0), False),
        (dict(changes={"tissue.cell_mm": 5.0}), False),
    ],
)
def test_the_start_screen_comes_where_nothing_is_said_of_a_patient(changed, is_open):
    assert RehearseOptions(**changed).leaves_patient_open is is_open
