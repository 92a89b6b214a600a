"""An OpenIGTLink server. Its messages are pyigtl's; its sockets are not.

pyigtl's own server has one client at a time, prints a traceback where that leaves, cannot be ended after half a header, takes
over the signals of the process, and listens on the first network card or on none.
"""

import os
import socket
from collections.abc import Callable
from contextlib import suppress
from ipaddress import ip_address
from socketserver import BaseRequestHandler, ThreadingTCPServer
from threading import Condition, Thread

from rehearsal.tracking.openigtlink_messages import LivePicture, WireError, packed, read_message
from rehearsal.tracking.openigtlink_pose import HandPose

POLL_S = 0.05


class Server(ThreadingTCPServer):
    """Sends the newest picture that it is shown to each client; ``hand`` follows what they send.

    Each client has two threads of its own, which pack, send and read: ``show`` does none of that. One that is slow skips pictures.
    Listens when it is made, on port 0 on a free one; raises OSError where it cannot. As a context manager it closes at the end.
    """

    daemon_threads = True
    # On Windows it would let two programs have one port.
    allow_reuse_address = os.name == "posix"

    def __init__(self, host: str, port: int, say: Callable[[str], None]) -> None:
        super().__init__((host, port), _Client)
        self.hand = HandPose(say)
        self._say, self._has_refused = say, False
        self._news = Condition()
        self._newest: LivePicture | None = None
        self._clients: set[_Client] = set()
        self._is_open = True
        Thread(target=self.serve_forever, args=(POLL_S,), daemon=True).start()

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self.server_address[1])

    @property
    def is_private(self) -> bool:
        """Whether programs on this machine alone can connect."""
        return ip_address(str(self.server_address[0])).is_loopback

    def show(self, live: LivePicture) -> None:
        """Have this picture sent. Its arrays must not change any more."""
        with self._news:
            self._newest = live
            self._news.notify_all()

    def close(self) -> None:
        """Free the port and let all clients go."""
        self.shutdown()
        self.server_close()
        with self._news:
            self._is_open = False
            clients = list(self._clients)
        for client in clients:
            client.leave()

    def __exit__(self, *_: object) -> None:
        self.close()

    def enter(self, client: "_Client") -> None:
        """A client has come."""
        with self._news:
            client.is_here = self._is_open
            self._clients.add(client)

    def left(self, client: "_Client") -> None:
        """A client has gone."""
        with self._news:
            client.is_here = False
            self._clients.discard(client)
            self._news.notify_all()

    def newer(self, client: "_Client", than: LivePicture | None) -> LivePicture | None:
        """Wait for a picture other than the last that a client got; None once it has gone."""
        with self._news:
            self._news.wait_for(lambda: self._newest is not than or not client.is_here)
            return self._newest if client.is_here else None

    def refuse(self, error: WireError) -> None:
        """Say once that a client was let go."""
        if not self._has_refused:
            self._has_refused = True
            self._say(f"Mind: a client of the link sent no OpenIGTLink message and was let go: {error}")


class _Client(BaseRequestHandler):
    """One client, whom this thread sends to and another one listens to."""

    server: Server
    is_here = False

    def setup(self) -> None:
        # A client that is gone already is found out when it is written to.
        with suppress(OSError):
            self.request.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.server.enter(self)
        Thread(target=self._listen, daemon=True).start()

    def handle(self) -> None:
        live = None
        with suppress(OSError):
            while (live := self.server.newer(self, live)) is not None:
                self.request.sendall(packed(live))
        self.leave()

    def _listen(self) -> None:
        with suppress(OSError, EOFError), self.request.makefile("rb") as stream:
            try:
                while True:
                    self.server.hand.take(*read_message(stream))
            except WireError as error:
                self.server.refuse(error)
        self.leave()

    def leave(self) -> None:
        """End both threads, whatever they wait for."""
        self.server.left(self)
        with suppress(OSError):
            self.request.shutdown(socket.SHUT_RDWR)
