"""The file of a session: one line of JSON a second, each on the disk when it is written, so that a crash costs a second at most.

The first line names what is rehearsed; each other line is a second: events, the transducer's poses, and the tissue's digest after
it. Once a minute and at the end a line has the whole state and the coverage; the last line has the summary. No line names a patient or a path.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator
from typing_extensions import TypedDict

from errors import FOUND, UserError, explained
from rehearsal.resection.resection_state import MOST_MARKS
from rehearsal.sessions.packed_arrays import (
    LEAST_STEP_S,
    MOST_STEP_S,
    Seen,
    SeenVoxels,
    unpack_lengths,
    unpack_poses,
)
from render.viewer import Technique
from scenes.scene import Scene
from text_files import TextError, json_value
from ultrasound.crater import Filling
from version import FORMAT, of_this_format

MOST_FILE_BYTES = 2_000_000_000
# Of a pose: how far its axes are from right angles, and its place from the origin [mm].
RIGID, MOST_MM = 1e-3, 1e4
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

    nephron_session: int = FORMAT
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
        return of_this_format(values, "nephron_session")


class SolverValues(TypedDict, total=False):
    """Settings of a step; what is left out stays unchanged."""

    __pydantic_config__ = ConfigDict(extra="forbid", allow_inf_nan=False)  # type: ignore[misc]
    iterations: Annotated[int, Field(ge=1, le=1000)]
    substeps: Annotated[int, Field(ge=1, le=100)]
    stiffness: Annotated[float, Field(ge=0, le=1)]
    young_kpa: Annotated[float, Field(gt=0, le=1e6)]
    gravity_m_s2: Annotated[float, Field(ge=0, le=100)]


class RecordedCut(TypedDict):
    """A cut along the score: see ``CutSettings``; ``seen`` has a bit for each vertex of the tumour's surface, as base64."""

    __pydantic_config__ = ConfigDict(extra="forbid", allow_inf_nan=False)  # type: ignore[misc]
    technique: Technique
    margin_mm: Annotated[float, Field(ge=0, le=100)]
    depth_mm: Annotated[float, Field(gt=0, le=500)] | None
    filling: Filling
    seen: Annotated[str, Field(pattern=r"^[A-Za-z0-9+/]*={0,2}$", max_length=1_000_000)]


Place = Annotated[list[Annotated[float, Field(ge=-1e4, le=1e4)]], Field(min_length=3, max_length=3)]
# What the value of each kind of event is.
VALUES: dict[str, TypeAdapter] = {
    "settings": TypeAdapter(dict[str, bool | int | float | str | None]),
    "solver": TypeAdapter(SolverValues),
    "back": TypeAdapter(int),
    "bookmark": TypeAdapter(int),
    "marks": TypeAdapter(Annotated[list[Place], Field(max_length=MOST_MARKS)]),
    "cut": TypeAdapter(RecordedCut),
    "reading": TypeAdapter(dict[str, float | None]),
    "state": TypeAdapter(str),
    "seen": TypeAdapter(Seen),
}
Kind = Literal["settings", "solver", "back", "bookmark", "marks", "cut", "reading", "state", "seen"]


class Event(_Line):
    """Something that happened before step ``at``."""

    at: int = Field(ge=0)
    kind: Kind
    value: Any

    @model_validator(mode="after")
    def _of_its_kind(self) -> "Event":
        VALUES[self.kind].validate_python(self.value, strict=True)
        return self


class Second(_Line):
    """Steps from ``at`` on: their poses, packed; the tissue's digest after the last one."""

    at: int = Field(ge=0)
    poses: str
    lengths_s: str | None = None
    """The steps' lengths, packed, where one is not the header's."""
    wrenches: str | None = None
    """Force [N] of the tissue on the probe, and its torque [N mm] about the centre of the array face, of each step (LPS), packed."""
    events: list[Event] = Field(default_factory=list)
    digest: str


class End(_Line):
    """The summary of a session that ended in order, its final state, and the coverage so far."""

    summary: dict[str, Any]
    state: str
    seen: Seen | None = None


@dataclass
class Log:
    """A session as read: ``poses`` (steps, 4, 4), NaN for a rollback, and ``lengths_s`` (steps,); the rest by step index."""

    header: Header
    poses: np.ndarray
    lengths_s: np.ndarray
    events: dict[int, list[Event]] = field(default_factory=dict)
    digests: dict[int, str] = field(default_factory=dict)
    states: dict[int, str] = field(default_factory=dict)
    seen: dict[int, SeenVoxels] = field(default_factory=dict)
    summary: dict[str, Any] | None = None

    @property
    def length_s(self) -> float:
        """Simulated time."""
        return float(self.lengths_s.sum())

    def step_at(self, seconds: float) -> int:
        """The number of steps whose end is nearest to a time [s]."""
        ends = np.concatenate([[0.0], np.cumsum(self.lengths_s)])
        return int(np.argmin(np.abs(ends - seconds)))


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
    header = _header(name, lines[0])
    log = Log(header, np.zeros((0, 4, 4)), np.zeros(0))
    parts: list[np.ndarray] = []
    lengths: list[np.ndarray] = []
    # A last line without its end was being written when the session was cut off.
    for number, line in enumerate(lines[1:-1], 2):
        second = _line_of(name, number, line)
        steps = sum(len(part) for part in parts)
        if isinstance(second, End):
            log.summary = second.summary
            log.states[steps] = second.state
            if second.seen is not None:
                log.seen[steps] = second.seen
            break
        try:
            poses = unpack_poses(second.poses)
            lengths_s = _lengths_of(second, len(poses), header.time_step_s)
        except ValueError:
            poses = np.zeros((0, 4, 4))
        if second.at != steps or len(poses) == 0:
            raise SessionError(
                f"{name}: line {number} does not follow the line before it: one is missing or damaged"
            )
        if not _are_rigid(poses):
            raise SessionError(
                f"{name}: line {number} has a pose that is none of a probe: expected right-angled axes of length 1, and a place within "
                f"{MOST_MM:g} mm; what comes before it can be had by deleting from it on"
            )
        parts.append(poses)
        lengths.append(lengths_s)
        for event in second.events:
            if event.kind == "state":
                log.states[event.at] = event.value
            elif event.kind == "seen":
                log.seen[event.at] = event.value
            log.events.setdefault(event.at, []).append(event)
        log.digests[steps + len(poses)] = second.digest
    log.poses = np.concatenate([log.poses, *parts])
    log.lengths_s = np.concatenate([log.lengths_s, *lengths])
    return log


def _are_rigid(poses: np.ndarray) -> bool:
    """Whether poses (n, 4, 4), NaN for a rollback, are rotations with a translation."""
    poses = poses[~np.isnan(poses).any(axis=(1, 2))]
    axes, places = poses[:, :3, :3], poses[:, :3, 3]
    off = np.abs(axes.transpose(0, 2, 1) @ axes - np.eye(3))
    return not ((off > RIGID).any() or (np.linalg.det(axes) < 0).any() or (np.abs(places) > MOST_MM).any())


def _lengths_of(second: Second, steps: int, usual_s: float) -> np.ndarray:
    """The lengths (steps,) [s] of a line's steps. Raises ValueError."""
    if second.lengths_s is None:
        return np.full(steps, usual_s)
    lengths_s = unpack_lengths(second.lengths_s)
    if len(lengths_s) != steps:
        raise ValueError(f"{len(lengths_s)} lengths of {steps} steps")
    return lengths_s


def _header(name: str, line: bytes) -> Header:
    try:
        return Header.model_validate(json_value(line))
    except (ValidationError, TextError) as error:
        what = explained(error) if isinstance(error, ValidationError) else error
        raise SessionError(
            f"{name}: not a session of this version ({what}); expected a file that rehearse has written, such as session-001.jsonl"
        ) from None


def _line_of(name: str, number: int, line: bytes) -> Second | End:
    try:
        values = json_value(line)
        is_end = isinstance(values, dict) and "summary" in values
        return End.model_validate(values) if is_end else Second.model_validate(values)
    except (ValidationError, TextError) as error:
        what = explained(error) if isinstance(error, ValidationError) else error
        raise SessionError(
            f"{name}: line {number} is damaged ({what}); what comes before it can be had by deleting from it on"
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
    found = []
    for section in [name for name, values in then.items() if isinstance(values, dict)]:
        for key, value in then[section].items():
            there = now[section].get(key)
            if value != there:
                is_table = isinstance(value, dict)
                values = "" if is_table else f" {FOUND.repr(value)} (scene: {FOUND.repr(there)})"
                found.append(f"{section}.{key}{values}")
    return found
