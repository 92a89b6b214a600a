"""Arrays that are computed once from the same inputs and then read from files, so that a rehearsal starts
sooner.

A file's name is a hash of the inputs, of the sources and of the libraries: it contains arrays alone, and no
name of a patient or a file.
"""

import functools
import hashlib
import os
import secrets
import sys
import zipfile
import zlib
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import TypeAlias

import numpy as np
import trimesh

Arrays: TypeAlias = tuple[np.ndarray, ...]
# Where the files are, readable to their owner alone; None keeps nothing.
FOLDER: Path | None = Path(__file__).parents[1] / ".cache" / "arrays"
# What is computed may call anything in these.
SOURCES = tuple(Path(__file__).parents[1] / name for name in ("sim", "scenes", "ultrasound", "rehearsal"))
# The files used least recently are removed beyond this size. The embedded patient has 60 MB.
MOST_BYTES = 256 << 20
LIBRARIES = " ".join([sys.version, *map(version, ("numpy", "scipy", "libigl", "trimesh", "taichi"))])
DAMAGED = (OSError, ValueError, EOFError, KeyError, NotImplementedError, zipfile.BadZipFile, zlib.error)


def stored(compute: Callable[..., Arrays], *arguments: object, backend: str = "") -> Arrays:
    """The arrays ``compute(*arguments)``, from a file where there is one: the same bits, in C order.

    ``arguments`` are arrays, closed surfaces, numbers, texts; ``backend`` names Taichi's, where the bits
    depend on it. A file that is damaged or cannot be written is no error. Raises TypeError for other
    arguments, and what ``compute`` raises.
    """
    if FOLDER is None:
        return _in_order(compute(*arguments))
    file = FOLDER / f"{_key(compute, arguments, backend)}.npz"
    with suppress(*DAMAGED):
        cached = _read(file)
        os.utime(file)
        return cached
    arrays = _in_order(compute(*arguments))
    # Larger ones would displace all others.
    if sum(array.nbytes for array in arrays) < MOST_BYTES // 2:
        with suppress(OSError):
            _write(file, arrays)
    return arrays


def _in_order(arrays: Arrays) -> Arrays:
    return tuple(np.asarray(array, order="C") for array in arrays)


def _key(compute: Callable[..., Arrays], arguments: tuple[object, ...], backend: str) -> str:
    digest = hashlib.sha256(f"{compute.__module__} {compute.__qualname__} {backend} {LIBRARIES}".encode())
    digest.update(_sources(SOURCES))
    for argument in arguments:
        parts = (argument.vertices, argument.faces) if isinstance(argument, trimesh.Trimesh) else (argument,)
        for part in parts:
            _add(digest, part)
    return digest.hexdigest()[:32]


def _add(digest: "hashlib._Hash", value: object) -> None:
    if isinstance(value, np.ndarray):
        digest.update(f"{value.dtype.str}{value.shape}".encode())
        digest.update(np.ascontiguousarray(value).tobytes())
    elif isinstance(value, int | float | str | np.number | None):
        digest.update(f"{type(value).__name__} {value!r};".encode())
    else:
        raise TypeError(f"{type(value).__name__}: expected an array, a surface, a number or a text")


@functools.cache
def _sources(folders: tuple[Path, ...]) -> bytes:
    """A hash of all sources and tables of folders, so that arrays of another version are not read."""
    files = sorted(file for folder in folders for kind in ("*.py", "*.toml") for file in folder.rglob(kind))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).digest()


def _read(file: Path) -> Arrays:
    with np.load(file, allow_pickle=False) as archive:
        return tuple(archive[f"arr_{n}"] for n in range(len(archive.files)))


def _write(file: Path, arrays: Arrays) -> None:
    """Write a file that appears complete, or not at all. Raises OSError."""
    file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    partial = file.with_name(f"{secrets.token_hex(4)}.partial")
    try:
        with partial.open("xb") as opened:
            np.savez(opened, *arrays)  # type: ignore[arg-type]
        partial.replace(file)
    finally:
        partial.unlink(missing_ok=True)
    _remove_oldest(file.parent)


def _remove_oldest(folder: Path) -> None:
    """Remove the files used least recently beyond MOST_BYTES, also what runs that were killed have left.

    Raises OSError.
    """
    kept = 0
    for status, file in sorted(
        ((file.stat(), file) for file in folder.iterdir()), key=lambda entry: -entry[0].st_mtime
    ):
        kept += status.st_size
        if kept > MOST_BYTES:
            file.unlink(missing_ok=True)
