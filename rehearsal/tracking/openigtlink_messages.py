"""OpenIGTLink messages: the live image and the probe's pose out, a tracked pose in, with the names of PLUS and 3D Slicer.

A transform is named by its two coordinate systems, such as ``ImageToProbe``. Image is in pixels (column, row, 0), the others in mm.
Reference is the patient: RAS in messages, as Slicer's world is, and LPS in the program.
"""

from collections.abc import Callable
from dataclasses import dataclass
from time import monotonic
from typing import BinaryIO

import numpy as np
from pyigtl import ImageMessage, TransformMessage
from pyigtl.messages import MessageBase
from scipy.linalg import polar

from rehearsal.tracking.pose_file import is_rigid

# PLUS names an image by its own coordinate system and the one of its pose. Names have at most 20 letters.
IMAGE, IMAGE_TO_PROBE, PROBE = "Image_Reference", "ImageToProbe", "ProbeToReference"
# Its own inverse.
RAS_FROM_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
HEADER_VERSIONS = (1, 2)
# A transform is 48 bytes, plus metadata.
TRANSFORM_BYTES, CHUNK_BYTES = 1 << 16, 1 << 16
# Not ProbeToReference: that is sent out, and a client with both could not tell them apart.
HAND_TO_REFERENCE = "HandToReference"
STALE_S = 1.0
FARTHEST_MM = 10_000.0


class MessageError(ValueError):
    """Bytes that are not an OpenIGTLink message."""


@dataclass(frozen=True)
class LiveImage:
    """An ultrasound image and its pose.

    ``grey`` is uint8 (rows, columns) in orientation MF; ``image_to_probe`` and ``probe_in_patient`` are (4, 4) [mm, LPS], in PLUS's
    axes of the probe. ``time_s`` is the rehearsal's time.
    """

    grey: np.ndarray
    image_to_probe: np.ndarray
    probe_in_patient: np.ndarray
    time_s: float


def packed(live: LiveImage) -> bytes:
    """Three messages with one time: the probe's pose, the image's pose on the probe, and the image."""
    probe = RAS_FROM_LPS @ live.probe_in_patient
    when = dict(timestamp=live.time_s)
    messages = (
        TransformMessage(probe, device_name=PROBE, **when),
        TransformMessage(live.image_to_probe, device_name=IMAGE_TO_PROBE, **when),
        # pyigtl takes (slices, rows, columns); of an image without slices it sends the size reversed.
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
        raise MessageError("a name that is not text") from error
    name, size = fields["device_name"], fields["body_size"]
    if fields["header_version"] not in HEADER_VERSIONS:
        raise MessageError(f"header version {fields['header_version']}: expected one of {HEADER_VERSIONS}")
    if fields["message_type"] != "TRANSFORM":
        _skip(stream, size)
        return name, None
    if size > TRANSFORM_BYTES:
        raise MessageError(f"a transform of {size} bytes: expected at most {TRANSFORM_BYTES}")
    return name, _matrix(fields, _read(stream, size))


def _matrix(fields: dict, body: bytes) -> np.ndarray:
    message = TransformMessage()
    try:
        message.unpack(fields, body)
    except Exception as error:  # pyigtl's readers raise whatever their parsers do
        raise MessageError("a transform that cannot be read") from error
    return message.matrix


def _read(stream: BinaryIO, size: int) -> bytes:
    content = stream.read(size)
    if len(content) < size:
        raise EOFError
    return content


def _skip(stream: BinaryIO, size: int) -> None:
    while size > 0:
        size -= len(_read(stream, min(size, CHUNK_BYTES)))


class ReceivedPose:
    """The newest pose that a client sent as HandToReference. One thread may write while another reads."""

    def __init__(self, message: Callable[[str], None], clock: Callable[[], float] = monotonic) -> None:
        self._message, self._clock = message, clock
        self._newest: tuple[np.ndarray, float] | None = None
        self._has_refused = False

    def pose(self) -> np.ndarray | None:
        """The probe in the patient (4, 4) [mm, LPS], in PLUS's axes.

        None before the first, ``STALE_S`` after the last, and after one that was not rigid.
        """
        newest = self._newest
        if newest is None or self._clock() - newest[1] > STALE_S:
            return None
        return newest[0]

    def take(self, name: str, matrix: np.ndarray | None) -> None:
        """Take a message's matrix (4, 4) [mm, RAS], if it has the right name."""
        if name != HAND_TO_REFERENCE or matrix is None:
            return
        if is_rigid(matrix) and np.abs(matrix[:3, 3]).max() <= FARTHEST_MM:
            self._newest = _orthonormalized(RAS_FROM_LPS @ matrix), self._clock()
            return
        self._newest = None
        if not self._has_refused:
            self._has_refused = True
            self._message(
                f"Warning: {HAND_TO_REFERENCE} of the link is not a rigid transform within {FARTHEST_MM / 1000:.0f} m: it is ignored; "
                "send a rotation and a translation in mm"
            )


def _orthonormalized(pose: np.ndarray) -> np.ndarray:
    """A pose with the nearest orthonormal axes: later code inverts it by its transpose."""
    result = pose.copy()
    result[:3, :3] = polar(pose[:3, :3])[0]
    return result
