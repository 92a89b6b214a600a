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
# Arrows are so far outside the housing. Those of a beam that turns are so deep in the image.
CLEAR_MM, BEAM_MM = 3.0, 15.0
ARC_POINTS = 13


@dataclass(frozen=True)
class FreedomDistance:
    """What one degree of freedom has to change by.

    ``amount`` is in mm or degrees, with the sign of its control in ``render.viewer.Controls``. ``direction``
    (3,) is where that moves the probe: where it rotates the marked end, where it tilts or rocks the beam.
    """

    freedom: DegreeOfFreedom
    amount: float
    direction: np.ndarray

    @property
    def is_angle(self) -> bool:
        """Whether the amount is in degrees."""
        return self.freedom in ("tilt", "rock", "rotate")

    @property
    def weight_mm(self) -> float:
        """The distance, comparable with those of the other degrees of freedom."""
        return abs(self.amount) / (DEG_PER_MM_OFF if self.is_angle else 1.0)


def freedom_distances(
    manipulator: ProbeManipulator, pose: np.ndarray, goal: np.ndarray
) -> list[FreedomDistance]:
    """The distances of a transducer at a pose (4, 4) from a goal (4, 4), in the order of
    ``DegreeOfFreedom``.

    The lengths are along the axes that the probe has now, the angles those that ``manipulator`` adds.
    """
    axes = (pose[:3, :3] * [1.0, 1.0, -1.0]).T
    lengths, turns = axes @ _face_shift(manipulator, pose, goal), manipulator.turns_to(pose, goal)
    turned = manipulator.turned_by(pose, np.diag(turns)) - pose
    beam, marked_end = [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]
    swung = np.einsum("nij,nj->ni", turned[:, :3, :3], [beam, beam, marked_end])
    directions = [*(np.sign(lengths)[:, None] * axes), *swung]
    freedoms: tuple[DegreeOfFreedom, ...] = get_args(DegreeOfFreedom)
    return [
        FreedomDistance(freedom, float(amount), direction)
        for freedom, amount, direction in zip(freedoms, [*lengths, *turns], directions, strict=True)
    ]


def arrows_between(
    manipulator: ProbeManipulator, pose: np.ndarray, goal: np.ndarray
) -> tuple[np.ndarray, ...]:
    """The arrows (n, 3) [mm] that lead to a goal: the whole move, and the largest of the turns at both sides
    of the probe, each unless negligible.
    """
    shift, turns = _face_shift(manipulator, pose, goal), manipulator.turns_to(pose, goal)
    length, largest = float(np.linalg.norm(shift)), int(np.argmax(np.abs(turns)))
    arrows = []
    if length > NEGLIGIBLE_MM:
        way = max(length, LEAST_ARROW_MM) / length * shift
        # Also an arrow towards the housing ends outside it.
        above = manipulator.size_mm[2] / 2 + CLEAR_MM + max(0.0, float(-way @ pose[:3, 2]))
        start = pose[:3, 3] + above * pose[:3, 2]
        arrows.append(np.stack([start, start + way]))
    if abs(turns[largest]) > NEGLIGIBLE_MM * DEG_PER_MM_OFF:
        angle = np.copysign(max(abs(turns[largest]), LEAST_ARROW_DEG), turns[largest])
        shares = np.linspace(0.0, 1.0, ARC_POINTS)[:, None]
        poses = manipulator.turned_by(pose, shares * angle * np.eye(3)[largest])
        arrows += [(poses @ [*point, 1.0])[:, :3] for point in _turned_points(manipulator, largest)]
    return tuple(arrows)


def _turned_points(manipulator: ProbeManipulator, axis: int) -> list[list[float]]:
    """The points on the transducer whose paths show that it turns about its x, y or z axis."""
    x, y, z = manipulator.size_mm / 2
    return [
        [[side * (x + CLEAR_MM), 0.0, -z - BEAM_MM] for side in (-1.0, 1.0)],
        [[0.0, side * (y + CLEAR_MM), -z - BEAM_MM] for side in (-1.0, 1.0)],
        # That of the marked end alone.
        [[x + CLEAR_MM, 0.0, 0.0]],
    ][axis]


def _face_shift(manipulator: ProbeManipulator, pose: np.ndarray, goal: np.ndarray) -> np.ndarray:
    length = float(manipulator.size_mm[2])
    return array_face_centre(goal, length) - array_face_centre(pose, length)
