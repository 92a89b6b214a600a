"""The file of a plan: sweeps over a target, the best first, with what each was worth. JSON; patient coordinates LPS, mm."""

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from errors import UserError
from rehearsal.numbered_files import next_number
from scenes.atomic_files import atomic_write
from scenes.scene import Trocar
from ultrasound.target import Target

MOST_POSES, MOST_MARGIN_MM = 20_000, 30.0
# Kinds of sweep that are compared, at most.
MOST_SWEEPS = 4
SLOWEST_MM_S, FASTEST_MM_S = 1.0, 100.0
NAME = r"plan-([0-9]{3,9})\.json"
# How far the axes of a pose may be from orthonormal: what six digits in a file leave.
RIGID = 1e-3
# What a plan begins with.
MARK = b'"nephron_plan"'

Row = Annotated[list[float], Field(min_length=4, max_length=4)]
Pose = Annotated[list[Row], Field(min_length=4, max_length=4)]


class PlanError(UserError):
    """A plan that cannot be made or used; the message is one line."""


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class PlannedSweep(_Part):
    """One candidate. ``passes`` are its poses, probe to patient: the probe's axes are PLUS's (``ultrasound.image_plane``)."""

    name: str
    score: float
    parts: dict[str, float]
    points: dict[str, float]
    values: dict[str, float]
    trials: int
    passes: list[Annotated[list[Pose], Field(min_length=2, max_length=MOST_POSES)]] = Field(min_length=1)

    @field_validator("parts")
    @classmethod
    def _say_what_is_seen(cls, parts: dict[str, float]) -> dict[str, float]:
        if "seen" not in parts:
            raise ValueError("seen is missing: expected the share of the target that the sweep shows")
        return parts

    @field_validator("passes")
    @classmethod
    def _are_rigid(cls, passes: list[list[Pose]]) -> list[list[Pose]]:
        poses = np.array([pose for each in passes for pose in each])
        axes = poses[:, :3, :3]
        off = np.abs(np.swapaxes(axes, 1, 2) @ axes - np.eye(3)).max()
        if off > RIGID or (np.linalg.det(axes) < 0).any() or (poses[:, 3] != [0, 0, 0, 1]).any():
            raise ValueError(
                "a pose is not rigid: expected three right-handed unit axes at right angles, and 0 0 0 1 below"
            )
        return passes

    def poses(self) -> list[np.ndarray]:
        """The poses (n, 4, 4) of each pass."""
        return [np.array(each) for each in self.passes]


class Plan(_Part):
    """``version`` is the Nephron that made it; ``anatomy`` is the fingerprint of the patient's files (``scenes.anatomy``); ``why`` says why the first sweep is first."""

    nephron_plan: Literal[1] = 1
    version: str | None = None
    anatomy: str
    target: Target
    margin_mm: float = Field(ge=0, le=MOST_MARGIN_MM)
    speed_mm_s: float = Field(ge=SLOWEST_MM_S, le=FASTEST_MM_S)
    probe: dict[str, Any]
    trocar: Trocar
    model: dict[str, float | int | str]
    seed: int
    why: list[str]
    sweeps: list[PlannedSweep] = Field(min_length=1)


def write_plan(plan: Plan, path: Path) -> None:
    """Write a plan; the same plan makes the same bytes. Raises OSError."""
    with atomic_write(path) as partial:
        partial.write_text(json.dumps(plan.model_dump(mode="json"), indent=1) + "\n", "utf-8")


def next_free(folder: Path) -> Path:
    """The place of the next plan in a folder."""
    return folder / f"plan-{next_number(folder, NAME):03d}.json"


def is_plan(path: Path) -> bool:
    """Whether a file says of itself that it is a plan."""
    try:
        return MARK in path.read_bytes()[:100]
    except OSError:
        return False


def read_plan(path: Path) -> Plan:
    """Read a plan. Raises PlanError."""
    try:
        return Plan.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        raise PlanError(f"{path}: no such plan; make one with: app.py plan SCENE --out {path.name}") from None
    except OSError as error:
        raise PlanError(f"{path}: cannot be read as a plan ({error.strerror})") from None
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        if first["type"] == "json_invalid":
            raise PlanError(f"{path}: not a plan; expected a file that app.py plan wrote") from None
        where = ".".join(map(str, first["loc"]))
        raise PlanError(
            f"{path}: not a plan{f', {where}' if where else ''}: {first['msg'].lower()}; expected a file that app.py plan wrote"
        ) from None
