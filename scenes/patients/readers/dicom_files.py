"""Find the DICOM files of a folder, a DICOMDIR or a zip archive, and parse them with bounded memory.

Nothing is extracted to disk.
"""

import io
import logging
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, BinaryIO, cast

import pydicom
from pydicom import config
from pydicom.dataset import FileDataset
from pydicom.filereader import read_dataset
from pydicom.uid import DeflatedExplicitVRLittleEndian, ExplicitVRLittleEndian, ImplicitVRLittleEndian

from errors import PatientError, parsing
from scenes.folder_files import files_below, is_system_file

# Values are validated where they are used; pydicom's warnings and logs would print them, also identifiers of
# the patient.
config.settings.reading_validation_mode = config.IGNORE
logging.getLogger("pydicom").setLevel(logging.CRITICAL)

MAGIC_AT, MAGIC = 128, b"DICM"
ARCHIVE = b"PK\3\4"
START_BYTES = MAGIC_AT + len(MAGIC)
# The limit of a deflated data set, against decompression bombs.
MOST_INFLATED = 2 * 2**30
MOST_FILES = 100_000
# One file of an archive may be an enhanced CT; an archive may have several series.
MOST_FILE_BYTES = 2 * 2**30
MOST_ARCHIVE_BYTES = 16 * 2**30
DAMAGED = "copy or export it again"


@dataclass(frozen=True)
class SourceFile:
    """A file on disk or in an archive."""

    name: str  # relative to the user's path
    open: Callable[[], BinaryIO]
    path: Path | None  # None in an archive

    def parsed(self, **options: Any) -> FileDataset:
        """Its data set; ``options`` are pydicom.dcmread's. Raises PatientError."""
        with self.open() as file, parsing(f"{self.name}: a damaged DICOM file", DAMAGED):
            has_preamble = file.read(START_BYTES)[MAGIC_AT:] == MAGIC
            if has_preamble:
                _check_inflated(file, self.name)
            file.seek(0)
            data = pydicom.dcmread(file, force=not has_preamble, **options)
            if "TransferSyntaxUID" not in data.file_meta:
                implicit = data.original_encoding[0]
                data.file_meta.TransferSyntaxUID = (
                    ImplicitVRLittleEndian if implicit else ExplicitVRLittleEndian
                )
            return data

    def header(self, tags: list[str] | None) -> FileDataset:
        """The elements without pixels; tags None: all. Raises PatientError."""
        return self.parsed(stop_before_pixels=True, specific_tags=tags)


def _check_inflated(file: BinaryIO, name: str) -> None:
    """Raises PatientError where a deflated data set inflates to more than MOST_INFLATED.

    The meta header's length is not trusted.
    """
    meta = read_dataset(file, False, True, stop_when=lambda tag, vr, length: tag.group != 2)
    if meta.get("TransferSyntaxUID") != DeflatedExplicitVRLittleEndian:
        return
    inflater, size = zlib.decompressobj(-zlib.MAX_WBITS), 0
    while (chunk := file.read(1 << 16)) and not inflater.eof:
        while chunk:
            size += len(inflater.decompress(chunk, 1 << 22))
            chunk = inflater.unconsumed_tail
            if size > MOST_INFLATED:
                raise PatientError(
                    f"{name}: inflates to more than 2 GiB; expected one CT; export it uncompressed"
                )


def find_dicom_files(path: Path, unreadable: Callable[[OSError], object] | None = None) -> list[SourceFile]:
    """The files with a DICOM signature in a folder and its subfolders, a DICOMDIR, a zip archive or one file.

    ``unreadable`` is called for each subfolder that cannot be listed.

    Raises PatientError where files are too many or too large, an archive is damaged, encrypted or has paths
    outside itself, or a DICOMDIR's files are missing or elsewhere.
    """
    if path.is_dir():
        items = _of_folder(path, unreadable)
    elif zipfile.is_zipfile(path) or _begins_as_archive(path):
        return _of_archive(path)
    elif path.name.upper() == "DICOMDIR":
        items = _of_directory_file(path)
    else:
        items = [_disk_file(path, path.name)]
    return [item for item in items if _begins_as_dicom(item)]


def _begins_as_archive(path: Path) -> bool:
    """Whether a file begins as a zip archive, also one whose end is missing."""
    with path.open("rb") as file:
        return file.read(len(ARCHIVE)) == ARCHIVE


def _disk_file(path: Path, name: str) -> SourceFile:
    return SourceFile(name, lambda: cast(BinaryIO, path.open("rb")), path)


def _begins_as_dicom(item: SourceFile) -> bool:
    try:
        with item.open() as file:
            return _looks_like_dicom(file.read(START_BYTES))
    except OSError as error:
        raise PatientError(
            f"{item.name}: cannot be read ({error.strerror}); check the file's permissions"
        ) from error


def _looks_like_dicom(start: bytes) -> bool:
    """Whether a file's first bytes are DICOM: with a preamble, or without one (group 2 or 8, little
    endian).
    """
    return start[MAGIC_AT:] == MAGIC or (start[:2] in (b"\x08\x00", b"\x02\x00") and start[3:4] == b"\x00")


def _of_folder(folder: Path, unreadable: Callable[[OSError], object] | None) -> list[SourceFile]:
    items: list[SourceFile] = []
    for file in files_below(folder, unreadable):
        items.append(_disk_file(file, str(file.relative_to(folder))))
        if len(items) > MOST_FILES:
            raise PatientError(
                f"{folder}: more than {MOST_FILES} files; expected one patient's; give the folder of the CT "
                "itself"
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
    item = _disk_file(path, str(path))
    with parsing(f"{path}: cannot be read as a DICOMDIR", "give the folder of the slices instead"):
        if not _begins_as_dicom(item):
            raise ValueError
        records = item.parsed().get("DirectoryRecordSequence") or []
        names = [record.get("ReferencedFileID") for record in records]
        return [[name] if isinstance(name, str) else [str(part) for part in name] for name in names if name]


def _of_archive(path: Path) -> list[SourceFile]:
    with parsing(f"{path}: a damaged archive", DAMAGED):
        archive = zipfile.ZipFile(path)
        entries = [
            entry
            for entry in archive.infolist()
            if not (entry.is_dir() or is_system_file(PurePosixPath(entry.filename)))
        ]
    if len(entries) > MOST_FILES:
        raise PatientError(f"{path}: has {len(entries)} files; expected at most {MOST_FILES}")
    for entry in entries:
        _check_entry(path, entry)

    def extracted(entry: zipfile.ZipInfo, most: int = MOST_FILE_BYTES) -> BinaryIO:
        where = f"{path}: {entry.filename[:60]} cannot be extracted"
        with parsing(where, "the archive is damaged; copy it again"), archive.open(entry) as file:
            return io.BytesIO(file.read(most))

    dicom_entries = [entry for entry in entries if _looks_like_dicom(extracted(entry, START_BYTES).read())]
    total = sum(entry.file_size for entry in dicom_entries)
    if total > MOST_ARCHIVE_BYTES:
        raise PatientError(
            f"{path}: extracts to {total / 2**30:.0f} GiB of DICOM; expected at most "
            f"{MOST_ARCHIVE_BYTES / 2**30:.0f}; "
            "give an archive of the CT alone"
        )
    return [SourceFile(entry.filename, partial(extracted, entry), None) for entry in dicom_entries]


def _check_entry(path: Path, entry: zipfile.ZipInfo) -> None:
    name = entry.filename
    if _is_outside(name):
        raise PatientError(
            f"{path}: has an entry {name[:60]!r} with a path outside the archive; expected a plain archive "
            "of DICOM files; "
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
