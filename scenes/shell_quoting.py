"""Command lines that the user may paste into a shell."""

import shlex
import subprocess
import sys
from pathlib import PurePath


def pasted(*words: str | PurePath) -> str:
    """A command line of app.py with these words, quoted where this system's shell needs it."""
    line = ["python", "app.py", *map(str, words)]
    return subprocess.list2cmdline(line) if sys.platform == "win32" else shlex.join(line)
