"""Atomic writes: a file or folder appears complete, or not at all; and names of files for libraries that
crash on some.
"""

import glob
import os
import re
import secrets
import shutil
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil

from errors import PatientError

# The process that writes a temporary file or folder, in its name.
WRITER = re.compile(r"\.(\d+)-[0-9a-f]+\.partial-")
# Letters of a name that a temporary name repeats whole: with the writer they stay below what file systems
# allow.
SHORT = 24


@contextmanager
def plain_path(path: Path, *beside: Path) -> Iterator[str]:
    """A file's name for a library that ends the process where one is not UTF-8: the same, or that of a link
    to it.

    ``beside``: other files that the file names. A file that is written need not exist. Raises OSError.
    """
    try:
        str(path).encode()
    except UnicodeEncodeError:
        with tempfile.TemporaryDirectory(prefix="nephron-") as folder:
            link = Path(folder, f"file{path.suffix}")
            link.symlink_to(path.absolute())
            for other in beside:
                Path(folder, other.name).symlink_to(other.absolute())
            yield str(link)
    else:
        yield str(path)


def check_writable(folder: Path) -> None:
    """Write a file into a folder and remove it: permissions alone do not show a full or read-only disk.

    Raises OSError.
    """
    with tempfile.TemporaryFile(dir=folder, buffering=0) as file:
        file.write(b"0")


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a temporary path for a file or folder; without an error it is renamed to ``path``, else it is
    removed.

    The caller creates a folder itself; ``path`` must not exist, or be an empty folder. Raises OSError, which
    names the path.
    """
    partial = path.with_name(f".{os.getpid()}-{secrets.token_hex(4)}.partial-{_short(path.name)}")
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


def _short(name: str) -> str:
    """A name, or a checksum and the end of a long one: the suffix, by which libraries choose a format,
    stays.
    """
    return name if len(name) <= SHORT else f"{zlib.crc32(os.fsencode(name)):08x}{name[8 - SHORT :]}"


@contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """Yield an empty folder to write to; it becomes ``folder`` when all files are written.

    Raises PatientError.
    """
    check_folder(folder)
    for left in folder.parent.glob(f".*.partial-{glob.escape(_short(folder.name))}"):
        if not _is_being_written(left):
            shutil.rmtree(left, ignore_errors=True)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(folder) as partial:
            partial.mkdir()
            yield partial
    except OSError as error:
        check_folder(folder)  # another run may have made it meanwhile
        raise PatientError(f"{folder}: {error.strerror}; choose a folder that can be written") from error


def _is_being_written(partial: Path) -> bool:
    """Whether a temporary folder is of a run that goes on, on this machine; not of one that was killed."""
    writer = WRITER.match(partial.name)
    return writer is not None and psutil.pid_exists(int(writer[1]))


def check_folder(folder: Path) -> None:
    """Check that a folder of this name can be created and written to, before the work.

    Raises PatientError.
    """
    # Path.exists raises where a name is too long.
    if os.path.exists(folder) and (not folder.is_dir() or any(folder.iterdir())):
        raise PatientError(f"{folder}: exists and is not an empty folder; choose another folder or remove it")
    full = Path(os.path.abspath(folder))
    above = next(path for path in full.parents if os.path.exists(path))
    try:
        with tempfile.TemporaryDirectory(prefix=".", dir=above) as trial:
            made = Path(trial, full.relative_to(above))
            made.mkdir(parents=True)
            check_writable(made)
    except OSError as error:
        raise PatientError(
            f"{folder}: cannot be made in {above} ({error.strerror}); choose a folder that can be written"
        ) from None
