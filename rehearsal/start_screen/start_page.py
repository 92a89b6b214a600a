"""The loop of the start screen, and what its pages have in common."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, Union

import numpy as np

from render.start_screen import TOWARDS, DrawnScreen
from render.viewer import KeyOrClick
from render.window_layout import WindowLayout

# A page is drawn so often.
REFRESH_S = 0.05
BACK = "back"


@dataclass(frozen=True)
class StartChoice:
    """What to rehearse: a scene, or a session of it from a second on."""

    scene: Path
    replay: Path | None = None
    at_s: float = 0.0


class StartPage(Protocol):
    """A page; it ends with ``close``, after which it may come again with ``open``."""

    keys: dict[str, str]
    """The action of each key, besides arrows, Return, and Esc, which is BACK."""

    @property
    def first(self) -> str:
        """The action that is selected at first, and when this changes."""

    def open(self) -> None:
        """The page is shown from now on."""

    def update(self) -> "Outcome":
        """Have what tasks have done until now; return as ``act``."""

    def drawn(self, layout: WindowLayout, selected: str) -> DrawnScreen:
        """The page with an action that is selected."""

    def act(self, action: str) -> "Outcome":
        """Do what the user asks: the page to show then, a choice, or None to quit."""

    def close(self) -> None:
        """End what the page has begun."""


Outcome = Union["StartPage", StartChoice, None]


class StartViewer(Protocol):
    """What the start screen asks of a window."""

    layout: WindowLayout

    @property
    def running(self) -> bool:
        """Whether the window is open."""

    def show_image(self, image: np.ndarray) -> None:
        """Show an image over the whole window, uint8 (height, width, 3)."""

    def presses(self) -> list[KeyOrClick]:
        """The keys and clicks since the last call."""


class StartScreen:
    """The pages in a window, from one to the next, until the user chooses."""

    def __init__(self, viewer: StartViewer, page: StartPage) -> None:
        self._viewer, self._page = viewer, page
        self._selected = self._first = page.first

    def choice(self) -> StartChoice | None:
        """What the user chooses; None where the window is closed, or Esc quits."""
        self._page.open()
        try:
            while self._viewer.running:
                for step in (self._updated, self._used):
                    outcome = step()
                    if outcome is None or isinstance(outcome, StartChoice):
                        return outcome
                    self._show(outcome)
                time.sleep(REFRESH_S)
        finally:
            self._page.close()
        return None

    def _show(self, page: StartPage) -> None:
        if page is not self._page:
            self._page.close()
            self._page = page
            page.open()
            self._selected = self._first = page.first

    def _updated(self) -> Outcome:
        return self._page.update()

    def _used(self) -> Outcome:
        """Draw the page, and do what the user asks, up to what leads to another page."""
        page = self._page
        if page.first != self._first:
            self._selected = self._first = page.first
        screen = page.drawn(self._viewer.layout, self._selected)
        if self._selected not in screen.boxes:
            self._selected = next(iter(screen.boxes), "")
            screen = page.drawn(self._viewer.layout, self._selected)
        self._viewer.show_image(screen.image)
        for press in self._viewer.presses():
            if press.key in TOWARDS and self._selected:
                self._selected = screen.neighbour(self._selected, press.key)
            elif action := self._action(press, screen):
                self._selected = action if action in screen.boxes else self._selected
                if (outcome := page.act(action)) is not page:
                    return outcome
        return page

    def _action(self, press: KeyOrClick, screen: DrawnScreen) -> str:
        if press.place is not None:
            return screen.action_at(*press.place)
        if press.key == "Return":
            return self._selected
        action = BACK if press.key == "Esc" else self._page.keys.get(press.key, "")
        return action if action in screen.boxes or action == BACK else ""
