"""What a volume file is, by how it begins: one under a wrong name is called what it is."""

import zlib
from pathlib import Path

from errors import PatientError
from scenes.volumes.itk_files import META, NRRD

START_BYTES = 352
GZIP = b"\x1f\x8b"
# Marks of formats and their places.
MARKS = (
    *(("NIfTI", 344, mark) for mark in (b"n+1\0", b"ni1\0")),
    *(("NIfTI", 4, mark) for mark in (b"n+2\0", b"ni2\0")),
    ("NRRD", 0, b"NRRD0"),
    ("DICOM", 128, b"DICM"),
    *(("MetaImage", 0, mark) for mark in (b"ObjectType", b"NDims", b"Comment =")),
)
# The endings of each format, the usual one first.
ENDINGS_OF = {"NIfTI": (".nii",), "NRRD": NRRD, "MetaImage": META, "DICOM": (".dcm",)}


def check_kind(path: Path) -> None:
    """Raises PatientError where a volume file is of another format than its name ends in, or compressed in
    another way, or a web page.

    Content of no known format is left to the reader of the name's format.
    """
    with path.open("rb") as file:
        start = file.read(START_BYTES)
    name = path.name.lower()
    is_compressed, is_named_gzip = start.startswith(GZIP), name.endswith(".gz")
    content = _decompressed(start) if is_compressed else start
    if content.lstrip()[:1] == b"<":
        raise PatientError(f"{path}: is a web page or XML; expected a volume; download it again")
    expected = next(kind for kind, ends in ENDINGS_OF.items() if name.removesuffix(".gz").endswith(ends))
    kind = next((kind for kind, at, mark in MARKS if content[at:].startswith(mark)), None)
    if not start or (kind in (None, expected) and is_compressed == is_named_gzip):
        return
    actual = kind or "no known volume"
    if is_compressed != is_named_gzip:
        actual += f", {'' if is_compressed else 'not '}compressed by gzip"
    if kind is None:
        advice = "copy or export it again"
    elif is_compressed and kind != "NIfTI":
        advice = f"decompress it, and rename it to end in {ENDINGS_OF[kind][0]}"
    else:
        advice = f"rename it to end in {ENDINGS_OF[kind][0]}{'.gz' * is_compressed}"
    raise PatientError(
        f"{path}: is {actual}; expected {expected}{' compressed by gzip' * is_named_gzip} by its name; "
        f"{advice}"
    )


def _decompressed(start: bytes) -> bytes:
    """The beginning of what gzip compressed; b"" where it is damaged."""
    try:
        return zlib.decompressobj(wbits=zlib.MAX_WBITS | 16).decompress(start, START_BYTES)
    except zlib.error:
        return b""
