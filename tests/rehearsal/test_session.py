"""A session recorded, read and replayed: the same bits, whatever became of the file and wherever it is opened."""

import base64
import errno
import io
import json
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
from rehearsal.inputs.input_source import ReplayInput
from rehearsal.inputs.user_input import UserInput
from rehearsal.sessions.session import Session
from test_undo_history import STEP_S, Numbers, ray, step

import app
from rehearsal.configuration import probe_of
from rehearsal.resection.cut import CutSettings
from rehearsal.resection.script import ResectionScript, ScriptedAction
from rehearsal.sessions import recorder
from rehearsal.sessions.packed_arrays import (
    StateError,
    pack_poses,
    pack_seen,
    pack_state,
    unpack_poses,
    unpack_seen,
    unpack_state,
)
from rehearsal.sessions.recorder import SessionRecorder, record
from rehearsal.sessions.replay import Replay
from rehearsal.sessions.session_file import (
    Event,
    Header,
    Log,
    SessionError,
    read_log,
    scene_of_log,
    settings_apart,
)
from render.viewer import Controls, Settings
from scenes.anatomy import LoadedAnatomy
from scenes.scene import EMBEDDED, Scene, load_scene
from version import FORMAT

SECOND = round(1 / STEP_S)


def header() -> Header:
    return Header(anatomy="0", scene={}, probe={}, arch="x64", time_step_s=STEP_S)


def live_into(path: Path, seen: Callable[[], np.ndarray] | None = None) -> UserInput:
    session = Session(Numbers(), coverage=None if seen is None else lambda: SimpleNamespace(seen=seen()))
    return UserInput(session, SessionRecorder(session, path, header()))


def scripted(random: np.random.Generator) -> list[ScriptedAction]:
    """Sometimes a mark, or a cut; both are refused after a cut, and a cut without a mark."""
    marks = [(0.0, 0.0, float(random.uniform(5.0, 15.0)))] if random.random() < 0.15 else None
    cut = CutSettings("wedge", float(random.integers(0, 9)), 5.0) if random.random() < 0.08 else None
    return [] if marks is None and cut is None else [ScriptedAction(0.0, marks, 5.0, cut)]


def lead(live: UserInput, moments: int, seed: int, lengths_s: tuple[float, ...] = (STEP_S,)) -> str:
    """A user who does all there is to do, at random, in steps of these lengths; the tissue's digest at the end."""
    random = np.random.default_rng(seed)
    settings = Settings(young_kpa=15.0)
    pressing = False
    for _ in range(moments):
        pressing ^= random.random() < 0.1
        settings.young_kpa = float(random.choice([5.0, 15.0, 1 / 3])) if random.random() < 0.05 else 15.0
        settings.iterations = int(random.integers(1, 20)) if random.random() < 0.1 else settings.iterations
        taken = dict(length_s=float(random.choice(lengths_s)), iterations=int(random.integers(1, 20)))
        keys = ("undo", "redo", "reset", "bookmark", "to_bookmark")
        did = {key: bool(random.random() < 0.04) for key in keys}
        x_mm = float(random.uniform(-8, 8))
        live.script = ResectionScript(scripted(random))
        step(
            live,
            settings=settings,
            ray=ray(x_mm) if random.random() < 0.2 else None,
            press=pressing,
            **taken,
            **did,
        )
        live.after_frame()
    return live.session.rehearsal.digest()


def written(path: Path, moments: int = 100, seed: int = 0, lengths_s: tuple[float, ...] = (STEP_S,)) -> str:
    live = live_into(path)
    digest = lead(live, moments, seed, lengths_s)
    live.recorder.close({"presses": 1})
    return digest


def played(log: Log, at_s: float = 0.0) -> Replay:
    """A replay opened at a time and played to its end."""
    replay = Replay(Numbers(), log)
    replay.begin_at(at_s)
    assert len(list(replay.go_to(at_s))) <= replay.session.step_index == log.step_at(at_s)
    for _ in replay.go_to(log.length_s):
        pass
    assert replay.is_over
    return replay


@pytest.fixture
def often(monkeypatch) -> None:
    """Whole states every two seconds."""
    monkeypatch.setattr(recorder, "STATE_S", 2.0)


@pytest.mark.parametrize("seed", range(8))
def test_a_session_replays_from_its_beginning_and_from_anywhere(often, tmp_path, seed):
    digest = written(tmp_path / "session", 150, seed)
    log = read_log(tmp_path / "session")
    assert len(log.poses) == 150 and len(log.states) >= 10 and log.summary == {"presses": 1}
    assert {event.kind for each in log.events.values() for event in each} >= {
        "back",
        "solver",
        "settings",
        "marks",
        "cut",
    }
    for at_s in (0.0, 3.0, 7.6, 9.999, 13.0, 1000.0):
        replay = played(log, at_s)
        assert replay.differs_s is None and replay.rehearsal.digest() == digest, at_s
        assert replay.compared >= 10 - at_s
        assert replay.bookmarks == sum(e.kind == "bookmark" for each in log.events.values() for e in each)
    replay = played(replace(log, states={}), 9.0)
    assert replay.differs_s is None and replay.compared == len(log.digests) == 19
    assert replay.rehearsal.digest() == digest


@pytest.mark.parametrize("seed", range(3))
def test_steps_of_different_lengths_replay_from_their_beginning_and_from_anywhere(often, tmp_path, seed):
    digest = written(tmp_path / "session", 150, seed, (STEP_S / 2, STEP_S, 2 * STEP_S))
    log = read_log(tmp_path / "session")
    assert set(log.lengths_s) == {STEP_S / 2, STEP_S, 2 * STEP_S} and len(log.states) >= 10
    for at_s in (0.0, 7.6, log.length_s / 2):
        replay = played(log, at_s)
        assert replay.differs_s is None and replay.rehearsal.digest() == digest
        assert replay.time_s == log.length_s


def marked_then_gone_to(path: Path) -> Log:
    """A bookmark at moment 5, gone to at moment 32; a whole state after every 8 moments of 48."""
    live = live_into(path)
    for moment in range(48):
        step(live, ray=ray(moment % 7 - 3.0), bookmark=moment == 5, to_bookmark=moment == 32)
        live.after_frame()
    live.recorder.close({})
    return read_log(path)


def test_a_state_that_a_later_way_back_goes_behind_is_not_begun_at(monkeypatch, tmp_path):
    monkeypatch.setattr(recorder, "STATE_S", 1.0)
    log = marked_then_gone_to(tmp_path / "session")
    assert sorted(log.states) == [5, 8, 16, 24, 32, 40, 48]
    # With the bookmark's own state all others can be begun at.
    assert Replay(Numbers(), log).begin_at(25 * STEP_S) == 24
    assert played(log, 25 * STEP_S).differs_s is None
    del log.states[5]
    for moment, begun_at in ((5, 0), (25, 0), (32, 0), (33, 0), (39, 0), (40, 40), (47, 40)):
        replay = Replay(Numbers(), log)
        assert replay.begin_at(moment * STEP_S) == begun_at == replay.session.step_index
        assert len(list(replay.go_to(moment * STEP_S))) == moment - begun_at
        assert replay.session.step_index == moment and replay.bookmarks == (moment > 5)
    assert played(log, 25 * STEP_S).differs_s is None


def voxels(count: int) -> np.ndarray:
    """The first so many of 5 x 3 x 7 were seen."""
    return (np.arange(105) < count).reshape(5, 3, 7)


def test_beside_each_whole_state_stands_what_was_seen_until_then(often, tmp_path):
    live = live_into(tmp_path / "session", lambda: voxels(live.session.step_index))
    for moment in range(50):
        step(live, bookmark=moment == 13, ray=ray(moment % 7 - 3.0))
        live.after_frame()
    live.recorder.close({})
    log = read_log(tmp_path / "session")
    assert sorted(log.seen) == sorted(log.states) == [13, 16, 32, 48, 50]
    assert all(np.array_equal(unpack_seen(seen), voxels(moment)) for moment, seen in log.seen.items())
    assert played(log).differs_s is None


def test_of_more_voxels_than_an_organ_has_none_is_unpacked():
    with pytest.raises(ValueError, match="voxels, expected at most"):
        unpack_seen(pack_seen(voxels(60)) | {"shape": [10**4] * 3})


def test_what_was_seen_that_is_damaged_is_named_by_its_line(tmp_path):
    whole = pack_seen(voxels(60))
    damages = [
        whole | {"shape": shape}
        for shape in ([5, 3], [5, 3, 8], [105, 1, 0], [10**5] * 3, [5, 3, 7.0], "537", None, [True, 15, 7])
    ]
    # Without the last two bytes of its checksum all voxels are there.
    cut = base64.b64encode(base64.b64decode(whole["bits"])[:-2]).decode()
    damages += [whole | {"bits": bits} for bits in ("", "AAAA", whole["bits"][:-8], cut, "\xe9", 7)]
    damages += [whole | {"bits": pack_seen(np.zeros(300, bool))["bits"]}, {"shape": [1, 1, 1]}, "seen", [], 1]
    damages += [whole | {"of": "doe"}]
    live = live_into(tmp_path / "session", lambda: voxels(60))
    for moment in range(9):
        step(live, bookmark=moment == 3)
        live.after_frame()
    live.recorder.close({})
    lines = (tmp_path / "session").read_text().splitlines()
    second, end = json.loads(lines[1]), json.loads(lines[-1])
    assert end["seen"] == whole == next(e["value"] for e in second["events"] if e["kind"] == "seen")
    for damage in damages:
        for event in second["events"]:
            event["value"] = damage if event["kind"] == "seen" else event["value"]
        end["seen"] = damage
        for number, texts in ((2, [json.dumps(second), *lines[2:]]), (4, [*lines[1:3], json.dumps(end)])):
            (tmp_path / "session").write_text("\n".join([lines[0], *texts, ""]))
            with pytest.raises(SessionError, match=rf"^session: line {number} is damaged \([^\n]*$"):
                read_log(tmp_path / "session")


@pytest.mark.parametrize("at_back", [False, True])
def test_a_digest_that_differs_is_said_with_its_second_once(tmp_path, capsys, at_back):
    live = live_into(tmp_path / "session")
    for moment in range(50):
        step(live, reset=at_back and moment == 3 * SECOND - 1)
        live.after_frame()
    live.recorder.close({})
    log = read_log(tmp_path / "session")
    for moment in (3 * SECOND, 5 * SECOND):
        log.digests[moment] = "another"
    driver = ReplayInput(Replay(Numbers(), log), lambda: None)
    while not driver.replay.is_over:
        pose = driver.next_pose(Controls(Settings()))
        if pose is not None:
            driver.after_step(driver.replay.rehearsal.timed_step(pose))
    assert driver.replay.differs_s == 3.0
    assert driver.notices.present() == []
    (notice,) = capsys.readouterr().out.splitlines()
    assert "from 3 s on" in notice and "differs" in notice


@pytest.mark.parametrize(
    ("events", "no_pose"), [([-2], 3), ([4], 3), (["1"], 3), ([None], 3), ([], 3), ([1], 5)]
)
def test_a_way_back_to_nowhere_and_a_moment_without_a_pose_are_refused(tmp_path, events, no_pose):
    written(tmp_path / "session", 20)
    log = read_log(tmp_path / "session")
    log.events |= {3: [Event.model_construct(at=3, kind="back", value=to) for to in events]}
    log.poses[no_pose] = np.nan
    with pytest.raises(SessionError, match="damaged"):
        Replay(Numbers(), log)


def test_a_state_of_another_body_is_refused(tmp_path):
    written(tmp_path / "session", 20)
    log = read_log(tmp_path / "session")
    log.header.begins = log.states[20]
    other = Numbers()
    other.settled.solver.history["plane"] = np.zeros((3, 4), np.float32)
    with pytest.raises(SessionError, match="another body"):
        Replay(other, log)


def test_poses_keep_every_bit_and_ways_back_are_no_numbers():
    random = np.random.default_rng(1)
    poses: list[np.ndarray | None] = [np.vstack([random.normal(size=(3, 4)), np.eye(4)[3]]) for _ in range(9)]
    poses[2][0] = [-0.0, 5e-324, 1e308, 1 / 3]
    poses[4] = None
    back = unpack_poses(pack_poses(poses))
    assert np.isnan(back[4, :3]).all()
    assert all(back[i].tobytes() == pose.tobytes() for i, pose in enumerate(poses) if pose is not None)


def on_disk(live: UserInput) -> None:
    """Wait until the disk has all that was handed to it."""
    live.recorder._disk.submit(int).result(10)


def test_the_file_is_on_the_disk_each_second(tmp_path):
    live = live_into(tmp_path / "session")
    for second in range(1, 4):
        digest = lead(live, SECOND, second)
        on_disk(live)
        log = read_log(tmp_path / "session")
        assert len(log.poses) == second * SECOND and log.digests[second * SECOND] == digest
        assert log.summary is None and log.length_s == second
    live.recorder.close({})


def test_of_a_file_that_a_crash_cut_all_whole_seconds_are_read(tmp_path):
    written(tmp_path / "session", 41)
    whole = (tmp_path / "session").read_bytes()
    ends = [at for at, byte in enumerate(whole, 1) if byte == ord("\n")]
    assert len(ends) == 8
    moments = [0, 8, 16, 24, 32, 40, 41, 41]
    cuts = {*range(ends[4] - 3, len(whole), 7), *ends, *(end - 1 for end in ends[1:])}
    for cut in cuts:
        (tmp_path / "session").write_bytes(whole[:cut])
        log = read_log(tmp_path / "session")
        assert len(log.poses) == moments[sum(end <= cut for end in ends) - 1]
        assert (log.summary is None) == (cut < len(whole))
    # What a disk may leave where the power went: zeros, or anything else.
    for rest in (bytes(500), b"\xff\xfe\xc3", whole[ends[3] : ends[4] - 1] + b"\xc3"):
        (tmp_path / "session").write_bytes(whole[: ends[4]] + rest)
        assert len(read_log(tmp_path / "session").poses) == 32
    for cut in range(0, ends[0] - 1, 9):
        (tmp_path / "session").write_bytes(whole[:cut])
        with pytest.raises(SessionError):
            read_log(tmp_path / "session")


def damaged(line: bytes) -> Iterator[bytes]:
    yield line[:-20]
    yield b""
    yield line.replace(b'"digest"', b'"digits"')
    yield line.replace(b'"at":8', b'"at":9')
    yield b'{"at":8,"poses":"","digest":"0"}'
    yield line.replace(b'"poses":"', b'"poses":"AAAA')
    for stranger in (b"\xc3", b"\0", b"["):
        yield line[:10] + stranger + line[11:]
    yield from (b"3", b"null", b'"summary"', b"[" * 100_000)


def test_a_damaged_line_is_named_by_its_number(tmp_path):
    written(tmp_path / "session", 41)
    lines = (tmp_path / "session").read_bytes().split(b"\n")
    for line in damaged(lines[2]):
        (tmp_path / "session").write_bytes(b"\n".join([*lines[:2], line, *lines[3:]]))
        with pytest.raises(SessionError, match="^session: line 3 "):
            read_log(tmp_path / "session")
    (tmp_path / "session").write_bytes(b"\n".join([*lines[:2], *lines[3:]]))
    with pytest.raises(SessionError, match="line 3 does not follow"):
        read_log(tmp_path / "session")


@pytest.mark.parametrize("other", [FORMAT - 1, FORMAT + 1])
def test_a_session_of_another_format_is_refused_with_its_version(tmp_path, other):
    values = header().model_dump() | dict(nephron_session=other, unheard_of=1)
    (tmp_path / "file").write_text(json.dumps(values) + "\n")
    with pytest.raises(
        SessionError, match=f"nephron_session = {other}: written by Nephron {other}, and this is"
    ):
        read_log(tmp_path / "file")


def test_what_is_no_session_is_said_so_in_one_line(tmp_path):
    control, other = (
        header().model_copy(update={name: "1.0\x1b[2J"}).model_dump_json().encode()
        for name in ("version", "arch")
    )
    no_time, quoted = (header().model_dump_json().replace("0.125", to).encode() for to in ("0", '"0.125"'))
    strangers = b"", b"\x89PNG\r\n\x1a\n\0\0", b'{"scene": {}}\n', b"[1, 2]\n", b"[" * 100_000
    for content in (*strangers, control, other, no_time, quoted):
        (tmp_path / "file").write_bytes(content)
        with pytest.raises(SessionError, match=r"^file: [^\n]+$"):
            read_log(tmp_path / "file")
    for path in (tmp_path / "none", tmp_path):
        with pytest.raises(SessionError):
            read_log(path)


@pytest.mark.parametrize("length_s", [1e9, 1e-12, -1.0])
def test_a_session_of_absurd_steps_is_refused(tmp_path, length_s):
    (tmp_path / "file").write_text(
        header().model_copy(update=dict(time_step_s=length_s)).model_dump_json() + "\n"
    )
    with pytest.raises(SessionError, match=r"^file: .*time_step_s = .* should be"):
        read_log(tmp_path / "file")


@pytest.mark.parametrize(
    "pose", [0 * np.eye(4), 3 * np.eye(4), np.diag([1.0, 1, -1, 1]), np.eye(4) + np.eye(4, k=3) * 1e6]
)
def test_a_pose_of_a_session_that_is_none_is_named_by_its_line(tmp_path, pose):
    written(tmp_path / "session", 41)
    lines = (tmp_path / "session").read_bytes().split(b"\n")
    second = json.loads(lines[2])
    second["poses"] = pack_poses([*unpack_poses(second["poses"])[:-1], pose])
    (tmp_path / "session").write_bytes(b"\n".join([*lines[:2], json.dumps(second).encode(), *lines[3:]]))
    with pytest.raises(SessionError, match="^session: line 3 has a pose that is none of a probe"):
        read_log(tmp_path / "session")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("grip.turn_deg", np.nan),
        ("grip.depth_mm", np.inf),
        ("numbers", np.inf),
        ("numbers", np.nan),
    ],
)
def test_a_state_with_what_is_no_number_is_refused(tmp_path, name, value):
    numbers = Numbers()
    text = pack_state(numbers.snapshot())
    arrays = dict(np.load(io.BytesIO(base64.b64decode(text))))
    arrays[name] = np.full(arrays[name].shape, value, arrays[name].dtype if name != "numbers" else float)
    changed = io.BytesIO()
    np.savez_compressed(changed, **arrays)
    with pytest.raises(StateError, match="cannot be used"):
        unpack_state(base64.b64encode(changed.getvalue()).decode(), numbers.settled)
    assert unpack_state(text, numbers.settled) is not None


@pytest.mark.parametrize(("name", "value"), [("position", np.nan), ("velocity", np.inf)])
def test_a_session_that_begins_with_tissue_that_is_not_finite_is_refused(tmp_path, name, value):
    written(tmp_path / "session", 41)
    log, numbers = read_log(tmp_path / "session"), Numbers()
    state = numbers.snapshot()
    body = state.solver.body
    damaged = replace(body, **{name: np.full_like(getattr(body, name), value)})
    state = replace(state, solver=replace(state.solver, body=damaged))
    log.header = log.header.model_copy(update=dict(begins=pack_state(state)))
    with pytest.raises(SessionError, match="a state of tissue that is not finite"):
        Replay(numbers, log)


class FullDisk(io.RawIOBase):
    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")


def test_a_full_disk_leaves_the_rehearsal_going_and_is_said_once(tmp_path, capsys):
    live = live_into(tmp_path / "session")
    for moment in range(50):
        if moment in (20, 40):
            on_disk(live)
        if moment == 20:
            live.recorder._file = io.TextIOWrapper(io.BufferedWriter(FullDisk()))
        step(live)
        live.after_frame()
    live.recorder.close({})
    live.recorder.notices.present()
    assert capsys.readouterr().out == "session: no longer written (No space left on device)\n"
    assert live.recorder.fault == "session: no longer written (No space left on device)"
    assert live.session.step_index == 50 and len(read_log(tmp_path / "session").poses) == 16


def recorded_at(folder: Path, ball: trimesh.Trimesh) -> SessionRecorder:
    """Numbers recorded in a scene whose files have a patient's name."""
    numbers = Numbers()
    files = dict(organ="/home/doe/organ.stl", tumour="doe.stl", ct="doe/ct.nrrd", labels="doe/labels.nrrd")
    shape = (dict(kind="mesh", file="/home/doe/table.stl"),)
    probe = dict(probe="/home/doe/probe.toml")
    numbers.scene = Scene(anatomy=files, shape=shape, tissue=dict(cell_mm=7.0), transducer=probe)
    numbers.probe = probe_of(load_scene(EMBEDDED))
    kept = record(Session(numbers), LoadedAnatomy(ball, None, None, ()), "x64", folder)
    lead(UserInput(kept.session, kept), 30, 0)
    kept.close({})
    return kept


def refused(*arguments: Any) -> str:
    """The one line with which a rehearsal is refused."""
    with redirect_stderr(io.StringIO()) as told:
        assert app.main(["rehearse", *map(str, arguments)]) == 2
    (line,) = told.getvalue().strip().splitlines()
    return line


def test_a_session_names_no_path_and_is_written_over_none(tmp_path, ball):
    paths = [recorded_at(tmp_path, ball).path for _ in range(2)]
    assert [path.name for path in paths] == ["session-001.jsonl", "session-002.jsonl"]
    text = paths[0].read_text()
    assert not any(word in text for word in ("doe", ".stl", ".toml", ".nrrd", str(tmp_path)))
    assert "/" not in text.splitlines()[0] and "\\" not in text


def test_a_session_is_refused_with_another_patient_and_with_options_of_its_own(tmp_path, ball):
    path = recorded_at(tmp_path, ball).path
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
    scene = scene_of_log(read_log(recorded_at(tmp_path, ball).path).header, embedded)
    assert scene.tissue.cell_mm == 7.0 != embedded.tissue.cell_mm
    assert (scene.anatomy, scene.shape, scene.title) == (embedded.anatomy, embedded.shape, embedded.title)
    assert "tissue.cell_mm 7.0 (scene: 3.5)" in settings_apart(scene, embedded)
    assert settings_apart(embedded, embedded) == []


@pytest.mark.parametrize("own", [load_scene(EMBEDDED), Scene(anatomy={"phantom": True})])
def test_what_a_session_says_of_a_patient_or_of_files_is_not_believed(tmp_path, ball, own):
    header = read_log(recorded_at(tmp_path, ball).path).header
    planted = dict(title="another", anatomy=dict(phantom=False, organ="other.stl"), shape=[])
    planted["transducer"] = header.scene["transducer"] | dict(probe="other.toml", speed_mm_s=33.0)
    scene = scene_of_log(header.model_copy(update=dict(scene=header.scene | planted)), own)
    assert (scene.anatomy, scene.shape, scene.title) == (own.anatomy, own.shape, own.title)
    assert scene.transducer.probe == own.transducer.probe and scene.transducer.speed_mm_s == 33.0
