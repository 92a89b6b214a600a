"""Sources of commands: the user's hand, settings and keys; a replay that the user takes over."""

from typing import Any

import numpy as np
import pytest
from fake_organ import STEP_S
from recorded_session import record_all
from settings_at_start import settings_with
from user_at_ball import UserAtBall, ray

from rehearsal.loop.command import BeginAction, GoTo, NewSession
from rehearsal.loop.frame import Applied
from rehearsal.notices import Notices
from rehearsal.sessions.replay import Replay
from rehearsal.sessions.session_file import read_log
from rehearsal.sources.scripted import ReplaySource, ScriptedPress
from rehearsal.sources.user import LONGEST_S, PAUSE_S, ActionTimes
from render.viewer import Controls
from ultrasound.probe_manipulator import advanced

STIFFER = settings_with({"tissue.young_kpa": 30.0})


def test_actions_begin_after_a_pause_with_a_press_and_after_five_seconds():
    times = ActionTimes()
    acts = [(0.0, True, False), (0.4, True, False), (0.8, True, True), (1.0, True, True), (1.2, False, False)]
    assert [times.begins(*act) for act in acts] == [True, False, True, False, False]
    assert not times.begins(1.0 + PAUSE_S, True, False) and times.begins(1.1 + 2 * PAUSE_S, True, False)
    now_s = began_s = 2.2 + PAUSE_S
    assert times.begins(now_s, True, False)
    while not times.begins(now_s := now_s + 0.4, True, False):
        pass
    assert now_s - began_s == pytest.approx(LONGEST_S + 0.2, abs=0.21)
    times.end()
    assert times.begins(now_s + 0.1, True, False)


def pressed_then_undone(at: Any) -> UserAtBall:
    """The mouse went to x = 5 mm, pressed there, and the press was undone."""
    user = UserAtBall()
    for _ in range(8):
        user.step(ray=ray(5.0))
    for _ in range(5):
        user.step(ray=ray(5.0), press=True)
    user.step(ray=at, undo=True)
    assert user.kinds == ["undo"] and user.frame.restored
    return user


DID = [
    dict(ray=ray(2.0)),
    dict(press=True),
    *({name: 0.5} for name in ("push_mm", "tilt_deg", "rock_deg", "rotate_deg")),
    dict(slide_mm=(0.0, 0.5)),
]


@pytest.mark.parametrize("did", DID, ids=lambda did: next(iter(did)))
def test_after_an_undo_the_transducer_stays_until_the_user_acts(did):
    user = pressed_then_undone(ray(3.0))
    undone = user.frame.pose
    for _ in range(10):
        assert np.array_equal(user.step(ray=ray(3.0)), undone)
    assert not np.array_equal(user.step(**{"ray": ray(3.0)} | did), undone)
    user.step(ray=ray(-4.0))
    assert not np.array_equal(user.step(ray=ray(-4.0)), undone)


def test_a_mouse_that_comes_back_into_the_view_is_no_act():
    user = pressed_then_undone(None)
    undone = user.frame.pose
    user.step()
    assert np.array_equal(user.step(ray=ray(3.0)), undone)
    assert np.array_equal(user.step(), undone)
    assert not np.array_equal(user.step(ray=ray(3.5)), undone)


def test_an_undo_gives_the_manipulator_as_it_was_before_the_input():
    user = UserAtBall()
    for _ in range(8):
        user.step(ray=ray(5.0))
    before, pose = user.manipulator.state, user.frame.pose
    user.step(ray=ray(-5.0), tilt_deg=7.0, push_mm=0.5, press=True)
    assert user.manipulator.state.turn_deg == (7.0, 0.0, 0.0)
    user.step(undo=True)
    user.step()
    state = user.manipulator.state
    assert (state.depth_mm, state.pressed_mm, state.turn_deg) == (0.0, 0.0, (0.0, 0.0, 0.0))
    assert np.array_equal(state.aim, before.aim) and np.array_equal(user.frame.pose, pose)


def test_no_pose_is_given_until_an_undo_was_applied():
    user = UserAtBall()
    for x_mm in (1.0, 3.0, 5.0):
        user.step(ray=ray(x_mm))
    controls = Controls(settings_with(), ray=ray(-5.0))
    undo = Controls(settings_with(), undo=True)
    late = user.frame
    (command,) = user.source.commands(late, undo, STEP_S)
    # The solver's process has not seen it yet.
    assert [list(user.source.commands(late, each, STEP_S)) for each in (controls, undo, controls)] == [
        [],
        [],
        [],
    ]
    user.stepper.submit(command)
    user.frame = user.stepper.newest()
    user.step(ray=ray(-5.0))
    assert user.kinds == ["follow"] and np.array_equal(user.commands[0].pose, user.manipulator.home)


def test_only_settings_that_change_are_given_all_at_first():
    user, changed = UserAtBall(), []
    for young_kpa, gain in ((15.0, 50.0), (15.0, 50.0), (30.0, 50.0), (30.0, 70.0)):
        user.step(settings_with({"tissue.young_kpa": young_kpa, "probe.gain_percent": gain}))
        changed.append(user.set)
    assert len(changed[0]) > 30
    assert changed[1:] == [{}, {"tissue.young_kpa": 30.0}, {"probe.gain_percent": 70.0}]
    assert user.timeline.organ.young_kpa == 30.0


def test_bookmarks_are_gone_to_last_first_then_round():
    user, states = UserAtBall(), []
    for x_mm in (1.0, 2.0, 3.0):
        for _ in range(6):
            user.step(ray=ray(x_mm))
        user.step(bookmark=True)
        states.append(user.frame.number)
    user.step(ray=ray(-3.0))
    gone_to = []
    for _ in range(4):
        user.step(to_bookmark=True)
        gone_to += [command.state for command in user.commands if isinstance(command, GoTo)]
        user.step()
    assert gone_to == [states[n] for n in (2, 1, 0, 2)]
    # Who moves on begins with the last one again.
    for n in range(6):
        user.step(ray=ray(4.0 + 0.1 * n))
    user.step(to_bookmark=True)
    assert user.commands[-1] == GoTo(state=states[2])


def test_without_a_bookmark_there_is_none_to_go_to():
    user = UserAtBall()
    user.step(to_bookmark=True)
    assert user.said() == "No bookmark: {bookmark} sets one" and user.kinds[-1] == "follow"


def test_frozen_nothing_moves_and_settings_wait():
    user = UserAtBall()
    pose = user.step(ray=ray(2.0))
    user.step(STIFFER, ray=ray(5.0), frozen=True)
    assert user.kinds == ["pause"] and np.array_equal(user.frame.pose, pose)
    user.step(STIFFER)
    assert user.set == {"tissue.young_kpa": 30.0}


def test_an_action_begins_before_the_pose_that_it_moves_to():
    user = UserAtBall()
    user.step()
    user.step(ray=ray(5.0))
    assert user.kinds[-2:] == ["begin", "follow"]
    assert [event.number for event in user.frame.events if isinstance(event, Applied)] == [1]
    assert isinstance(user.commands[-2], BeginAction)


def test_after_a_slide_the_mouse_moves_the_probe_only_once_it_moves_itself():
    user = UserAtBall()

    def aimed_at() -> np.ndarray:
        return (user.manipulator.aim @ [0, 0, -3.0, 1])[:3]

    for _ in range(4):
        user.step(ray=ray(2.0))
    for _ in range(10):
        user.step(ray=ray(2.0), slide_mm=(-0.5, 0.2))
    # On the ball of 12 mm 5.4 mm of path, of which some is height.
    slid = aimed_at()
    assert slid[0] == pytest.approx(-3.0, abs=0.4) and slid[1] == pytest.approx(2.0, abs=0.3)
    user.step(ray=ray(2.0))
    assert np.array_equal(aimed_at(), slid)
    user.step(ray=ray(2.5))
    assert aimed_at()[:2] == pytest.approx([2.5, 0.0], abs=1e-6)


def test_a_press_by_a_share_goes_no_deeper():
    user = UserAtBall()
    for _ in range(30):
        user.step(press=True, press_share=0.5)
    assert user.manipulator.state.pressed_mm == pytest.approx(user.manipulator.max_mm / 2)


def test_a_replay_is_taken_over_in_a_new_session(tmp_path):
    record_all(tmp_path / "session")
    for taken_over in (True, False):
        user, notices = UserAtBall(), Notices()
        replay = Replay(read_log(tmp_path / "session"))
        source = ReplaySource(replay, lambda: user.source, notices)
        frame, given = user.frame, []
        for count in range(200):
            controls = Controls(settings_with(), take_over=taken_over and count == 20)
            given = list(source.commands(frame, controls, STEP_S))
            for command in given:
                user.stepper.submit(command)
            frame = user.stepper.newest()
            if source.user is not None:
                break
        assert isinstance(given[0], NewSession) and given[-1].kind == "follow"
        assert frame.begins is not None and frame.number == 1 and replay.is_over != taken_over
        said = "Mouse and keys control the probe"
        assert notices.present() == [said if taken_over else f"The replay has ended. {said}"]
        assert list(source.commands(frame, Controls(settings_with()), STEP_S))[-1].kind == "follow"


def test_a_scripted_press_makes_a_move_for_each_of_its_steps():
    user = UserAtBall()
    home = user.manipulator.home
    press = ScriptedPress(lambda share, pose: advanced(home, 4.0 * share), 4)
    for _ in range(4):
        for command in press.commands(user.frame, Controls(settings_with()), STEP_S):
            user.stepper.submit(command)
    frame = user.stepper.newest()
    assert len(frame.steps) == 4 and np.allclose(frame.pose, advanced(home, 4.0))


def test_the_depth_of_a_key_goes_back_when_the_mouse_moves_on():
    user = UserAtBall()
    touching = user.step(ray=ray(0.0))[2, 3]
    for _ in range(6):
        user.step(ray=ray(0.0), push_mm=0.5)
    pushed = user.step(ray=ray(0.0))
    assert pushed[2, 3] == pytest.approx(touching - 3.0, abs=1e-6)
    assert user.commands[-1].presses
    # A tremor of the hand is no move.
    for _ in range(4):
        user.step(ray=ray(0.5))
    assert user.manipulator.state.depth_mm == 3.0
    for _ in range(4):
        user.step(ray=ray(-5.0))
    assert user.manipulator.state.depth_mm == 0.0 and not user.commands[-1].presses


def test_a_mouse_that_only_points_asks_to_touch_and_a_button_or_a_tracker_to_press():
    user = UserAtBall()
    user.step(ray=ray(4.0))
    assert not user.commands[-1].presses
    user.step(ray=ray(4.0), press=True)
    assert user.commands[-1].presses
    tracked = UserAtBall(tracked=lambda time_s: np.eye(4))
    tracked.step()
    assert tracked.commands[-1].presses
