"""Gamepad input, read by pygame's SDL; it fills the same controls as mouse and keys."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass

from render.keys import BUTTONS, TILT_DEG_S, begin, hold
from render.viewer import Controls

SLIDE_MM_S = 40.0
# Dead zones: sticks and triggers at rest are not exactly at 0. A power law makes a stick fine near its
# centre.
DEAD_STICK, DEAD_TRIGGER = 0.15, 0.05
STICK_POWER = 2.0
# SDL's game controllers of any make: axes of the sticks (down is positive) and of the right trigger.
LEFT_X, LEFT_Y, RIGHT_X, RIGHT_Y, RIGHT_TRIGGER = 0, 1, 2, 3, 5
FULL = 32767


@dataclass(frozen=True)
class PadState:
    """Sticks (right and up are positive) from -1 to 1, the right trigger from 0 to 1, buttons by their
    names.
    """

    left: tuple[float, float] = (0.0, 0.0)
    right: tuple[float, float] = (0.0, 0.0)
    trigger: float = 0.0
    held: frozenset[str] = frozenset()
    """Down now."""
    pressed: tuple[str, ...] = ()
    """Went down since the last read, even if released again."""


class Gamepad:
    """Left stick: slide; right stick: rock and tilt; right trigger: press; ``buttons`` are action ->
    button.
    """

    def __init__(self, pads: SdlPads, buttons: Mapping[str, str]) -> None:
        self._pads, self._buttons = pads, buttons
        self._connected: bool | None = None

    def read(self, controls: Controls, seconds: float) -> None:
        """Add the input of the last seconds to the controls."""
        state = self._pads.read()
        connected = state is not None
        if connected != self._connected:
            lost = "No gamepad connected" if self._connected is None else "Gamepad disconnected"
            controls.message = "Gamepad ready" if connected else f"{lost}: use mouse and keys"
            self._connected = connected
        if state is None:
            return
        x, y = shaped(*state.left)
        controls.slide_mm = (SLIDE_MM_S * seconds * x, SLIDE_MM_S * seconds * y)
        x, y = shaped(*state.right)
        controls.rock_deg -= TILT_DEG_S * seconds * x
        controls.tilt_deg += TILT_DEG_S * seconds * y
        if state.trigger > DEAD_TRIGGER and not controls.press:
            controls.press, controls.press_share = True, _beyond(state.trigger, DEAD_TRIGGER)
        for action, button in self._buttons.items():
            if button in state.pressed:
                begin(action, controls)
            if button in state.held:
                hold(action, controls, seconds)


def shaped(x: float, y: float) -> tuple[float, float]:
    """A stick's deflection without its dead zone, fine near the centre, of length 1 at most, in the same
    direction.
    """
    length = math.hypot(x, y)
    if length <= DEAD_STICK:
        return 0.0, 0.0
    share = _beyond(length, DEAD_STICK) ** STICK_POWER / length
    return share * x, share * y


def _beyond(value: float, dead: float) -> float:
    return (min(value, 1.0) - dead) / (1.0 - dead)


class SdlPads:
    """The first gamepad with a layout known to SDL."""

    def __init__(self) -> None:
        # GGUI has the window: SDL gets a dummy display, which never has the focus.
        os.environ.update(
            SDL_VIDEODRIVER="dummy", SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS="1", PYGAME_HIDE_SUPPORT_PROMPT="1"
        )
        import pygame
        from pygame._sdl2 import controller

        pygame.display.init()
        controller.init()
        self._pygame, self._controller = pygame, controller
        self._pad: controller.Controller | None = None

    def read(self) -> PadState | None:
        """The state of the connected gamepad, None where there is none."""
        events = self._pygame.event.get()
        if self._pad is not None and not self._pad.attached():
            self._pad = None
        if self._pad is None:
            known = filter(self._controller.is_controller, range(self._controller.get_count()))
            first = next(known, None)
            self._pad = None if first is None else self._controller.Controller(first)
        if self._pad is None:
            return None
        axes = [max(-1.0, self._pad.get_axis(axis) / FULL) for axis in range(RIGHT_TRIGGER + 1)]
        # Only a gamepad that is open sends events.
        down = [event.button for event in events if event.type == self._pygame.CONTROLLERBUTTONDOWN]
        return PadState(
            (axes[LEFT_X], -axes[LEFT_Y]),
            (axes[RIGHT_X], -axes[RIGHT_Y]),
            axes[RIGHT_TRIGGER],
            frozenset(name for number, name in enumerate(BUTTONS) if self._pad.get_button(number)),
            tuple(BUTTONS[number] for number in down if number < len(BUTTONS)),
        )
