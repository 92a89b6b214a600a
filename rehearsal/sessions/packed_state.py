"""A rehearsal's state as text for a session's file, without loss of bits."""

import base64
import io
import struct
import zipfile
import zlib
from dataclasses import asdict
from typing import Any

import numpy as np

from rehearsal.rehearsal import RehearsalState
from sim.body import BodyState
from sim.divergence_check import DivergenceState
from sim.solver import SolverState
from ultrasound.probe_manipulator import ManipulatorState

# Limit of all arrays together: a body of a million particles has less.
MOST_BYTES = 1 << 30

# What NumPy and zipfile raise for unreadable data.
UNREADABLE = (
    *(ValueError, LookupError, TypeError, RuntimeError, OSError, EOFError, MemoryError),
    *(zipfile.BadZipFile, zlib.error, struct.error),
)


class StateError(ValueError):
    """A text that is no state of this body."""


def to_text(state: RehearsalState) -> str:
    """Pack a state."""
    watch = state.watch
    arrays: dict[str, Any] = {
        **_of_solver("now", state.solver),
        **({} if _is_same(watch.good, state.solver) else _of_solver("good", watch.good)),
        "pose": state.pose,
        **{f"grip.{name}": value for name, value in asdict(state.manipulator).items() if value is not None},
        "numbers": [state.steps, watch.steps_since_good, watch.steps_tangled, watch.is_restored],
    }
    packed = io.BytesIO()
    np.savez_compressed(packed, allow_pickle=False, **arrays)
    return base64.b64encode(packed.getvalue()).decode("ascii")


def from_text(text: str, like: RehearsalState) -> RehearsalState:
    """Unpack a state of the same body as ``like``. Raises StateError."""
    try:
        packed = zipfile.ZipFile(io.BytesIO(base64.b64decode(text, validate=True)))
        if sum(member.file_size for member in packed.infolist()) > MOST_BYTES:
            raise StateError("a state that is too large")
        arrays = dict(np.load(io.BytesIO(packed.fp.getvalue()), allow_pickle=False))  # type: ignore[union-attr]
        now = _solver(arrays, "now", like.solver)
        steps, since_good, tangled, restored = map(int, arrays["numbers"])
        good = _solver(arrays, "good", like.solver) if "good.position" in arrays else now
        watch = DivergenceState(good, since_good, tangled, bool(restored))
        turn = tuple(map(float, arrays["grip.turn_deg"].reshape(3)))
        depth, pressed = float(arrays["grip.depth_mm"]), float(arrays["grip.pressed_mm"])
        aim = _pose(arrays, "grip.aim") if "grip.aim" in arrays else None
        grip = ManipulatorState(depth, pressed, turn, aim)  # type: ignore[arg-type]
        pose = _pose(arrays, "pose")
    except UNREADABLE as error:
        what = str(error) or type(error).__name__
        raise StateError(f"a state that cannot be used ({what.splitlines()[0]})") from None
    return RehearsalState(now, watch, pose, steps, grip)


def _pose(arrays: dict[str, np.ndarray], name: str) -> np.ndarray:
    pose = arrays[name]
    if pose.shape != (4, 4) or pose.dtype != float or not np.isfinite(pose).all():
        raise StateError(f"{name} is no pose")
    return pose


def _is_same(one: SolverState, other: SolverState) -> bool:
    arrays = zip(_of_solver("", one).values(), _of_solver("", other).values(), strict=True)
    return all(np.array_equal(a, b) for a, b in arrays)


def _of_solver(name: str, state: SolverState) -> dict[str, np.ndarray]:
    contacts = {f"{name}.contacts.{key}": values for key, values in state.contacts.items()}
    return {
        f"{name}.position": state.body.position,
        f"{name}.velocity": state.body.velocity,
    } | contacts


def _solver(arrays: dict[str, np.ndarray], name: str, like: SolverState) -> SolverState:
    def taken(key: str, model: np.ndarray) -> np.ndarray:
        values = arrays[f"{name}.{key}"]
        if values.shape != model.shape or values.dtype != model.dtype:
            raise StateError(f"{key} of {values.dtype} {values.shape}: expected {model.dtype} {model.shape}")
        return values

    body = BodyState(taken("position", like.body.position), taken("velocity", like.body.velocity))
    return SolverState(body, {key: taken(f"contacts.{key}", old) for key, old in like.contacts.items()})
