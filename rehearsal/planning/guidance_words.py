"""Guidance along a plan in words: the next pose, what is left to it, and the key that leads there.

``{action}`` stands for the key of an action.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from rehearsal.planning.pose_distance import DegreeOfFreedom, FreedomDistance

Side = Literal["left", "right"]
# Towards the negative and positive ends of LPS axes, where the side of the kidney is not known.
TOWARDS = (("the patient's right", "the patient's left"), ("the front", "the back"), ("the feet", "the head"))
OF_SIDE: dict[Side, tuple[str, str]] = {
    "left": ("the midline", "the flank"),
    "right": ("the flank", "the midline"),
}
# A direction has the name of a second axis from this share of the first on.
SECOND_AXIS = 0.6
# What a degree of freedom does for a negative and a positive amount, and the actions.
VERBS: dict[DegreeOfFreedom, tuple[str, str]] = {
    "along": ("slide", "slide"),
    "across": ("slide", "slide"),
    "depth": ("lift", "push in"),
    "tilt": ("tilt the beam", "tilt the beam"),
    "rock": ("rock the beam", "rock the beam"),
    "rotate": ("rotate the marked end", "rotate the marked end"),
}
ACTIONS: dict[DegreeOfFreedom, tuple[str, str]] = {
    "along": ("point", "point"),
    "across": ("point", "point"),
    "depth": ("lift", "push"),
    "tilt": ("tilt_back", "tilt_forward"),
    "rock": ("rock_right", "rock_left"),
    "rotate": ("rotate_right", "rotate_left"),
}


@dataclass(frozen=True)
class NextPose:
    """The pose of a sweep that comes next, the ``number``-th of ``count``, and what is left to it.

    ``has_reached`` is whether the one before was reached, and not only passed by. ``named`` is the distance
    that comes first.
    """

    number: int
    count: int
    has_reached: bool
    distances: Sequence[FreedomDistance]
    named: FreedomDistance


def next_pose_in_words(pose: NextPose, side: Side | None, has_keys: bool) -> str:
    """Two lines: what to do next, and what is left in each degree of freedom; ``has_keys`` says whether keys
    and mouse move the probe.
    """
    before = f"Pose {pose.number - 1} of {pose.count} is reached. Next: " if pose.has_reached else ""
    begin = before or f"Pose {pose.number} of {pose.count}: "
    named = pose.named
    verb = _by_sign(VERBS[named.freedom], named.amount)
    unit = f"{abs(named.amount):.0f} degrees" if named.is_angle else f"{abs(named.amount):.1f} mm"
    key = f": {{{_by_sign(ACTIONS[named.freedom], named.amount)}}}" if has_keys else ""
    return f"{begin}{verb} {unit} towards {towards(named.direction, side)}{key}\n{_left(pose.distances)}"


def completed_in_words(count: int) -> str:
    """After the last pose of a sweep."""
    return f"All {count} poses of this sweep are completed. {{next_plan}} shows the next sweep, then none."


def _left(distances: Sequence[FreedomDistance]) -> str:
    lengths = ", ".join(f"{one.freedom} {abs(one.amount):.1f}" for one in distances if not one.is_angle)
    angles = ", ".join(f"{one.freedom} {abs(one.amount):.0f}" for one in distances if one.is_angle)
    return f"To go: {lengths} mm; {angles} degrees"


def towards(direction: np.ndarray, side: Side | None) -> str:
    """A direction (3,) in LPS, by the axis or the two axes that it is nearest to; ``side`` is that of the
    kidney, None where it is not known.
    """
    ends = (TOWARDS[0] if side is None else OF_SIDE[side], *TOWARDS[1:])
    first, second = np.argsort(-np.abs(direction))[:2]
    axes = [first, second] if abs(direction[second]) >= SECOND_AXIS * abs(direction[first]) else [first]
    return " and ".join(_by_sign(ends[axis], direction[axis]) for axis in axes)


def _by_sign(pair: tuple[str, str], amount: float) -> str:
    return pair[int(amount > 0)]
