"""Guidance to the next pose: what the words and arrows say is what key and mouse then do."""

import re
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from plan_ball import (
    BALL,
    SIZE,
    case_of_ball,
    guide_over_ball,
    manipulator_on,
    plan_of,
    straight_pass,
    sweep_of,
)

from rehearsal.live_settings import DEFAULT_KEYS
from rehearsal.planning.guidance_words import NextPose, next_pose_in_words, towards
from rehearsal.planning.plan_guidance import PlanGuidance
from rehearsal.planning.pose_distance import (
    BEAM_MM,
    LEAST_ARROW_DEG,
    LEAST_ARROW_MM,
    DegreeOfFreedom,
    arrows_between,
    freedom_distances,
)
from rehearsal.sources.user import Hand
from render.keys import HELD, hold
from render.scene_view import TIP_MM, arrow_segments
from render.viewer import Controls
from ultrasound.probe_manipulator import ManipulatorState, ProbeManipulator

# Where the probe is on a ball about the origin, in LPS: from the flank, the front, the feet, obliquely.
OUTWARD = {
    "flank": [1.0, 0.0, 0.0],
    "front": [0.0, -1.0, 0.1],
    "feet": [-0.2, 0.1, -1.0],
    "oblique": [0.6, -0.6, 0.5],
}
TURNS = (0.0, 0.0, 0.0), (12.0, -8.0, 70.0), (-20.0, 15.0, -150.0)
# What of a pose is not reached: a degree of freedom and its amount, by the control that changes it.
STEPS: dict[DegreeOfFreedom, tuple[str, float]] = {
    "depth": ("push_mm", 4.0),
    "tilt": ("tilt_deg", 15.0),
    "rock": ("rock_deg", 15.0),
    "rotate": ("rotate_deg", 20.0),
}
KEYS_OF = {
    *(("depth", 1, "W"), ("depth", -1, "S"), ("tilt", 1, "C"), ("tilt", -1, "Z")),
    *(("rock", 1, "Q"), ("rock", -1, "E"), ("rotate", 1, "A"), ("rotate", -1, "D")),
}
# The ends of the axes of LPS, for each side of the kidney.
ENDS = {
    "left": {(0, 1): "flank", (0, -1): "midline"},
    "right": {(0, 1): "midline", (0, -1): "flank"},
    None: {(0, 1): "patient's left", (0, -1): "patient's right"},
}
FIXED_ENDS = {(1, 1): "back", (1, -1): "front", (2, 1): "head", (2, -1): "feet"}


def manipulator_at(place: str, turn_deg: tuple[float, float, float]) -> ProbeManipulator:
    """Over the ball, turned by angles, pressed in by 2 mm."""
    manipulator = manipulator_on(BALL)
    manipulator.state = ManipulatorState(depth_mm=2.0, turn_deg=turn_deg)
    outward = np.array(OUTWARD[place])
    manipulator.aim_at(30.0 * outward / np.linalg.norm(outward), np.array([0.3, 0.5, 0.8]))
    return manipulator


def goal_of(manipulator: ProbeManipulator, freedom: DegreeOfFreedom, amount: float) -> np.ndarray:
    """The pose (4, 4) in which one degree of freedom differs."""
    state, (control, _) = manipulator.state, STEPS[freedom]
    if control == "push_mm":
        manipulator.push(amount)
    else:
        manipulator.turn(
            *(amount if name == control else 0.0 for name in ("tilt_deg", "rock_deg", "rotate_deg"))
        )
    goal, manipulator.state = manipulator.pose(), state
    return goal


def faces_apart_mm(one: np.ndarray, other: np.ndarray) -> float:
    face = np.array([0.0, 0.0, -SIZE[2] / 2, 1.0])
    return float(np.linalg.norm((one - other) @ face))


def angle_between(one: np.ndarray, other: np.ndarray) -> float:
    cosine = (np.trace(one[:3, :3].T @ other[:3, :3]) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def words_to(manipulator: ProbeManipulator, goal: np.ndarray, side=None, has_keys=True) -> str:
    """The words at the manipulator's pose, with the user's keys."""
    distances = freedom_distances(manipulator, manipulator.pose(), goal)
    largest = max(distances, key=lambda one: one.weight_mm)
    text = next_pose_in_words(NextPose(3, 9, False, distances, largest), side, has_keys)
    return DEFAULT_KEYS.worded(text)


def after_key(manipulator: ProbeManipulator, key: str, seconds: float) -> np.ndarray:
    """The pose after a key was held."""
    controls = Controls(None)
    hold(DEFAULT_KEYS.action_of(key.lower()), controls, seconds)
    hand = Hand(manipulator)
    hand.pose(controls, manipulator.pose(), seconds)
    return manipulator.pose()


def named_ends(direction: np.ndarray, side) -> list[str]:
    """The ends of the LPS axes that a direction is nearest to, the nearest first."""
    names = ENDS[side] | FIXED_ENDS
    order = np.argsort(-np.abs(direction))
    return [names[int(axis), int(np.sign(direction[axis]))] for axis in order]


@pytest.mark.parametrize("side", ["left", "right", None])
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("freedom", list(STEPS))
@pytest.mark.parametrize("turn_deg", TURNS)
@pytest.mark.parametrize("place", list(OUTWARD))
def test_the_named_key_moves_the_probe_nearer_as_named(place, turn_deg, freedom, sign, side):
    manipulator = manipulator_at(place, turn_deg)
    start, goal = manipulator.pose(), goal_of(manipulator, freedom, sign * STEPS[freedom][1])
    line = words_to(manipulator, goal, side).splitlines()[0]
    words, _, key = line.rpartition(": ")
    assert (freedom, sign, key) in KEYS_OF
    before = {one.freedom: one.amount for one in freedom_distances(manipulator, start, goal)}
    moved = after_key(manipulator, key, 0.1)
    after = {one.freedom: one.amount for one in freedom_distances(manipulator, moved, goal)}
    assert abs(after[freedom]) < abs(before[freedom]) and np.sign(before[freedom]) == sign
    if freedom == "depth":
        assert faces_apart_mm(moved, goal) < faces_apart_mm(start, goal) - 1.0
        point = [0.0, 0.0, 0.0, 1.0]
    else:
        assert angle_between(moved, goal) < angle_between(start, goal) - 2.0
        point = [10.0, 0.0, 0.0, 1.0] if freedom == "rotate" else [0.0, 0.0, -SIZE[2] / 2 - BEAM_MM, 1.0]
    # Of the rotation alone: in contact the probe moves along its axis, too.
    shift = (moved - start) @ point
    if freedom != "depth":
        shift -= (moved - start) @ [0.0, 0.0, -SIZE[2] / 2, 1.0]
    ends = named_ends(shift[:3], side)
    assert words.partition(" towards ")[2].replace("the ", "").split(" and ")[0] in ends[:2]
    # One of the two where they are about as large.
    lengths = np.sort(np.abs(shift[:3]))
    if lengths[1] < 0.8 * lengths[2]:
        assert words.partition(" towards ")[2].replace("the ", "").split(" and ")[0] == ends[0]


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("shift", [(7.0, 1.0), (-7.0, 1.0), (1.0, 7.0), (1.0, -7.0)])
@pytest.mark.parametrize("turn_deg", TURNS)
@pytest.mark.parametrize("place", list(OUTWARD))
def test_a_slide_as_named_brings_the_face_nearer(place, turn_deg, shift, side):
    manipulator = manipulator_at(place, turn_deg)
    start, state = manipulator.pose(), manipulator.state
    manipulator.slide(*shift)
    goal, manipulator.state = manipulator.pose(), state
    line = words_to(manipulator, goal, side).splitlines()[0]
    assert line.endswith(": Mouse") and "slide" in line
    distances = {one.freedom: one.amount for one in freedom_distances(manipulator, start, goal)}
    named = "along" if abs(shift[0]) > abs(shift[1]) else "across"
    ends = [name for name in (*ENDS[side].values(), *FIXED_ENDS.values()) if f"the {name}" in line]
    names = {name: key for key, name in (ENDS[side] | FIXED_ENDS).items()}
    way = sum(sign * np.eye(3)[axis] for axis, sign in map(names.__getitem__, ends))
    # The mouse goes over the organ in the named direction.
    face = (start @ [0.0, 0.0, -SIZE[2] / 2, 1.0])[:3]
    origin = face + 40.0 * start[:3, 2] + 3.0 * way / np.linalg.norm(way)
    Hand(manipulator).pose(Controls(None, ray=(origin, -start[:3, 2])), start, 1.0)
    assert faces_apart_mm(manipulator.pose(), goal) < faces_apart_mm(start, goal)
    # So does the stick of a gamepad, by the sign of the distance.
    manipulator.state = state
    stick = tuple(2.0 * np.sign(distances[one]) * (one == named) for one in ("along", "across"))
    manipulator.slide(*stick)
    assert faces_apart_mm(manipulator.pose(), goal) < faces_apart_mm(start, goal) - 1.0


def test_all_distances_are_those_of_the_six_degrees_of_freedom():
    manipulator = manipulator_at("oblique", (12.0, -8.0, 70.0))
    start = manipulator.pose()
    goal = start.copy()
    goal[:3, 3] += start[:3, :3] @ [3.0, -2.0, -1.5]
    distances = freedom_distances(manipulator, start, goal)
    assert [one.freedom for one in distances] == list(get_args(DegreeOfFreedom))
    assert [one.amount for one in distances] == pytest.approx([3.0, -2.0, 1.5, 0.0, 0.0, 0.0], abs=1e-9)
    assert words_to(manipulator, goal).splitlines()[1] == (
        "To go: along 3.0, across 2.0, depth 1.5 mm; tilt 0, rock 0, rotate 0 degrees"
    )
    turned = manipulator.turned_by(goal, np.array([5.0, -9.0, 30.0]))
    turns = [one.amount for one in freedom_distances(manipulator, start, turned)]
    # The face stays where it is.
    assert turns == pytest.approx([3.0, -2.0, 1.5, 5.0, -9.0, 30.0])


def test_a_tracked_probe_has_no_keys():
    manipulator = manipulator_at("front", (0.0, 0.0, 0.0))
    goal = goal_of(manipulator, "depth", 4.0)
    assert words_to(manipulator, goal).splitlines()[0].endswith("push in 4.0 mm towards the back: W")
    assert words_to(manipulator, goal, has_keys=False).splitlines()[0].endswith("towards the back")


def test_directions_are_the_patients():
    x, y, z = np.eye(3)
    assert [towards(way, None) for way in (x, -x)] == ["the patient's left", "the patient's right"]
    assert [towards(way, "left") for way in (x, -x)] == ["the flank", "the midline"]
    assert [towards(way, "right") for way in (x, -x)] == ["the midline", "the flank"]
    assert [towards(way, "left") for way in (y, -y, z, -z)] == [
        "the back",
        "the front",
        "the head",
        "the feet",
    ]
    assert towards(-z - 0.8 * y, "left") == "the feet and the front"
    assert towards(-z - 0.3 * y, "left") == "the feet"


# Along a sweep

FIRST = straight_pass(4, step_mm=2.0)


def test_the_words_go_on_with_the_poses_to_the_end():
    guide = guide_over_ball(plan_of(sweep_of(FIRST)))
    assert guide.next_in_words("left", True) == ""
    away = FIRST[0].copy()
    away[:3, 3] += [0.0, -9.0, 0.0]
    guide.follow(away)
    line = guide.next_in_words("left", True).splitlines()[0]
    assert line == "Pose 1 of 4: slide 9.0 mm towards the back: {point}"
    guide.follow(FIRST[0])
    assert guide.next_in_words("left", True).startswith("Pose 1 of 4 is reached. Next: slide 2.0 mm")
    # Passed by, and not reached.
    beside = FIRST[2].copy()
    beside[0, 3] += 1.5
    guide.follow(beside)
    assert guide.next_in_words("left", True).startswith("Pose 3 of 4: slide 1.5 mm towards the midline")
    guide.follow(FIRST[3])
    assert guide.next_in_words("left", True).startswith("All 4 poses of this sweep are completed.")
    assert guide.guidance().arrows_mm == ()
    guide.next_sweep()
    assert guide.next_in_words("left", True) == ""


def test_the_named_degree_of_freedom_does_not_change_with_each_frame():
    guide = guide_over_ball(plan_of(sweep_of(FIRST)))
    named = []
    for aside, ahead in ((9.0, 8.0), (9.0, 10.0), (9.0, 12.0), (9.0, 14.0), (11.0, 14.0)):
        pose = FIRST[0].copy()
        pose[:3, 3] += [aside, -ahead, 0.0]
        guide.follow(pose)
        named.append(guide.next_in_words(None, True).partition("towards ")[2].partition(":")[0])
    assert named == [*["the patient's right"] * 3, *["the back"] * 2]


# A user reads the line and does it: at most so often for a pose, each time so much of it.
MOST_ACTS, SHARE = 150, 0.7


def do_as_said(hand: Hand, line: str, side: str, pose: np.ndarray) -> np.ndarray:
    """The pose after what the first line of the words says, by key or mouse alone."""
    words, _, key = line.rpartition(": ")
    amount = float(re.search(r"(\d+\.?\d*) (mm|degrees)", words)[1])
    controls, seconds = Controls(None), 1.0
    if key == "Mouse":
        names = {name: place for place, name in (ENDS[side] | FIXED_ENDS).items()}
        towards = words.partition(" towards ")[2].replace("the ", "").split(" and ")
        way = sum(sign * np.eye(3)[axis] for axis, sign in map(names.__getitem__, towards))
        face = (pose @ [0.0, 0.0, -SIZE[2] / 2, 1.0])[:3]
        origin = face + 40.0 * pose[:3, 2] + SHARE * amount * way / np.linalg.norm(way)
        controls.ray = origin, -pose[:3, 2]
    else:
        action = DEFAULT_KEYS.action_of(key.lower())
        seconds = SHARE * amount / abs(HELD[action][1])
        hold(action, controls, seconds)
    return hand.pose(controls, pose, max(seconds, 1.0))


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("place", list(OUTWARD))
def test_who_does_what_the_words_say_completes_the_sweep(place, side):
    manipulator = manipulator_at(place, (10.0, -6.0, 25.0))
    poses = []
    for _ in range(6):
        poses.append(manipulator.pose())
        manipulator.slide(1.0, 2.0)
        manipulator.turn(-2.0, 1.5, 3.0)
    sweep, state = sweep_of(np.stack(poses)), manipulator.state
    guide = PlanGuidance(case_of_ball(), manipulator, plan_of(sweep))
    # From another place, and turned otherwise.
    manipulator.state = replace(state, depth_mm=0.0, turn_deg=(-15.0, 20.0, -30.0))
    manipulator.slide(-9.0, 6.0)
    hand, pose, reached = Hand(manipulator), manipulator.pose(), list[str]()
    for _ in range(MOST_ACTS):
        guide.follow(pose)
        line = DEFAULT_KEYS.worded(guide.next_in_words(side, True)).splitlines()[0]
        if line.startswith("All 6 poses"):
            break
        reached += re.findall(r"Pose (\d) of 6 is reached", line)
        pose = do_as_said(hand, line, side, pose)
    assert line.startswith("All 6 poses") and guide.figures()["plan_followed"] == 1.0
    # Those of a sweep may be passed by nearby; some are reached.
    assert reached


# Arrows


@pytest.mark.parametrize("turn_deg", TURNS)
@pytest.mark.parametrize("place", list(OUTWARD))
def test_arrows_point_as_the_words_do(place, turn_deg):
    manipulator = manipulator_at(place, turn_deg)
    start = manipulator.pose()
    for turn in (*(20.0 * np.eye(3)), *(-20.0 * np.eye(3))):
        goal = manipulator.turned_by(start, turn)
        named = max(freedom_distances(manipulator, start, goal), key=lambda one: one.weight_mm)
        arrows = arrows_between(manipulator, start, goal)
        assert len(arrows) == (1 if named.freedom == "rotate" else 2)
        way = sum(arrow[-1] - arrow[0] for arrow in arrows)
        assert way @ named.direction > 0.97 * np.linalg.norm(way) * np.linalg.norm(named.direction)


def test_arrows_point_to_the_goal_and_are_long_enough_to_be_seen():
    manipulator = manipulator_at("flank", (0.0, 0.0, 0.0))
    start = manipulator.pose()
    goal = start.copy()
    goal[:3, 3] += start[:3, :3] @ [20.0, 5.0, 0.0]
    (move,) = arrows_between(manipulator, start, goal)
    assert move[1] - move[0] == pytest.approx(goal[:3, 3] - start[:3, 3])
    near = start.copy()
    near[:3, 3] += [0.0, 1.0, 0.0]
    (move,) = arrows_between(manipulator, start, near)
    assert move[1] - move[0] == pytest.approx([0.0, LEAST_ARROW_MM, 0.0])
    # Both ends are outside the housing, also where the probe goes in.
    (pushed,) = arrows_between(manipulator, start, goal_of(manipulator, "depth", 6.0))
    assert ((pushed - start[:3, 3]) @ start[:3, 2] >= SIZE[2] / 2 + 1.0).all()
    rocked = arrows_between(manipulator, start, manipulator.turned_by(start, np.array([0.0, 3.0, 0.0])))
    # At both sides of the image, which would hide one of them.
    sides = [arrow @ start[:3, 1] for arrow in rocked]
    assert np.ptp(sides, axis=1) == pytest.approx(0.0, abs=1e-9) and sides[0][0] < sides[1][0]
    for arrow in rocked:
        radius = arrow - (start @ [0.0, 0.0, -SIZE[2] / 2, 1.0])[:3]
        radius -= np.outer(radius @ start[:3, 1], start[:3, 1])
        assert np.linalg.norm(radius, axis=1) == pytest.approx(BEAM_MM)
        cosine = radius[0] @ radius[-1] / BEAM_MM**2
        assert np.degrees(np.arccos(cosine)) == pytest.approx(LEAST_ARROW_DEG)
    assert arrows_between(manipulator, start, start) == ()


def test_the_tip_is_at_the_end_and_can_be_seen():
    toward = np.array([0.0, 0.0, 1.0])
    segments = arrow_segments(np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0], [5.0, 8.0, 0.0]]), toward)
    assert segments[:2].tolist() == [[[0, 0, 0], [5, 0, 0]], [[5, 0, 0], [5, 8, 0]]]
    tip = segments[2:]
    assert tip[:, 0] == pytest.approx(np.array([[5.0, 8.0, 0.0]] * 2))
    ends = tip[:, 1] - tip[:, 0]
    assert ends[:, 1] == pytest.approx(-TIP_MM) and ends[:, 2] == pytest.approx(0.0)
    assert ends[0, 0] == pytest.approx(-ends[1, 0]) and abs(ends[0, 0]) > 1.0
