"""The OpenIGTLink server over real sockets: messages, coordinates, and clients that misbehave."""

import asyncio
import itertools
import json
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pyigtl
import pytest
from conftest import rotation_about
from pyigtl.messages import CRC64

from rehearsal.tracking.openigtlink_server import (
    FORCE,
    HAND_TO_REFERENCE,
    IMAGE,
    IMAGE_TO_PROBE,
    MOST_CLIENTS,
    PROBE,
    STALE_S,
    OpenIGTLinkServer,
    ReceivedPose,
    send_live,
)
from ultrasound.probe import Probe, load_probe

# One of 3 x 5 pixels is 277 bytes.
ROWS, COLUMNS = 3, 5
HEADER = ">H 12s 20s II Q Q"
# Long for a loopback, short for a test.
SOON_S = 5.0


class LiveImage(NamedTuple):
    """What a server sends."""

    grey: np.ndarray
    image_to_probe: np.ndarray
    probe_in_patient: np.ndarray
    time_s: float
    wrench: np.ndarray | None = None


def pose() -> np.ndarray:
    """A probe held aslant, off the origin, with no two axes alike."""
    pose = np.eye(4)
    pose[:3, :3] = rotation_about([1.0, 2.0, -0.5], 40.0)
    pose[:3, 3] = 12.0, -80.5, -333.25
    return pose


def live(number: int = 0, rows: int = ROWS, columns: int = COLUMNS, probe: Probe | None = None) -> LiveImage:
    """Pictures that tell their number by pixels, place and time."""
    grey = ((np.arange(rows * columns) + number) % 251).astype(np.uint8).reshape(rows, columns)
    place = pose()
    place[0, 3] += number
    pixels = (probe or load_probe("linear")).image_to_probe(rows, columns)
    return LiveImage(grey, pixels, place, number / 30)


@pytest.fixture
def said() -> list[str]:
    return []


@pytest.fixture
def server(said) -> Iterator[OpenIGTLinkServer]:
    """A server on a free port of the loopback."""
    with OpenIGTLinkServer("127.0.0.1", 0, said.append) as server:
        yield server


@pytest.fixture
def client(server) -> Iterator[pyigtl.OpenIGTLinkClient]:
    client = pyigtl.OpenIGTLinkClient("127.0.0.1", server.port)
    yield client
    client.stop()


def joined(server: OpenIGTLinkServer) -> socket.socket:
    return socket.create_connection(("127.0.0.1", server.port), SOON_S)


def read(connection: socket.socket, size: int) -> bytes:
    content = b""
    while len(content) < size:
        piece = connection.recv(size - len(content))
        assert piece, "the server has gone"
        content += piece
    return content


def next_message(connection: socket.socket) -> tuple[str, str, bytes]:
    """Type, device name and body of the next message, by the protocol's text; its sum must be right."""
    version, kind, name, _, _, size, check = struct.unpack(HEADER, read(connection, struct.calcsize(HEADER)))
    body = read(connection, size)
    assert version == 1 and check == CRC64(body)
    return kind.rstrip(b"\0").decode(), name.rstrip(b"\0").decode(), body


def next_picture(connection: socket.socket) -> bytes:
    while (message := next_message(connection))[:2] != ("IMAGE", IMAGE):
        pass
    return message[2]


def read_until(connection: socket.socket, number: int) -> int:
    """Read pictures up to one of a number; how many came before it."""
    for before in itertools.count():
        if next_picture(connection)[72] == number:
            return before


def soon(holds: Callable[[], bool]) -> bool:
    """Whether something comes true before long."""
    until = time.monotonic() + SOON_S
    while not holds() and time.monotonic() < until:
        time.sleep(0.005)
    return holds()


def test_a_client_gets_each_picture_with_its_poses(server, client):
    for number in range(3):
        sent = live(number)
        server.send(*sent)
        # x and y change sign from LPS to RAS, z does not; a float32 of 333 mm is good to 2e-5.
        probe = sent.probe_in_patient * [[-1], [-1], [1], [1]]
        for name, matrix in ((PROBE, probe), (IMAGE_TO_PROBE, sent.image_to_probe)):
            message = client.wait_for_message(name, SOON_S)
            assert np.allclose(message.matrix, matrix, atol=2e-5)
            assert message.timestamp == pytest.approx(number / 30, abs=2e-9)
        picture = client.wait_for_message(IMAGE, SOON_S)
        assert np.array_equal(picture.image, sent.grey[None]) and picture.world_coordinate_system == "ras"
        assert picture.timestamp == pytest.approx(number / 30, abs=2e-9)
        assert np.allclose(picture.ijk_to_world_matrix, probe @ sent.image_to_probe, atol=1e-4)


def test_the_corner_pixels_are_where_they_are_in_the_patient(server):
    """A curved array's picture of 40 rows and 24 columns laid out by hand, read by the protocol's text."""
    rows, columns = 40, 24
    probe = load_probe("curvilinear")
    width, depth, above = probe.extent_mm
    assert above > 1
    sent = live(7, rows, columns, probe)
    with joined(server) as connection:
        server.send(*sent)
        body = next_picture(connection)
    version, components, scalar, _, space, *size = struct.unpack(">HBBBBHHH", body[:12])
    assert (version, components, scalar, space, size) == (1, 1, 3, 1, [columns, rows, 1])
    vectors = np.array(struct.unpack(">12f", body[12:60])).reshape(4, 3)
    assert struct.unpack(">6H", body[60:72]) == (0, 0, 0, columns, rows, 1)
    along_column, along_row, normal, centre = vectors
    x, y, z, origin = sent.probe_in_patient[:3].T
    for column in (0, columns - 1):
        for row in (0, rows - 1):
            place = centre + (column - (columns - 1) / 2) * along_column + (row - (rows - 1) / 2) * along_row
            u = (column + 0.5) * width / columns - width / 2
            v = (row + 0.5) * depth / rows - above
            wanted = (origin + u * x + v * y) * [-1, -1, 1]
            # Two dozen float32 of up to 400 mm.
            assert np.allclose(place, wanted, atol=2e-4)
            pixel = body[72 + row * columns + column]
            assert pixel == sent.grey[row, column]
    # Slices are one mm thick, towards z = x cross y, so that no picture is mirrored.
    assert np.allclose(normal, z * [-1, -1, 1], atol=1e-6)


def test_no_identifiers_are_sent_and_the_pose_comes_before_the_image(server):
    sent, kinds = live(), []
    with joined(server) as connection:
        server.send(*sent)
        for name in (PROBE, IMAGE_TO_PROBE, IMAGE):
            header = read(connection, struct.calcsize(HEADER))
            _, kind, sent_name, seconds, _, size, _ = struct.unpack(HEADER, header)
            read(connection, size)
            kinds.append(kind.rstrip(b"\0"))
            # The rehearsal's time, which says nothing of the day.
            assert sent_name.rstrip(b"\0").decode() == name and len(name) <= 20 and seconds == 0
    assert kinds == [b"TRANSFORM", b"TRANSFORM", b"IMAGE"]


def test_the_force_on_the_probe_comes_as_a_text_along_the_axes_of_the_picture(server, client):
    wrench = np.array([1.0, 2.0, -3.0, 10.0, 20.0, -30.0])
    server.send(*live()._replace(wrench=wrench))
    text = client.wait_for_message(FORCE, timeout=SOON_S).string
    # From LPS to RAS the first two axes turn round.
    assert json.loads(text) == dict(force_N=[-1.0, -2.0, -3.0], torque_N_mm=[-10.0, -20.0, -30.0])


def test_sending_packs_nothing_without_a_client(server, monkeypatch):
    packers: list[int] = []
    pack = pyigtl.ImageMessage.pack

    def watched(message: pyigtl.ImageMessage) -> bytes:
        packers.append(threading.get_ident())
        return pack(message)

    monkeypatch.setattr(pyigtl.ImageMessage, "pack", watched)
    for number in range(20):
        server.send(*live(number))
    time.sleep(0.1)
    assert packers == []
    with joined(server) as connection:
        # One that comes late has the newest picture at once, and that once.
        assert next_picture(connection)[72] == 19
        server.send(*live(20))
        assert next_picture(connection)[72] == 20
        assert len(packers) == 2 and threading.get_ident() not in packers


def test_a_slow_client_skips_pictures_and_the_newest_reaches_it(server):
    with joined(server) as slow, joined(server) as quick:
        for number in range(100):
            # More than the sockets between them hold.
            server.send(*live(number, 512, 512))
        read_until(quick, 99)
        assert read_until(slow, 99) < 75


def test_clients_that_disconnect_or_send_garbage_do_not_disturb_others(server, said):
    half = struct.pack(HEADER, 1, b"TRANSFORM", HAND_TO_REFERENCE.encode(), 0, 0, 48, 0)
    rubbish = (
        b"GET / HTTP/1.1\r\nHost: here\r\nAccept: everything, twice over\r\n\r\n",
        bytes(range(255, 195, -1)),
        struct.pack(HEADER, 1, b"\xff\xfe", b"", 0, 0, 0, 0),
        struct.pack(HEADER, 1, b"TRANSFORM", b"", 0, 0, 1 << 60, 0),
        struct.pack(HEADER, 1, b"TRANSFORM", b"", 0, 0, 5, 0) + b"short",
    )
    for content in rubbish:
        with joined(server) as connection:
            connection.sendall(content)
            assert connection.recv(1) == b"", content
    for content in (b"", half[:20], half + b"\0" * 20):
        joined(server).sendall(content)
    with joined(server) as connection:
        server.send(*live(5))
        assert next_picture(connection)[72] == 5
    server.send(*live(6))
    assert len(said) == 1 and "was disconnected" in said[0]
    assert soon(lambda: not asyncio.all_tasks(server._loop)) and server.received_pose.pose() is None


def test_more_clients_than_are_served_are_disconnected_and_say_so_once(server, said):
    served = [joined(server) for _ in range(MOST_CLIENTS)]
    server.send(*live(5))
    assert [next_picture(connection)[72] for connection in served] == [5] * MOST_CLIENTS
    for _ in range(2):
        with joined(server) as one_more, suppress(ConnectionResetError):
            assert one_more.recv(1) == b""
    assert soon(lambda: said) and len(said) == 1 and f"more than {MOST_CLIENTS} clients" in said[0]
    for connection in served:
        connection.close()
    assert soon(lambda: not asyncio.all_tasks(server._loop))
    with joined(server) as connection:
        assert next_picture(connection)[72] == 5


@pytest.mark.parametrize("sends", [True, False], ids=["half a message", "takes no data"])
def test_an_idle_client_is_disconnected(server, monkeypatch, sends):
    monkeypatch.setattr("rehearsal.tracking.openigtlink_server.IDLE_S", 0.2)
    # One that sends nothing may stay: a viewer does so.
    with joined(server) as viewer, joined(server) as idle:
        if sends:
            idle.sendall(b"\0" * 30)
            with suppress(ConnectionResetError):
                assert idle.recv(1) == b""
        else:
            for number in range(200):
                server.send(*live(number, 512, 512))
                read_until(viewer, number)
                if server._clients == 1:
                    break
            assert soon(lambda: server._clients == 1)
        server.send(*live(201))
        read_until(viewer, 201)


def test_other_messages_are_ignored(server, client):
    with joined(server) as connection:
        picture = pyigtl.ImageMessage(np.zeros((1, 300, 300), np.uint8), device_name=HAND_TO_REFERENCE).pack()
        status = struct.pack(HEADER, 2, b"GET_STATUS", b"", 0, 0, 0, 0)
        connection.sendall(picture + status + hand_message(pose(), "Stylus") + hand_message(np.eye(4)))
        assert soon(lambda: server.received_pose.pose() is not None)
    assert np.allclose(server.received_pose.pose(), np.diag([-1, -1, 1, 1]))


@pytest.mark.parametrize(
    ("clients", "sends", "reads"),
    [(1, b"", False), (1, b"\0" * 30, False), (1, b"", True), (3, b"", True)],
    ids=["silent", "half a header", "served", "three served"],
)
def test_closing_ends_at_once_frees_the_port_and_says_nothing(said, caplog, clients, sends, reads):
    server = OpenIGTLinkServer("127.0.0.1", 0, said.append)
    port, before = server.port, threading.active_count()
    connections = [joined(server) for _ in range(clients)]
    server.send(*live(0))
    for connection in connections:
        connection.sendall(sends)
        if reads:
            next_picture(connection)
    assert soon(lambda: asyncio.all_tasks(server._loop))
    began = time.monotonic()
    server.close()
    assert time.monotonic() - began < 1 and soon(lambda: threading.active_count() < before)
    for connection in connections:
        # Bytes that were not read yet make it a reset.
        with suppress(ConnectionResetError):
            while connection.recv(1 << 16):
                pass
        connection.close()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port), SOON_S)
    assert said == [] and caplog.records == []
    OpenIGTLinkServer("127.0.0.1", port, said.append).close()


def hand_message(matrix: np.ndarray, name: str = HAND_TO_REFERENCE, version: int = 1) -> bytes:
    message = pyigtl.TransformMessage(matrix, device_name=name)
    message.header_version = version
    return message.pack()


@pytest.mark.parametrize("version", [1, 2])
def test_a_clients_pose_comes_in(server, version):
    assert server.received_pose.pose() is None
    # Aslant, in RAS: a probe whose x is the patient's right is -x in LPS.
    sent = pose()
    with joined(server) as connection:
        connection.sendall(hand_message(sent, version=version))
        assert soon(lambda: server.received_pose.pose() is not None)
    got = server.received_pose.pose()
    assert np.allclose(got[:3, 3], [-12.0, 80.5, -333.25]) and np.allclose(got[3], [0, 0, 0, 1])
    for axis in range(3):
        assert np.allclose(got[:3, axis], sent[:3, axis] * [-1, -1, 1], atol=1e-6)
    # What a float32 leaves of right angles is put right.
    assert np.abs(got[:3, :3].T @ got[:3, :3] - np.eye(3)).max() < 1e-14


def test_a_pose_goes_stale(said):
    now = [100.0]
    received = ReceivedPose(said.append, lambda: now[0])
    received.take(pose())
    now[0] += STALE_S
    assert np.allclose(received.pose()[:3, 3], [-12.0, 80.5, -333.25])
    now[0] += 1e-3
    assert received.pose() is None
    received.take(np.eye(4))
    assert np.allclose(received.pose(), np.diag([-1, -1, 1, 1])) and said == []


@pytest.mark.parametrize("rest", [b"\0\xff\xfe\x80", b"\0\xcd\xcd"])
def test_what_follows_the_end_of_a_name_is_not_part_of_it(server, rest):
    message = bytearray(hand_message(pose()))
    for begin, text in ((2, b"TRANSFORM" + rest[:3]), (14, HAND_TO_REFERENCE.encode() + rest)):
        message[begin : begin + len(text)] = text
    with joined(server) as connection:
        connection.sendall(message)
        assert soon(lambda: server.received_pose.pose() is not None)


@pytest.mark.parametrize("at", [-3, 57], ids=["body", "checksum"])
def test_damaged_messages_are_ignored_counted_and_said_once(said, at):
    with OpenIGTLinkServer("127.0.0.1", 0, said.append) as server, joined(server) as connection:
        damaged = bytearray(hand_message(changed((0, 3), 99.0)))
        damaged[at] ^= 1
        connection.sendall(damaged * 3)
        assert soon(lambda: server.damaged_messages == 3) and server.received_pose.pose() is None
        connection.sendall(hand_message(np.eye(4)))
        assert soon(lambda: server.received_pose.pose() is not None)
        assert len(said) == 1 and "wrong checksum" in said[0]
    assert said[1:] == ["3 damaged messages of the link were ignored"]


def changed(at: tuple, value: float) -> np.ndarray:
    matrix = pose()
    matrix[at] = value
    return matrix


@pytest.mark.parametrize(
    "matrix",
    [
        changed((0, 3), np.nan),
        changed((1, 1), np.inf),
        changed((2, 3), 1e5),
        pose() @ np.diag([1.01, 1, 1, 1]),
        pose() @ np.diag([1, 1, -1, 1]),
        np.diag([0, 0, 0, 1.0]),
        np.array([[1, 0.01, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
    ],
)
def test_a_pose_that_is_not_rigid_is_refused_with_one_warning(said, matrix):
    received = ReceivedPose(said.append)
    received.take(pose())
    for _ in range(2):
        received.take(matrix)
        assert received.pose() is None
    assert len(said) == 1 and "not a rigid transform" in said[0]
    received.take(pose())
    assert isinstance(received.pose(), np.ndarray)


def test_the_first_image_of_a_view_is_sent_with_the_current_probe():
    shown: list[LiveImage] = []
    wrench = np.array([1.0, 2.0, -3.0, 0.0, 5.0, 6.0])
    frame = SimpleNamespace(time_s=1.5, wrench=wrench)
    anatomy = SimpleNamespace(probe_in_patient=pose, frame=frame)
    echo, ct = np.full((8, 6), 9, np.uint8), np.zeros((8, 6), np.uint8)
    probe = load_probe("linear").model_copy(update=dict(depth_mm=80.0, transducer_width_mm=30.0))
    send_live(None, anatomy, SimpleNamespace(images={"B-mode": echo}), probe)
    link = SimpleNamespace(send=lambda *live: shown.append(LiveImage(*live)))
    send_live(link, anatomy, SimpleNamespace(images={"B-mode": echo, "CT": ct}), probe)
    (sent,) = shown
    assert sent.grey is echo and sent.time_s == 1.5 and sent.wrench is wrench
    assert np.array_equal(sent.probe_in_patient, pose())
    assert np.allclose(np.diag(sent.image_to_probe), [30 / 6, 80 / 8, 1, 1])
