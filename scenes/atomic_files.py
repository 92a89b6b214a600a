"""Atomic writes: a file or folder appears complete, or not at all."""

import glob
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from errors import PatientError


def check_writable(folder: Path) -> None:
    """Write a file into a folder and remove it: permissions alone do not show a full or read-only disk. Raises OSError."""
    with tempfile.TemporaryFile(dir=folder, buffering=0) as file:
        file.write(b"0")


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a temporary path for a file or folder; without an error it is renamed to ``path``, else it is removed.

    The caller creates a folder itself; ``path`` must not exist, or be an empty folder. Raises OSError, which names the path.
    """
    partial = path.with_name(f".{secrets.token_hex(4)}.partial-{path.name}")
    try:
        yield partial
        if partial.is_dir() and path.exists():  # Windows does not replace a folder
            path.rmdir()
        os.replace(partial, path)
    except OSError as error:  # the error of a full disk names no file
        raise OSError(error.errno, error.strerror or "cannot be written", str(path)) from error
    finally:
        if partial.is_dir():
            shutil.rmtree(partial, ignore_errors=True)
        else:
            partial.unlink(missing_ok=True)


@contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """Yield an empty folder to write to; it becomes ``folder`` when all files are written. Raises PatientError."""
    check_folder(folder)
    for left in folder.parent.glob(f".*.partial-{glob.escape(folder.name)}"):  # by a run that was killed
        shutil.rmtree(left, ignore_errors=True)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(folder) as partial:
            partial.mkdir()
            yield partial
    except OSError as error:
        raise PatientError(f"{folder}: {error.strerror}; choose a folder that can be written") from error


def check_folder(folder: Path) -> None:
    """Check that a folder can be created, before the work. Raises PatientError."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise PatientError(f"{folder}: exists and is not an empty folder; choose another folder or remove it")
    # The files are written into a temporary folder beside it.
    above = next(path for path in folder.absolute().parents if path.exists())
    try:
        check_writable(above)
    except OSError as error:
        raise PatientError(
            f"{folder}: cannot be made in {above} ({error.strerror}); choose a folder that can be written"
        ) from None
