"""Initial states of the stress test, and motions of the transducer."""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ultrasound.probe_manipulator import advanced

AWAY_MM = 200.0
# Reach of a sweep to both sides, and mean depth of spinning and shaking [mm].
SWEEP_MM, MIDDLE_MM = 80.0, 15.0
# Duration of a press, or its number of steps where that is longer.
PRESS_S, PRESS_STEPS = 0.02, 20
SEED = 20161130
# Depths [mm] and rotations of the transducer, one a time step.
DEPTHS_MM = MIDDLE_MM + np.random.default_rng(SEED).uniform(-MIDDLE_MM, MIDDLE_MM, 1000)
TURNS = Rotation.random(1000, random_state=SEED).as_matrix()

# From settled positions and the upward direction: positions (n, 3) [mm] and velocities (n, 3) [mm/s].
State = Callable[..., tuple[np.ndarray, np.ndarray]]


def _placed(positions: Callable[..., np.ndarray]) -> State:
    """A state at other positions, without velocities."""
    return lambda x, up, *numbers: (positions(x, up, *numbers), np.zeros_like(x))


def _moving(velocities: Callable[..., np.ndarray]) -> State:
    """A state at the settled positions, with velocities."""
    return lambda x, up, *numbers: (x, velocities(x, *numbers))


def _random() -> np.random.Generator:
    return np.random.default_rng(SEED)


def _one_out(x: np.ndarray, up: np.ndarray, mm: float) -> np.ndarray:
    moved = x.copy()
    moved[len(x) // 2] += mm * up
    return moved


def _overlapped(x: np.ndarray, up: np.ndarray, share: float) -> np.ndarray:
    """The right of two bodies shifted along x into the left one."""
    moved, right = x.copy(), x[:, 0] > 0
    apart = x[right, 0].mean() - x[~right, 0].mean()
    wide = np.ptp(x[right, 0])
    moved[right, 0] -= apart - (1 - share) * wide
    return moved


STATES: dict[str, State] = {
    "settled": _placed(lambda x, up: x),
    "scaled": _placed(lambda x, up, *factors: x.mean(axis=0) + (x - x.mean(axis=0)) * factors),
    "scattered": _placed(lambda x, up, mm: x + _random().normal(0.0, mm, x.shape)),
    "boxed": _placed(lambda x, up: _random().uniform(x.min(axis=0), x.max(axis=0), x.shape)),
    "thrown": _moving(lambda x, *velocity: np.tile(velocity, (len(x), 1))),
    "heated": _moving(lambda x, speed: _random().normal(0.0, speed, x.shape)),
    "turning": _moving(lambda x, axis, rad_s: np.cross(rad_s * np.eye(3)[axis], x - x.mean(axis=0))),
    "lifted": _placed(lambda x, up, mm: x + mm * up),
    "one out": _placed(_one_out),
    "nothing": _placed(lambda x, up: np.full_like(x, np.nan)),
    "overlapped": _placed(_overlapped),
}


def _pressed(t: float, body: Any, dt: float, depth_mm: float) -> np.ndarray:
    return advanced(body.home, depth_mm * min(t / max(PRESS_S, PRESS_STEPS * dt), 1.0))


def _swept(t: float, body: Any, dt: float, speed: float, depth_mm: float) -> np.ndarray:
    pose = advanced(body.home, depth_mm)
    pose[:3, 3] += (speed * t % (2 * SWEEP_MM) - SWEEP_MM) * pose[:3, 0]
    return pose


def _turned(body: Any, rotation: np.ndarray) -> np.ndarray:
    """In the middle of the tissue, with another rotation (3, 3)."""
    pose = advanced(body.home, MIDDLE_MM)
    pose[:3, :3] = rotation
    return pose


def _spun(t: float, body: Any, dt: float, rad_s: float, axis: int) -> np.ndarray:
    return _turned(body, body.home[:3, :3] @ Rotation.from_rotvec(rad_s * t * np.eye(3)[axis]).as_matrix())


# The pose (4, 4) at a time [s], from a body with the pose of first contact and the thickness below it, and
# the time step [s].
PROBES: dict[str, Callable[..., np.ndarray]] = {
    "away": lambda t, body, dt: advanced(body.home, -AWAY_MM),
    "press": _pressed,
    "teleport": lambda t, body, dt, depth_mm: advanced(body.home, depth_mm),
    "flat": lambda t, body, dt, gap_mm: _pressed(t, body, dt, body.thickness_mm - gap_mm),
    "sweep": _swept,
    "spin": _spun,
    "in and out": lambda t, body, dt: advanced(body.home, 20.0 if round(t / dt) % 2 else -50.0),
    "jitter": lambda t, body, dt: advanced(body.home, float(np.interp(t / dt, np.arange(1000), DEPTHS_MM))),
    "tumble": lambda t, body, dt: _turned(body, TURNS[round(t / dt) % 1000]),
}
