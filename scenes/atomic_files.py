"""Files and folders that are there whole or not at all."""

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def check_writable(folder: Path) -> None:
    """Write a file into a folder, and remove it: rights alone do not say what a disk lets in. Raises OSError."""
    tried = folder / f".{secrets.token_hex(4)}.tried"
    try:
        tried.write_bytes(b"0")
    finally:
        tried.unlink(missing_ok=True)


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """A place beside a path to write its file or folder to; what ends in order takes the path's name, what does not is removed.

    A folder's place must be made, and the path be free or an empty folder. Raises OSError, which names the path.
    """
    partial = path.with_name(f".{secrets.token_hex(4)}.partial-{path.name}")
    try:
        yield partial
        if partial.is_dir() and path.exists():  # which Windows would not replace
            path.rmdir()
        os.replace(partial, path)
    except OSError as error:  # a full disk's error does not say which file
        raise OSError(error.errno, error.strerror or "cannot be written", str(path)) from error
    finally:
        if partial.is_dir():
            shutil.rmtree(partial, ignore_errors=True)
        else:
            partial.unlink(missing_ok=True)
