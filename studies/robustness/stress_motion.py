"""Initial states of the stress test, and motions of the transducer."""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from ultrasound.probe_manipulator import advanced

AWAY_MM = 200.0
# Reach of a sweep to both sides, and mean depth of spinning and shaking [mm].
SWEEP_MM, MIDDLE_MM = 80.0, 15.0
# Duration of a press, or its number of steps where that is longer.
PRESS_S, PRESS_STEPS = 0.02, 20
SEED = 20161130

# From settled positions and the upward direction: positions (n, 3) [mm] and velocities (n, 3) [mm/s].
State = Callable[..., tuple[np.ndarray, np.ndarray]]
# From the pose of first contact, the thickness below it [mm] and the time step [s]: the pose (4, 4) at a time [s].
Path = Callable[[float], np.ndarray]


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


def _pressed(home: np.ndarray, thickness_mm: float, dt: float, depth_mm: float) -> Path:
    takes_s = max(PRESS_S, PRESS_STEPS * dt)
    return lambda t: advanced(home, depth_mm * min(t / takes_s, 1.0))


def _swept(home: np.ndarray, thickness_mm: float, dt: float, speed: float, depth_mm: float) -> Path:
    pose = advanced(home, depth_mm)

    def at(t: float) -> np.ndarray:
        moved = pose.copy()
        moved[:3, 3] += (speed * t % (2 * SWEEP_MM) - SWEEP_MM) * pose[:3, 0]
        return moved

    return at


def _turned(pose: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    turned = pose.copy()
    turned[:3, :3] = rotation
    return turned


def _spun(home: np.ndarray, thickness_mm: float, dt: float, rad_s: float, axis: int) -> Path:
    pose = advanced(home, MIDDLE_MM)
    return lambda t: _turned(
        pose, pose[:3, :3] @ Rotation.from_rotvec(rad_s * t * np.eye(3)[axis]).as_matrix()
    )


def _jitter(home: np.ndarray, thickness_mm: float, dt: float) -> Path:
    depths = MIDDLE_MM + _random().uniform(-MIDDLE_MM, MIDDLE_MM, 1000)
    return lambda t: advanced(home, float(np.interp(t / dt, np.arange(1000), depths)))


def _tumble(home: np.ndarray, thickness_mm: float, dt: float) -> Path:
    pose, turns = advanced(home, MIDDLE_MM), Rotation.random(1000, random_state=SEED).as_matrix()
    return lambda t: _turned(pose, turns[round(t / dt) % 1000])


PROBES: dict[str, Callable[..., Path]] = {
    "away": lambda home, thickness_mm, dt: lambda t: advanced(home, -AWAY_MM),
    "press": _pressed,
    "teleport": lambda home, thickness_mm, dt, depth_mm: lambda t: advanced(home, depth_mm),
    "flat": lambda home, thickness_mm, dt, gap_mm: _pressed(home, thickness_mm, dt, thickness_mm - gap_mm),
    "sweep": _swept,
    "spin": _spun,
    "in and out": lambda home, thickness_mm, dt: (
        lambda t: advanced(home, 20.0 if round(t / dt) % 2 else -50.0)
    ),
    "jitter": _jitter,
    "tumble": _tumble,
}
