"""A gamepad: what its sticks, trigger and buttons do, with a made-up one, and with one that SDL makes up."""

import ctypes
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from settings_at_start import settings_with

from render.gamepad import DEAD_STICK, SLIDE_MM_S, Gamepad, PadState, SdlPads, shaped
from render.keys import BUTTONS, DEFAULT_BUTTONS, TILT_DEG_S
from render.viewer import Controls

SECONDS = 0.02


class MadeUp:
    """Gives the states of a list, one by one."""

    def __init__(self, *states: PadState | None) -> None:
        self.states = iter(states)

    def read(self) -> PadState | None:
        return next(self.states)


def read(*states: PadState | None, **did) -> list[Controls]:
    pad = Gamepad(MadeUp(*states), DEFAULT_BUTTONS)
    found = [Controls(settings_with(), **did) for _ in states]
    for controls in found:
        pad.read(controls, SECONDS)
    return found


def test_a_stick_has_a_dead_zone_and_full_deflection_at_its_end():
    assert shaped(0.1, -0.1) == (0.0, 0.0) and shaped(DEAD_STICK, 0.0) == (0.0, 0.0)
    assert shaped(0.0, -1.0) == pytest.approx((0.0, -1.0)) and shaped(1.0, 1.0) == pytest.approx(
        (0.5**0.5, 0.5**0.5)
    )
    half = (1.0 + DEAD_STICK) / 2
    assert shaped(half, 0.0) == pytest.approx((0.25, 0.0))
    assert shaped(0.6 * half, -0.8 * half) == pytest.approx((0.15, -0.2))


def test_sticks_slide_rock_and_tilt():
    (controls,) = read(PadState(left=(0.0, 1.0), right=(1.0, 0.0)))
    assert controls.slide_mm == pytest.approx((0.0, SLIDE_MM_S * SECONDS))
    # To the right is towards +x, and so a negative tilt.
    assert (controls.rock_deg, controls.tilt_deg) == pytest.approx((-TILT_DEG_S * SECONDS, 0.0))
    (controls,) = read(PadState(left=(-1.0, 0.0), right=(0.0, -1.0)), tilt_deg=5.0)
    assert controls.slide_mm == pytest.approx((-SLIDE_MM_S * SECONDS, 0.0))
    assert (controls.rock_deg, controls.tilt_deg) == pytest.approx((0.0, 5.0 - TILT_DEG_S * SECONDS))


def test_the_trigger_presses_as_deep_as_it_is_pulled():
    off, half, full = read(PadState(trigger=0.04), PadState(trigger=0.525), PadState(trigger=1.0))
    assert not off.press and off.press_share == 1.0
    assert half.press and half.press_share == pytest.approx(0.5)
    assert full.press and full.press_share == pytest.approx(1.0)
    (mouse,) = read(PadState(trigger=0.3), press=True)
    assert mouse.press and mouse.press_share == 1.0


def test_buttons_begin_and_hold():
    first, then = read(
        PadState(pressed=("A", "Y")), PadState(held=frozenset({"A", "Pad up", "Left shoulder"}))
    )
    assert first.freeze and first.sweep and not first.undo and first.push_mm == 0.0
    assert not then.freeze and then.push_mm == pytest.approx(0.3) and then.rotate_deg == pytest.approx(0.9)
    (down,) = read(
        PadState(held=frozenset({"Pad down", "Right shoulder"}), pressed=("B", "X", "Start", "Pad down"))
    )
    assert down.push_mm == pytest.approx(-0.3) and down.rotate_deg == pytest.approx(-0.9)
    assert down.undo and down.bookmark and down.reset


def test_connecting_and_disconnecting_is_reported_once():
    there = PadState()
    said = [controls.message for controls in read(None, None, there, there, None, None, there)]
    assert [text.split(":")[0] for text in said] == [
        "No gamepad connected",
        "",
        "Gamepad ready",
        "",
        "Gamepad disconnected",
        "",
        "Gamepad ready",
    ]
    assert read(there)[0].message == "Gamepad ready"


def test_buttons_are_numbered_as_sdl_has_them():
    pygame = pytest.importorskip("pygame")
    theirs = (
        "A",
        "B",
        "X",
        "Y",
        "BACK",
        "GUIDE",
        "START",
        "LEFTSTICK",
        "RIGHTSTICK",
        "LEFTSHOULDER",
        "RIGHTSHOULDER",
    )
    theirs += ("DPAD_UP", "DPAD_DOWN", "DPAD_LEFT", "DPAD_RIGHT")
    assert [getattr(pygame, f"CONTROLLER_BUTTON_{name}") for name in theirs] == list(range(len(BUTTONS)))
    ours = [name.upper().replace(" ", "").replace("PAD", "DPAD_") for name in BUTTONS]
    assert ours == list(theirs)


def sdl() -> ctypes.CDLL:
    """The SDL that pygame has loaded."""
    maps = Path("/proc/self/maps").read_text().splitlines()
    library = ctypes.CDLL(next(line.split()[-1] for line in maps if "libSDL2-" in line))
    library.SDL_JoystickOpen.restype = ctypes.c_void_p
    for name in ("Axis", "Button"):
        getattr(library, f"SDL_JoystickSetVirtual{name}").argtypes = [
            ctypes.c_void_p,
            ctypes.c_int,
            ctypes.c_int16,
        ]
    return library


class Virtual:
    """SDL's virtual gamepad: six axes and fifteen buttons."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self.sdl, self.joystick = library, None

    def plug_in(self) -> None:
        index = self.sdl.SDL_JoystickAttachVirtual(1, 6, len(BUTTONS), 1)
        self.joystick = self.sdl.SDL_JoystickOpen(index)

    def unplug(self) -> None:
        self.sdl.SDL_JoystickDetachVirtual(0)

    def move(self, axis: int, value: int) -> None:
        self.sdl.SDL_JoystickSetVirtualAxis(self.joystick, axis, value)

    def set(self, button: str, down: bool) -> None:
        self.sdl.SDL_JoystickSetVirtualButton(self.joystick, BUTTONS.index(button), down)
        self.sdl.SDL_PumpEvents()


@pytest.fixture
def pads() -> Iterator[SdlPads]:
    pytest.importorskip("pygame")
    opened = SdlPads()
    yield opened
    from pygame import quit as close

    close()


@pytest.mark.skipif(sys.platform != "linux", reason="finds SDL by /proc")
def test_a_gamepad_is_read_through_sdl(pads):
    virtual = Virtual(sdl())
    assert pads.read() is None
    virtual.plug_in()
    # SDL's triggers go from one end of the axis to the other.
    for axis, value in ((0, 16384), (1, -32768), (2, -32767), (3, 32767), (4, 9000), (5, -32768)):
        virtual.move(axis, value)
    pads.read()
    state = pads.read()
    assert state.left == pytest.approx((0.5, 1.0), abs=1e-4) and state.right == pytest.approx((-1.0, -1.0))
    assert state.trigger == pytest.approx(0.0, abs=1e-4) and state.held == frozenset()
    virtual.move(5, 32767)
    for name in BUTTONS:
        virtual.set(name, True)
        state = pads.read()
        assert state.held == {name} and state.pressed == (name,) and state.trigger == pytest.approx(1.0)
        virtual.set(name, False)
        assert pads.read().held == frozenset()


@pytest.mark.skipif(sys.platform != "linux", reason="finds SDL by /proc")
def test_a_tap_between_two_frames_is_not_lost_and_a_gamepad_comes_back(pads):
    virtual = Virtual(sdl())
    for _ in range(2):
        virtual.plug_in()
        pads.read()
        virtual.set("B", True)
        virtual.set("B", False)
        state = pads.read()
        assert state.pressed == ("B",) and state.held == frozenset() and pads.read().pressed == ()
        virtual.unplug()
        assert pads.read() is None
