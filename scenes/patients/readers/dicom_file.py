"""Parse one DICOM data set with bounded memory; every damage becomes a PatientError."""

import logging
import warnings
import zlib
from typing import Any, BinaryIO

import pydicom
from pydicom import config
from pydicom.dataset import Dataset, FileDataset
from pydicom.uid import ExplicitVRLittleEndian, ImplicitVRLittleEndian

from errors import PatientError

# Values are validated where they are used; pydicom's warnings and logs would print them, also identifiers of the patient.
config.settings.reading_validation_mode = config.IGNORE
logging.getLogger("pydicom").setLevel(logging.CRITICAL)

MAGIC_AT, MAGIC = 128, b"DICM"
MEDIA_DIRECTORY = "1.2.840.10008.1.3.10"
# The transfer syntax of deflated data sets, and the limit against decompression bombs.
DEFLATED, MOST_INFLATED = b"1.2.840.10008.1.2.1.99", 2 * 2**30


def looks_like_dicom(start: bytes) -> bool:
    """Whether a file's first 132 bytes are DICOM: with a preamble, or without one (group 2 or 8, little endian)."""
    return start[MAGIC_AT:] == MAGIC or (start[:2] in (b"\x08\x00", b"\x02\x00") and start[3:4] == b"\x00")


def parse_dicom(file: BinaryIO, name: str, **options: Any) -> FileDataset:
    """A DICOM data set; ``options`` are pydicom.dcmread's. Raises PatientError."""
    try:
        start = file.read(4096)
        file.seek(0)
        if start[MAGIC_AT : MAGIC_AT + 4] == MAGIC:
            _check_inflated(file, name)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            data = pydicom.dcmread(file, force=start[MAGIC_AT : MAGIC_AT + 4] != MAGIC, **options)
            if "TransferSyntaxUID" not in data.file_meta:
                implicit = data.original_encoding[0]
                data.file_meta.TransferSyntaxUID = (
                    ImplicitVRLittleEndian if implicit else ExplicitVRLittleEndian
                )
            return data
    except PatientError:
        raise
    except Exception as error:  # a parser raises many kinds of error; each is the file's fault
        raise PatientError(
            f"{name}: a damaged DICOM file ({type(error).__name__}); copy or export it again"
        ) from error


def _check_inflated(file: BinaryIO, name: str) -> None:
    """Raises PatientError where a deflated data set inflates to more than MOST_INFLATED. The meta header's length is not trusted."""
    at, deflated = MAGIC_AT + 4, False
    while True:
        file.seek(at)
        head = file.read(12)
        if len(head) < 8 or head[:2] != b"\x02\x00":
            break
        long = head[4:6] in (b"OB", b"OW", b"UN", b"UT", b"SQ", b"OD", b"OF", b"OL", b"OV", b"UC", b"UR")
        length = int.from_bytes(head[8:12] if long else head[6:8], "little")
        at += (12 if long else 8) + length
        if head[2:4] == b"\x10\x00":
            file.seek(at - length)
            deflated = file.read(min(length, 64)).strip(b"\0 ") == DEFLATED
    if not deflated:
        file.seek(0)
        return
    file.seek(at)
    inflater, size = zlib.decompressobj(-zlib.MAX_WBITS), 0
    while (chunk := file.read(1 << 16)) and not inflater.eof:
        while chunk:
            size += len(inflater.decompress(chunk, 1 << 22))
            chunk = inflater.unconsumed_tail
            if size > MOST_INFLATED:
                raise PatientError(
                    f"{name}: inflates to more than 2 GiB; expected one CT; export it uncompressed"
                )
    file.seek(0)


def text_of(name: str, header: Dataset, keyword: str) -> str:
    """A value as text, empty where it is missing. Raises PatientError where it is damaged."""
    try:
        found = header.get(keyword)
    except Exception as error:  # a parser raises many kinds of error; each is the file's fault
        raise PatientError(
            f"{name}: a damaged DICOM file ({keyword}: {type(error).__name__}); copy or export it again"
        ) from error
    return "" if found is None else str(found)


def is_directory(header: FileDataset) -> bool:
    """Whether a data set is a DICOMDIR."""
    try:
        return str(header.file_meta.get("MediaStorageSOPClassUID", "")) == MEDIA_DIRECTORY
    except Exception:  # a damaged meta header
        return False
