"""Sweeps as NRRD sequences (.igs.nrrd), as PLUS writes them: fields ``name: value`` and ``name:=value``,
an empty line, the pixels.
"""

import gzip
import os
import reprlib
import zlib
from collections.abc import Iterator, Mapping
from typing import BinaryIO

import numpy as np

from ultrasound.sequence_fields import (
    HEADER_LIMIT,
    FrameFields,
    accept,
    field_line,
    in_order,
    numbers_of,
    put_field,
)
from ultrasound.sweep import ORIENTATIONS, Sweep, SweepError, reoriented

MAGIC = b"NRRD000"
# The names of a metafile for fields of PLUS that have others in NRRD: of the header, and of each frame.
ORIENTATION = "ultrasound image orientation"
METAFILE_NAMES = {ORIENTATION: "UltrasoundImageOrientation", "ultrasound image type": "UltrasoundImageType"}
STATUS, METAFILE_STATUS = "Status", "ImageStatus"
# Fields of the format, which other formats have in their own way; PLUS writes the user's fields like these.
FORMAT_FIELDS = frozenset(
    "dimension, type, block size, blocksize, encoding, endian, content, min, max, old min, oldmin, "
    "old max, oldmax, data file, "
    "datafile, line skip, lineskip, byte skip, byteskip, number, sample units, sampleunits, sizes, "
    "spacings, thicknesses, axis mins, "
    "axismins, axis maxs, axismaxs, centers, centerings, labels, units, kinds, space, space "
    "dimension, space units, space origin, "
    "space directions, measurement frame".split(", ")
)
TYPES = ("uint8", "uchar", "unsigned char", "uint8_t")
ENCODINGS = ("raw", "gz", "gzip")
# Kinds of the axes, and what their sizes are.
KINDS = {
    "domain domain list": "columns rows frames",
    "domain domain time": "columns rows frames",
    "domain domain domain list": "columns rows 1 frames",
    "domain domain domain time": "columns rows 1 frames",
    "domain domain": "columns rows",  # of one frame
}
NEW_HEADER = """NRRD0004
# Complete NRRD file format specification at:
# http://teem.sourceforge.net/nrrd/format.html
type: uint8
dimension: 3
sizes: {columns} {rows} {count}
kinds: domain domain list
endian: little
encoding: gz
space dimension: 2
space directions: (1,0) (0,1) none
space origin: (0,0)
"""


def read_nrrd(file: BinaryIO) -> Sweep:
    """The sweep of an NRRD sequence: names as in a metafile, images in MF. Raises SweepError."""
    fields, own, numbered = _read_header(file)
    own = _renamed(own, METAFILE_NAMES)
    columns, rows, count = _sizes(fields)
    frames = [_renamed(frame, {STATUS: METAFILE_STATUS}) for frame in in_order(numbered, count, "sizes")]
    # PLUS writes an empty pixel a frame where there are only poses.
    if columns * rows == 0 or (columns * rows == 1 and METAFILE_NAMES[ORIENTATION] not in own):
        return Sweep(np.empty((count, 0, 0), np.uint8), frames, own)
    accept("type", fields.get("type", ""), TYPES)
    orientation = accept(ORIENTATION, own.get(METAFILE_NAMES[ORIENTATION], ""), tuple(ORIENTATIONS))
    pixels = np.frombuffer(_read_pixels(file, fields, columns * rows * count), np.uint8)
    if ORIENTATIONS[orientation] != "MF":
        own[METAFILE_NAMES[ORIENTATION]] = "MF"
    return Sweep(reoriented(pixels.reshape(count, rows, columns), orientation), frames, own)


def nrrd_header(own: Mapping[str, str], shape: tuple[int, int], count: int) -> bytes:
    """The lines of a header up to those of the ``count`` frames.

    ``own`` are fields that are not of a format; of the others only orientation and type of the image count.
    ``shape`` is rows and columns of an image, (0, 0) for poses alone.
    """
    rows, columns = shape if any(shape) else (1, 1)
    header = NEW_HEADER.format(columns=columns, rows=rows, count=count).encode()
    names = {theirs: ours for ours, theirs in METAFILE_NAMES.items()}
    lines = [
        field_line(names.get(name, name), ":=", text)
        for name, text in own.items()
        if any(shape) or name not in names
    ]
    return header + b"".join(lines)


def nrrd_frame_lines(number: int, fields: Mapping[str, str]) -> bytes:
    """The lines of a frame. Raises SweepError."""
    renamed = _renamed(fields, {METAFILE_STATUS: STATUS})
    return b"".join(field_line(f"Seq_Frame{number:04}_{name}", ":=", text) for name, text in renamed.items())


def _renamed(fields: Mapping[str, str], names: Mapping[str, str]) -> dict[str, str]:
    """The fields with other names, unless one has that name already."""
    return {
        name if names.get(name) in fields else names.get(name, name): text for name, text in fields.items()
    }


def _read_header(file: BinaryIO) -> tuple[dict[str, str], dict[str, str], FrameFields]:
    """The fields of the format, the others, and those of each frame by number; leave the file at the
    pixels.
    """
    fields: dict[str, str] = {}
    own: dict[str, str] = {}
    frames: FrameFields = {}
    for start, line in _lines(file):
        if line.startswith("#"):
            continue
        name, colon, text = line.partition(":")
        name = name.strip()
        if not colon or not name:
            raise SweepError(f"byte {start}: {reprlib.repr(line)}: expected name: value")
        if text.startswith("="):
            put_field(name, text[1:], own, frames)
        elif name.lower() in FORMAT_FIELDS:
            put_field(name.lower(), text.strip(), fields, {})
        else:
            put_field(name, text.strip(), own, frames)
    return fields, own, frames


def _lines(file: BinaryIO) -> Iterator[tuple[int, str]]:
    """Place and text of each line between the first and the empty one.

    Raises SweepError where the header has no end.
    """
    end = "\r\n" if file.readline(HEADER_LIMIT).endswith(b"\r\n") else "\n"
    while True:
        start = file.tell()
        line = file.readline(HEADER_LIMIT - start).decode("latin-1")
        if not line.endswith(end):
            raise SweepError(f"no empty line, which ends the header, in the first {start} bytes")
        if line == end:
            return
        yield start, line.removesuffix(end)


def _sizes(fields: dict[str, str]) -> tuple[int, int, int]:
    kinds = accept("kinds", fields.get("kinds", ""), tuple(KINDS))
    numbers = numbers_of("sizes", fields.get("sizes", ""), KINDS[kinds])
    if len(numbers) == 4 and numbers[2] not in (0, 1):
        raise SweepError(f"sizes = {reprlib.repr(fields['sizes'])}: expected images, not volumes")
    return numbers[0], numbers[1], 1 if len(numbers) == 2 else numbers[-1]


def _read_pixels(file: BinaryIO, fields: dict[str, str], size: int) -> bytes:
    encoding = accept("encoding", fields.get("encoding", ""), ENCODINGS)
    for name in ("data file", "datafile", "line skip", "lineskip", "byte skip", "byteskip"):
        if fields.get(name, "0").strip() != "0":
            raise SweepError(
                f"{name} = {reprlib.repr(fields[name])}: expected the pixels right after the header"
            )
    if encoding == "raw":
        remaining = os.fstat(file.fileno()).st_size - file.tell()
        if remaining != size:
            raise SweepError(f"{remaining} bytes of pixels: expected {size}")
        return file.read(size)
    try:
        with gzip.GzipFile(fileobj=file) as packed:
            pixels = packed.read(size + 1)
    except (EOFError, OSError, zlib.error) as error:
        raise SweepError(f"the pixels are not whole gzip data: {error}") from error
    if len(pixels) != size:
        raise SweepError(f"{len(pixels)} bytes of pixels or more in the gzip data: expected {size}")
    return pixels
