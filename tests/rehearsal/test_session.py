"""The file of a session: what becomes of it on a disk, in a crash, and by other hands.

``test_timeline`` replays any session.
"""

import base64
import errno
import io
import json
from collections.abc import Iterator
from contextlib import redirect_stderr
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from fake_organ import DEEPEST_MM, STEP_S, SURFACE_MM, fake_timeline, pose_at
from recorded_session import LiveSession, header, record_all
from settings_at_start import settings_with

import app
from rehearsal.configuration import probe_of
from rehearsal.loop.command import CutOut, GoTo, Move, NewSession, Undo
from rehearsal.notices import Notices
from rehearsal.sessions.packed_arrays import (
    StateError,
    pack_poses,
    pack_seen,
    pack_state,
    unpack_poses,
    unpack_seen,
    unpack_state,
)
from rehearsal.sessions.recorder import next_path
from rehearsal.sessions.replay import Replay, ReplayCheck
from rehearsal.sessions.session_file import (
    SESSION_FORMAT,
    CommandLine,
    Header,
    SessionError,
    read_log,
    scene_of_log,
    settings_apart,
)
from render.viewer import Controls
from scenes.anatomy import LoadedAnatomy, fingerprint
from scenes.scene import EMBEDDED, Scene, load_scene

SECOND = round(1 / STEP_S)


def lines_of(path: Path) -> list[bytes]:
    return path.read_bytes().split(b"\n")


def with_line(path: Path, number: int, line: bytes) -> None:
    """Put another line in the place of one, counted from 1."""
    lines = lines_of(path)
    path.write_bytes(b"\n".join([*lines[: number - 1], line, *lines[number:]]))


def line_with(path: Path, key: bytes) -> int:
    """The number of the first line that has a key."""
    return next(n for n, line in enumerate(lines_of(path), 1) if b'"' + key + b'"' in line)


def test_the_file_has_a_line_for_each_command_in_their_order(tmp_path):
    record_all(tmp_path / "session")
    lines = [json.loads(line) for line in lines_of(tmp_path / "session")[:-1]]
    kinds = [line["command"]["kind"] if "command" in line else next(iter(line)) for line in lines]
    done = [kind for kind in kinds if kind not in ("at", "nephron_session", "summary")]
    assert done == ["set", "begin", "bookmark", "undo", "redo", "mark"]
    log = read_log(tmp_path / "session")
    assert log.steps == 40 and log.length_s == 40 * STEP_S and log.summary == {"presses": 1}
    assert log.readings == {7: {"force_n": 1.5, "margin_mm": None}}
    assert {command.kind for _, command in log.commands} == {*done, "move"}


def test_the_file_is_on_the_disk_each_second(tmp_path):
    live = LiveSession(tmp_path / "session")
    for second in range(1, 4):
        digest = live.move(SECOND)
        live.on_disk()
        log = read_log(tmp_path / "session")
        assert log.steps == second * SECOND and log.digests[second * SECOND] == digest
        assert log.summary is None and log.length_s == second
    live.recorder.close({})


def test_of_a_file_that_a_crash_cut_all_whole_lines_are_read(tmp_path):
    path = tmp_path / "session"
    record_all(path)
    whole, before = path.read_bytes(), 0
    ends = [at for at, byte in enumerate(whole, 1) if byte == ord("\n")]
    for cut in range(ends[0], len(whole), 97):
        path.write_bytes(whole[:cut])
        log = read_log(path)
        assert log.summary is None and before <= log.steps <= 40
        before = log.steps
    # What a disk may leave where the power went: zeros, or anything else.
    for rest in (bytes(500), b"\xff\xfe\xc3", whole[ends[3] : ends[4] - 1] + b"\xc3"):
        path.write_bytes(whole[: ends[4]] + rest)
        assert len(read_log(path).commands) > 0
    for cut in range(0, ends[0] - 1, 9):
        path.write_bytes(whole[:cut])
        with pytest.raises(SessionError):
            read_log(path)


def damaged(line: bytes) -> Iterator[bytes]:
    """Lines that are none."""
    yield line[:-20]
    yield b""
    yield line.replace(b'"moves"', b'"movies"')
    yield line.replace(b'"at":0', b'"at":1')
    yield b'{"at":0,"moves":""}'
    yield line.replace(b'"moves":"', b'"moves":"AAAA')
    yield b'{"at":0,"command":{"kind":"jump"}}'
    yield b'{"at":0,"command":{"kind":"set","values":[1]}}'
    yield b'{"at":0,"command":{"kind":"mark","places_mm":[[1,2]]}}'
    yield b'{"at":0,"command":{"kind":"cut","technique":"wedge","margin_mm":-1,"seen":""}}'
    for stranger in (b"\xc3", b"\0", b"["):
        yield line[:10] + stranger + line[11:]
    yield from (b"3", b"null", b'"summary"', b"[" * 100_000)


def test_a_damaged_line_is_named_by_its_number(tmp_path):
    path = tmp_path / "session"
    record_all(path)
    number, whole = line_with(path, b"moves"), path.read_bytes()
    for line in damaged(lines_of(path)[number - 1]):
        with_line(path, number, line)
        with pytest.raises(SessionError, match=rf"^session: line {number} [^\n]*$"):
            read_log(path)
        path.write_bytes(whole)
    lines = lines_of(path)
    path.write_bytes(b"\n".join([*lines[: number - 1], *lines[number:]]))
    with pytest.raises(SessionError, match=r"line \d+ does not follow"):
        read_log(path)


@pytest.mark.parametrize("command", [GoTo(state=3), Undo()])
def test_a_state_that_was_not_kept_is_not_restored(tmp_path, command):
    live = LiveSession(tmp_path / "session")
    live.move(5)
    live.recorder._write(CommandLine(at=5, command=command))
    live.recorder._write_moves()
    live.recorder.close({})
    path = tmp_path / "session"
    # The line of the moves that come before it was written after it.
    lines = lines_of(path)
    path.write_bytes(b"\n".join([lines[0], lines[2], lines[1], *lines[3:]]))
    with pytest.raises(SessionError, match="its file is damaged"):
        read_log(path)


@pytest.mark.parametrize(
    "pose", [0 * np.eye(4), 3 * np.eye(4), np.diag([1.0, 1, -1, 1]), np.eye(4) + np.eye(4, k=3) * 1e6]
)
def test_a_pose_that_is_none_of_a_probe_is_named_by_its_line(tmp_path, pose):
    path = tmp_path / "session"
    record_all(path)
    number = line_with(path, b"moves")
    values = json.loads(lines_of(path)[number - 1])
    values["moves"] = pack_poses([*unpack_poses(values["moves"])[:-1], pose])
    with_line(path, number, json.dumps(values).encode())
    with pytest.raises(SessionError, match=f"^session: line {number} has a pose that is none of a probe"):
        read_log(path)


def test_poses_keep_every_bit():
    random = np.random.default_rng(1)
    poses = [np.vstack([random.normal(size=(3, 4)), np.eye(4)[3]]) for _ in range(9)]
    poses[2][0] = [-0.0, 5e-324, 1e308, 1 / 3]
    assert unpack_poses(pack_poses(poses)).tobytes() == np.stack(poses).tobytes()


def test_of_another_format_a_sentence_says_which_version_replays_it(tmp_path):
    for other, words in ((SESSION_FORMAT - 1, "recorded by Nephron 2, which replays it"), (9, "expected 3")):
        values = header().model_dump() | dict(nephron_session=other, unheard_of=1)
        (tmp_path / "file").write_text(json.dumps(values) + "\n")
        with pytest.raises(SessionError, match=rf"^file: .*nephron_session = {other}: {words}[^\n]*$"):
            read_log(tmp_path / "file")


def test_what_is_no_session_is_said_so_in_one_line(tmp_path):
    control, other = (
        header().model_copy(update={name: "1.0\x1b[2J"}).model_dump_json().encode()
        for name in ("version", "arch")
    )
    no_time, quoted = (header().model_dump_json().replace("0.125", to).encode() for to in ("0", '"0.125"'))
    absurd = [
        header().model_copy(update=dict(time_step_s=length_s)).model_dump_json().encode()
        for length_s in (1e9, 1e-12, -1.0)
    ]
    strangers = b"", b"\x89PNG\r\n\x1a\n\0\0", b'{"scene": {}}\n', b"[1, 2]\n", b"[" * 100_000
    for content in (*strangers, control, other, no_time, quoted, *absurd):
        (tmp_path / "file").write_bytes(content)
        with pytest.raises(SessionError, match=r"^file: [^\n]+$"):
            read_log(tmp_path / "file")
    for path in (tmp_path / "none", tmp_path):
        with pytest.raises(SessionError):
            read_log(path)


# What was imaged


def voxels(count: int) -> np.ndarray:
    """The first so many of 5 x 3 x 7 were seen."""
    return (np.arange(105) < count).reshape(5, 3, 7)


def test_beside_each_whole_state_is_what_was_seen_until_then(tmp_path):
    live = LiveSession(tmp_path / "session", lambda: pack_seen(voxels(live.stepper.number)))
    live.recorder.close({})
    record_all(tmp_path / "session-2", seen=lambda: pack_seen(voxels(60)))
    log = read_log(tmp_path / "session-2")
    assert sorted(log.seen) == sorted(log.states) == [10, 43]
    assert all(np.array_equal(unpack_seen(seen), voxels(60)) for seen in log.seen.values())


def test_what_was_seen_that_is_damaged_is_named_by_its_line(tmp_path):
    with pytest.raises(ValueError, match="voxels, expected at most"):
        unpack_seen(pack_seen(voxels(60)) | {"shape": [10**4] * 3})
    whole = pack_seen(voxels(60))
    shapes = [[5, 3], [5, 3, 8], [105, 1, 0], [10**5] * 3, [5, 3, 7.0], "537", None, [True, 15, 7]]
    # Without the last two bytes of its checksum all voxels are there.
    cut = base64.b64encode(base64.b64decode(whole["bits"])[:-2]).decode()
    bits = ["", "AAAA", whole["bits"][:-8], cut, "\xe9", 7, pack_seen(np.zeros(300, bool))["bits"]]
    damages = [whole | {"shape": shape} for shape in shapes] + [whole | {"bits": each} for each in bits]
    damages += [{"shape": [1, 1, 1]}, "seen", [], 1, whole | {"of": "doe"}]
    path = tmp_path / "session"
    record_all(path, seen=lambda: whole)
    number = line_with(path, b"seen")
    values = json.loads(lines_of(path)[number - 1])
    for damage in damages:
        with_line(path, number, json.dumps(values | {"seen": damage}).encode())
        with pytest.raises(SessionError, match=rf"^session: line {number} is damaged \([^\n]*$"):
            read_log(path)


# Whole states


def changed_state(name: str, change: Any) -> str:
    """The text of a state with one of its arrays changed."""
    arrays = dict(np.load(io.BytesIO(base64.b64decode(pack_state(fake_timeline().whole_state())))))
    arrays[name] = change(arrays[name])
    packed = io.BytesIO()
    np.savez_compressed(packed, **arrays)
    return base64.b64encode(packed.getvalue()).decode()


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("numbers", lambda numbers: numbers * np.inf),
        ("numbers", lambda numbers: numbers * np.nan),
        ("since_good_s", lambda seconds: seconds + np.nan),
        ("pose", lambda pose: pose * np.nan),
        ("pose", lambda pose: pose[:3]),
        ("now.position", lambda position: position * np.nan),
        ("now.velocity", lambda velocity: velocity * np.inf),
        ("now.position", lambda position: position[:1]),
        ("now.position", lambda position: position.astype(float)),
    ],
)
def test_a_state_that_no_tissue_has_is_refused(tmp_path, name, change):
    positions = fake_timeline().newest().positions
    with np.errstate(invalid="ignore"), pytest.raises(StateError):
        unpack_state(changed_state(name, change), positions)
    assert unpack_state(pack_state(fake_timeline().whole_state()), positions) is not None
    record_all(tmp_path / "session")
    log = read_log(tmp_path / "session")
    log.header = log.header.model_copy(update=dict(begins=changed_state(name, change)))
    with pytest.raises(SessionError, match=r"^the session holds [^\n]*damaged, or of another body$"):
        list(Replay(log).begin(positions))


# Replays


def replayed(log: Any, notices: Notices) -> ReplayCheck:
    """A replay to its end. Raises SessionError."""
    stepper, replay, check = (
        fake_timeline(),
        Replay(log, one_by_one=True),
        ReplayCheck(log, notices),
    )
    while not replay.is_over:
        for command in replay.commands(stepper.newest(), Controls(settings_with()), STEP_S):
            stepper.submit(command)
        frame = stepper.newest()
        replay.check(frame)
        check.observe(frame, None)
    return check


def test_a_digest_that_differs_is_said_with_its_second_once(tmp_path, capsys):
    record_all(tmp_path / "session")
    log = read_log(tmp_path / "session")
    for number in (3 * SECOND + 3, 4 * SECOND + 3):
        assert number in log.digests
        log.digests[number] = "another"
    notices = Notices()
    assert replayed(log, notices).differs_s == 3.0
    (notice,) = notices.present()
    assert "from 3 s on" in notice and "differs" in notice
    assert capsys.readouterr().out.splitlines() == [notice]


def test_a_command_that_cannot_be_repeated_ends_the_replay_in_words(tmp_path):
    record_all(tmp_path / "session")
    log = read_log(tmp_path / "session")
    log.commands.insert(5, (4, CutOut(technique="wedge", margin_mm=5.0, seen="")))
    with pytest.raises(
        SessionError, match=r"^the session's cut cannot be repeated: this patient has no tumour"
    ):
        replayed(log, Notices())


def test_a_replay_keeps_pace_with_the_clock_and_does_not_run_away_from_a_slow_solver(tmp_path):
    record_all(tmp_path / "session")
    replay, stepper = Replay(read_log(tmp_path / "session")), fake_timeline()

    def given(elapsed_s: float) -> int:
        commands = replay.commands(stepper.newest(), Controls(settings_with()), elapsed_s)
        return sum(isinstance(command, Move) for command in list(commands))

    # The stepper gets none of them.
    assert [given(STEP_S / 2) for _ in range(4)] == [1, 0, 1, 0] and given(10.0) == 2
    assert given(10.0) == 0


# Disk, privacy, scenes


class FullDisk(io.RawIOBase):
    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")


def test_a_full_disk_leaves_the_rehearsal_going_and_is_said_once(tmp_path, capsys):
    live = LiveSession(tmp_path / "session")
    live.move(2 * SECOND)
    live.on_disk()
    live.recorder._file = io.TextIOWrapper(io.BufferedWriter(FullDisk()))
    for _ in range(3):
        live.move(SECOND)
        live.on_disk()
    live.recorder.close({})
    live.notices.present()
    fault = "session: no longer written (No space left on device)"
    assert capsys.readouterr().out == f"{fault}\n" and live.recorder.fault == fault
    assert read_log(tmp_path / "session").steps == 2 * SECOND


def recorded_at(folder: Path, ball: trimesh.Trimesh) -> Path:
    """A session of a scene whose files have a patient's name."""
    files = dict(organ="/home/doe/organ.stl", tumour="doe.stl", ct="doe/ct.nrrd", labels="doe/labels.nrrd")
    shape = (dict(kind="mesh", file="/home/doe/table.stl"),)
    probe = dict(probe="/home/doe/probe.toml")
    scene = Scene(anatomy=files, shape=shape, tissue=dict(cell_mm=7.0), transducer=probe)
    own = Header(
        anatomy=fingerprint(LoadedAnatomy(ball, None, None, ())),
        scene=recorded_scene(scene),
        probe=probe_of(load_scene(EMBEDDED)).model_dump(mode="json", by_alias=True),
        arch="x64",
        time_step_s=STEP_S,
    )
    path = next_path(folder)
    record_all(path, header=own)
    return path


def recorded_scene(scene: Scene) -> dict[str, Any]:
    from rehearsal.sessions.session_file import recorded_values

    return recorded_values(scene)


def refused(*arguments: Any) -> str:
    """The one line with which a rehearsal is refused."""
    with redirect_stderr(io.StringIO()) as told:
        assert app.main(["rehearse", *map(str, arguments)]) == 2
    (line,) = told.getvalue().strip().splitlines()
    return line


def test_a_session_names_no_path_and_is_written_over_none(tmp_path, ball):
    paths = [recorded_at(tmp_path, ball) for _ in range(2)]
    assert [path.name for path in paths] == ["session-001.jsonl", "session-002.jsonl"]
    text = paths[0].read_text()
    assert not any(word in text for word in ("doe", ".stl", ".toml", ".nrrd", str(tmp_path)))
    assert "/" not in text.splitlines()[0] and "\\" not in text


def test_a_session_is_refused_with_another_patient_and_with_options_of_its_own(tmp_path, ball):
    path = recorded_at(tmp_path, ball)
    assert "other anatomy" in refused("--replay", path)
    for option, value in (("--cell", 7), ("--probe", "linear"), ("--budget-ms", 5), ("--quality", "fast")):
        assert refused("--replay", path, option, value).startswith(f"nephron: {option}: a replay computes")
    assert refused("--at", 3).startswith("nephron: --at: ")
    length_s = read_log(path).length_s
    beyond = refused("--replay", path, "--at", length_s + 1)
    assert f"--at {length_s + 1:g}: the session is {length_s:.1f} s long; choose an earlier" in beyond
    assert "other anatomy" in refused("--replay", path, "--at", length_s)
    assert "no such session file" in refused("--replay", tmp_path / "none")


def test_the_scene_of_a_session_is_the_patients_with_all_else_as_recorded(tmp_path, ball):
    embedded = load_scene(EMBEDDED)
    scene = scene_of_log(read_log(recorded_at(tmp_path, ball)).header, embedded)
    assert scene.tissue.cell_mm == 7.0 != embedded.tissue.cell_mm
    assert (scene.anatomy, scene.shape, scene.title) == (embedded.anatomy, embedded.shape, embedded.title)
    assert "tissue.cell_mm 7.0 (scene: 3.5)" in settings_apart(scene, embedded)
    assert settings_apart(embedded, embedded) == []


@pytest.mark.parametrize("own", [load_scene(EMBEDDED), Scene(anatomy={"phantom": True})])
def test_what_a_session_says_of_a_patient_or_of_files_is_not_believed(tmp_path, ball, own):
    recorded = read_log(recorded_at(tmp_path, ball)).header
    planted = dict(title="another", anatomy=dict(phantom=False, organ="other.stl"), shape=[])
    planted["transducer"] = recorded.scene["transducer"] | dict(probe="other.toml", speed_mm_s=33.0)
    scene = scene_of_log(recorded.model_copy(update=dict(scene=recorded.scene | planted)), own)
    assert (scene.anatomy, scene.shape, scene.title) == (own.anatomy, own.shape, own.title)
    assert scene.transducer.probe == own.transducer.probe and scene.transducer.speed_mm_s == 33.0


def test_what_the_probe_did_is_recorded_beside_what_the_hand_asked(tmp_path):
    path = tmp_path / "session.jsonl"
    live = LiveSession(path)
    asked = [(pose_at(1.0, z=z), presses) for z, presses in ((2.0, True), (-3.0, False), (-99.0, True))]
    live.do(*(Move(pose=pose, presses=presses) for pose, presses in asked))
    live.recorder.close({})
    log = read_log(path)
    moves = [command for _, command in log.commands]
    assert [(move.pose[2, 3], move.presses) for move in moves] == [(2.0, True), (-3.0, False), (-99.0, True)]
    assert [log.poses[number][2, 3] for number in range(3)] == [2.0, SURFACE_MM, DEEPEST_MM]
    # The replay moves the hand, and so gets the same states.
    again = fake_timeline()
    again.submit(NewSession(pose=np.eye(4)))
    for move in moves:
        again.submit(move)
    assert again.organ.digest() == live.stepper.organ.digest()
    # Where the probe follows and presses, the hand's poses say all.
    plain = LiveSession(tmp_path / "plain.jsonl")
    plain.do(Move(pose=pose_at(1.0)))
    plain.recorder.close({})
    assert not {'"probe":"', '"presses":'} & set((tmp_path / "plain.jsonl").read_text().split(","))
    assert (read_log(tmp_path / "plain.jsonl").poses[0] == pose_at(1.0)).all()
