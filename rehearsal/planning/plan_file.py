"""The file of a plan: sweeps over a target, the best first, with their scores.

JSON; patient coordinates LPS, mm.
"""

import json
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    JsonValue,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)
from scipy.spatial.transform import Rotation

from errors import UserError, explained
from rehearsal.result_files import next_number
from rehearsal.tracking.pose_file import Pose, TimedPoses
from scenes.atomic_files import atomic_write
from scenes.scene import Trocar
from text_files import TextError, read_text
from ultrasound.target import Target
from version import FORMAT, of_this_format

MOST_POSES, MOST_MARGIN_MM = 20_000, 30.0
# The most sweeps of a plan, each of another kind.
MOST_SWEEPS = 2
SLOWEST_MM_S, FASTEST_MM_S = 1.0, 100.0
NAME = r"plan-([0-9]{3,9})\.json"
# The first bytes of a plan contain this.
MARK = '"nephron_plan"'
# Before and after a pass the probe is lifted by this, and moves at this speed.
LIFT_MM, LIFTED_MM_S = 6.0, 60.0
# The time before the first pass, to come above its first pose from anywhere.
APPROACH_S = 1.0
# A rotation by this angle takes as long as one millimetre.
DEG_PER_MM = 1.5


class PlanError(UserError):
    """A plan that cannot be made or used; the message is one line."""


class _FileModel(BaseModel):
    """A text is no number."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, strict=True)


class PlannedSweep(_FileModel):
    """One candidate.

    ``parts`` are its ``ScoreTerms`` by name, ``points`` what each adds to the score, ``trials`` the passes
    that were tried for it. ``transfers`` are poses from each pass to above the next, outside the organ.
    ``passes`` are its poses, probe to patient; the probe's axes are PLUS's
    (``ultrasound.probe_manipulator``).
    """

    name: str
    score: float
    parts: dict[str, float]
    points: dict[str, float]
    trials: int
    passes: list[Annotated[list[Pose], Field(min_length=2, max_length=MOST_POSES)]] = Field(min_length=1)
    transfers: list[Annotated[list[Pose], Field(min_length=1, max_length=MOST_POSES)]]

    @field_validator("transfers")
    @classmethod
    def _check_transfers(cls, transfers: list, info: ValidationInfo) -> list:
        wanted = len(info.data.get("passes", [None])) - 1
        if len(transfers) != wanted:
            raise ValueError(f"expected poses from each pass to the next, {wanted} lists")
        return transfers

    @field_validator("parts")
    @classmethod
    def _check_coverage(cls, parts: dict[str, float]) -> dict[str, float]:
        if "seen" not in parts:
            raise ValueError("seen is missing: expected the fraction of the target that the sweep covers")
        return parts

    @property
    def coverage(self) -> float:
        """The planned coverage of the target, 0 to 1."""
        return self.parts["seen"]

    def poses(self) -> list[np.ndarray]:
        """The poses (n, 4, 4) of each pass."""
        return [np.array(poses) for poses in self.passes]


class Plan(_FileModel):
    """``version`` is the Nephron that made it, ``anatomy`` the fingerprint of the patient's files, ``why``
    the reasons for the order.
    """

    nephron_plan: int = FORMAT
    version: str | None = None
    anatomy: str
    target: Target
    margin_mm: float = Field(ge=0, le=MOST_MARGIN_MM)
    speed_mm_s: float = Field(ge=SLOWEST_MM_S, le=FASTEST_MM_S)
    probe: dict[str, Any]
    trocar: Trocar
    model: dict[str, JsonValue]
    seed: int
    why: list[str]
    sweeps: list[PlannedSweep] = Field(min_length=1)

    @model_validator(mode="before")
    @classmethod
    def _has_this_format(cls, values: Any) -> Any:
        return of_this_format(values, "nephron_plan")


def write_plan(plan: BaseModel, path: Path) -> None:
    """Write a plan; the same plan gives the same bytes. Raises OSError."""
    with atomic_write(path) as partial:
        partial.write_text(json.dumps(plan.model_dump(mode="json"), indent=1) + "\n", "utf-8")


def next_plan_path(folder: Path) -> Path:
    """The path of the next plan in a folder."""
    return folder / f"plan-{next_number(folder, NAME):03d}.json"


def is_plan(path: Path, mark: str = MARK) -> bool:
    """Whether a file begins as a plan does: with a ``mark``."""
    try:
        return mark in read_text(path)[:100]
    except (OSError, TextError):
        return False


def read_plan(path: Path) -> Plan:
    """Read a plan. Raises PlanError."""
    try:
        return Plan.model_validate_json(read_text(path))
    except (FileNotFoundError, NotADirectoryError):
        raise PlanError(f"{path}: no such plan; make one with: app.py plan SCENE --out {path.name}") from None
    except TextError as error:
        raise PlanError(
            f"{path}: cannot be read as a plan ({error}); expected a file that app.py plan wrote"
        ) from None
    except ValidationError as error:
        raise PlanError(
            f"{path}: not a plan of this version ({explained(error)}); expected a file that app.py plan wrote"
        ) from None


def timed_poses(sweep: PlannedSweep, speed_mm_s: float) -> TimedPoses:
    """The poses of a sweep with times, at a speed on its passes; the probe starts above the first pose and
    is lifted between passes.
    """
    poses: list[np.ndarray] = []
    speeds: list[float] = []
    passes = sweep.poses()
    before = [np.array([_lifted(passes[0][0])]), *map(np.array, sweep.transfers)]
    for way, one_pass in zip(before, passes, strict=True):
        poses += [*way, *one_pass]
        speeds += [*(LIFTED_MM_S for _ in way), *(speed_mm_s for _ in one_pass)]
    poses.append(_lifted(passes[-1][-1]))
    speeds.append(LIFTED_MM_S)
    durations = [_length_mm(a, b) / speed for (a, b), speed in zip(pairwise(poses), speeds[1:], strict=True)]
    return TimedPoses(np.cumsum([0.0, APPROACH_S, *durations]), [poses[0], *poses])


def _lifted(pose: np.ndarray) -> np.ndarray:
    """A probe's pose in the patient (4, 4), in PLUS's axes, moved back along the probe's axis."""
    above = pose.copy()
    above[:3, 3] -= LIFT_MM * pose[:3, 1]
    return above


def _length_mm(start: np.ndarray, end: np.ndarray) -> float:
    """The length of a move, with rotations counted as a length; at least a micrometre, because times must
    increase.
    """
    angle = np.degrees(Rotation.from_matrix(end[:3, :3] @ start[:3, :3].T).magnitude())
    return max(float(np.linalg.norm(end[:3, 3] - start[:3, 3])), float(angle) / DEG_PER_MM, 1e-3)
