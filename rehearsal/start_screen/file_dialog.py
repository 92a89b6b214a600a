"""A dialogue of the operating system to choose a file or a folder, in a process of its own.

On Windows and macOS it is that of Tk, which shows the system's own; on Linux that of the desktop, zenity or
kdialog, and where neither is installed Tk's.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

# Prints what was chosen; nothing where the dialogue was cancelled.
TK_DIALOG = """\
import sys, tkinter
from tkinter import filedialog
title, chooses_folder = sys.argv[1], sys.argv[2] == "folder"
root = tkinter.Tk()
root.withdraw()
root.attributes("-topmost", True)
ask = filedialog.askdirectory if chooses_folder else filedialog.askopenfilename
chosen = ask(title=title, parent=root)
sys.stdout.buffer.write(str(chosen or "").encode("utf-8", "surrogateescape"))
"""
NO_DIALOG = {
    "linux": "No file dialogue is installed: install the package zenity, kdialog or python3-tk",
    "darwin": "This Python has no Tk for the file dialogue: install it (Homebrew: brew install python-tk)",
    "win32": "This Python has no Tk for the file dialogue: run its installer again and choose tcl/tk",
}
NOT_OPENED = "The file dialogue did not open; type: python app.py import CT LABELS --out FOLDER"


def dialog_command(title: str, chooses_folder: bool) -> list[str] | None:
    """The command line that shows a dialogue and prints the path chosen; None where there is none."""
    if sys.platform not in ("win32", "darwin"):
        if shutil.which("zenity"):
            return ["zenity", "--file-selection", f"--title={title}", *["--directory"] * chooses_folder]
        if shutil.which("kdialog"):
            kind = "--getexistingdirectory" if chooses_folder else "--getopenfilename"
            return ["kdialog", "--title", title, kind, os.getcwd()]
    if find_spec("tkinter") is None or find_spec("_tkinter") is None:
        return None
    return [sys.executable, "-c", TK_DIALOG, title, "folder" if chooses_folder else "file"]


def no_dialog_text() -> str:
    """What to install where there is no dialogue."""
    return NO_DIALOG.get(sys.platform, NO_DIALOG["linux"])


class FileDialog:
    """An open dialogue. Once ``is_done``, ``path`` is what was chosen, None where it was cancelled, and
    ``fault`` says why there was no dialogue, empty where there was one.
    """

    def __init__(self, command: Sequence[str]) -> None:
        self.path: Path | None = None
        self.fault, self.is_done = "", False
        try:
            self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE
            )
        except OSError as error:
            self.is_done, self.fault = True, f"{NOT_OPENED} ({error.strerror})"

    def update(self) -> None:
        """Look whether the user has chosen."""
        if self.is_done or (status := self._process.poll()) is None:
            return
        output, errors = self._process.communicate()
        if chosen := output.rstrip(b"\r\n"):
            self.path = Path(os.fsdecode(chosen))
        # zenity and kdialog end with 1 where the user cancels, and so does Python where Tk has failed.
        has_failed = status not in (0, 1) or b"Traceback" in errors
        self.fault = NOT_OPENED if has_failed and not chosen else ""
        self.is_done = True

    def stop(self) -> None:
        """Close the dialogue, if it is open."""
        if not self.is_done:
            self._process.terminate()
            self._process.communicate()
            self.is_done = True
