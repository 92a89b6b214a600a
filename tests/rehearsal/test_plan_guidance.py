"""Guidance along a plan: progress, the lines in the 3D view, and the keys."""

from itertools import pairwise
from typing import get_args

import numpy as np
import pytest
from conftest import rotation_about
from fake_organ import fake_timeline
from plan_ball import SIZE, guide_over_ball, plan_of, straight_pass, sweep_of
from settings_at_start import settings_with

from rehearsal.live_settings import DEFAULT_KEYS
from rehearsal.loop.command import (
    BeginAction,
    Bookmark,
    Command,
    GoTo,
    Move,
    NewSession,
    Pause,
    Redo,
    Reset,
    Undo,
)
from rehearsal.planning.plan_guidance import ABOVE_MM, AHEAD, DEG_PER_MM_OFF, NEAR_MM, PlanGuidance
from render import scene_view, transducer_shape
from render.keys import begin
from render.scene_view import DONE, TO_GO, PlanLines
from render.viewer import Controls, Guidance, TransducerHousing
from sim.fields import Field, array_of
from ultrasound.probe_manipulator import advanced
from ultrasound.target import Target

FIRST, SECOND = straight_pass(4, step_mm=2.0), straight_pass(3, 20.0, 2.0)


def guide_of(*sweeps) -> PlanGuidance:
    return guide_over_ball(plan_of(*(sweeps or [sweep_of(FIRST, SECOND)])))


def turned(pose: np.ndarray, degrees: float) -> np.ndarray:
    """About the face's middle."""
    turn, face = np.eye(4), np.eye(4)
    turn[:3, :3], face[2, 3] = rotation_about([1, 1, 0], degrees), -SIZE[2] / 2
    return pose @ face @ turn @ np.linalg.inv(face)


# Followed


def test_a_plan_followed_exactly_is_completed_without_deviation():
    guide = guide_of()
    for number, pose in enumerate([*FIRST, *SECOND]):
        assert guide.guidance().goal == pytest.approx(pose)
        assert guide.figures()["plan_followed"] == pytest.approx(number / 7)
        guide.follow(pose)
    assert guide.figures() == pytest.approx(dict(plan_followed=1.0, plan_off_mm=0.0, plan_off_deg=0.0))
    assert guide.guidance().goal is None and guide.guidance().done.all()
    assert guide.in_words(0.5) == (
        "plan      two passes: 100 % completed, mean deviation 0.0 mm and 0 degrees; "
        "coverage of margin 50 % (planned 75 %)"
    )
    guide.follow(SECOND[-1])
    assert guide.figures()["plan_followed"] == 1.0


def test_the_deviation_is_the_distance_of_the_face_and_the_angle():
    sparse = straight_pass(7, step_mm=9.0)
    guide = guide_of(sweep_of(sparse))
    for number, pose in enumerate(sparse):
        beside = turned(pose, 9.0 if number % 2 else 3.0)
        beside[:3, 3] += [0.6, 0.0, -0.8]
        guide.follow(beside)
    figures = guide.figures()
    assert figures["plan_followed"] == 1.0 and figures["plan_off_mm"] == pytest.approx(1.0)
    assert figures["plan_off_deg"] == pytest.approx((4 * 3 + 3 * 9) / 7)


@pytest.mark.parametrize("offset", [0.0, 2.0])
def test_each_pose_counts_at_its_least_distance_and_is_not_completed_before(offset):
    """In tenths of a step, from above the first. One reached exactly is completed a millimetre before it.

    Any other is completed where the next is nearer, the last where the one before it is not.
    """
    guide = guide_of(sweep_of(straight_pass(11, step_mm=1.5)))
    (begin,) = straight_pass(1, offset)
    for height in np.arange(8.0, 1.0, -0.25):
        guide.follow(advanced(begin, -height))
        assert guide.next_pose == 0
    for number, pose in enumerate(straight_pass(101, offset, 0.15)):
        guide.follow(pose)
        if offset == 0:
            assert guide.next_pose == min((number + 6) // 10 + 1, 11)
        elif number % 10 != 5:
            assert guide.next_pose == (number + 5) // 10 + (number > 95)
    off = dict(plan_followed=1.0, plan_off_mm=offset, plan_off_deg=0.0)
    assert guide.figures() == pytest.approx(off, abs=1e-6)


def test_tilting_counts_each_pose_at_its_least_angle_too():
    tilted = np.stack([turned(straight_pass(1)[0], angle) for angle in np.arange(-30.0, 31.0, 2.0)])
    guide = guide_of(sweep_of(tilted))
    for angle in np.arange(-30.0, 30.1, 0.5):
        guide.follow(turned(straight_pass(1)[0], angle))
        assert (angle + 30) / 2 < guide.next_pose <= (angle + 30) / 2 + 3
    assert guide.figures() == pytest.approx(
        dict(plan_followed=1.0, plan_off_mm=0.0, plan_off_deg=0.0), abs=1e-4
    )


def test_the_path_is_drawn_on_each_pass_and_not_between_them():
    guide = guide_of()
    places = [[0.0, 2 * n, 0.0] for n in range(4)], [[20.0, 2 * n, 0.0] for n in range(3)]
    segments = [[a, b] for each in places for a, b in pairwise(each)]
    assert guide.guidance().path_mm == pytest.approx(np.array(segments) + [0, 0, ABOVE_MM])
    done = []
    for pose in [*FIRST, *SECOND]:
        guide.follow(pose)
        done.append(guide.guidance().done.sum())
    assert done == [0, 1, 2, 3, 3, 4, 5]


def test_some_poses_may_be_skipped_and_progress_does_not_go_back():
    long = straight_pass(30, step_mm=5.0)
    guide = guide_of(sweep_of(long))
    guide.follow(long[3])
    assert guide.next_pose == 4 and guide.guidance().goal == pytest.approx(long[4])
    guide.follow(long[0])
    guide.follow(long[4 + AHEAD + 1])
    assert guide.next_pose == 4
    guide.follow(long[4 + AHEAD - 1])
    assert guide.next_pose == 4 + AHEAD


@pytest.mark.parametrize(
    ("mm", "degrees", "near"),
    [(5.9, 0, True), (6.1, 0, False), (0, 17.9, True), (0, 18.1, False), (3.1, 9, False)],
)
def test_a_pose_is_near_by_distance_and_angle_together(mm, degrees, near):
    assert (NEAR_MM, DEG_PER_MM_OFF) == (6.0, 3.0)
    sparse = straight_pass(4, step_mm=50.0)
    guide = guide_of(sweep_of(sparse))
    beside = turned(sparse[2], degrees)
    beside[0, 3] += mm
    guide.follow(beside)
    assert guide.next_pose == (2 if near else 0)


def test_the_sweeps_are_shown_in_turn_and_then_none():
    guide = guide_of(sweep_of(FIRST), sweep_of(SECOND, name="tilting in one place", seen=0.6))
    assert guide.title() == "Plan 1: two passes, covers 75 %"
    guide.follow(FIRST[0])
    assert guide.next_sweep() == "Plan 2: tilting in one place, covers 60 %"
    assert guide.next_pose == 0 and guide.guidance().goal == pytest.approx(SECOND[0])
    assert guide.next_sweep() == "Plan hidden"
    guide.follow(FIRST[0])
    assert guide.guidance() is None and guide.figures() == {} and guide.in_words(0.5) == ""
    assert guide.next_sweep() == "Plan 1: two passes, covers 75 %" and len(guide.guidance().path_mm) == 3


def test_a_restart_clears_the_progress():
    guide = guide_of()
    assert guide.figures() == dict(plan_followed=0.0, plan_off_mm=None, plan_off_deg=None)
    assert guide.in_words(None) == "plan      two passes: 0 % completed"
    guide.follow(FIRST[0])
    guide.restart()
    assert guide.next_pose == 0 and guide.figures()["plan_followed"] == 0 and not guide.guidance().done.any()


# Undo, reset and bookmarks


class FollowedPlan:
    """A guide that observes a timeline; the tissue is of no importance."""

    def __init__(self) -> None:
        self.timeline = fake_timeline()
        self.timeline.submit(NewSession(pose=advanced(FIRST[0], -50.0)))
        self.guide = guide_of(sweep_of(FIRST, SECOND), sweep_of(SECOND))

    def do(self, command: Command) -> dict[str, float | None]:
        """The figures after a command."""
        self.timeline.submit(command)
        self.guide.observe(self.timeline.newest())
        return self.guide.figures()

    def act(self, *poses: np.ndarray) -> dict[str, float | None]:
        """The figures after an action."""
        self.do(BeginAction())
        return [self.do(Move(pose=pose)) for pose in poses][-1]


def test_undo_and_redo_restore_the_progress():
    followed = FollowedPlan()
    beside = turned(FIRST[1], 3.0)
    beside[0, 3] += 0.6
    steps = [
        followed.guide.figures(),
        followed.act(FIRST[0]),
        followed.act(beside, FIRST[2]),
        followed.act(FIRST[3], SECOND[0]),
    ]
    assert [each["plan_followed"] for each in steps] == pytest.approx([0, 1 / 7, 3 / 7, 5 / 7])
    assert steps[2]["plan_off_mm"] == pytest.approx(0.2) and steps[2]["plan_off_deg"] == pytest.approx(1.0)
    for before in steps[2::-1]:
        assert followed.do(Undo()) == before
    assert followed.guide.guidance().goal == pytest.approx(FIRST[0])
    for after in steps[1:]:
        assert followed.do(Redo()) == after
    # Another way from there on leaves what is kept of the one before as it was.
    followed.do(Undo())
    assert followed.act(FIRST[3])["plan_off_mm"] == pytest.approx(0.15)
    assert followed.do(Undo()) == steps[2]


def test_reset_and_bookmarks_restore_the_progress():
    followed, beside = FollowedPlan(), FIRST[0].copy()
    nothing = followed.do(Pause())
    beside[0, 3] += 0.6
    marked = followed.act(beside, FIRST[1])
    followed.do(Bookmark())
    bookmark = GoTo(state=followed.timeline.number)
    after = followed.act(FIRST[2])
    assert followed.do(Reset()) == nothing
    assert followed.do(Undo()) == after
    # Gone to twice, with a better way from there in between.
    for _ in range(2):
        assert followed.do(bookmark) == marked
        better = followed.act(FIRST[0], FIRST[2])
        assert better["plan_followed"] == after["plan_followed"]
        assert better["plan_off_mm"] == 0 < marked["plan_off_mm"]
    assert followed.do(Undo()) == marked


def test_another_sweep_has_no_progress_at_states_before_it_was_shown():
    followed = FollowedPlan()
    followed.act(FIRST[0], FIRST[1])
    followed.act(FIRST[2])
    followed.guide.next_sweep()
    assert followed.guide.figures()["plan_followed"] == 0
    assert followed.act(SECOND[0])["plan_followed"] == pytest.approx(1 / 3)
    for _ in range(2):
        assert followed.do(Undo())["plan_followed"] == 0
    # Nor where it is shown and undone in one frame.
    followed.guide.next_sweep()
    assert followed.do(Redo()) == {}


# Its lines


class Drawn:
    """A scene that keeps what it is given."""

    def __init__(self) -> None:
        self.given: list[tuple[np.ndarray, dict]] = []

    def lines(self, points, width, **colours) -> None:
        colours = {
            name: array_of(each) if isinstance(each, Field) else each for name, each in colours.items()
        }
        self.given.append((array_of(points).astype(float), colours))


EDGES = transducer_shape.edges(TransducerHousing(tuple(SIZE)))


def drawn(lines: PlanLines, guidance: Guidance) -> tuple[np.ndarray, np.ndarray, list]:
    """Segments (n, 2, 3) that have a length, their colours (n, 3), and what else was drawn."""
    scene = Drawn()
    lines.draw(scene, guidance, np.array([0.0, -1.0, 0.0]))
    (points, colours), *more = scene.given
    segments, each = points.reshape(-1, 2, 3), colours["per_vertex_color"].reshape(-1, 2, 3)
    long = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1) > 0
    assert np.array_equal(each[:, 0], each[:, 1])
    return segments[long], each[long, 0], more


def test_the_completed_part_of_the_path_has_another_colour(one_device):
    guide, lines = guide_of(), PlanLines(EDGES)
    for pose in [None, *FIRST[:3]]:
        if pose is not None:
            guide.follow(pose)
        guidance = guide.guidance()
        segments, colours, (goal, *arrows) = drawn(lines, guidance)
        assert segments == pytest.approx(guidance.path_mm)
        assert np.array_equal(colours, np.where(guidance.done[:, None], DONE, TO_GO))
        assert goal[0] == pytest.approx(transducer_shape.placed(EDGES, guidance.goal), abs=1e-5)
        # Before the first frame nobody knows where the probe is.
        assert len(arrows) == len(guidance.arrows_mm) == (0 if pose is None else 1)
    for pose in [FIRST[3], *SECOND]:
        guide.follow(pose)
    _, colours, more = drawn(lines, guide.guidance())
    assert (colours == DONE).all() and more == []


def test_two_sweeps_shown_in_turn_have_their_own_lines(one_device):
    """Arrays that are freed leave their identity to others."""
    lines, goal = PlanLines(EDGES), np.eye(4)
    for number in range(20):
        way = np.array([[[number, 0.0, 0.0], [number, 1.0, 0.0]]])
        segments, _, _ = drawn(lines, Guidance(goal, way, np.zeros(1, bool)))
        assert segments == pytest.approx(way)
        del way


def test_every_second_segment_of_a_path_with_too_many_is_drawn(one_device, monkeypatch):
    monkeypatch.setattr(scene_view, "MAX_SEGMENTS", 10)
    way = np.arange(15 * 6, dtype=float).reshape(15, 2, 3)
    done = np.arange(15) < 7
    segments, colours, _ = drawn(PlanLines(EDGES), Guidance(None, way, done))
    assert segments == pytest.approx(way[::2])
    assert np.array_equal(colours, np.where(done[::2, None], DONE, TO_GO))


# Keys


def test_the_keys_of_a_plan():
    keys = DEFAULT_KEYS
    heard = {" ": "plan_for", "Return": "plan", "BackSpace": "next_plan"}
    assert {key: keys.action_of(key) for key in heard} == heard
    controls, targets = Controls(settings_with()), []
    begin("plan", controls)
    assert controls.plan and not controls.next_plan
    begin("next_plan", controls)
    assert controls.next_plan
    order = get_args(Target)
    for _ in order:
        begin("plan_for", controls)
        targets.append(controls.settings.plan.plan_for)
    assert targets == [*order[1:], order[0]] and settings_with().plan.plan_for == order[0]
