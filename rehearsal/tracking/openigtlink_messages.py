"""What goes over OpenIGTLink: the live picture and the probe's pose, named and placed as PLUS and 3D Slicer have them.

A transform is named by what it takes to what, ``ImageToProbe``; Image is in pixels (column, row, 0), all else in mm. Reference is
the patient, which on the wire is RAS, as Slicer's world is; in the program it is LPS.
"""

from dataclasses import dataclass
from typing import BinaryIO

import numpy as np
from pyigtl import ImageMessage, TransformMessage
from pyigtl.messages import MessageBase

# PLUS names an image by its own system and the one that its place is given in. Names have 20 letters at most.
IMAGE, IMAGE_TO_PROBE, PROBE = "Image_Reference", "ImageToProbe", "ProbeToReference"
# Its own inverse.
RAS_FROM_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
HEADER_VERSIONS = (1, 2)
# A transform is 48 bytes; with it come names and values that its sender thinks of.
TRANSFORM_BYTES, PIECE_BYTES = 1 << 16, 1 << 16


class WireError(ValueError):
    """Bytes that are no OpenIGTLink message."""


@dataclass(frozen=True)
class LivePicture:
    """What the scanner shows at a moment, and where.

    ``grey`` is uint8 (rows, columns) in orientation MF; ``image_to_probe`` and ``probe_in_patient`` are (4, 4) [mm, LPS], the probe's
    axes PLUS's. ``time_s`` is the rehearsal's time.
    """

    grey: np.ndarray
    image_to_probe: np.ndarray
    probe_in_patient: np.ndarray
    time_s: float


def packed(live: LivePicture) -> bytes:
    """A picture as three messages of one time: where its probe is, where its pixels are on the probe, and the pixels themselves."""
    probe = RAS_FROM_LPS @ live.probe_in_patient
    when = dict(timestamp=live.time_s)
    messages = (
        TransformMessage(probe, device_name=PROBE, **when),
        TransformMessage(live.image_to_probe, device_name=IMAGE_TO_PROBE, **when),
        # pyigtl takes (slices, rows, columns); of a picture without slices it sends the size turned about.
        ImageMessage(live.grey[None], probe @ live.image_to_probe, "ras", device_name=IMAGE, **when),
    )
    return b"".join(message.pack() for message in messages)


def read_message(stream: BinaryIO) -> tuple[str, np.ndarray | None]:
    """The name of the next message, and of a TRANSFORM its matrix (4, 4) as it is on the wire; None of all others.

    Raises WireError where it is no message, EOFError where the stream ends.
    """
    header = _read(stream, MessageBase.IGTL_HEADER_SIZE)
    try:
        fields = MessageBase.parse_header(header)
    except UnicodeDecodeError as error:
        raise WireError("a name that is no text") from error
    name, size = fields["device_name"], fields["body_size"]
    if fields["header_version"] not in HEADER_VERSIONS:
        raise WireError(f"header version {fields['header_version']}: expected one of {HEADER_VERSIONS}")
    if fields["message_type"] != "TRANSFORM":
        _skip(stream, size)
        return name, None
    if size > TRANSFORM_BYTES:
        raise WireError(f"a transform of {size} bytes: expected at most {TRANSFORM_BYTES}")
    return name, _matrix(fields, _read(stream, size))


def _matrix(fields: dict, body: bytes) -> np.ndarray:
    message = TransformMessage()
    try:
        message.unpack(fields, body)
    except Exception as error:  # pyigtl's readers raise whatever their parsers do
        raise WireError("a transform that cannot be read") from error
    return message.matrix


def _read(stream: BinaryIO, size: int) -> bytes:
    content = stream.read(size)
    if len(content) < size:
        raise EOFError
    return content


def _skip(stream: BinaryIO, size: int) -> None:
    while size > 0:
        size -= len(_read(stream, min(size, PIECE_BYTES)))
