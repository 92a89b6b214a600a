"""Sweeps as sequence files of PLUS: metafiles (.igs.mha), also of 3D Slicer, a MetaImage whose header has
poses and times; and NRRD.
"""

import os
import reprlib
import secrets
import shutil
import tempfile
import zlib
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ultrasound.nrrd_sweep import MAGIC, nrrd_frame_lines, nrrd_header, read_nrrd
from ultrasound.probe import Probe
from ultrasound.sequence_fields import (
    HEADER_LIMIT,
    PIXEL_LIMIT,
    FrameFields,
    accept,
    field_line,
    in_order,
    numbers_of,
    put_field,
)
from ultrasound.sweep import ORIENTATIONS, Sweep, SweepError, reoriented, transform_fields
from version import VERSION

# A higher level compresses speckle no better, and a sweep is written while it is recorded.
COMPRESSION_LEVEL = 1
GZIP, ZLIB = 31, 15  # zlib's wbits of NRRD and of a metafile
# Accepted values of a sweep with pixels; the first is the default where the field is not required.
PIXEL_FORMAT = {
    "NDims": ("3",),
    "Kinds": ("domain domain list", "domain domain time"),
    "ElementType": ("MET_UCHAR",),
    "ElementNumberOfChannels": ("1",),
    "BinaryData": ("True",),
    "CompressedData": ("False", "True"),
    "UltrasoundImageOrientation": tuple(ORIENTATIONS),
}
REQUIRED = ("ElementType", "UltrasoundImageOrientation")
NEW_HEADER = {
    "ObjectType": "Image",
    "NDims": "3",
    "AnatomicalOrientation": "RAI",
    "BinaryData": "True",
    "BinaryDataByteOrderMSB": "False",
    "CenterOfRotation": "0 0 0",
    "CompressedData": "",
    "CompressedDataSize": "",
    "DimSize": "",
    "Kinds": "domain domain list",
    "ElementSpacing": "1 1 1",
    "ElementType": "MET_UCHAR",
    "Offset": "0 0 0",
    "TransformMatrix": "1 0 0 0 1 0 0 0 1",
    "UltrasoundImageOrientation": "MF",
    "UltrasoundImageType": "BRIGHTNESS",
}
NO_PIXELS = {
    "ElementType": "MET_OTHER",
    "CompressedData": "False",
    "UltrasoundImageOrientation": "XX",
    "UltrasoundImageType": "XX",
}
# Fields of a metafile that are its format's; NRRD has its own.
METAFILE_FIELDS = NEW_HEADER.keys() - {"UltrasoundImageOrientation", "UltrasoundImageType"} | {
    "ElementByteOrderMSB",
    "ElementNumberOfChannels",
    "HeaderSize",
}
SUFFIX, LABELS_SUFFIX = ".igs.mha", "-marks.igs.mha"
NRRD_SUFFIX = ".igs.nrrd"
# Fields of the header: the probe, and the version of Nephron.
PROBE_FIELD, VERSION_FIELD = "TransducerName", "NephronVersion"


def read_sweep(path: Path) -> Sweep:
    """A sequence file's images, in MF, and fields, with the names of a metafile. Times and transforms are
    parsed on demand.

    Raises SweepError with the file's name for a file that cannot be read, is damaged, or is not an 8-bit
    B-mode sweep.
    """
    try:
        with path.open("rb") as file:
            return _read(file)
    except (OSError, SweepError) as error:
        raise SweepError(f"{path.name}: {error.strerror if isinstance(error, OSError) else error}") from error


def write_sweep(path: Path, sweep: Sweep) -> None:
    """Write a sweep, as NRRD where the name ends in .nrrd, else as a metafile; a sweep that was read from one
    keeps the lines of its header. The same sweep gives the same bytes.

    Raises SweepError for a sweep that does not fit into a file, and OSError; an existing file is then not
    changed.
    """
    with SweepWriter(path, sweep.fields) as writer:
        for image, fields in zip(sweep.images, sweep.frames, strict=True):
            writer.append(image, fields)


def read_ground_truth(sweep: Path) -> Sweep | None:
    """The labels recorded with a sweep, None where there are none. Raises SweepError."""
    suffix = suffix_of(sweep)
    path = sweep.with_name(sweep.name.removesuffix(suffix) + LABELS_SUFFIX.removesuffix(SUFFIX) + suffix)
    return read_sweep(path) if sweep.name.endswith(suffix) and path.is_file() else None


def suffix_of(sweep: Path) -> str:
    """How the names of sweeps in the format of this one end."""
    return NRRD_SUFFIX if sweep.suffix.lower() == ".nrrd" else SUFFIX


class SweepWriter:
    """Writes a sweep frame by frame, pixels to disk; ``close`` writes the file atomically. ``count`` is the
    number of frames so far.

    The format is that of the name: NRRD (.nrrd), else a metafile. ``fields`` add to PLUS's own, or replace
    them where they are those of a sweep that was read. As a context manager it closes at the end, and leaves
    no file after an exception.
    """

    def __init__(self, path: Path, fields: dict[str, str]) -> None:
        self.path, self.count = path, 0
        self._is_nrrd = suffix_of(path) == NRRD_SUFFIX
        self._header = dict(fields) if "ObjectType" in fields else NEW_HEADER | fields
        self._shape: tuple[int, ...] = ()
        wbits = GZIP if self._is_nrrd else ZLIB
        self._lines, self._compress = bytearray(), zlib.compressobj(COMPRESSION_LEVEL, wbits=wbits)
        # Deleted by the system, even if the process is killed.
        self._pixels = tempfile.TemporaryFile(dir=path.parent)

    def __enter__(self) -> "SweepWriter":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()
        self._pixels.close()

    def append(self, image: np.ndarray, fields: dict[str, str]) -> None:
        """Add a frame: uint8 (rows, columns) in MF, (0, 0) in a sweep of poses alone, and its fields as text.

        Raises SweepError for an image or text that does not fit into the file, which then continues without
        this frame.
        """
        if image.dtype != np.uint8 or image.ndim != 2 or image.shape != (self._shape or image.shape):
            actual, expected = f"{image.dtype} {image.shape}", self._shape or "(rows, columns)"
            raise SweepError(f"frame {self.count}: image of {actual}: expected uint8 {expected}")
        if (self.count + 1) * image.size > PIXEL_LIMIT:
            raise SweepError(f"frame {self.count}: more than {PIXEL_LIMIT} bytes of pixels")
        lines = (nrrd_frame_lines if self._is_nrrd else _frame_lines)(self.count, fields)
        self._shape, self.count = image.shape, self.count + 1
        self._lines += lines
        if image.size:
            self._pixels.write(self._compress.compress(image.tobytes()))

    def close(self) -> None:
        """Write the file; SweepError without frames. A second call does nothing."""
        if self._pixels.closed:
            return
        with self._pixels:
            if not self.count:
                raise SweepError("a sweep without frames")
            if self._is_nrrd and not any(self._shape):
                self._pixels.write(self._compress.compress(bytes(self.count)))
            if self._is_nrrd or any(self._shape):
                self._pixels.write(self._compress.flush())
            header = self._nrrd_header() if self._is_nrrd else self._metafile_header()
            if len(header) > HEADER_LIMIT:
                raise SweepError(f"a header of {len(header)} bytes: at most {HEADER_LIMIT} can be read again")
            partial = self.path.with_name(f".{self.path.name}.partial-{secrets.token_hex(4)}")
            try:
                with partial.open("xb") as file:
                    file.write(header)
                    self._pixels.seek(0)
                    shutil.copyfileobj(self._pixels, file, 1 << 20)
                os.replace(partial, self.path)
            finally:
                partial.unlink(missing_ok=True)

    def _nrrd_header(self) -> bytes:
        rows, columns = self._shape
        own = {name: text for name, text in self._fields().items() if name not in METAFILE_FIELDS}
        return nrrd_header(own, (rows, columns), self.count) + self._lines + b"\n"

    def _metafile_header(self) -> bytes:
        lines = b"".join(field_line(name, " = ", text) for name, text in self._fields().items())
        return lines + self._lines + b"ElementDataFile = LOCAL\n"

    def _fields(self) -> dict[str, str]:
        """The fields of the header, with the names of a metafile."""
        rows, columns = self._shape
        header = dict(self._header)
        size = f"{columns} {rows} {self.count}"
        # An equal value keeps its text, with PLUS's spaces.
        if header.get("DimSize", "").split() != size.split():
            header["DimSize"] = size
        if not any(self._shape):
            header |= NO_PIXELS
            header.pop("CompressedDataSize", None)
            return header
        if ORIENTATIONS.get(header.get("UltrasoundImageOrientation", "").strip()) != "MF":
            header["UltrasoundImageOrientation"] = "MF"
        length = len(header.get("CompressedDataSize", ""))
        return header | {
            "CompressedData": "True",
            "CompressedDataSize": str(self._pixels.tell()).ljust(length),
        }


class LabelledSweep:
    """Writes STEM.igs.mha and STEM-marks.igs.mha into a folder, both or none.

    Reference is the patient (LPS, mm). Raises OSError.
    """

    def __init__(self, folder: Path, stem: str, probe: Probe) -> None:
        self.name = f"{stem}{SUFFIX}"
        fields = {PROBE_FIELD: probe.transducer_name, VERSION_FIELD: VERSION}
        self._images, self._labels = (
            SweepWriter(folder / f"{stem}{end}", fields) for end in (SUFFIX, LABELS_SUFFIX)
        )

    @property
    def count(self) -> int:
        """Number of frames so far."""
        return self._images.count

    def add(
        self,
        image: np.ndarray,
        labels: np.ndarray,
        probe: Probe,
        reference_from_probe: np.ndarray,
        time_s: float,
    ) -> None:
        """Add a frame: grey values and ``PixelLabel`` values (rows, columns), probe pose (4, 4), time.

        Raises OSError, SweepError.
        """
        pose = transform_fields("ProbeToReference", reference_from_probe)
        pose |= transform_fields("ImageToProbe", probe.image_to_probe(*image.shape))
        fields = pose | {"Timestamp": repr(float(time_s)), "ImageStatus": "OK"}
        self._images.append(image, fields)
        self._labels.append(labels, fields)

    def close(self) -> None:
        """Write both files. Raises OSError, SweepError."""
        self._labels.close()
        try:
            self._images.close()
        except (OSError, SweepError):
            self._labels.path.unlink(missing_ok=True)
            raise


def _frame_lines(number: int, fields: dict[str, str]) -> bytes:
    return b"".join(field_line(f"Seq_Frame{number:04}_{name}", " = ", text) for name, text in fields.items())


def _read(file: BinaryIO) -> Sweep:
    is_nrrd = file.read(len(MAGIC)) == MAGIC
    file.seek(0)
    if is_nrrd:
        return read_nrrd(file)
    fields, numbered = _read_header(file)
    columns, rows, count = numbers_of("DimSize", fields.get("DimSize", ""), "columns rows frames")
    frames = in_order(numbered, count, "DimSize")
    if columns * rows == 0:
        return Sweep(np.empty((count, 0, 0), np.uint8), frames, fields)
    for name, accepted in PIXEL_FORMAT.items():
        accept(name, fields.get(name, "" if name in REQUIRED else accepted[0]), accepted)
    orientation = fields["UltrasoundImageOrientation"].strip()
    pixels = np.frombuffer(_read_pixels(file, fields, columns * rows * count), np.uint8)
    if ORIENTATIONS[orientation] != "MF":
        fields["UltrasoundImageOrientation"] = "MF"
    return Sweep(reoriented(pixels.reshape(count, rows, columns), orientation), frames, fields)


def _read_header(file: BinaryIO) -> tuple[dict[str, str], FrameFields]:
    """The fields of the header and of each frame by number; leave the file at the pixels."""
    fields: dict[str, str] = {}
    frames: FrameFields = {}
    if b"".join(file.readline(HEADER_LIMIT).split()) != b"ObjectType=Image":
        raise SweepError(
            "is not a sweep; expected a tracked one (.igs.mha, .igs.nrrd), which begins with ObjectType = "
            "Image or NRRD"
        )
    file.seek(0)
    while True:
        start = file.tell()
        line = file.readline(HEADER_LIMIT - start).decode("latin-1")
        if not line:
            raise SweepError(f"no ElementDataFile = LOCAL in the first {start} bytes")
        name, equals, text = line.removesuffix("\n").partition("=")
        name, text = name.strip(), text.removeprefix(" ")
        if not equals or not name:
            raise SweepError(f"byte {start}: {reprlib.repr(line)}: expected Name = value")
        if name == "ElementDataFile":
            if text.strip() != "LOCAL":
                raise SweepError(f"ElementDataFile = {reprlib.repr(text)}: expected LOCAL")
            return fields, frames
        put_field(name, text, fields, frames)


def _read_pixels(file: BinaryIO, fields: dict[str, str], size: int) -> bytes:
    remaining = os.fstat(file.fileno()).st_size - file.tell()
    if fields.get("CompressedData", "").strip() != "True":
        if remaining != size:
            raise SweepError(f"{remaining} bytes of pixels: expected {size}")
        return file.read(size)
    text = fields.get("CompressedDataSize", "")
    # Deflate adds at most five bytes in some thousands.
    if text.strip() != str(remaining) or remaining > size + size // 1000 + 1024:
        raise SweepError(
            f"CompressedDataSize = {reprlib.repr(text)}, but {remaining} bytes were found for {size}"
        )
    decoder = zlib.decompressobj()
    try:
        pixels = decoder.decompress(file.read(remaining), size + 1)
    except zlib.error as error:
        raise SweepError(f"the pixels are not zlib data: {error}") from error
    if len(pixels) != size or not decoder.eof or decoder.unused_data:
        raise SweepError(f"{len(pixels)} bytes of pixels or more in the zlib data: expected {size}")
    return pixels
