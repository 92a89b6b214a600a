"""A real window under Xvfb, its mouse moved by xdotool: what the surgeon does is what happens."""

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from PIL import Image
from settings_at_start import settings_with

from render.sliders import boxes_of, groups_of
from render.ultrasound_panel import CALIPER
from render.viewer import Geometry
from render.window_layout import Rect, WindowLayout

pytestmark = pytest.mark.skipif(
    not (shutil.which("Xvfb") and shutil.which("xdotool")), reason="needs Xvfb and xdotool"
)
START_S, REST_S = 120, 90
# How long a picture is waited for before its key is pressed again, and how far apart two pictures are at
# least.
ASK_S, APART_S = 2.0, 0.5
# A small screen, so that its window is drawn fast without a graphics card.
SCREEN, WINDOW = "640x480x24", (640, 360)
# The slice and what is drawn of organ and transducer, and how much two pictures of a still one differ at
# most.
PANEL, SCENE = np.s_[70:310, 400:620], np.s_[40:240, 10:360]
STILL = 0.5
# Two points on the B-mode image beside the CT.
MARKS = ((200, 130), (290, 130), (245, 165))
B_MODE_TOP, B_MODE_FOOT = (450, 70), (450, 195)


class Screen:
    """The program in a window on a display of its own."""

    def __init__(self, display: str, out: Path) -> None:
        self.out = out
        self.environment = os.environ | {"DISPLAY": display}
        self.environment.pop("WAYLAND_DISPLAY", None)
        keys = out / "keys.toml"
        keys.write_text('[keys]\nfreeze = "Space"\nplan_for = "F"\nexport = "E"\nrock_right = "I"\n')
        self.program = subprocess.Popen(
            [
                sys.executable,
                str(ROOT / "app.py"),
                "rehearse",
                "--cell",
                "7",
                "--picture",
                "ct",
                "--arch",
                "cpu",
                "--keys",
                str(keys),
                "--out",
                str(out),
            ],
            env=self.environment,
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self.window = self._wait_for_window()
        # The window opens before the organ is built.
        self.picture(within_s=START_S)

    def _wait_for_window(self) -> str:
        end = time.monotonic() + START_S
        while time.monotonic() < end and self.program.poll() is None:
            found = self.do("search", "--name", "Nephron").stdout.split()
            if found:
                return found[0]
            time.sleep(0.5)
        self.program.kill()
        output = self.program.communicate()[0]
        if "Vulkan" in output:
            pytest.skip("no Vulkan driver to open a window with")
        pytest.fail(f"no window came: {output}")

    def do(self, *command) -> subprocess.CompletedProcess:
        return subprocess.run(
            ["xdotool", *map(str, command)], env=self.environment, capture_output=True, text=True
        )

    def point(self, x: int, y: int) -> None:
        self.do("mousemove", "--window", self.window, x, y)

    def at_rest(self) -> np.ndarray:
        """What the window shows when nothing moves any more, however slow the machine."""
        end = time.monotonic() + REST_S
        before = self.picture()
        while time.monotonic() < end:
            after = self.picture()
            if all(np.abs(after - before)[part].mean() < STILL for part in (SCENE, PANEL)):
                return after
            before = after
        pytest.fail("the picture does not come to rest")

    def picture(self, within_s: float = 60) -> np.ndarray:
        """What the window shows, saved by its own screenshot key."""
        before = len(self._screenshots())
        end = time.monotonic() + within_s
        while time.monotonic() < end:
            self.do("key", "--window", self.window, "p")
            asked = time.monotonic()
            while time.monotonic() < asked + ASK_S:
                time.sleep(0.1)
                if len(self._screenshots()) > before:
                    # Not sooner: what moves slowly is not to be taken for still.
                    time.sleep(max(0.0, asked + APART_S - time.monotonic()))
                    return np.asarray(Image.open(self._screenshots()[-1]).convert("RGB")).astype(int)
        pytest.fail("the screenshot key leaves no picture")

    def _screenshots(self) -> list[Path]:
        """Those that are written to their end."""
        paths = sorted(self.out.glob("screenshot-*.png"))
        return [path for path in paths if path.read_bytes()[-8:-4] == b"IEND"]


def slider(name: str) -> Rect:
    """Where one of an engineer's sliders is, without its label."""
    geometry = Geometry(
        (None, np.zeros((0, 3))), np.zeros((2, 3)), tumour=(1, 1), parts={"vessel": (1, 1)}, support=(1, 1)
    )
    settings = settings_with({"view.show_engineer": True})
    boxes = boxes_of(settings, geometry, WindowLayout(*WINDOW, has_engineer=True))
    for group, members in groups_of(settings, geometry).items():
        for place, member in enumerate(members):
            if member.name == name:
                left, top, width, _ = boxes[group]
                return Rect(left + 8, top + 27 + 23 * place, round(0.65 * width), 19)
    raise KeyError(name)


@pytest.fixture
def screen(tmp_path):
    read, write = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(write), "-screen", "0", SCREEN],
        pass_fds=[write],
        stderr=subprocess.DEVNULL,
    )
    os.close(write)
    with os.fdopen(read) as numbers:
        display = f":{numbers.readline().strip()}"
    shown = None
    try:
        shown = Screen(display, tmp_path)
        yield shown
    finally:
        if shown is not None:
            shown.program.kill()
        server.terminate()
        server.wait()


def test_the_mouse_moves_and_presses_the_transducer(screen):
    screen.point(165, 165)
    first = screen.at_rest()
    screen.point(225, 165)
    second = screen.at_rest()
    assert first.shape == (*WINDOW[::-1], 3)
    assert np.abs(second - first)[SCENE].mean() > 1.0, "the transducer does not follow the mouse"
    assert np.abs(second - first)[PANEL].mean() > 5.0, "the panel does not change with the transducer"
    screen.do("mousedown", 1)
    pressed = screen.at_rest()
    screen.do("mouseup", 1)
    assert np.abs(pressed - second)[PANEL].mean() > 5.0, "pressing does not change the panel"
    assert np.abs(pressed - second)[SCENE].mean() > 0.5, "pressing does not move the transducer in"
    let_go = screen.at_rest()
    assert np.abs(let_go - second)[PANEL].mean() < 0.5 * np.abs(pressed - second)[PANEL].mean()
    screen.do("key", "--window", screen.window, "b")
    both = screen.at_rest()
    assert np.abs(both - let_go)[PANEL].mean() > 5.0, "the key for the B-mode image changes nothing"
    screen.do("key", "--window", screen.window, "space")
    for place in (B_MODE_TOP, B_MODE_FOOT):
        screen.point(*place)
        time.sleep(0.5)
        screen.do("mousedown", 1)
        time.sleep(0.5)
        screen.do("mouseup", 1)
    measured = screen.picture()
    green = (measured == CALIPER).all(axis=2)[PANEL]
    assert green.sum() > 100, "two clicks on the B-mode image draw no caliper"
    screen.do("key", "--window", screen.window, "e")
    exported = [screen.out / name for name in ("001-b-mode.dcm", "001-ct.png")]
    end = time.monotonic() + 20
    while not all(each.exists() for each in exported) and time.monotonic() < end:
        time.sleep(0.5)
    assert all(each.exists() for each in exported)
    screen.do("key", "--window", screen.window, "shift+e")
    screen.picture()
    level = slider("level_hu")
    screen.point(level.left + level.width // 2, level.top + level.height // 2)
    time.sleep(0.5)
    screen.do("mousedown", 1)
    screen.point(level.left, level.top + level.height // 2)
    time.sleep(0.5)
    screen.do("mouseup", 1)
    screen.do("key", "--window", screen.window, "shift+e")
    brighter = screen.picture()
    assert brighter[PANEL].mean() > measured[PANEL].mean() + 10.0, "the slider of the CT changes nothing"
    screen.do("keydown", "Shift_L")
    for place in MARKS:
        screen.point(*place)
        time.sleep(0.5)
        screen.do("mousedown", 1)
        time.sleep(0.5)
        screen.do("mouseup", 1)
    # At once: also a slow window sees the last click with shift.
    screen.do("keyup", "Shift_L")
    screen.picture()
    # A mark was set just now: the first asks, and one soon after it quits.
    end = time.monotonic() + 60
    while screen.program.poll() is None and time.monotonic() < end:
        screen.do("key", "--window", screen.window, "Escape")
        time.sleep(1.5)
    assert screen.program.poll() == 0
    lines = (screen.out / "session-001.jsonl").read_text().splitlines()
    commands = [json.loads(line).get("command", {}) for line in lines]
    marks = [len(command["places_mm"]) for command in commands if command.get("kind") == "mark"]
    assert marks == [1, 1, 1], "a click with shift sets no mark"
