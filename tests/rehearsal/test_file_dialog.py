"""The file dialogue: which one a system has, and what comes of it. No real one is opened here."""

import sys
import time
from pathlib import Path

import pytest

from rehearsal.start_screen import file_dialog
from rehearsal.start_screen.file_dialog import FileDialog, dialog_command, no_dialog_text

END_S = 20.0


def ended(dialog: FileDialog) -> FileDialog:
    """A dialogue when it is done."""
    end = time.monotonic() + END_S
    while not dialog.is_done and time.monotonic() < end:
        dialog.update()
        time.sleep(0.01)
    assert dialog.is_done
    return dialog


def program(code: str) -> list[str]:
    return [sys.executable, "-c", code]


def having(monkeypatch, platform: str, *programs: str, has_tk: bool = True) -> None:
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.setattr(file_dialog.shutil, "which", lambda name: name if name in programs else None)
    monkeypatch.setattr(file_dialog, "find_spec", lambda name: object() if has_tk else None)


@pytest.mark.parametrize("name", ["a b.nii.gz", "é.nrrd", "'; rm.mha"])
def test_the_chosen_path_comes_back_as_it_is(name):
    path = Path("/data") / name
    dialog = ended(
        FileDialog(program(f"import sys; sys.stdout.buffer.write({str(path)!r}.encode() + b'\\n')"))
    )
    assert dialog.path == path and dialog.fault == ""


@pytest.mark.parametrize("status", [0, 1])
def test_a_cancelled_dialogue_is_no_error(status):
    dialog = ended(FileDialog(program(f"raise SystemExit({status})")))
    assert dialog.path is None and dialog.fault == ""


def test_a_dialogue_that_fails_names_the_command():
    for command in (program("raise RuntimeError('no display')"), ["/no/such/program"]):
        dialog = ended(FileDialog(command))
        assert dialog.path is None and "python app.py import CT LABELS" in dialog.fault


def test_looking_does_not_wait_and_stopping_closes_it():
    dialog = FileDialog(program("import time; time.sleep(60)"))
    before = time.monotonic()
    dialog.update()
    assert time.monotonic() - before < 1.0 and not dialog.is_done
    dialog.stop()
    assert dialog.is_done and dialog.path is None and dialog.fault == ""


@pytest.mark.parametrize("chooses_folder", [False, True])
def test_linux_takes_the_desktops_own_first(monkeypatch, chooses_folder):
    having(monkeypatch, "linux", "zenity", "kdialog")
    zenity = dialog_command("The CT", chooses_folder)
    assert zenity[:2] == ["zenity", "--file-selection"] and ("--directory" in zenity) == chooses_folder
    having(monkeypatch, "linux", "kdialog")
    kdialog = dialog_command("The CT", chooses_folder)
    assert kdialog[0] == "kdialog" and ("--getexistingdirectory" in kdialog) == chooses_folder
    having(monkeypatch, "linux")
    assert dialog_command("The CT", chooses_folder)[0] == sys.executable


@pytest.mark.parametrize("platform", ["win32", "darwin"])
def test_windows_and_macos_take_tk(monkeypatch, platform):
    having(monkeypatch, platform, "zenity", "kdialog")
    assert dialog_command("The CT", False)[0] == sys.executable


@pytest.mark.parametrize("platform", ["linux", "win32", "darwin"])
def test_without_any_the_text_says_what_to_install(monkeypatch, platform):
    having(monkeypatch, platform, has_tk=False)
    assert dialog_command("The CT", True) is None
    assert "install" in no_dialog_text() or "installer" in no_dialog_text()


def test_the_program_for_tk_prints_what_was_chosen(tmp_path):
    # A Tk of our own, which answers at once.
    folder = tmp_path / "tkinter"
    folder.mkdir()
    (folder / "__init__.py").write_text(
        "class Tk:\n    def withdraw(self): ...\n    def attributes(self, *_): ...\n"
    )
    (folder / "filedialog.py").write_text(
        "def askopenfilename(title, parent): return '/a file of ' + title\n"
        "def askdirectory(title, parent): return ()\n"
    )
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n{file_dialog.TK_DIALOG}"
    chosen = ended(FileDialog([sys.executable, "-c", code, "the CT", "file"]))
    assert chosen.path == Path("/a file of the CT")
    cancelled = ended(FileDialog([sys.executable, "-c", code, "the CT", "folder"]))
    assert cancelled.path is None and cancelled.fault == ""
