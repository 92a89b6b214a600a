"""How far it is: a bar or a line for the terminal, or nothing."""

from __future__ import annotations

import shlex
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable
from pathlib import PurePath
from typing import Protocol, TypeVar

from tqdm import tqdm

Thing = TypeVar("Thing")
# Is told what is being made.
ReportProgress = Callable[[str], None]
REFRESH_S = 0.5


class Progress(Protocol):
    """Hands things on, one by one, and shows how far it is."""

    def __call__(self, things: Iterable[Thing], what: str) -> Iterable[Thing]: ...


def silent(things: Iterable[Thing], what: str) -> Iterable[Thing]:
    """No bar."""
    return things


def bar(things: Iterable[Thing], what: str) -> Iterable[Thing]:
    """A bar on the terminal's error stream; none where that is no terminal."""
    return tqdm(things, desc=f"{what:10}", leave=False, disable=None)


def no_progress(what: str) -> None:
    """No line."""


class Stages:
    """A line on the terminal's error stream that says what is being made, and for how long; none where that is no terminal."""

    def __init__(self) -> None:
        self._bar = tqdm(bar_format="{desc} ({elapsed})", leave=False, disable=None)
        self._ended = threading.Event()
        self._clock = threading.Thread(target=self._tick, daemon=True)

    def __enter__(self) -> ReportProgress:
        self._clock.start()
        return self._bar.set_description_str

    def __exit__(self, *reason: object) -> None:
        self._ended.set()
        self._clock.join()
        self._bar.close()

    def _tick(self) -> None:
        while not self._ended.wait(REFRESH_S):
            self._bar.refresh()


def shell_command(*words: str | PurePath) -> str:
    """A command line of app.py with these words, quoted where this system's shell needs it."""
    line = ["python", "app.py", *map(str, words)]
    return subprocess.list2cmdline(line) if sys.platform == "win32" else shlex.join(line)
