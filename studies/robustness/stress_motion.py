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


def _scaled(x: np.ndarray, up: np.ndarray, *factors: float) -> tuple[np.ndarray, np.ndarray]:
    middle = x.mean(axis=0)
    return middle + (x - middle) * factors, np.zeros_like(x)


def _scattered(x: np.ndarray, up: np.ndarray, mm: float) -> tuple[np.ndarray, np.ndarray]:
    return x + np.random.default_rng(SEED).normal(0.0, mm, x.shape), np.zeros_like(x)


def _boxed(x: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.random.default_rng(SEED).uniform(x.min(axis=0), x.max(axis=0), x.shape), np.zeros_like(x)


def _thrown(x: np.ndarray, up: np.ndarray, *velocity: float) -> tuple[np.ndarray, np.ndarray]:
    return x, np.tile(velocity, (len(x), 1))


def _heated(x: np.ndarray, up: np.ndarray, speed: float) -> tuple[np.ndarray, np.ndarray]:
    return x, np.random.default_rng(SEED).normal(0.0, speed, x.shape)


def _turning(x: np.ndarray, up: np.ndarray, axis: int, rad_s: float) -> tuple[np.ndarray, np.ndarray]:
    return x, np.cross(rad_s * np.eye(3)[axis], x - x.mean(axis=0))


def _lifted(x: np.ndarray, up: np.ndarray, mm: float) -> tuple[np.ndarray, np.ndarray]:
    return x + mm * up, np.zeros_like(x)


def _one_out(x: np.ndarray, up: np.ndarray, mm: float) -> tuple[np.ndarray, np.ndarray]:
    moved = x.copy()
    moved[len(x) // 2] += mm * up
    return moved, np.zeros_like(x)


def _overlapped(x: np.ndarray, up: np.ndarray, share: float) -> tuple[np.ndarray, np.ndarray]:
    """The right of two bodies shifted along x into the left one."""
    moved, right = x.copy(), x[:, 0] > 0
    apart = x[right, 0].mean() - x[~right, 0].mean()
    wide = np.ptp(x[right, 0])
    moved[right, 0] -= apart - (1 - share) * wide
    return moved, np.zeros_like(x)


STATES: dict[str, State] = {
    "settled": lambda x, up: (x, np.zeros_like(x)),
    "scaled": _scaled,
    "scattered": _scattered,
    "boxed": _boxed,
    "thrown": _thrown,
    "heated": _heated,
    "turning": _turning,
    "lifted": _lifted,
    "one out": _one_out,
    "nothing": lambda x, up: (np.full_like(x, np.nan), np.zeros_like(x)),
    "overlapped": _overlapped,
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


def _spun(home: np.ndarray, thickness_mm: float, dt: float, rad_s: float, axis: int) -> Path:
    pose = advanced(home, MIDDLE_MM)

    def at(t: float) -> np.ndarray:
        turned = pose.copy()
        turned[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(rad_s * t * np.eye(3)[axis]).as_matrix()
        return turned

    return at


def _jitter(home: np.ndarray, thickness_mm: float, dt: float) -> Path:
    depths = MIDDLE_MM + np.random.default_rng(SEED).uniform(-MIDDLE_MM, MIDDLE_MM, 1000)
    return lambda t: advanced(home, float(np.interp(t / dt, np.arange(1000), depths)))


def _tumble(home: np.ndarray, thickness_mm: float, dt: float) -> Path:
    pose, turns = advanced(home, MIDDLE_MM), Rotation.random(1000, random_state=SEED).as_matrix()

    def at(t: float) -> np.ndarray:
        turned = pose.copy()
        turned[:3, :3] = turns[round(t / dt) % 1000]
        return turned

    return at


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
