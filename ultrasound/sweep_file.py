"""Sweeps as IGSIO sequence metafiles (.igs.mha) of PLUS and 3D Slicer: a MetaImage whose header has poses and times."""

import os
import re
import reprlib
import secrets
import shutil
import tempfile
import zlib
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ultrasound.probe import Probe
from ultrasound.sweep import ORIENTATIONS, Sweep, SweepError, reoriented, transform_fields
from version import VERSION

HEADER_LIMIT = 64 << 20
# A higher level compresses speckle no better, and a sweep is written while it is recorded.
COMPRESSION_LEVEL = 1
PIXEL_LIMIT = (1 << 32) - 1  # PLUS counts a sweep's bytes in 32 bits.
FRAME_FIELD = re.compile(r"Seq_Frame([0-9]{4,9})_(.+)", re.DOTALL)
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
SUFFIX, LABELS_SUFFIX = ".igs.mha", "-marks.igs.mha"
# Fields of the header: the probe, and the version of Nephron.
PROBE_FIELD, VERSION_FIELD = "TransducerName", "NephronVersion"


def read_sweep(path: Path) -> Sweep:
    """Return a sequence metafile's images, in MF, and fields. Times and transforms are parsed on demand.

    Raises SweepError with the file's name for a file that cannot be read, is damaged, or is not an 8-bit B-mode sweep.
    """
    try:
        with path.open("rb") as file:
            return _read(file)
    except (OSError, SweepError) as error:
        raise SweepError(f"{path.name}: {error.strerror if isinstance(error, OSError) else error}") from error


def write_sweep(path: Path, sweep: Sweep) -> None:
    """Write a sweep; a sweep that was read keeps the lines of its header. The same sweep gives the same bytes.

    Raises SweepError for a sweep that does not fit into a file, and OSError; an existing file is then not changed.
    """
    with SweepWriter(path, sweep.fields) as writer:
        for image, fields in zip(sweep.images, sweep.frames, strict=True):
            writer.append(image, fields)


def read_ground_truth(sweep: Path) -> Sweep | None:
    """Return the labels recorded with a sweep, None where there are none. Raises SweepError."""
    path = sweep.with_name(sweep.name.removesuffix(SUFFIX) + LABELS_SUFFIX)
    return read_sweep(path) if sweep.name.endswith(SUFFIX) and path != sweep and path.is_file() else None


class SweepWriter:
    """Writes a sweep frame by frame, pixels to disk; ``close`` writes the file atomically. ``count`` is the number of frames so far.

    ``fields`` add to PLUS's own, or replace them where they are those of a sweep that was read. As a context manager it closes at the
    end, and leaves no file after an exception.
    """

    def __init__(self, path: Path, fields: dict[str, str]) -> None:
        self.path, self.count = path, 0
        self._header = dict(fields) if "ObjectType" in fields else NEW_HEADER | fields
        self._shape: tuple[int, ...] = ()
        self._lines, self._compress = bytearray(), zlib.compressobj(COMPRESSION_LEVEL)
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

        Raises SweepError for an image or text that does not fit into the file, which then continues without this frame.
        """
        if image.dtype != np.uint8 or image.ndim != 2 or image.shape != (self._shape or image.shape):
            found, expected = f"{image.dtype} {image.shape}", self._shape or "(rows, columns)"
            raise SweepError(f"frame {self.count}: image of {found}: expected uint8 {expected}")
        if (self.count + 1) * image.size > PIXEL_LIMIT:
            raise SweepError(f"frame {self.count}: more than {PIXEL_LIMIT} bytes of pixels")
        lines = b"".join(_line(f"Seq_Frame{self.count:04}_{name}", text) for name, text in fields.items())
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
            if any(self._shape):
                self._pixels.write(self._compress.flush())
            header = b"".join(_line(*each) for each in self._final_header().items())
            header += self._lines + b"ElementDataFile = LOCAL\n"
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

    def _final_header(self) -> dict[str, str]:
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
    """Writes STEM.igs.mha and STEM-marks.igs.mha into a folder, both or none. Reference is the patient (LPS, mm). Raises OSError."""

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
        """Add a frame: grey values and ``PixelLabel`` values (rows, columns), probe pose (4, 4), time. Raises OSError, SweepError."""
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


def _line(name: str, text: str) -> bytes:
    if "=" in name or name != name.strip() or not name or "\n" in name + text:
        raise SweepError(f"field {reprlib.repr(name + ' = ' + text)}: expected one line, no = in the name")
    try:
        return f"{name} = {text}\n".encode("latin-1")
    except UnicodeEncodeError as error:
        raise SweepError(f"field {reprlib.repr(name)}: a character beyond Latin-1") from error


def _read(file: BinaryIO) -> Sweep:
    fields, numbered = _read_header(file)
    columns, rows, count = _dimensions(fields)
    last = max(numbered, default=-1)
    if len(numbered) != count or last != count - 1:
        raise SweepError(f"DimSize has {count} frames, but {len(numbered)} have fields, the last is {last}")
    frames = [numbered[each] for each in range(count)]
    if columns * rows == 0:
        return Sweep(np.empty((count, 0, 0), np.uint8), frames, fields)
    for name, accepted in PIXEL_FORMAT.items():
        text = fields.get(name, "" if name in REQUIRED else accepted[0])
        if " ".join(text.split()) not in accepted:
            raise SweepError(f"{name} = {reprlib.repr(text)}: expected {' or '.join(accepted)}")
    orientation = fields["UltrasoundImageOrientation"].strip()
    pixels = np.frombuffer(_read_pixels(file, fields, columns * rows * count), np.uint8)
    if ORIENTATIONS[orientation] != "MF":
        fields["UltrasoundImageOrientation"] = "MF"
    return Sweep(reoriented(pixels.reshape(count, rows, columns), orientation), frames, fields)


def _read_header(file: BinaryIO) -> tuple[dict[str, str], dict[int, dict[str, str]]]:
    """Return the fields of the header and of each frame by number; leave the file at the pixels."""
    fields: dict[str, str] = {}
    frames: dict[int, dict[str, str]] = {}
    if b"".join(file.readline(HEADER_LIMIT).split()) != b"ObjectType=Image":
        raise SweepError(
            "is not a sweep; expected a tracked one (.igs.mha), which begins with ObjectType = Image"
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
        match = FRAME_FIELD.fullmatch(name)
        if name.startswith("Seq_Frame") and not match:
            raise SweepError(f"field {reprlib.repr(name)}: expected Seq_Frame0000_Name")
        into, key = (frames.setdefault(int(match[1]), {}), match[2]) if match else (fields, name)
        if key in into:
            raise SweepError(f"field {reprlib.repr(name)}: found twice")
        into[key] = text


def _dimensions(fields: dict[str, str]) -> tuple[int, int, int]:
    text = fields.get("DimSize", "")
    if not re.fullmatch(r"\s*[0-9]{1,9}\s+[0-9]{1,9}\s+[0-9]{1,9}\s*", text):
        raise SweepError(f"DimSize = {reprlib.repr(text)}: expected columns rows frames")
    columns, rows, count = map(int, text.split())
    if not count or columns * rows * count > PIXEL_LIMIT:
        raise SweepError(f"DimSize = {reprlib.repr(text)}: expected 1 frame to {PIXEL_LIMIT} bytes of them")
    return columns, rows, count


def _read_pixels(file: BinaryIO, fields: dict[str, str], size: int) -> bytes:
    found = os.fstat(file.fileno()).st_size - file.tell()
    if fields.get("CompressedData", "").strip() != "True":
        if found != size:
            raise SweepError(f"{found} bytes of pixels: expected {size}")
        return file.read(size)
    text = fields.get("CompressedDataSize", "")
    # Deflate adds at most five bytes in some thousands.
    if text.strip() != str(found) or found > size + size // 1000 + 1024:
        raise SweepError(
            f"CompressedDataSize = {reprlib.repr(text)}, but {found} bytes were found for {size}"
        )
    decoder = zlib.decompressobj()
    try:
        pixels = decoder.decompress(file.read(found), size + 1)
    except zlib.error as error:
        raise SweepError(f"the pixels are not zlib data: {error}") from error
    if len(pixels) != size or not decoder.eof or decoder.unused_data:
        raise SweepError(f"{len(pixels)} bytes of pixels or more in the zlib data: expected {size}")
    return pixels
