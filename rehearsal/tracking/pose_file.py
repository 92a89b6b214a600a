"""Files of probe poses: for the images of ``scan``, and as a path that a rehearsal follows."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from errors import UserError, explained
from rehearsal.resection.resection_state import Number, ScriptedAction, ScriptedCut
from text_files import TABLES, TextError, json_value, read_text, table_rows
from ultrasound.probe_manipulator import interpolated

# Tolerance of orthonormal axes: more than the rounding of six digits in a file or of a float32, less than a
# scaled matrix.
RIGID = 1e-3
EXPECTED = "expected poses as JSON or CSV"
SIXTEEN = "sixteen, row by row, or before them the time in s"


class PoseError(UserError):
    """Poses that cannot be used; the message is one line."""


def is_rigid(pose: np.ndarray) -> bool:
    """Whether a matrix (4, 4) is a finite rotation without mirroring, with a translation."""
    axes, last = pose[:3, :3], pose[3]
    is_right_handed = _axes_error(axes) <= RIGID and np.linalg.det(axes) > 0
    return bool(np.isfinite(pose).all() and is_right_handed and np.allclose(last, [0, 0, 0, 1]))


def check_rigid(pose: np.ndarray) -> None:
    """Raises PoseError unless a matrix (4, 4) is a rigid pose."""
    if not is_rigid(pose):
        axes = pose[:3, :3]
        raise PoseError(
            "not rigid: expected three right-handed unit axes at right angles (found an error of "
            f"{_axes_error(axes):.2g}, determinant {np.linalg.det(axes):.3g}) and a last row of 0 0 0 1"
        )


def _axes_error(axes: np.ndarray) -> float:
    """The largest deviation of the axes' products from orthonormal."""
    return float(np.abs(axes.T @ axes - np.eye(3)).max())


def _rigid(rows: list[list[float]]) -> list[list[float]]:
    check_rigid(np.array(rows))
    return rows


def _possible_name(name: str) -> str:
    if not re.fullmatch("[A-Za-z0-9_-]{0,40}", name):
        raise ValueError("expected at most 40 English letters, digits, - and _")
    return name


Row = Annotated[list[float], Field(min_length=4, max_length=4)]
Place = Annotated[list[Number], Field(min_length=3, max_length=3)]
Pose = Annotated[list[Row], Field(min_length=4, max_length=4), AfterValidator(_rigid)]


class _FilePose(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    name: Annotated[str, AfterValidator(_possible_name)] = ""
    time_s: float | None = None
    probe_to_patient: Pose
    score: Literal["image"] | Annotated[list[Place], Field(min_length=1)] | None = None
    """Set marks of the score: at the edges of tumour and margin in the image, or at these places (LPS,
    mm).
    """
    margin_mm: float = Field(5.0, ge=0, le=20)
    cut: ScriptedCut | None = None
    """Cut along the score."""

    def action(self, from_s: float) -> ScriptedAction | None:
        """What is done at this pose, at its time after another [s]."""
        if self.time_s is None or (self.score is None and self.cut is None):
            return None
        cut = None if self.cut is None else self.cut.settings()
        score = [(x, y, z) for x, y, z in self.score] if isinstance(self.score, list) else self.score
        return ScriptedAction(self.time_s - from_s, score, self.margin_mm, cut)


@dataclass(frozen=True)
class TimedPoses:
    """Poses (4, 4) of a probe, None where it was not tracked, at times (n,) [s]. Raises PoseError unless the
    times increase.

    ``actions`` are those of a resection, at times after the first pose.
    """

    times_s: np.ndarray
    poses: list[np.ndarray | None]
    actions: tuple[ScriptedAction, ...] = ()

    def __post_init__(self) -> None:
        back = np.flatnonzero(np.diff(self.times_s) <= 0)
        if back.size:
            number = int(back[0]) + 1
            raise PoseError(
                f"pose {number + 1} at {self.times_s[number]:g} s is not later than the one before, at "
                f"{self.times_s[number - 1]:g} s; expected increasing times"
            )

    @property
    def length_s(self) -> float:
        return float(self.times_s[-1] - self.times_s[0])

    def at(self, time_s: float) -> np.ndarray | None:
        """The pose (4, 4) at a time after the first, interpolated between two; None where one of the two
        was not tracked.
        """
        times, last = self.times_s - self.times_s[0], len(self.times_s) - 1
        after = min(int(np.searchsorted(times, time_s)), last)
        end = self.poses[after]
        if after == 0 or time_s >= times[after]:
            return end
        start = self.poses[after - 1]
        if start is None or end is None:
            return None
        return interpolated(
            start, end, float((time_s - times[after - 1]) / (times[after] - times[after - 1]))
        )


def load_poses(path: Path) -> dict[str, np.ndarray]:
    """Name -> pose (4, 4), probe to patient (LPS, mm), from a JSON or CSV file. Raises PoseError.

    The probe's axes are PLUS's: the origin at the centre of the array face, x to the marked side, y into the
    tissue, z = x cross y. JSON holds a list of {"name": ..., "probe_to_patient": 4 x 4}, CSV sixteen numbers
    per line, row by row. Poses without a name are numbered. Times are ignored.
    """
    poses: dict[str, np.ndarray] = {}
    for number, placed in enumerate(_read(path), 1):
        if placed.name in poses:
            raise PoseError(
                f"{path}: pose {number}: the name {placed.name!r} occurs twice; expected different names"
            )
        poses[placed.name or f"{number:04d}"] = np.array(placed.probe_to_patient)
    return poses


def load_timed_poses(path: Path) -> TimedPoses:
    """The poses of such a file with their times [s]: "time_s" in JSON, a number before the sixteen in CSV.

    Raises PoseError.
    """
    placed = _read(path)
    for number, pose in enumerate(placed, 1):
        if pose.time_s is None:
            raise PoseError(
                f"{path}: pose {number} has no time; expected time_s in JSON, or in CSV seconds and sixteen "
                "numbers per line"
            )
    times_s = np.array([pose.time_s for pose in placed])
    actions = [pose.action(times_s[0]) for pose in placed]
    try:
        return TimedPoses(
            times_s,
            [np.array(pose.probe_to_patient) for pose in placed],
            tuple(action for action in actions if action is not None),
        )
    except PoseError as error:
        raise PoseError(f"{path}: {error}") from None


def _read(path: Path) -> list[_FilePose]:
    is_table = path.suffix.lower() in TABLES
    try:
        text = read_text(path)
        if not text.strip():
            raise PoseError(f"{path}: is empty; expected a list of poses")
        values = _of_table(path, table_rows(text)) if is_table else json_value(text)
    except (FileNotFoundError, NotADirectoryError):
        raise PoseError(f"{path}: no such pose file") from None
    except TextError as error:
        raise PoseError(f"{path}: cannot be read as poses ({error}); {EXPECTED}") from None
    if not isinstance(values, list):
        raise PoseError(f"{path}: is no list; expected a list of poses, each with probe_to_patient")
    if not values:
        raise PoseError(f"{path}: holds no poses; expected at least one")
    # In JSON a text is no number.
    return [_pose(path, number, pose, strict=not is_table) for number, pose in enumerate(values, 1)]


def _pose(path: Path, number: int, values: Any, strict: bool) -> _FilePose:
    try:
        return _FilePose.model_validate(values, strict=strict)
    except ValidationError as error:
        raise PoseError(
            f"{path}: pose {number}, {explained(error)}; expected a list of poses with probe_to_patient, 4 "
            "rows of 4 numbers"
        ) from None


def _of_table(path: Path, table: dict[int, list[str]]) -> list[dict[str, Any]]:
    """The poses as JSON has them, their numbers as text."""
    rows = list(table.values())
    for number, row in enumerate(rows, 1):
        if len(row) not in (16, 17) or len(row) != len(rows[0]):
            raise PoseError(
                f"{path}: pose {number}: {len(row)} numbers; expected {SIXTEEN}, as in each line, separated "
                "by commas, or by "
                "semicolons where there are decimal commas"
            )
    poses = [dict(probe_to_patient=np.reshape(row[-16:], (4, 4)).tolist()) for row in rows]
    return [
        pose | ({"time_s": row[0]} if len(row) == 17 else {}) for pose, row in zip(poses, rows, strict=True)
    ]
