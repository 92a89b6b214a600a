"""The start screen in a real window under Xvfb: a key chooses a patient, and the same window rehearses it."""

import os
import shutil
import subprocess
import sys
import threading
import time

import pytest
from ball_patient import folder_of_ball
from conftest import ROOT

pytestmark = pytest.mark.skipif(
    not (shutil.which("Xvfb") and shutil.which("xdotool")), reason="needs Xvfb and xdotool"
)
START_S, ASK_S = 180, 1.0


class StartedProgram:
    """The program on a display of its own; what it prints is in ``lines``."""

    def __init__(self, display: str, folder) -> None:
        self.environment = os.environ | {"DISPLAY": display}
        self.environment.pop("WAYLAND_DISPLAY", None)
        self.process = subprocess.Popen(
            [sys.executable, str(ROOT / "app.py"), "rehearse", "--arch", "cpu"],
            env=self.environment,
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self.lines: list[str] = []
        threading.Thread(target=lambda: self.lines.extend(self.process.stdout), daemon=True).start()

    @property
    def text(self) -> str:
        return "".join(self.lines)

    def press_until(self, is_so, *keys: str) -> None:
        """Press keys again and again until something is so: a window takes none before it is there."""
        end = time.monotonic() + START_S
        while time.monotonic() < end and not is_so():
            for window in self._do("search", "--name", "Nephron").split():
                self._do("windowfocus", window, "key", *keys)
            time.sleep(ASK_S)
        if "Vulkan" in self.text:
            pytest.skip("no Vulkan driver to open a window with")
        assert is_so(), self.text

    def has_ended(self) -> bool:
        return self.process.poll() is not None

    def _do(self, *command: str) -> str:
        asked = subprocess.run(
            ["xdotool", *command], env=self.environment, capture_output=True, text=True, timeout=START_S
        )
        return asked.stdout


@pytest.fixture
def program(tmp_path):
    (tmp_path / "patients" / "a").mkdir(parents=True)
    folder_of_ball(tmp_path / "patients" / "a")
    read, write = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(write), "-screen", "0", "640x480x24"],
        pass_fds=[write],
        stderr=subprocess.DEVNULL,
    )
    os.close(write)
    with os.fdopen(read) as numbers:
        display = f":{numbers.readline().strip()}"
    started = StartedProgram(display, tmp_path)
    try:
        yield started
    finally:
        started.process.kill()
        server.terminate()
        server.wait()


def test_esc_quits_and_leaves_nothing(program, tmp_path):
    program.press_until(program.has_ended, "Escape")
    assert program.process.returncode == 0 and "Traceback" not in program.text
    assert sorted(path.name for path in tmp_path.iterdir()) == ["patients"]


def test_a_patient_is_chosen_by_keys_and_rehearsed_in_the_same_window(program, tmp_path):
    program.press_until(lambda: "The window is open" in program.text, "Right", "Return")
    program.press_until(program.has_ended, "Escape")
    assert program.process.returncode == 0 and "Traceback" not in program.text
    # It was the ball, not the embedded patient: the command to replay it names its folder.
    assert "rehearse patients/a --replay out/session-001.jsonl" in program.text
    assert (tmp_path / "out" / "session-001.jsonl").is_file()
