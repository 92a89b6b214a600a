"""The file of a session: a line of JSON for each command, with the number of the state that it was applied
to.

The first line names what is rehearsed. Moves are packed, those of a second or up to the next command in a
line. Beside them are hashes of the tissue, whole states with the coverage, measurements, and in the last line
the summary. Each line is on the disk when it is written, so that a crash costs a second at most. No line
names a patient or a path.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from errors import FOUND, UserError, explained
from rehearsal.loop.command import (
    LEAST_STEP_S,
    MOST_STEP_S,
    BeginAction,
    Bookmark,
    CutOut,
    GoTo,
    Mark,
    Move,
    Recorded,
    Redo,
    Reset,
    Undo,
    are_rigid,
)
from rehearsal.loop.state import History
from rehearsal.loop.timeline import SETTLED
from rehearsal.sessions.packed_arrays import Seen, SeenVoxels, unpack_bits, unpack_lengths, unpack_poses
from scenes.scene import Scene
from text_files import TextError, json_value

# Times are sums of steps.
ROUNDING_S = 1e-9
# The format of a session's file. The first had events between the poses of seconds.
SESSION_FORMAT = 3
MOST_FILE_BYTES = 2_000_000_000
# The parts of a scene that belong to the patient's folder and may name files.
PATIENTS: dict[str, Any] = {
    **{"anatomy": True, "shape": True, "title": True, "uncertainty": True},
    "transducer": {"probe"},
}


class SessionError(UserError):
    """A session's file that cannot be used; the message is one line."""


class _Line(BaseModel):
    """A text is no number."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, strict=True)


class Header(_Line):
    """What is rehearsed, by which version of Nephron. ``anatomy`` is the fingerprint of the scene's files."""

    nephron_session: int = SESSION_FORMAT
    version: str | None = Field(None, pattern=r"^[0-9A-Za-z.+-]{1,40}$")
    anatomy: str
    scene: dict[str, Any]
    probe: dict[str, Any]
    arch: str = Field(pattern=r"^[0-9a-z_]{1,20}$")
    time_step_s: float = Field(ge=LEAST_STEP_S, le=MOST_STEP_S)
    serial: bool | None = None
    """Whether a step was computed on one core: its bits depend on that, and machines differ in it."""
    begins: str | None = None
    """The state that it begins with, where that is not the settled one."""

    @model_validator(mode="before")
    @classmethod
    def _has_this_format(cls, values: Any) -> Any:
        version = values.get("nephron_session") if isinstance(values, dict) else None
        if isinstance(version, int) and 0 < version < SESSION_FORMAT:
            raise ValueError(
                f"nephron_session = {version}: recorded by Nephron {version}, which replays it; record the "
                "session anew with this one"
            )
        if version is not None and version != SESSION_FORMAT:
            raise ValueError(f"nephron_session = {FOUND.repr(version)}: expected {SESSION_FORMAT}")
        return values


class CommandLine(_Line):
    """A command that was applied to the state of a number."""

    at: int = Field(ge=0)
    command: Annotated[Recorded, Field(discriminator="kind")]


class MovesLine(_Line):
    """Moves from the state of a number on, packed: the poses that the hand asked for, those of the probe
    where one differs, which moves pressed where one only touched, lengths where one is not the header's, and
    wrenches (force [N] of the tissue on the probe, torque [N mm] about the centre of the array face, LPS).
    """

    at: int = Field(ge=0)
    moves: str
    probe: str | None = None
    presses: str | None = None
    lengths_s: str | None = None
    wrenches: str | None = None


class DigestLine(_Line):
    """A hash of the tissue in the state of a number."""

    at: int = Field(ge=0)
    digest: str


class StateLine(_Line):
    """The whole state of a number, and the coverage until then."""

    at: int = Field(ge=0)
    state: str
    seen: Seen | None = None


class ReadingLine(_Line):
    """Measurements in the state of a number."""

    at: int = Field(ge=0)
    reading: dict[str, float | None]


class EndLine(_Line):
    """The summary of a session that ended in order."""

    summary: dict[str, Any]


# The key that only lines of a kind have.
LINES: dict[str, type[_Line]] = dict(
    command=CommandLine,
    moves=MovesLine,
    digest=DigestLine,
    state=StateLine,
    reading=ReadingLine,
    summary=EndLine,
)


@dataclass
class Log:
    """A session as read: its ``commands`` in their order, each with the number of the state that it was
    applied to; the rest by number. ``poses`` (4, 4) are those of the probe after a move.
    """

    header: Header
    commands: list[tuple[int, Recorded | Move]] = field(default_factory=list)
    poses: dict[int, np.ndarray] = field(default_factory=dict)
    digests: dict[int, str] = field(default_factory=dict)
    states: dict[int, str] = field(default_factory=dict)
    seen: dict[int, SeenVoxels] = field(default_factory=dict)
    readings: dict[int, dict[str, float | None]] = field(default_factory=dict)
    summary: dict[str, Any] | None = None
    last_number: int = 0

    @property
    def steps(self) -> int:
        """The number of moves."""
        return sum(isinstance(command, Move) for _, command in self.commands)

    @property
    def length_s(self) -> float:
        """Simulated time."""
        return float(self.ends_s[-1]) if self.commands else 0.0

    @property
    def ends_s(self) -> np.ndarray:
        """The simulated time (n,) [s] after each command."""
        lengths = [
            (command.length_s or self.header.time_step_s) if isinstance(command, Move) else 0.0
            for _, command in self.commands
        ]
        return np.cumsum(lengths)

    def place_at(self, seconds: float) -> int:
        """How many commands come before a time [s]: up to the move whose end is nearest to it, or all at
        the end.
        """
        ends_s = self.ends_s
        if not self.commands or seconds >= ends_s[-1] - ROUNDING_S:
            return len(self.commands)
        starts_s = np.concatenate([[0.0], ends_s])
        return int(np.argmin(np.abs(starts_s - seconds)))

    def restored(self) -> list[tuple[int, int, History]]:
        """For each command that restores a state its place, the number of that state, and the history
        before it.
        """
        restored, history = [], History()
        for place, (number, command) in enumerate(self.commands):
            after, to = history_after(history, number, command)
            if to is not None:
                restored.append((place, to, history))
            history = after
        return restored


def history_after(history: History, number: int, command: Recorded | Move) -> tuple[History, int | None]:
    """The history after a command that was applied to the state of a number, and the number of the state
    that it restored.
    """
    match command:
        case BeginAction() | Mark():
            return history.begun(number), None
        case CutOut():
            return history.begun(number).attempted(number + 1), None
        case Bookmark():
            return history.marked(number), None
        case Undo():
            return history.undo(number)
        case Redo():
            return history.redo(number)
        case Reset():
            return history.begun(number), SETTLED
        case GoTo():
            return history.begun(number), command.state
    return history, None


def makes_state(command: Recorded | Move) -> bool:
    """Whether the tissue has another state after a command."""
    return isinstance(command, Move | Mark | CutOut | Undo | Redo | Reset | GoTo)


def read_log(path: Path) -> Log:
    """Read a session's file, without a last line that a crash cut off. Raises SessionError."""
    name = path.name
    try:
        if path.stat().st_size > MOST_FILE_BYTES:
            raise SessionError(
                f"{name}: is larger than any session; expected a file that rehearse has written"
            )
        lines = path.read_bytes().split(b"\n")
    except FileNotFoundError:
        raise SessionError(f"{path}: no such session file") from None
    except OSError as error:
        raise SessionError(f"{name}: cannot be read as a session ({error.strerror})") from None
    log, number = Log(_header(name, lines[0])), 0
    # A last line without its end was being written when the session was cut off.
    for count, text in enumerate(lines[1:-1], 2):
        line = _line_of(name, count, text)
        if isinstance(line, EndLine):
            log.summary = line.summary
            break
        try:
            number = _add(log, line, number)
        except ValueError as error:
            raise SessionError(
                f"{name}: line {count} {error}; what comes before it can be had by deleting from it on"
            ) from None
    log.last_number = number
    _check_history(name, log)
    return log


def _add(log: Log, line: _Line, number: int) -> int:
    """Add a line to a log at the state of a number; return the number after it. Raises ValueError."""
    match line:
        case CommandLine():
            _check_follows(line.at, number)
            log.commands.append((number, line.command))
            return number + makes_state(line.command)
        case MovesLine():
            _check_follows(line.at, number)
            return _add_moves(log, line, number)
        case DigestLine():
            log.digests[line.at] = line.digest
        case StateLine():
            log.states[line.at] = line.state
            if line.seen is not None:
                log.seen[line.at] = line.seen
        case ReadingLine():
            log.readings[line.at] = line.reading
    return number


def _add_moves(log: Log, line: MovesLine, number: int) -> int:
    hand = unpack_poses(line.moves)
    count = len(hand)
    probe = hand if line.probe is None else unpack_poses(line.probe)
    if not are_rigid(np.concatenate([hand, probe])) or count == 0:
        raise ValueError("has a pose that is none of a probe: expected right-angled axes of length 1")
    lengths_s = np.full(count, log.header.time_step_s)
    if line.lengths_s is not None:
        lengths_s = unpack_lengths(line.lengths_s)
    presses = np.ones(count, bool) if line.presses is None else unpack_bits(line.presses, count)
    if len(lengths_s) != count or len(probe) != count:
        raise ValueError(f"has {len(lengths_s)} lengths and {len(probe)} poses of the probe of {count} moves")
    for at, (pose, length_s) in enumerate(zip(hand, lengths_s.tolist(), strict=True), number):
        of_move = dict(pose=pose, length_s=length_s, presses=bool(presses[at - number]))
        log.commands.append((at, Move.model_construct(kind="move", **of_move)))
        log.poses[at] = probe[at - number]
    return number + count


def _check_follows(at: int, number: int) -> None:
    if at != number:
        raise ValueError("does not follow the line before it: one is missing or damaged")


def _check_history(name: str, log: Log) -> None:
    """Raises SessionError for a log that restores a state which had not been made."""
    for place, to, history in log.restored():
        command = log.commands[place][1]
        if isinstance(command, GoTo) and to not in history.marked_states:
            raise SessionError(
                f"{name}: it goes to a bookmark or an attempt that there was not: its file is damaged"
            )
    history = History()
    for number, command in log.commands:
        history, restored = history_after(history, number, command)
        if isinstance(command, Undo | Redo) and restored is None:
            raise SessionError(f"{name}: it restores a state that had not been made: its file is damaged")


def _header(name: str, line: bytes) -> Header:
    try:
        return Header.model_validate(json_value(line))
    except (ValidationError, TextError) as error:
        what = explained(error) if isinstance(error, ValidationError) else error
        raise SessionError(
            f"{name}: not a session of this version ({what}); expected a file that rehearse has written, "
            "such as session-001.jsonl"
        ) from None


def _line_of(name: str, count: int, text: bytes) -> _Line:
    try:
        values = json_value(text)
        kind = next((key for key in LINES if isinstance(values, dict) and key in values), "command")
        return LINES[kind].model_validate(values)
    except (ValidationError, TextError) as error:
        what = explained(error) if isinstance(error, ValidationError) else error
        raise SessionError(
            f"{name}: line {count} is damaged ({what}); what comes before it can be had by deleting from it "
            "on"
        ) from None


def recorded_values(scene: Scene) -> dict[str, Any]:
    """The part of a scene that a session records."""
    return scene.model_dump(mode="json", exclude=PATIENTS)


def scene_of_log(header: Header, scene: Scene) -> Scene:
    """The patient of a scene, with all other settings as recorded. Raises ValidationError."""
    values = scene.model_dump(mode="json", exclude_unset=True)
    recorded = {name: section for name, section in header.scene.items() if PATIENTS.get(name) is not True}
    if "transducer" in recorded:
        kept = {key: value for key, value in recorded["transducer"].items() if key != "probe"}
        own = values.get("transducer", {}).get("probe")
        recorded["transducer"] = kept | ({"probe": own} if own else {})
    return Scene.model_validate(values | recorded)


def settings_apart(recorded: Scene, present: Scene) -> list[str]:
    """The settings of a session that are not its scene's, each in words; of a table only the name."""
    then, now = recorded_values(recorded), recorded_values(present)
    differences = []
    for section in [name for name, values in then.items() if isinstance(values, dict)]:
        for key, value in then[section].items():
            there = now[section].get(key)
            if value != there:
                is_table = isinstance(value, dict)
                values = "" if is_table else f" {FOUND.repr(value)} (scene: {FOUND.repr(there)})"
                differences.append(f"{section}.{key}{values}")
    return differences
