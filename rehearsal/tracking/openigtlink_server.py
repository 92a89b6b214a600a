"""An OpenIGTLink server: the live image and the probe's pose out, a tracked pose in, with the names of PLUS
and 3D Slicer.

A transform is named by its two coordinate systems, such as ``ImageToProbe``. Image is in pixels (column, row,
0), the others in mm. Reference is the patient: RAS in messages, as Slicer's world is, and LPS in the program.

The messages are pyigtl's, the sockets asyncio's: pyigtl's own server serves one client at a time, prints a
traceback when it leaves, cannot be ended after half a header, takes over the signals of the process, and
listens on the first network card or on none.
"""

import asyncio
import json
from collections.abc import Callable
from contextlib import suppress
from ipaddress import ip_address
from threading import Thread
from time import monotonic

import numpy as np
from pyigtl import ImageMessage, StringMessage, TransformMessage
from pyigtl.messages import CRC64, MessageBase
from scipy.linalg import polar

from rehearsal.deformed_anatomy import DeformedAnatomy
from rehearsal.tracking.pose_file import is_rigid
from render.viewer import View
from ultrasound.probe import Probe

# PLUS names an image by its own coordinate system and the one of its pose. Names have at most 20 letters.
IMAGE, IMAGE_TO_PROBE, PROBE = "Image_Reference", "ImageToProbe", "ProbeToReference"
# A text, because pyigtl has no SENSOR message, nor has Slicer.
FORCE = "ProbeForce"
# Its own inverse.
RAS_FROM_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
HEADER_VERSIONS = (1, 2)
# Type and name of a message, in bytes of its header: texts that end at the first NUL; what follows them may
# be anything.
TEXTS = slice(2, 14), slice(14, 34)
# The header's last number; some programs send 0 instead of computing it.
CHECKSUM_BYTES = 8
# A transform is 48 bytes, plus metadata.
TRANSFORM_BYTES, CHUNK_BYTES = 1 << 16, 1 << 16
# Not ProbeToReference: that is sent out, and a client with both could not tell them apart.
HAND_TO_REFERENCE = "HandToReference"
STALE_S = 1.0
FARTHEST_MM = 10_000.0
# More clients are not served. One that takes no data for so long, or does not end its message, is
# disconnected.
MOST_CLIENTS, IDLE_S = 8, 30.0


class MessageError(ValueError):
    """Bytes that are not an OpenIGTLink message."""


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
        return None if newest is None or self._clock() - newest[1] > STALE_S else newest[0]

    def take(self, matrix: np.ndarray) -> None:
        """Take a transform's matrix (4, 4) [mm, RAS]."""
        if is_rigid(matrix) and np.abs(matrix[:3, 3]).max() <= FARTHEST_MM:
            pose = RAS_FROM_LPS @ matrix
            # The nearest orthonormal axes: later code inverts the pose by its transpose.
            pose[:3, :3] = polar(pose[:3, :3])[0]
            self._newest = pose, self._clock()
            return
        self._newest = None
        if not self._has_refused:
            self._has_refused = True
            self._message(
                f"Warning: {HAND_TO_REFERENCE} of the link is not a rigid transform within "
                f"{FARTHEST_MM / 1000:.0f} m: it is ignored; "
                "send a rotation and a translation in mm"
            )


class OpenIGTLinkServer:
    """Sends the newest image to each client; ``received_pose`` is the pose that clients send,
    ``damaged_messages`` counts what had a wrong checksum.

    One thread packs, sends and reads; a slow client skips images. Listens from the start, on a free port
    where ``port`` is 0; raises OSError where it cannot, UnicodeError for a text that cannot be a host's name.
    As a context manager it closes at the end.
    """

    def __init__(self, host: str, port: int, message: Callable[[str], None]) -> None:
        self.received_pose = ReceivedPose(message)
        self._message, self._has_refused = message, False
        self.damaged_messages = self._clients = 0
        self._newest: tuple[MessageBase, ...] = ()
        self._loop = asyncio.new_event_loop()
        # Set when there is a newer image, and replaced by one for the next.
        self._has_newer = asyncio.Event()
        try:
            self._server = self._loop.run_until_complete(asyncio.start_server(self._serve, host, port))
        except (OSError, UnicodeError):
            self._loop.close()
            raise
        self._thread = Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        self.addresses = [socket.getsockname()[0] for socket in self._server.sockets]
        self.port = self._server.sockets[0].getsockname()[1]

    @property
    def is_private(self) -> bool:
        """Whether only programs on this machine can connect."""
        return all(ip_address(address).is_loopback for address in self.addresses)

    def send(
        self,
        grey: np.ndarray,
        image_to_probe: np.ndarray,
        probe_in_patient: np.ndarray,
        time_s: float,
        wrench: np.ndarray | None = None,
    ) -> None:
        """Send an image and its pose to all clients; the arrays must not change any more.

        ``grey`` is uint8 (rows, columns) in orientation MF; ``image_to_probe`` and ``probe_in_patient`` are
        (4, 4) [mm, LPS], in PLUS's axes of the probe. ``time_s`` is the rehearsal's time. ``wrench`` (6,):
        force [N] of the tissue on the probe and torque [N mm] about the centre of the array face (LPS).
        """
        probe = RAS_FROM_LPS @ probe_in_patient
        messages: tuple[MessageBase, ...] = (
            TransformMessage(probe, device_name=PROBE, timestamp=time_s),
            TransformMessage(image_to_probe, device_name=IMAGE_TO_PROBE, timestamp=time_s),
            # pyigtl takes (slices, rows, columns); of an image without slices it sends the size reversed.
            ImageMessage(grey[None], probe @ image_to_probe, "ras", device_name=IMAGE, timestamp=time_s),
        )
        if wrench is not None:
            messages += (StringMessage(force_text(wrench), device_name=FORCE, timestamp=time_s),)
        self._loop.call_soon_threadsafe(self._publish, messages)

    def __enter__(self) -> "OpenIGTLinkServer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Free the port and disconnect all clients."""
        asyncio.run_coroutine_threadsafe(self._shut(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()
        if self.damaged_messages > 1:
            self._message(f"{self.damaged_messages} damaged messages of the link were ignored")

    async def _shut(self) -> None:
        self._server.close()
        clients = asyncio.all_tasks() - {asyncio.current_task()}
        for client in clients:
            client.cancel()
        await asyncio.gather(*clients, return_exceptions=True)

    def _publish(self, messages: tuple[MessageBase, ...]) -> None:
        self._newest = messages
        self._has_newer.set()
        self._has_newer = asyncio.Event()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """One client, until it leaves, sends what is no message, or is idle."""
        if self._clients == MOST_CLIENTS:
            self._warn_once(f"one more than {MOST_CLIENTS} clients of the link was disconnected")
            writer.transport.abort()
            return
        self._clients += 1
        both = [asyncio.create_task(self._send_to(writer)), asyncio.create_task(self._read_from(reader))]
        try:
            # asyncio prints a traceback for a client that ends cancelled.
            with suppress(asyncio.CancelledError):
                await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
        finally:
            self._clients -= 1
            for task in both:
                task.cancel()
            writer.transport.abort()

    def _warn_once(self, text: str) -> None:
        if not self._has_refused:
            self._has_refused = True
            self._message(f"Warning: {text}")

    async def _send_to(self, writer: asyncio.StreamWriter) -> None:
        sent: tuple[MessageBase, ...] = ()
        with suppress(OSError):
            while True:
                has_newer = self._has_newer
                if sent is self._newest:
                    await has_newer.wait()
                sent = self._newest
                writer.write(b"".join(message.pack() for message in sent))
                async with asyncio.timeout(IDLE_S):
                    await writer.drain()

    async def _read_from(self, reader: asyncio.StreamReader) -> None:
        with suppress(OSError, EOFError):
            try:
                while True:
                    first = await reader.readexactly(1)
                    async with asyncio.timeout(IDLE_S):
                        await self._read_message(first, reader)
            except MessageError as error:
                self._warn_once(
                    f"a client of the link was disconnected: it sent no OpenIGTLink message: {error}"
                )

    async def _read_message(self, first: bytes, reader: asyncio.StreamReader) -> None:
        """Take the message that begins with a byte; all but transforms are skipped.

        Raises MessageError, EOFError, OSError.
        """
        header = first + await reader.readexactly(MessageBase.IGTL_HEADER_SIZE - 1)
        try:
            fields = MessageBase.parse_header(_without_rests(header))
        except UnicodeDecodeError as error:
            raise MessageError("a name that is not text") from error
        size = fields["body_size"]
        if fields["header_version"] not in HEADER_VERSIONS:
            raise MessageError(
                f"header version {fields['header_version']}: expected one of {HEADER_VERSIONS}"
            )
        if fields["message_type"] != "TRANSFORM":
            while size > 0:
                size -= len(await reader.readexactly(min(size, CHUNK_BYTES)))
            return
        if size > TRANSFORM_BYTES:
            raise MessageError(f"a transform of {size} bytes: expected at most {TRANSFORM_BYTES}")
        body, message = await reader.readexactly(size), TransformMessage()
        if int.from_bytes(header[-CHECKSUM_BYTES:]) not in (0, CRC64(body)):
            self.damaged_messages += 1
            if self.damaged_messages == 1:
                self._message(
                    "Warning: a message of the link is damaged (wrong checksum): it is ignored, as are more "
                    "like it; check the program "
                    "that sends it, and the network"
                )
            return
        try:
            message.unpack(fields, body)
        except Exception as error:  # pyigtl's readers raise whatever their parsers do
            raise MessageError("a transform that cannot be read") from error
        if fields["device_name"] == HAND_TO_REFERENCE:
            self.received_pose.take(message.matrix)


def _without_rests(header: bytes) -> bytes:
    """A header without what follows the NUL of a text."""
    cleared = bytearray(header)
    for part in TEXTS:
        cleared[part] = header[part].partition(b"\0")[0].ljust(part.stop - part.start, b"\0")
    return bytes(cleared)


def send_live(link: OpenIGTLinkServer | None, anatomy: DeformedAnatomy, view: View, probe: Probe) -> None:
    """Send the first image of a view of an anatomy as it is shown, if there is a link."""
    if link is not None:
        grey = next(iter(view.images.values()))
        image_to_probe = probe.image_to_probe(*grey.shape)
        frame = anatomy.frame
        link.send(grey, image_to_probe, anatomy.probe_in_patient(), frame.time_s, frame.wrench)


def force_text(wrench: np.ndarray) -> str:
    """A wrench (6,) [N, N mm, LPS] as JSON: force and torque along the axes of Reference (RAS)."""
    rotation = RAS_FROM_LPS[:3, :3]
    return json.dumps(
        dict(
            force_N=(rotation @ wrench[:3]).round(5).tolist(),
            torque_N_mm=(rotation @ wrench[3:]).round(4).tolist(),
        )
    )
