"""Find the DICOM files of a folder, a DICOMDIR or a zip archive. Nothing is extracted to disk."""

import io
import os
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import BinaryIO, cast

from errors import PatientError
from scenes.patients.readers.dicom_file import MAGIC, MAGIC_AT, looks_like_dicom, parse_dicom

MOST_FILES = 100_000
# One file of an archive may be an enhanced CT; an archive may have several series.
MOST_FILE_BYTES = 2 * 2**30
MOST_ARCHIVE_BYTES = 16 * 2**30


@dataclass(frozen=True)
class SourceFile:
    """A file on disk or in an archive."""

    name: str  # relative to the user's path
    open: Callable[[], BinaryIO]
    path: Path | None  # None in an archive


def find_dicom_files(path: Path) -> list[SourceFile]:
    """The files with a DICOM signature in a folder and its subfolders, a DICOMDIR, a zip archive or one file.

    Raises PatientError: too many or too large files, an archive that is damaged, encrypted or has paths outside itself, a
    DICOMDIR whose files are missing or elsewhere.
    """
    if path.is_dir():
        items = _of_folder(path)
    elif zipfile.is_zipfile(path):
        return _of_archive(path)
    elif path.name.upper() == "DICOMDIR":
        items = _of_directory_file(path)
    else:
        items = [_disk_file(path, path.name)]
    return [item for item in items if _begins_as_dicom(item)]


def _disk_file(path: Path, name: str) -> SourceFile:
    return SourceFile(name, lambda: cast(BinaryIO, path.open("rb")), path)


def _begins_as_dicom(item: SourceFile) -> bool:
    try:
        with item.open() as file:
            return looks_like_dicom(file.read(MAGIC_AT + len(MAGIC)))
    except OSError as error:
        raise PatientError(
            f"{item.name}: cannot be read ({error.strerror}); check the file's permissions"
        ) from error


def _of_folder(folder: Path) -> list[SourceFile]:
    items: list[SourceFile] = []
    for root, folders, files in os.walk(folder):
        folders.sort()
        for name in sorted(files):
            file = Path(root, name)
            if file.is_file():
                items.append(_disk_file(file, str(file.relative_to(folder))))
        if len(items) > MOST_FILES:
            raise PatientError(
                f"{folder}: more than {MOST_FILES} files; expected one patient's; give the folder of the CT itself"
            )
    return items


def _of_directory_file(path: Path) -> list[SourceFile]:
    """The images that a DICOMDIR lists, in its folder or below."""
    root = path.parent.resolve()
    items = []
    for parts in _listed(path):
        name = "/".join(parts)
        plain = all(part.isprintable() and 0 < len(part) < 256 and not _is_outside(part) for part in parts)
        file = (root / Path(*parts)).resolve() if plain else root
        if not plain or not file.is_relative_to(root):
            raise PatientError(
                f"{path}: lists {name!r}, which is outside its folder; expected files in its folder; "
                "give the folder of the slices instead"
            )
        if not file.is_file():
            raise PatientError(
                f"{path}: lists {name}, which is missing; expected the complete medium; copy it again, "
                "or give the folder of the slices instead"
            )
        items.append(_disk_file(file, name))
    if not items:
        raise PatientError(f"{path}: lists no image; give the folder of the slices instead")
    return items


def _listed(path: Path) -> list[list[str]]:
    """The ReferencedFileID of each image record."""
    try:
        with path.open("rb") as file:
            if not looks_like_dicom(file.read(MAGIC_AT + len(MAGIC))):
                raise ValueError
            file.seek(0)
            records = parse_dicom(file, str(path)).get("DirectoryRecordSequence") or []
        names = [record.get("ReferencedFileID") for record in records]
        return [[name] if isinstance(name, str) else [str(part) for part in name] for name in names if name]
    except PatientError:
        raise
    except Exception as error:  # a parser raises many kinds of error; each is the file's fault
        raise PatientError(
            f"{path}: cannot be read as a DICOMDIR; give the folder of the slices instead"
        ) from error


def _of_archive(path: Path) -> list[SourceFile]:
    try:
        archive = zipfile.ZipFile(path)
        entries = [entry for entry in archive.infolist() if not entry.is_dir()]
    except Exception as error:  # a parser raises many kinds of error; each is the archive's fault
        raise PatientError(f"{path}: a damaged archive ({error}); copy or export it again") from error
    if len(entries) > MOST_FILES:
        raise PatientError(f"{path}: has {len(entries)} files; expected at most {MOST_FILES}")
    for entry in entries:
        _check_entry(path, entry)
    found = [entry for entry in entries if looks_like_dicom(_extracted(path, archive, entry, 132))]
    total = sum(entry.file_size for entry in found)
    if total > MOST_ARCHIVE_BYTES:
        raise PatientError(
            f"{path}: extracts to {total / 2**30:.0f} GiB of DICOM; expected at most {MOST_ARCHIVE_BYTES / 2**30:.0f}; "
            "give an archive of the CT alone"
        )

    def opened(entry: zipfile.ZipInfo) -> BinaryIO:
        return io.BytesIO(_extracted(path, archive, entry, MOST_FILE_BYTES))

    return [SourceFile(entry.filename, partial(opened, entry), None) for entry in found]


def _check_entry(path: Path, entry: zipfile.ZipInfo) -> None:
    name = entry.filename
    if _is_outside(name):
        raise PatientError(
            f"{path}: has an entry {name[:60]!r} with a path outside the archive; expected a plain archive of DICOM files; "
            "do not trust it"
        )
    if entry.flag_bits & 1:
        raise PatientError(f"{path}: {name[:60]} is encrypted; extract the archive and give the folder")
    if entry.file_size > MOST_FILE_BYTES:
        raise PatientError(
            f"{path}: {name[:60]} extracts to {entry.file_size / 2**30:.0f} GiB; expected at most "
            f"{MOST_FILE_BYTES / 2**30:.0f}; unpack the archive and give the folder of the CT"
        )


def _is_outside(name: str) -> bool:
    """Whether a path is absolute or contains "..", on any system."""
    kinds = PurePosixPath(name), PureWindowsPath(name)
    return any(p.is_absolute() or p.drive or p.root or ".." in p.parts for p in kinds)


def _extracted(path: Path, archive: zipfile.ZipFile, entry: zipfile.ZipInfo, most: int) -> bytes:
    try:
        with archive.open(entry) as file:
            return file.read(most)
    except Exception as error:  # a decompressor raises many kinds of error; each is the archive's fault
        raise PatientError(
            f"{path}: {entry.filename[:60]} cannot be extracted; the archive is damaged; copy it again"
        ) from error
