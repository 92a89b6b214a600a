"""The files of a folder, without those that operating systems put there by themselves."""

import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path, PurePath

# Of macOS (AppleDouble files begin with ._) and Windows; also in archives and on media that they wrote.
SYSTEM_NAMES = {
    *(".ds_store", "__macosx", ".trashes", ".spotlight-v100", ".fseventsd", ".temporaryitems"),
    *("thumbs.db", "ehthumbs.db", "desktop.ini", "$recycle.bin", "system volume information"),
    "lost+found",
}
APPLE_DOUBLE = "._"


def is_system_file(path: PurePath) -> bool:
    """Whether a file, or a folder of its path, is an operating system's own."""
    return any(part.startswith(APPLE_DOUBLE) or part.lower() in SYSTEM_NAMES for part in path.parts)


def without_system_files(paths: Iterable[Path]) -> tuple[Path, ...]:
    """The paths whose last part is no operating system's own: the shell's * gives these too."""
    return tuple(path for path in paths if not is_system_file(Path(path.name)))


def entries_of(folder: Path) -> list[Path]:
    """Files and folders in a folder, by name. Raises OSError."""
    return sorted(without_system_files(folder.iterdir()))


def files_below(folder: Path, unreadable: Callable[[OSError], object] | None = None) -> Iterator[Path]:
    """The files of a folder and its subfolders, by folder and name; ``unreadable`` is called for each that
    cannot be listed.
    """
    for root, folders, names in os.walk(folder, onerror=unreadable):
        folders[:] = sorted(name for name in folders if not is_system_file(Path(name)))
        for name in sorted(names):
            if not is_system_file(Path(name)) and (file := Path(root, name)).is_file():
                yield file
