"""The distance of the transducer from a planned pose, in each of its degrees of freedom."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from ultrasound.probe_manipulator import ProbeManipulator, array_face_centre

DegreeOfFreedom = Literal["along", "across", "depth", "tilt", "rock", "rotate"]
# An angular deviation of this many degrees counts as one millimetre.
DEG_PER_MM_OFF = 3.0
# A distance that counts as less than this is none [mm].
NEGLIGIBLE_MM = 0.3
# Shorter arrows could not be seen: their least length and angle.
LEAST_ARROW_MM, LEAST_ARROW_DEG = 8.0, 15.0
# Arrows are so far outside the housing. That of a tilt is at this depth in the image.
CLEAR_MM, BEAM_MM = 3.0, 25.0
ARC_POINTS = 13


@dataclass(frozen=True)
class FreedomDistance:
    """What one degree of freedom has to change by.

    ``amount`` is in mm or degrees, with the sign of its control in ``render.viewer.Controls``. ``arrow_mm``
    (n, 3) is the path of a point of the probe: where it rotates of the marked end, where it tilts or rocks of
    a point of the beam.
    """

    freedom: DegreeOfFreedom
    amount: float
    arrow_mm: np.ndarray

    @property
    def is_angle(self) -> bool:
        """Whether the amount is in degrees."""
        return self.freedom in ("tilt", "rock", "rotate")

    @property
    def weight_mm(self) -> float:
        """The distance, comparable with those of the other degrees of freedom."""
        return abs(self.amount) / (DEG_PER_MM_OFF if self.is_angle else 1.0)

    @property
    def direction(self) -> np.ndarray:
        """The unit vector (3,) from the start of the arrow to its end."""
        way = self.arrow_mm[-1] - self.arrow_mm[0]
        return way / np.linalg.norm(way)


def freedom_distances(
    manipulator: ProbeManipulator, pose: np.ndarray, goal: np.ndarray
) -> list[FreedomDistance]:
    """The distances of a transducer at a pose (4, 4) from a goal (4, 4), in the order of
    ``DegreeOfFreedom``.

    The lengths are along the axes that the probe has now, the angles those that ``manipulator`` adds.
    """
    axes = (pose[:3, :3] * [1.0, 1.0, -1.0]).T
    lengths, turns = axes @ _face_shift(manipulator, pose, goal), manipulator.turns_to(pose, goal)
    ways = np.array([_at_least(mm, LEAST_ARROW_MM) for mm in lengths])[:, None] * axes
    angles = np.diag([_at_least(degrees, LEAST_ARROW_DEG) for degrees in turns])
    arrows = [_move(manipulator, pose, way) for way in ways] + [
        _turn(manipulator, pose, turn) for turn in angles
    ]
    freedoms: tuple[DegreeOfFreedom, ...] = get_args(DegreeOfFreedom)
    return [
        FreedomDistance(freedom, float(amount), arrow)
        for freedom, amount, arrow in zip(freedoms, [*lengths, *turns], arrows, strict=True)
    ]


def arrows_between(
    manipulator: ProbeManipulator, pose: np.ndarray, goal: np.ndarray
) -> tuple[np.ndarray, ...]:
    """The arrows (n, 3) [mm] that lead to a goal: the whole move, and the largest of the turns, each unless
    negligible.
    """
    shift = _face_shift(manipulator, pose, goal)
    length = float(np.linalg.norm(shift))
    turns = [one for one in freedom_distances(manipulator, pose, goal) if one.is_angle]
    turn = max(turns, key=lambda one: one.weight_mm)
    arrows = []
    if length > NEGLIGIBLE_MM:
        arrows.append(_move(manipulator, pose, _at_least(length, LEAST_ARROW_MM) / length * shift))
    if turn.weight_mm > NEGLIGIBLE_MM:
        arrows.append(turn.arrow_mm)
    return tuple(arrows)


def _face_shift(manipulator: ProbeManipulator, pose: np.ndarray, goal: np.ndarray) -> np.ndarray:
    length = float(manipulator.size_mm[2])
    return array_face_centre(goal, length) - array_face_centre(pose, length)


def _at_least(amount: float, least: float) -> float:
    return float(np.copysign(max(abs(amount), least), amount))


def _move(manipulator: ProbeManipulator, pose: np.ndarray, way: np.ndarray) -> np.ndarray:
    """An arrow (2, 3) along a way (3,), from above the transducer."""
    start = pose[:3, 3] + (manipulator.size_mm[2] / 2 + CLEAR_MM) * pose[:3, 2]
    return np.stack([start, start + way])


def _turn(manipulator: ProbeManipulator, pose: np.ndarray, turn_deg: np.ndarray) -> np.ndarray:
    """The path (ARC_POINTS, 3) of the marked end as the probe rotates, or of the beam as it tilts or rocks by
    angles (3,).
    """
    x, _, z = manipulator.size_mm / 2
    point = [x + CLEAR_MM, 0.0, 0.0, 1.0] if turn_deg[2] else [0.0, 0.0, -z - BEAM_MM, 1.0]
    shares = np.linspace(0.0, 1.0, ARC_POINTS)[:, None]
    return (manipulator.turned_by(pose, shares * turn_deg) @ point)[:, :3]
