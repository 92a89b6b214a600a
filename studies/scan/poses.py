"""Files of probe poses: where the pictures of ``scan`` are taken."""

import json
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

# How far the axes of a pose may be from orthonormal: what six digits in a file leave.
RIGID = 1e-3


class PoseError(ValueError):
    """Poses that cannot be used; the message is one line."""


class _Pose(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    name: str = Field("", max_length=40, pattern=r"^[A-Za-z0-9_-]*$")
    probe_to_patient: Annotated[
        list[Annotated[list[float], Field(min_length=4, max_length=4)]], Field(min_length=4, max_length=4)
    ]


def load_poses(path: Path) -> dict[str, np.ndarray]:
    """Name -> pose (4, 4), patient (LPS, mm) from probe, of a JSON or CSV file. Raises PoseError.

    The probe's axes are PLUS's: the origin in the middle of the array's face, x to the marked side, y away into the tissue,
    z = x cross y. JSON holds a list of {"name": ..., "probe_to_patient": 4 x 4}; CSV sixteen numbers a line, row by row. Poses
    without a name are numbered.
    """
    try:
        text = path.read_text("utf-8")
    except FileNotFoundError:
        raise PoseError(f"{path}: no such file of poses") from None
    except (OSError, UnicodeDecodeError) as error:
        raise PoseError(f"{path}: cannot be read as poses ({str(error).splitlines()[0]})") from None
    found = _of_csv(path, text) if path.suffix.lower() == ".csv" else _of_json(path, text)
    poses: dict[str, np.ndarray] = {}
    for number, (name, pose) in enumerate(found, 1):
        _check_rigid(path, number, pose)
        if name in poses:
            raise PoseError(f"{path}: pose {number}: the name {name!r} is there twice; names must differ")
        poses[name or f"{number:04d}"] = pose
    if not poses:
        raise PoseError(f"{path}: holds no poses; expected at least one")
    return poses


def _of_json(path: Path, text: str) -> list[tuple[str, np.ndarray]]:
    try:
        if not text.strip():
            raise PoseError(f"{path}: is empty; expected a list of poses")
        poses = TypeAdapter(list[_Pose]).validate_python(json.loads(text))
    except json.JSONDecodeError as error:
        raise PoseError(f"{path}: not valid JSON: {error}") from None
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = (
            f"pose {int(first['loc'][0]) + 1}, {'.'.join(map(str, first['loc'][1:]))}: "
            if first["loc"]
            else ""
        )
        raise PoseError(
            f"{path}: {where}{first['msg'].lower()}; expected a list of poses with probe_to_patient, 4 rows of 4 numbers"
        ) from None
    return [(pose.name, np.array(pose.probe_to_patient)) for pose in poses]


def _of_csv(path: Path, text: str) -> list[tuple[str, np.ndarray]]:
    rows = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    try:
        numbers = [[float(value) for value in line.replace(";", ",").split(",")] for line in rows]
    except ValueError as error:
        raise PoseError(f"{path}: {error}; expected sixteen numbers a line") from None
    for number, row in enumerate(numbers, 1):
        if len(row) != 16:
            raise PoseError(f"{path}: pose {number}: {len(row)} numbers; expected sixteen, row by row")
    return [("", np.array(row).reshape(4, 4)) for row in numbers]


def _check_rigid(path: Path, number: int, pose: np.ndarray) -> None:
    axes = pose[:3, :3]
    off = np.abs(axes.T @ axes - np.eye(3)).max()
    if not (
        np.isfinite(pose).all()
        and off <= RIGID
        and np.linalg.det(axes) > 0
        and np.allclose(pose[3], [0, 0, 0, 1])
    ):
        raise PoseError(
            f"{path}: pose {number} is not rigid: expected three right-handed unit axes at right angles (found an error of "
            f"{off:.2g}, determinant {np.linalg.det(axes):.3g}) and a last row of 0 0 0 1"
        )
