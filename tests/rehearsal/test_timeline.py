"""The timeline: undo, redo, bookmarks, marks and settings in any order, and a session's file that repeats
them to the bit.
"""

import tempfile
from pathlib import Path

import numpy as np
import pytest
from fake_organ import STEP_S, fake_timeline, pose_at
from hypothesis import settings, strategies
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
from settings_at_start import settings_with

from rehearsal.loop import timeline as timeline_module
from rehearsal.loop.command import (
    BeginAction,
    Bookmark,
    Checkpoint,
    GoTo,
    Load,
    Mark,
    Move,
    NewSession,
    Redo,
    Reset,
    SetValues,
    Undo,
)
from rehearsal.loop.frame import Applied, Digest, Refused, Step
from rehearsal.loop.state import MOST_UNDONE, History
from rehearsal.loop.timeline import SETTLED, Timeline
from rehearsal.notices import Notices
from rehearsal.sessions.recorder import SessionRecorder
from rehearsal.sessions.replay import Replay, ReplayCheck
from rehearsal.sessions.session_file import Header, read_log
from render.viewer import Controls

# Whole states are recorded this often, so that short sessions have several.
CHECKPOINT_S = 2.0


# Taichi's threads may round numbers that are hardly any to zero.
PLACES = strategies.floats(-5, 5, allow_subnormal=False)
CHANGES = [{"solver.iterations": 2}, {"tissue.young_kpa": 20.0}, {"gravity.acceleration_m_s2": 1.0}]


def header() -> Header:
    return Header(anatomy="a", scene={}, probe={}, arch="cpu", time_step_s=STEP_S)


def state_of(timeline: Timeline) -> tuple:
    """All that undo restores; what the divergence check would restore may be newer."""
    organ = timeline.organ
    arrays = organ.position, organ.velocity, organ.friction, organ.pose
    return tuple(array.tobytes() for array in arrays), timeline.resection


def good_of(timeline: Timeline) -> bytes:
    """What the divergence check would restore."""
    return timeline.organ.divergence.good.body.position.tobytes()


def repeated(path: Path, at_s: float = 0.0) -> tuple[Timeline, ReplayCheck]:
    """A timeline after the replay of a session from the last whole state before a time [s], and its
    comparison.
    """
    log = read_log(path)
    replay, check = Replay(log, one_by_one=True), ReplayCheck(log, Notices())
    stepper = fake_timeline()
    stepper.submit(NewSession(pose=np.eye(4)))
    for command in replay.begin(stepper.newest().positions, at_s):
        stepper.submit(command)
    while not replay.is_over:
        frame = stepper.newest()
        check.observe(frame, None)
        for command in replay.commands(frame, Controls(settings_with()), STEP_S):
            stepper.submit(command)
    frame = stepper.newest()
    replay.check(frame)
    check.observe(frame, None)
    return stepper, check


def test_settings_of_tissue_solver_and_gravity_change_the_organ():
    timeline = fake_timeline()
    for values in CHANGES:
        timeline.submit(SetValues(values=values))
    organ = timeline.organ
    assert (organ.settings.iterations, organ.young_kpa, organ.gravity) == (2, 20.0, 1.0)
    timeline.submit(SetValues(values={"solver.iterations": -1}))
    (refused,) = [event for event in timeline.newest().events if isinstance(event, Refused)]
    assert "solver.iterations = -1" in refused.reason and organ.settings.iterations == 2


class AnySession(RuleBasedStateMachine):
    """Commands in any order, beside a model of what undo and bookmarks restore."""

    def __init__(self) -> None:
        super().__init__()
        self._folder = tempfile.TemporaryDirectory()
        self.path = Path(self._folder.name) / "session"
        self.stepper = fake_timeline()
        self.stepper.submit(NewSession(pose=np.eye(4)))
        self.timeline = self.stepper
        self.recorder = SessionRecorder(self.path, header(), Notices())
        self.settled = state_of(self.timeline)
        self.before: list[tuple] = []
        self.undone: list[tuple] = []
        self.bookmarks: list[tuple[int, tuple]] = []
        self.refused = 0

    def do(self, *commands) -> None:
        for command in commands:
            self.stepper.submit(command)
        frame = self.stepper.newest()
        self.refused += sum(isinstance(event, Refused) for event in frame.events)
        self.recorder.observe(frame)

    @rule(x=PLACES, longer=strategies.sampled_from([None, None, None, 0.05, 0.3]))
    def move(self, x: float, longer: float | None) -> None:
        self.do(Move(pose=pose_at(x), length_s=longer))

    @rule(x=PLACES, count=strategies.integers(5, 12))
    def move_on(self, x: float, count: int) -> None:
        self.do(*(Move(pose=pose_at(x * n / count)) for n in range(count)))

    @rule(values=strategies.sampled_from(CHANGES))
    def set(self, values: dict) -> None:
        self.do(SetValues(values=values))

    def act(self, *commands) -> None:
        before = state_of(self.timeline)
        self.do(*commands)
        self.before, self.undone = [*self.before, before][-MOST_UNDONE:], []

    @rule()
    def begin(self) -> None:
        self.act(BeginAction())

    @precondition(lambda self: len(self.timeline.resection.marks) < 2)
    @rule(x=PLACES)
    def mark(self, x: float) -> None:
        self.act(Mark(places_mm=[(x, 0.0, 0.0)]))

    @rule()
    def reset(self) -> None:
        self.act(Reset())
        assert state_of(self.timeline) == self.settled

    @rule()
    def undo(self) -> None:
        now, refused = state_of(self.timeline), self.refused
        self.do(Undo())
        if self.before:
            assert state_of(self.timeline) == self.before[-1]
            self.undone.append(now)
            self.before.pop()
        else:
            assert self.refused == refused + 1 and state_of(self.timeline) == now

    @rule()
    def redo(self) -> None:
        now, refused = state_of(self.timeline), self.refused
        self.do(Redo())
        if self.undone:
            assert state_of(self.timeline) == self.undone.pop()
            self.before = [*self.before, now][-MOST_UNDONE:]
        else:
            assert self.refused == refused + 1 and state_of(self.timeline) == now

    @rule()
    def bookmark(self) -> None:
        self.do(Bookmark())
        self.bookmarks.append((self.timeline.number, state_of(self.timeline)))

    @precondition(lambda self: self.bookmarks)
    @rule(data=strategies.data())
    def go_to(self, data) -> None:
        number, state = data.draw(strategies.sampled_from(self.bookmarks))
        self.act(GoTo(state=number))
        assert state_of(self.timeline) == state

    @invariant()
    def no_more_is_kept_than_may_be_restored(self) -> None:
        kept = self.timeline.newest().kept if not self.timeline._events else frozenset()
        assert len(kept) <= 1 + len(self.before) + len(self.undone) + len(self.bookmarks)

    def teardown(self) -> None:
        # The last whole state, which a replay may begin with, is also the last good one.
        self.do(Checkpoint())
        self.recorder.close({})
        length_s = read_log(self.path).length_s
        for at_s in (0.0, 0.4 * length_s, 0.8 * length_s, length_s):
            timeline, check = repeated(self.path, at_s)
            assert check.differs_s is None and good_of(timeline) == good_of(self.timeline)
            assert state_of(timeline) == state_of(self.timeline) and timeline.number == self.timeline.number
            assert timeline.time_s == pytest.approx(self.timeline.time_s)
        self._folder.cleanup()


@pytest.fixture(autouse=True)
def often(monkeypatch) -> None:
    monkeypatch.setattr(timeline_module, "CHECKPOINT_S", CHECKPOINT_S)


AnySession.TestCase.settings = settings(
    max_examples=80, stateful_step_count=30, deadline=None, derandomize=True
)
TestAnySession = AnySession.TestCase


def test_forty_actions_can_be_undone_and_no_more():
    history = History()
    for number in range(50):
        history = history.begun(number)
    restored = []
    while (after := history.undo(99))[1] is not None:
        history, number = after
        restored.append(number)
    assert restored == [*range(49, 49 - MOST_UNDONE, -1)] and len(history.undone) == MOST_UNDONE


def test_what_is_refused_changes_nothing_and_says_why():
    timeline = fake_timeline()
    before = state_of(timeline)
    for command, why in (
        (Undo(), "Nothing to undo"),
        (Redo(), "Nothing to redo"),
        (GoTo(state=3), "no such"),
    ):
        timeline.submit(command)
        (event,) = timeline.newest().events
        assert isinstance(event, Refused) and why in event.reason and event.command == command
    assert state_of(timeline) == before and timeline.number == 0


def test_iterations_are_recorded_as_they_were_and_not_as_they_are_set():
    timeline = fake_timeline()
    for iterations in (None, 2, 2, None):
        timeline.step(pose_at(1.0), iterations=iterations)
    values = [event.command.values for event in timeline.newest().events if isinstance(event, Applied)]
    assert values == [{"solver.iterations": 2}, {"solver.iterations": 4}]


def test_each_second_has_a_digest_and_each_way_back():
    timeline = fake_timeline()
    timeline.submit(BeginAction())
    for _ in range(20):
        timeline.submit(Move(pose=pose_at(1.0)))
    timeline.submit(Undo())
    frame = timeline.newest()
    assert [event.number for event in frame.events if isinstance(event, Digest)] == [8, 16, 21]
    assert [step.number for step in frame.steps] == [*range(20)] and frame.restored == [0]
    assert isinstance(frame.events[1], Step) and frame.kept == {SETTLED, 20}


def test_a_state_of_another_body_is_refused():
    timeline = fake_timeline()
    other = timeline.whole_state()
    other.organ.solver.internal_state["plane"] = np.zeros((3, 4), np.float32)
    timeline.submit(Load(state=other, number=7))
    assert timeline.newest().notices == ["a state of another body, or a damaged one"] and timeline.number == 0
