"""The solver in a process of its own: the same bits, states of one instant, pace with the clock."""

import os
import signal
import sys
import time
from collections.abc import Iterator

import numpy as np
import pytest
import trimesh
from conftest import rotation_about
from fake_organ import fake_timeline

from rehearsal.case import case_of
from rehearsal.loop.command import Bookmark, Follow, GoTo, Move, NewSession, Pause, SetValues
from rehearsal.loop.frame import Frame, Step
from rehearsal.pressed_organ import PressedOrgan
from rehearsal.real_time.frame_times import FrameTimes
from rehearsal.real_time.pace import BUSY, LEAST_ITERATIONS, SPARE, STEPS_DOWN, STEPS_UP, Pace
from rehearsal.real_time.pose_path import CATCH_UP, LONGEST_S, PosePath
from rehearsal.real_time.shared_tissue import SLOTS, SharedTissue
from rehearsal.real_time.solver_loop import Sent, SolverLoop, SolverSetup
from rehearsal.real_time.solver_process import SolverEnded, SolverProcess
from rehearsal.real_time.started_process import start_process
from rehearsal.rehearsal import Rehearsal
from rehearsal.window_loop import MOST_WAIT_S
from scenes.anatomy import LoadedAnatomy
from scenes.scene import AnatomyFiles, Attachment, Scene, with_options
from scenes.tissue import NeoHookeanTissue
from sim import stored_arrays
from sim.solver import StepSettings
from ultrasound.probe_manipulator import advanced

# A process that makes a step of a small body in less than a millisecond; the machine may be busy.
LONGEST_WAIT_S = 30.0
RATE = 200.0


def small_rehearsal(floor_mm: float | None = None, **changes: float) -> Rehearsal:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=15.0)
    scene = Scene(
        anatomy=AnatomyFiles(),
        attachment=Attachment(at_mm=(0.0, 0.0, -15.0), radius_mm=8.0),
        press={"warm_up_steps": 3},
    )
    scene = with_options(scene, {"tissue.cell_mm": 6.0} | changes)
    floor = () if floor_mm is None else (trimesh.creation.box([60.0, 60.0, 10.0]),)
    for each in floor:
        each.apply_translation([0.0, 0.0, floor_mm - 20.0])
    loaded = LoadedAnatomy(ball, None, None, floor)
    return Rehearsal(case_of(scene, loaded), loaded)


@pytest.fixture(scope="module")
def reference(one_device) -> Rehearsal:
    """The same organ, computed in this process."""
    return small_rehearsal()


@pytest.fixture(scope="module")
def started(reference) -> Iterator[SolverProcess]:
    solver = SolverProcess(start_process())
    solver.build(SolverSetup(reference.case, "cpu", Pace(1 / RATE)))
    assert solver.model().counts == reference.organ.model.counts()
    solver.begin()
    solver.submit(NewSession(pose=reference.manipulator.pose()))
    solver.submit(Bookmark())
    yield solver
    solver.close()


@pytest.fixture
def solver(started, reference) -> SolverProcess:
    """The process, paused and at rest, as the reference is."""
    started.submit(Pause())
    started.submit(GoTo(state=0))
    started.submit(SetValues(values={"tissue.young_kpa": 15.0}))
    started.wait()
    assert started.newest().pose.tobytes() == reference.manipulator.pose().tobytes()
    reference.reset()
    return started


def follow(pose: np.ndarray, took_s: float = 0.01) -> Follow:
    return Follow(pose=pose, input_s=time.perf_counter(), took_s=took_s)


def pressing(solver: SolverProcess, home: np.ndarray, steps: int) -> list[Frame]:
    """The frames in which the probe is pressed in and turned, until so many steps."""
    frames: list[Frame] = []
    end_s = time.monotonic() + LONGEST_WAIT_S
    while sum(len(frame.steps) for frame in frames) < steps and time.monotonic() < end_s:
        frames.append(solver.newest())
        solver.submit(follow(advanced(home, 4.0 * np.sin(len(frames) / 9) ** 2)))
        time.sleep(0.007)
    return frames


def test_each_frame_is_of_one_instant_and_has_the_bits_of_the_same_steps_here(solver, reference):
    home, compared = reference.manipulator.pose(), 0
    for frame in pressing(solver, home, 300):
        for step in frame.steps:
            reference.timeline.step(step.pose, step.length_s, step.iterations)
        here = reference.do()
        assert here.positions.tobytes() == frame.positions.tobytes()
        assert np.array_equal(here.pose, frame.pose)
        compared += len(frame.steps)
    assert compared >= 300


def test_arrays_in_shared_memory_are_read_whole_or_not_at_all():
    like = [np.zeros((7, 3), np.float32), np.zeros((2, 4, 4), np.float32)]
    reader = SharedTissue(like)
    writer = SharedTissue(like, reader.name)
    for number in range(1, 8):
        writer.write([np.full_like(array, number) for array in like], number)
        for earlier in range(max(1, number - SLOTS + 1), number + 1):
            assert all((array == earlier).all() for array in reader.read(earlier))
        if number > SLOTS:
            assert reader.read(number - SLOTS) is None
    # The writer is killed while it writes: the arrays before are still there, and nobody waits.
    writer._begun[0] = 8
    writer._slots[8 % SLOTS][0][:] = -1.0
    assert (reader.read(7)[0] == 7).all() and reader.read(5) is None
    writer.close()
    reader.close()


def test_steps_keep_pace_with_the_clock(solver, reference):
    solver.submit(follow(reference.manipulator.pose()))
    began = time.perf_counter()
    time.sleep(0.5)
    solver.submit(Pause())
    solver.wait()
    passed = time.perf_counter() - began
    steps = solver.newest().steps
    # No faster than the clock; how much slower depends on the machine.
    assert 0 < sum(step.length_s for step in steps) <= passed + steps[-1].length_s
    assert all(step.late_ms >= 0 for step in steps)


def test_paused_it_makes_no_steps_and_moves_are_made_one_by_one(solver, reference):
    pressing(solver, reference.manipulator.pose(), 30)
    solver.submit(Pause())
    solver.wait()
    number = solver.newest().number
    time.sleep(0.05)
    assert solver.newest().number == number
    # An undo: back to the start, with other settings.
    solver.submit(GoTo(state=0))
    poses = [advanced(reference.manipulator.pose(), depth) for depth in np.linspace(0.1, 2.0, 8)]
    lengths = np.linspace(1 / 200, 1 / 20, 8).tolist()
    moves = [Move(pose=pose, length_s=length) for pose, length in zip(poses, lengths, strict=True)]
    softer = SetValues(values={"tissue.young_kpa": 30.0})
    for command in (softer, *moves):
        solver.submit(command)
    solver.wait()
    frame, here = solver.newest(), reference.do(softer, *moves)
    reference.do(SetValues(values={"tissue.young_kpa": 15.0}))
    assert len(frame.steps) == 8 and frame.positions.tobytes() == here.positions.tobytes()
    assert frame.wrench == pytest.approx(here.wrench)


def test_the_state_at_rest_is_stored_by_all_that_it_depends_on(one_device, monkeypatch, tmp_path):
    monkeypatch.setattr(stored_arrays, "FOLDER", tmp_path)
    steps: list[int] = []
    advance = PressedOrgan.advance
    monkeypatch.setattr(PressedOrgan, "advance", lambda organ, pose: steps.append(1) or advance(organ, pose))

    def rested(**given: float) -> tuple[int, Rehearsal]:
        steps.clear()
        rehearsal = small_rehearsal(**given)
        return len(steps), rehearsal

    def pressed(rehearsal: Rehearsal) -> tuple[str, str]:
        at_rest = rehearsal.organ.digest()
        for depth_mm in (1.0, 2.0, 3.0):
            rehearsal.advance(rehearsal.pose_at_depth(depth_mm))
        return at_rest, rehearsal.organ.digest()

    (made, first), (again, second) = rested(), rested()
    assert (made, again) == (3, 0) and pressed(first) == pressed(second)
    # The others do not move: each would compile a step of its own.
    monkeypatch.setattr(PressedOrgan, "advance", lambda organ, pose: steps.append(1))
    others = (
        dict(floor_mm=0.0),
        dict(floor_mm=0.5),
        {"tissue.young_kpa": 9.0},
        {"gravity.acceleration_m_s2": 5.0},
    )
    for other in others:
        assert rested(**other)[0] == 3
    assert rested(**others[-1])[0] == 0
    monkeypatch.setitem(NeoHookeanTissue.step_defaults, "iterations", 7)
    assert rested()[0] == 3


def test_a_process_that_ends_is_an_error_in_words():
    solver = SolverProcess(start_process())
    solver._started.process.kill()
    with pytest.raises(SolverEnded, match=r"the solver's process has ended \(exit status -9\)"):
        solver.model()
    solver.close()


@pytest.mark.skipif(sys.platform == "win32", reason="no signals to single processes")
@pytest.mark.parametrize("after_s", [0.0, 0.2])
def test_ctrl_c_does_not_reach_the_process_while_it_loads(capfd, after_s):
    before = signal.getsignal(signal.SIGINT)
    started = start_process()
    time.sleep(after_s)
    os.kill(started.process.pid, signal.SIGINT)
    time.sleep(0.3)
    assert started.process.is_alive() and signal.getsignal(signal.SIGINT) is before
    started.kill()
    assert capfd.readouterr().err == ""


# The time of each step, by a clock that only waiting and steps advance


class ClockedLoop(SolverLoop):
    """A loop without tissue, whose steps take 10 ms; inputs come at given times, each 1 mm further."""

    def __init__(
        self, monkeypatch, level: int, inputs_s: list[float], end_s: float, hangs_s: float = 0.0
    ) -> None:
        self.now_s, self.begun, self.hangs_s = 0.0, [], hangs_s
        monkeypatch.setattr("rehearsal.real_time.solver_loop.perf_counter", lambda: self.now_s)
        pace = Pace(1 / 60)
        pace.level, pace.note = level, lambda *_: None
        super().__init__(self, self, pace, None)
        poses = [np.eye(4) + np.eye(4, k=3) * number for number in range(1, len(inputs_s) + 1)]
        self.inputs = [Follow(pose=pose, input_s=at_s) for pose, at_s in zip(poses, inputs_s, strict=True)]
        self.times_s = [*inputs_s, end_s, np.inf]
        self.organ, self.settings = self, StepSettings(time_step_s=1 / 60, substeps=1, iterations=4)
        self.pose = np.eye(4)
        self._runs = True
        self._path.stay(self.pose, 0.0)
        self.serve()

    def poll(self, wait_s: float) -> bool:
        """Whether an input comes within a time."""
        self.now_s = min(self.now_s + wait_s, max(self.times_s[0], self.now_s))
        return self.now_s >= self.times_s[0]

    def recv(self) -> Follow | None:
        self.times_s.pop(0)
        return self.inputs.pop(0) if self.inputs else None

    def step(self, pose: np.ndarray, length_s: float, iterations: int, *clock) -> Step:
        self.begun.append((self.now_s, round(60 * length_s), pose[0, 3]))
        self.now_s += 0.01 + self.hangs_s
        self.hangs_s = 0.0
        return Step(0, pose, pose, length_s, iterations, 10.0)

    def aim(self, command: Follow) -> None: ...
    def newest(self) -> Frame:
        return fake_timeline().newest()

    def _send(self, frame: None) -> None: ...


def test_a_long_step_is_made_as_soon_as_the_input_comes_and_shows_it(monkeypatch):
    inputs_s = [0.055, 0.11, 0.165, 0.22]
    loop = ClockedLoop(monkeypatch, 1, inputs_s, end_s=0.23)
    assert [at_s for at_s, _, _ in loop.begun] == pytest.approx(inputs_s)
    assert [place for _, _, place in loop.begun] == [1.0, 2.0, 3.0, 4.0]
    # 3.3 sixtieths are due each time; what remains is made up for.
    assert [sixtieths for _, sixtieths, _ in loop.begun] == [3, 3, 3, 4]


def test_of_two_long_steps_for_one_input_the_last_shows_it(monkeypatch):
    loop = ClockedLoop(monkeypatch, 1, [0.09], end_s=0.13)
    assert [step[1:] for step in loop.begun] == [(2, pytest.approx(0.4)), (3, 1.0)]
    assert [step[0] for step in loop.begun] == pytest.approx([0.09, 0.1])


def test_long_steps_do_not_wait_longer_than_a_tenth_of_a_second(monkeypatch):
    loop = ClockedLoop(monkeypatch, 1, [], end_s=0.45)
    simulated = np.cumsum([sixtieths / 60 for _, sixtieths, _ in loop.begun])
    assert np.all(np.array([at_s for at_s, _, _ in loop.begun]) - simulated < 0.1)
    assert simulated[-1] == pytest.approx(0.4)


def test_short_steps_are_made_by_the_clock(monkeypatch):
    loop = ClockedLoop(monkeypatch, 0, [0.05], end_s=0.1)
    assert [at_s for at_s, _, _ in loop.begun] == pytest.approx([n / 60 for n in range(1, 7)])
    moved = CATCH_UP / 60 / 0.05
    assert [place for _, _, place in loop.begun] == pytest.approx([0.0, 0.0, moved, 2 * moved, 1.0, 1.0])


def test_of_a_step_that_hangs_a_tenth_of_a_second_is_made_up_for(monkeypatch):
    loop = ClockedLoop(monkeypatch, 0, [], end_s=2.0, hangs_s=1.0)
    # A tenth of a second and a step are seven sixtieths, one after the other; then steps of 10 ms are made by
    # the clock again.
    made_up = [at_s for at_s, _, _ in loop.begun if 1.0 < at_s < 1.0 + 1 / 60 + 0.0701]
    assert np.diff(made_up) == pytest.approx([0.01] * (len(made_up) - 1)) and len(made_up) == 7
    simulated_s = sum(sixtieths for _, sixtieths, _ in loop.begun) / 60
    assert simulated_s == pytest.approx(2.0 - (1.0 - 0.1), abs=0.03)


class ScriptedPipe:
    """Gives steps at given times, by a clock that only waiting advances."""

    def __init__(self, monkeypatch, steps: list[tuple[float, Step]]) -> None:
        self.now_s, self.steps, self.sent = 0.0, steps, []
        monkeypatch.setattr("rehearsal.real_time.solver_process.perf_counter", lambda: self.now_s)

    def poll(self, wait_s: float = 0.0) -> bool:
        comes_s = self.steps[0][0] if self.steps else np.inf
        self.now_s = max(self.now_s, min(self.now_s + wait_s, comes_s))
        return self.now_s >= comes_s

    def recv(self) -> Sent:
        return Sent(0, {}, (self.steps.pop(0)[1],), 0)

    def send(self, command: Follow) -> None:
        self.sent.append(command)

    def close(self) -> None: ...


def collected_at(monkeypatch, steps: list[tuple[float, float, bool]], inputs_s: list[float]) -> list[float]:
    """When the frame of each input was there; steps are (made at, of the input at, awaited) [s]."""
    made = [
        (at_s, Step(0, np.eye(4), np.eye(4), 1 / 15, 4, 10.0, input_s=of_s, awaited=awaited))
        for at_s, of_s, awaited in steps
    ]
    solver = SolverProcess(start_process())
    solver._started.process.kill()
    solver._connection.close()
    solver._connection = pipe = ScriptedPipe(monkeypatch, made)
    solver._frame = lambda: None
    times = []
    for input_s in inputs_s:
        pipe.now_s = max(pipe.now_s, input_s)
        solver.submit(Follow(pose=np.eye(4), input_s=input_s, took_s=0.06))
        solver.newest(MOST_WAIT_S)
        times.append(pipe.now_s)
    solver.close()
    return times


def test_a_picture_waits_for_the_step_of_its_input_where_steps_wait_for_inputs(monkeypatch):
    # The first input knows of no step that waited; the third is on its way when the second step for the input
    # before comes.
    steps = [(0.1, 0.1, True), (0.215, 0.2, True), (0.305, 0.2, True), (0.32, 0.3, True)]
    assert collected_at(monkeypatch, steps, [0.1, 0.2, 0.3]) == pytest.approx([0.1, 0.215, 0.32])


def test_a_picture_does_not_wait_for_steps_by_the_clock_nor_long_for_any(monkeypatch):
    assert collected_at(monkeypatch, [(0.1, 0.1, False), (0.21, 0.2, False)], [0.1, 0.2]) == [0.1, 0.2]
    late = collected_at(monkeypatch, [(0.1, 0.1, True), (0.6, 0.2, True)], [0.1, 0.2])
    assert late == pytest.approx([0.1, 0.3])


# The path of the transducer


def test_the_transducer_moves_as_fast_as_its_input():
    start, goal = np.eye(4), np.eye(4)
    goal[:3, 3] = [6.0, 0.0, 0.0]
    goal[:3, :3] = rotation_about([0, 0, 1], 30.0)
    path = PosePath(start, 1.0)
    path.go_to(goal, 1.06, 0.06)
    places = [path.pose_after(0.01) for _ in range(8)]
    assert [pose[0, 3] for pose in places] == pytest.approx([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 6.0, 6.0])
    assert places[2][:3, :3] == pytest.approx(rotation_about([0, 0, 1], 15.0))
    assert path.input_s == 1.06 and np.array_equal(places[-1], goal)


def test_behind_its_input_it_catches_up_at_a_limited_rate():
    path, goal = PosePath(np.eye(4), 1.0), np.eye(4)
    goal[0, 3] = 10.0
    # Inputs every 10 ms, and a step of only 1 ms: it is 109 ms behind the last one.
    for number in range(1, 12):
        path.go_to(goal * [[number / 10], [1], [1], [1]], 1.0 + number / 100, 0.01)
    behind = 1.11 - path.input_s
    path.pose_after(behind / CATCH_UP / 2)
    assert path.input_s == pytest.approx(1.0 + 0.11 / 2)
    path.stay(goal, 5.0)
    path.go_to(np.eye(4), 50.0, 0.0)
    assert np.array_equal(path.pose_after(0.5 * LONGEST_S / CATCH_UP)[:3, 3], [5.0, 0.0, 0.0])


# The pace


def watched(pace: Pace, took_ms: float, steps: int) -> tuple[float, int]:
    for _ in range(steps):
        pace.note(took_ms, pace.length_s)
    return pace.length_s, pace.iterations(8)


def test_slow_steps_get_longer_then_have_fewer_iterations_and_return():
    pace = Pace(1 / 60)
    step_ms = 1000 / 60
    assert watched(pace, 0.9 * BUSY * step_ms, STEPS_UP) == (1 / 60, 8) and pace.text(8) == ""
    assert watched(pace, 1.1 * BUSY * step_ms, STEPS_DOWN) == (2 / 60, 8)
    assert pace.waits_for_input and pace.text(8) == "Longer steps 1/15 s"
    # Twice as long, they take half of the time that they simulate: more than is spare for short ones.
    assert watched(pace, 1.1 * BUSY * step_ms, 2 * STEPS_UP) == (2 / 60, 8)
    assert watched(pace, 100.0, 2 * STEPS_DOWN) == (4 / 60, 8)
    assert [watched(pace, 100.0, STEPS_DOWN)[1] for _ in range(4)] == [6, 4, 2, 2]
    assert pace.text(8) == "Longer steps 1/15 s   Reduced iterations 2 of 8"
    assert watched(pace, 0.9 * SPARE * step_ms / 4, 6 * STEPS_UP) == (1 / 60, 8)
    assert Pace(1 / 60).iterations(1) == 1
    pace.level = len(pace.levels) - 1
    assert pace.iterations(3) == LEAST_ITERATIONS


def test_single_long_steps_change_nothing():
    pace = Pace(1 / 60)
    for number in range(2 * STEPS_UP):
        pace.note(100.0 if number % 3 == 0 else 5.0, 1 / 60)
    assert pace.level == 0


# Times longer than a sixtieth of a second, and shares of the iterations, of each level.
LEVELS = [(1, 1.0), (2, 1.0), (3, 1.0), (4, 1.0), (4, 0.75), (4, 0.5), (4, 0.25)]


@pytest.mark.parametrize("load", [0.4, 0.6, 0.69, 0.95, 1.2, 1.45, 1.9, 2.3, 2.6, 2.75, 3.6, 4.2, 7.0, 20.0])
def test_a_machine_of_one_speed_goes_to_one_level_and_stays(load):
    """A step takes as long as its iterations; of five, one is half as long again, and one takes hardly any
    time.
    """
    pace, levels = Pace(1 / 60), [0]
    for number in range(12 * STEPS_UP):
        unsteady = (1.0, 1.0, 1.5, 0.1, 1.0)[number % 5]
        pace.note(unsteady * load * pace.iterations(8) / 8 * 1000 / 60, pace.length_s)
        levels.append(pace.level)
    # The first at which a step takes at most half of the time that it simulates, else the last.
    enough = [n for n, (longer, share) in enumerate(LEVELS) if load * share <= 0.5 * longer]
    assert np.unique(levels).tolist() == list(range(min(enough, default=6) + 1))
    assert (np.diff(levels) >= 0).all()


def test_steps_are_at_most_a_fifteenth_of_a_second_unless_the_scenes_are_longer():
    assert max(level.times_longer for level in Pace(1 / 60).levels) == 4
    assert max(level.times_longer for level in Pace(1 / 1000).levels) == 64
    assert {level.times_longer for level in Pace(1 / 10).levels} == {1}


def test_long_steps_wait_for_the_input_and_simulate_what_is_due_then():
    pace = Pace(1 / 60)
    assert not pace.waits_for_input and pace.lengths_s(0.1) == [1 / 60]
    pace.level = 1
    assert pace.waits_for_input and pace.length_s == 2 / 60
    for units, lengths in {2: [2], 3: [3], 4: [4], 5: [2, 3], 6: [3, 3], 9: [3, 3, 3], 11: [3, 4, 4]}.items():
        for due_s in (units / 60, (units + 0.9) / 60):
            assert pace.lengths_s(due_s) == [1 / 60 * times for times in lengths]
    # A haptic device's steps do not wait, unless they are as long.
    pace = Pace(1 / 1000)
    pace.level = 7
    assert pace.length_s == 0.016 and not pace.waits_for_input
    # Nor do those that are set so long, until the machine needs longer ones or fewer iterations.
    pace = Pace(1 / 30)
    assert not pace.waits_for_input and pace.lengths_s(0.1) == [1 / 30] and pace.text(8) == ""
    pace.level = 1
    assert pace.waits_for_input and pace.text(8) == "Longer steps 1/15 s"
    pace = Pace(1 / 10)
    pace.level = 1
    assert pace.lengths_s(0.25) == [0.1, 0.1] and pace.text(8) == "Reduced iterations 6 of 8"


def test_a_budget_limits_the_time_of_a_step():
    pace = Pace(1 / 60, budget_ms=2.0)
    assert watched(pace, 1.9, STEPS_UP) == (1 / 60, 8)
    assert watched(pace, 2.1, 10 * STEPS_DOWN) == (4 / 60, 2)


# The figures of the frames


def test_rates_are_those_of_the_recent_frames(monkeypatch):
    clock = [100.0]
    monkeypatch.setattr("rehearsal.real_time.frame_times.perf_counter", lambda: clock[0])
    times = FrameTimes()
    assert times.rates() == (0.0, 1.0)
    # Ten frames a second at half the pace, then twenty in real time.
    for number in range(11):
        clock[0] = 100.0 + number / 10
        times.end_frame(simulated_s=number / 20, input_s=clock[0] - 0.05)
    for number in range(1, 21):
        clock[0] = 101.0 + number / 20
        times.end_frame(simulated_s=0.5 + number / 20, input_s=None)
    assert times.rates(0.999) == pytest.approx((20.0, 1.0))
    assert times.rates() == pytest.approx((15.0, 0.75))
    assert list(times.latency_ms) == pytest.approx([50.0] * 11)
    times.restart()
    assert times.rates() == (0.0, 1.0)
    with times.stage("image"):
        clock[0] += 0.025
    assert times.stages_ms["image"][-1] == pytest.approx(25.0)
