"""Terminal output: progress bars, the current step of a long task, command lines to paste."""

import shlex
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable
from pathlib import PurePath
from typing import Protocol, TypeVar

from tqdm import tqdm

Thing = TypeVar("Thing")
# Called with a message when the next step of a task begins.
ReportProgress = Callable[[str], None]
REFRESH_S = 0.5


class Progress(Protocol):
    """Iterates over things and shows the progress under a title."""

    def __call__(self, things: Iterable[Thing], title: str) -> Iterable[Thing]: ...


def silent(things: Iterable[Thing], title: str) -> Iterable[Thing]:
    """Iterate without a progress bar."""
    return things


def bar(things: Iterable[Thing], title: str) -> Iterable[Thing]:
    """Iterate with a progress bar on stderr, if stderr is a terminal."""
    return tqdm(things, desc=f"{title:10}", leave=False, disable=None)


def no_progress(message: str) -> None:
    """Ignore the message."""


class Stages:
    """Show the current message and the elapsed time in one line on stderr, if stderr is a terminal."""

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
    """A command line of app.py with these words, quoted for this system's shell."""
    line = ["python", "app.py", *map(str, words)]
    return subprocess.list2cmdline(line) if sys.platform == "win32" else shlex.join(line)
