"""An OpenIGTLink server, with pyigtl's messages and its own sockets.

pyigtl's own server serves one client at a time, prints a traceback when it leaves, cannot be ended after half a header, takes
over the signals of the process, and listens on the first network card or on none.
"""

import os
import socket
from collections.abc import Callable
from contextlib import suppress
from ipaddress import ip_address
from socketserver import BaseRequestHandler, ThreadingTCPServer
from threading import Condition, Thread

from rehearsal.coordinates import probe_in_patient
from rehearsal.rehearsal import Rehearsal
from rehearsal.tracking.openigtlink_messages import (
    LiveImage,
    MessageError,
    ReceivedPose,
    packed,
    read_message,
)
from render.viewer import View
from ultrasound.probe import Probe

POLL_S = 0.05


class OpenIGTLinkServer(ThreadingTCPServer):
    """Sends the newest image to each client; ``received_pose`` is the pose that clients send.

    Each client has two threads, which pack, send and read; a slow one skips images. Listens from the start, on a free port where
    ``port`` is 0; raises OSError where it cannot. As a context manager it closes at the end.
    """

    daemon_threads = True
    # On Windows it would let two programs share a port.
    allow_reuse_address = os.name == "posix"

    def __init__(self, host: str, port: int, message: Callable[[str], None]) -> None:
        super().__init__((host, port), _Client)
        self.received_pose = ReceivedPose(message)
        self._message, self._has_refused = message, False
        self._changed = Condition()
        self._newest: LiveImage | None = None
        self._clients: set[_Client] = set()
        self._is_open = True
        Thread(target=self.serve_forever, args=(POLL_S,), daemon=True).start()

    @property
    def port(self) -> int:
        """The port on which it listens."""
        return int(self.server_address[1])

    @property
    def is_private(self) -> bool:
        """Whether only programs on this machine can connect."""
        return ip_address(str(self.server_address[0])).is_loopback

    def send(self, live: LiveImage) -> None:
        """Send an image to all clients. Its arrays must not change any more."""
        with self._changed:
            self._newest = live
            self._changed.notify_all()

    def close(self) -> None:
        """Free the port and disconnect all clients."""
        self.shutdown()
        self.server_close()
        with self._changed:
            self._is_open = False
            clients = list(self._clients)
        for client in clients:
            client.disconnect()

    def __exit__(self, *_: object) -> None:
        self.close()

    def add(self, client: "_Client") -> None:
        """A client has connected."""
        with self._changed:
            client.is_connected = self._is_open
            self._clients.add(client)

    def remove(self, client: "_Client") -> None:
        """A client has disconnected."""
        with self._changed:
            client.is_connected = False
            self._clients.discard(client)
            self._changed.notify_all()

    def wait_for_newer(self, client: "_Client", than: LiveImage | None) -> LiveImage | None:
        """Wait for an image other than the last that a client got; None once it has disconnected."""
        with self._changed:
            self._changed.wait_for(lambda: self._newest is not than or not client.is_connected)
            return self._newest if client.is_connected else None

    def refuse(self, error: MessageError) -> None:
        """Report, once, that a client was disconnected."""
        if not self._has_refused:
            self._has_refused = True
            self._message(
                f"Warning: a client of the link was disconnected: it sent no OpenIGTLink message: {error}"
            )


class _Client(BaseRequestHandler):
    """One client: this thread sends, another one reads."""

    server: OpenIGTLinkServer
    is_connected = False

    def setup(self) -> None:
        # A client that has left already is noticed when something is sent.
        with suppress(OSError):
            self.request.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.server.add(self)
        Thread(target=self._read, daemon=True).start()

    def handle(self) -> None:
        live = None
        with suppress(OSError):
            while (live := self.server.wait_for_newer(self, live)) is not None:
                self.request.sendall(packed(live))
        self.disconnect()

    def _read(self) -> None:
        with suppress(OSError, EOFError), self.request.makefile("rb") as stream:
            try:
                while True:
                    self.server.received_pose.take(*read_message(stream))
            except MessageError as error:
                self.server.refuse(error)
        self.disconnect()

    def disconnect(self) -> None:
        """End both threads, whatever they wait for."""
        self.server.remove(self)
        with suppress(OSError):
            self.request.shutdown(socket.SHUT_RDWR)


def send_live(
    link: OpenIGTLinkServer | None, rehearsal: Rehearsal, view: View, probe: Probe, time_s: float
) -> None:
    """Send the first image of a view, if there is a link."""
    if link is not None:
        grey = next(iter(view.images.values()))
        link.send(LiveImage(grey, probe.image_to_probe(*grey.shape), probe_in_patient(rehearsal), time_s))
