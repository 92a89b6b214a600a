"""Undo, bookmarks, freeze, sweeps, a plan and the link in a window whose solver keeps pace with the clock,
at each of its paces.
"""

from collections.abc import Iterator
from pathlib import Path
from time import perf_counter, sleep
from types import SimpleNamespace

import numpy as np
import pytest
from coarse_patient import coarse_patient
from null_viewer import NullViewer
from plan_ball import plan_of, sweep_of
from settings_at_start import settings_with

from rehearsal import run
from rehearsal.commands.rehearse_options import RehearseOptions
from rehearsal.input_files import InputFiles
from rehearsal.live_settings import DEFAULT_KEYS, LiveSettings, initial_settings
from rehearsal.loop.command import Move
from rehearsal.measurements.live_measurements import LiveMeasurements
from rehearsal.notices import Notices
from rehearsal.opening import compile_picture
from rehearsal.planning.plan_file import Plan
from rehearsal.real_time.pace import Pace
from rehearsal.real_time.solver_loop import SolverSetup
from rehearsal.real_time.solver_process import SolverProcess
from rehearsal.real_time.started_process import start_process
from rehearsal.rehearsal import Rehearsal, begin
from rehearsal.sessions.replay import Replay, ReplayCheck
from rehearsal.sessions.session_file import Log, read_log
from render.viewer import Controls
from scenes.anatomy import LoadedAnatomy, fingerprint
from sim.device import start
from ultrasound.probe_manipulator import advanced
from ultrasound.sweep_file import read_sweep

pytestmark = pytest.mark.usefixtures("arrays_stored")


class SlowMachine(Pace):
    """Each step takes longer than the longest one simulates."""

    def note(self, took_ms: float, length_s: float) -> None:
        sleep(0.08)


def pace_at(level: int, kind: type[Pace] = Pace) -> Pace:
    """A pace that begins at a level and returns from it only after 90 steps."""
    pace = kind(1 / 60)
    pace.level = level % len(pace.levels)
    return pace


@pytest.fixture(scope="module")
def built() -> tuple[Rehearsal, LoadedAnatomy]:
    start("cpu")
    rehearsal, anatomy = coarse_patient()
    # Kernels that the first frame would wait for.
    compile_picture(rehearsal.anatomy)
    frame, probe = rehearsal.do(Move(pose=rehearsal.frame.pose)), rehearsal.case.probe
    LiveMeasurements(rehearsal.anatomy, rehearsal.manipulator).observe(frame, probe)
    return rehearsal, anatomy


@pytest.fixture
def process() -> Iterator[SolverProcess]:
    solver = SolverProcess(start_process())
    yield solver
    solver.close()


def plan_down(rehearsal: Rehearsal, anatomy: LoadedAnatomy) -> Plan:
    """A plan for this patient, of two poses at the first contact."""
    home = rehearsal.manipulator.home
    planned = [rehearsal.case.probe_in_patient(pose).tolist() for pose in (home, advanced(home, 0.1))]
    sweep = sweep_of(np.stack([home, home])).model_copy(update=dict(passes=[planned]))
    return plan_of(sweep, anatomy=fingerprint(anatomy))


# What is done in order, each for some time and frames.
SCRIPT = (
    "rest press rest bookmark sweep press press rest undo redo to_bookmark sweep freeze freeze press "
    "press rest"
)
PART_S, PART_FRAMES = 0.15, 4


def everything(rehearsal: Rehearsal, settings: LiveSettings) -> Iterator[Controls]:
    """The controls of each frame of the script."""
    home = rehearsal.manipulator.home
    down = home[:3, 3] + 60.0 * home[:3, 2], -home[:3, 2]
    for part in SCRIPT.split():
        began_s, frames = perf_counter(), 0
        while frames < PART_FRAMES or perf_counter() - began_s < PART_S:
            key = {part: True} if frames == 0 and part not in ("rest", "press") else {}
            yield Controls(settings, down, press=part == "press", **key)
            frames += 1
    yield Controls(settings, quit=True)


class LiveLink(SimpleNamespace):
    """An open link: counts the images that are sent."""

    images = 0

    def send(self, *image: object) -> None:
        self.images += 1


# How the pace begins, what is said then, and how many times longer than usual the steps are that it begins
# with.
PACES = {
    "as set": (lambda: pace_at(0), "", {1}),
    "longer steps": (lambda: pace_at(2), "Longer steps", {2, 3, 4}),
    # With fewer iterations, too.
    "slow motion": (lambda: pace_at(-1, SlowMachine), "Reduced iterations", {2, 3, 4}),
}


@pytest.mark.parametrize("pace", PACES)
def test_every_tool_works_at_every_pace(built, process, tmp_path, capsys, pace):
    rehearsal, loaded = built
    case, anatomy = rehearsal.case, rehearsal.anatomy
    make_pace, said, times_longer = PACES[pace]
    process.build(SolverSetup(case, "cpu", make_pace()))
    model = process.model()
    process.begin()
    manipulator = begin(case, anatomy, process)
    settings, link = initial_settings(case), LiveLink()
    viewer = NullViewer(settings, everything(rehearsal, settings))
    files = InputFiles(Path(), case.scene, case.probe, DEFAULT_KEYS, plan=plan_down(rehearsal, loaded))
    asked = RehearseOptions(out=tmp_path, link=True)
    built_for_window = run.Built(anatomy, process, manipulator, model.counts, model.serial)
    each = run.RehearsalRun(built_for_window, loaded, "cpu", asked, files, viewer, link)
    began_s = perf_counter()
    each.in_window()
    took_s = perf_counter() - began_s
    printed = capsys.readouterr().out

    log = read_log(each.recording.recorder.path)
    assert log.summary["went_back"] == 3 and log.summary["bookmarks"] == 1 and log.summary["presses"] >= 1
    assert each.measurements.guide.figures()["plan_followed"] == 1.0
    first = next(command for _, command in log.commands if isinstance(command, Move))
    # A busy machine changes the pace later.
    assert round(60 * first.length_s) in times_longer and said in printed
    assert pace != "slow motion" or log.length_s < 0.8 * took_s
    sweep = read_sweep(tmp_path / "sweep-001.igs.mha")
    assert len(sweep) >= 4 and (np.diff(sweep.times_s) > 0).all()
    # Frozen frames are sent too.
    assert link.images == viewer.frames
    check = replayed(rehearsal, log)
    assert check.compared >= 1 and check.differs_s is None


def replayed(rehearsal: Rehearsal, log: Log) -> ReplayCheck:
    """The comparison of a session with its replay in this process."""
    rehearsal.reset()
    replay, check = Replay(log, one_by_one=True), ReplayCheck(log, Notices())
    while not replay.is_over:
        frame = rehearsal.do(*replay.commands(rehearsal.frame, Controls(settings_with()), 0.0))
        check.observe(frame, rehearsal.case.probe)
    return check
