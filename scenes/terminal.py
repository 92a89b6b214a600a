"""Terminal output: progress bars, the current step of a long task, command lines to paste."""

import re
import shlex
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import PurePath
from typing import Any

from tqdm import tqdm

# Iterates over things and shows the progress under a title.
Progress = Callable[[Iterable[Any], str], Iterable[Any]]
# Called with a message when the next step of a task begins.
ReportProgress = Callable[[str], None]
REFRESH_S = 0.5
# How Python has a byte of a path that is not UTF-8.
NOT_UTF_8 = re.compile("[\udc80-\udcff]")


def silent(things: Iterable[Any], title: str) -> Iterable[Any]:
    """Iterate without a progress bar."""
    return things


def bar(things: Iterable[Any], title: str) -> Iterable[Any]:
    """Iterate with a progress bar on stderr, if stderr is a terminal."""
    return tqdm(things, desc=f"{title:10}", leave=False, disable=None)


def no_progress(message: str) -> None:
    """Ignore the message."""


@contextmanager
def stages() -> Iterator[ReportProgress]:
    """Show the current message and the elapsed time in one line on stderr, if stderr is a terminal."""
    ended = threading.Event()
    with tqdm(bar_format="{desc} ({elapsed})", leave=False, disable=None) as line:

        def refresh() -> None:
            while not ended.wait(REFRESH_S):
                line.refresh()

        clock = threading.Thread(target=refresh, daemon=True)
        clock.start()
        try:
            yield line.set_description_str
        finally:
            ended.set()
            clock.join()


def shell_command(*words: str | PurePath) -> str:
    """A command line of app.py with these words, quoted for this system's shell."""
    line = ["python", "app.py", *map(str, words)]
    return subprocess.list2cmdline(line) if sys.platform == "win32" else " ".join(map(_quoted, line))


def _quoted(word: str) -> str:
    """A word for a POSIX shell; bytes that are not UTF-8 become $'\\xe9', which bash and zsh read."""
    return NOT_UTF_8.sub(lambda byte: f"'$'\\x{ord(byte[0]) - 0xDC00:02x}''", shlex.quote(word))
