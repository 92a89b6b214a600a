"""Commands: all that changes a rehearsal. The list of them, each with the number of the state that it was
applied to, is a session's file.

``Follow`` and ``Pause`` are for the clock of a ``Stepper`` alone: what is recorded are the moves that it
makes of them.
"""

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, InstanceOf, PlainSerializer

from rehearsal.loop.state import History, WholeState
from rehearsal.resection.resection_state import MOST_MARKS
from render.viewer import Technique
from settings import Value
from ultrasound.crater import Filling
from ultrasound.probe_manipulator import ManipulatorState

# Of a pose: how far its axes are from right angles, and its place from the origin [mm].
RIGID, MOST_MM = 1e-3, 1e4
LEAST_STEP_S, MOST_STEP_S = 1e-6, 10.0


def rigid_pose(value: Any) -> np.ndarray:
    """A pose (4, 4), or (3, 4) without its last row. Raises ValueError where it is none of a probe."""
    pose = np.eye(4)
    try:
        pose[:3] = np.asarray(value, float).reshape(-1, 4)[:3]
    except (TypeError, ValueError):
        raise ValueError("expected a pose of 4 x 4 numbers") from None
    if not are_rigid(pose[None]):
        raise ValueError(
            "a pose that is none of a probe: expected right-angled axes of length 1, and a place within "
            f"{MOST_MM:g} mm"
        )
    return pose


def are_rigid(poses: np.ndarray) -> bool:
    """Whether poses (n, 4, 4) are rotations with a translation that a probe can have."""
    if not np.isfinite(poses).all():
        return False
    axes, places = poses[:, :3, :3], poses[:, :3, 3]
    off = np.abs(axes.transpose(0, 2, 1) @ axes - np.eye(3))
    return not ((off > RIGID).any() or (np.linalg.det(axes) < 0).any() or (np.abs(places) > MOST_MM).any())


Pose = Annotated[
    Any, BeforeValidator(rigid_pose), PlainSerializer(lambda pose: np.asarray(pose)[:3].ravel().tolist())
]
Place = tuple[float, float, float]
Seconds = Annotated[float, Field(ge=LEAST_STEP_S, le=MOST_STEP_S)]


class _Command(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)


class Move(_Command):
    """One step of a length, in which the transducer follows a hand at a pose as far as the tissue lets it;
    without a length, of the length that is set. Unless it ``presses``, it only touches.
    """

    kind: Literal["move"] = "move"
    pose: Pose
    length_s: Seconds | None = None
    presses: bool = True


class Follow(_Command):
    """The transducer follows the hand: to the pose that the hand had at a time [s] by the clock, a time [s]
    after the one before. Unless it ``presses``, it only touches.

    ``manipulator`` is the state of what the hand moves, which undo restores.
    """

    kind: Literal["follow"] = "follow"
    pose: Pose
    input_s: float = 0.0
    took_s: float = Field(0.0, ge=0)
    presses: bool = True
    manipulator: InstanceOf[ManipulatorState] | None = None


class Pause(_Command):
    """No more steps by the clock, until the transducer follows the hand again."""

    kind: Literal["pause"] = "pause"


class SetValues(_Command):
    """Settings by path: those of tissue, solver and gravity change the steps from now on, all others only
    what is shown.
    """

    kind: Literal["set"] = "set"
    values: dict[str, Value]


class BeginAction(_Command):
    """An action of the user begins: undo restores the present state, with the manipulator's state before
    it.
    """

    kind: Literal["begin"] = "begin"
    manipulator: InstanceOf[ManipulatorState] | None = Field(None, exclude=True)


class Mark(_Command):
    """Marks of the score, at places of the organ's surface at rest [mm], beside those that are set or
    instead of them: an action.
    """

    kind: Literal["mark"] = "mark"
    places_mm: Annotated[list[Place], Field(max_length=MOST_MARKS)]
    replaces: bool = False


class CutOut(_Command):
    """A cut along the score: an action. The state after it is kept as an attempt, and recorded whole.

    See ``CutSettings``; ``seen`` has a bit for each vertex of the tumour's surface, as base64.
    """

    kind: Literal["cut"] = "cut"
    technique: Technique
    margin_mm: Annotated[float, Field(ge=0, le=100)]
    depth_mm: Annotated[float, Field(gt=0, le=500)] | None = None
    filling: Filling = "fluid"
    seen: Annotated[str, Field(pattern=r"^[A-Za-z0-9+/]*={0,2}$", max_length=1_000_000)]


class Undo(_Command):
    """Restore the state before the last action."""

    kind: Literal["undo"] = "undo"


class Redo(_Command):
    """Restore the state before the last undo."""

    kind: Literal["redo"] = "redo"


class Reset(_Command):
    """Restore the settled tissue with the transducer just touching: an action."""

    kind: Literal["reset"] = "reset"


class Bookmark(_Command):
    """Keep the present state, and record it whole."""

    kind: Literal["bookmark"] = "bookmark"


class GoTo(_Command):
    """Restore the state of a bookmark or of an attempt, by its number: an action."""

    kind: Literal["go to"] = "go to"
    state: int = Field(ge=0)


class Checkpoint(_Command):
    """Record the present state whole."""

    kind: Literal["checkpoint"] = "checkpoint"


class NewSession(_Command):
    """A session begins with the present tissue, and with the transducer at a pose, where one is given, which
    is also where a reset brings it.
    """

    kind: Literal["new session"] = "new session"
    pose: Pose | None = None


class Load(_Command):
    """Continue from a recorded state: that of a number, at a time [s] of its session; ``kept`` are states
    that may be restored from there.
    """

    kind: Literal["load"] = "load"
    state: InstanceOf[WholeState]
    number: int = 0
    time_s: float = 0.0
    history: InstanceOf[History] = History()
    kept: dict[int, InstanceOf[WholeState]] = {}


# What a session's file has a line for; moves are packed in lines of their own.
Recorded = SetValues | BeginAction | Mark | CutOut | Undo | Redo | Reset | Bookmark | GoTo
Command = Recorded | Move | Follow | Pause | Checkpoint | NewSession | Load
