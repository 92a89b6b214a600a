"""Undo, bookmarks, freeze, sweeps, a plan and the link in a window whose solver keeps pace with the clock, at each of its paces."""

from collections.abc import Iterator
from pathlib import Path
from time import perf_counter, sleep
from types import SimpleNamespace

import numpy as np
import pytest
from coarse_patient import coarse_patient
from null_viewer import NullViewer
from plan_ball import plan_of, sweep_of
from rehearsal.open_window import initial_settings
from rehearsal.sessions.session import Session

from rehearsal import run
from rehearsal.asked_files import AskedFiles
from rehearsal.build_solver import step_settings
from rehearsal.commands.rehearse_options import RehearseOptions
from rehearsal.measurements.live_measurements import LiveMeasurements
from rehearsal.opening import compile_picture
from rehearsal.planning.plan_file import Plan
from rehearsal.real_time.pace import Pace
from rehearsal.real_time.solver_loop import SolverSetup
from rehearsal.real_time.solver_process import SolverProcess
from rehearsal.real_time.started_process import start_process
from rehearsal.rehearsal import Rehearsal
from rehearsal.sessions.replay import Replay
from rehearsal.sessions.session_file import read_log
from render.keys import Keys
from render.viewer import Controls, Settings
from scenes.anatomy import LoadedAnatomy, fingerprint
from sim.device import start
from ultrasound.probe_manipulator import advanced, image_plane
from ultrasound.sweep_file import read_sweep

pytestmark = pytest.mark.usefixtures("arrays_stored")


class SlowMachine(Pace):
    """Each step takes longer than the longest one simulates."""

    def watch(self, took_ms: float, length_s: float) -> None:
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
    compile_picture(rehearsal)
    LiveMeasurements(rehearsal).watch(Session(rehearsal), rehearsal.probe)
    return rehearsal, anatomy


@pytest.fixture(scope="module")
def process() -> Iterator[SolverProcess]:
    solver = SolverProcess(start_process())
    yield solver
    solver.close()


def plan_down(rehearsal: Rehearsal, anatomy: LoadedAnatomy) -> Plan:
    """A plan for this patient, of two poses at the first contact."""
    home = rehearsal.manipulator.home
    planned = np.stack(
        [
            image_plane(pose, rehearsal.size_mm[2], 1.0, 1.0).world_from_plane
            for pose in (home, advanced(home, 0.1))
        ]
    )
    planned[:, :3, 3] += rehearsal.origin
    sweep = sweep_of(np.stack([home, home])).model_copy(update=dict(passes=[planned.tolist()]))
    return plan_of(sweep, anatomy=fingerprint(anatomy))


# What is done in order, each for some time and frames.
SCRIPT = "rest press rest bookmark sweep press press rest undo redo to_bookmark sweep freeze freeze press press rest"
PART_S, PART_FRAMES = 0.15, 4


def everything(rehearsal: Rehearsal, settings: Settings) -> Iterator[Controls]:
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


# How the pace begins, what is said then, and how many times longer than usual the steps are that it begins with.
PACES = {
    "as set": (lambda: pace_at(0), "", {1}),
    "longer steps": (lambda: pace_at(2), "LONGER STEPS", {2, 3, 4}),
    # With fewer iterations, too.
    "slow motion": (lambda: pace_at(-1, SlowMachine), "REDUCED ITERATIONS", {2, 3, 4}),
}


@pytest.mark.parametrize("pace", PACES)
def test_every_tool_works_at_every_pace(built, process, tmp_path, capsys, pace):
    rehearsal, anatomy = built
    make_pace, said, times_longer = PACES[pace]
    process.build(SolverSetup(rehearsal.scene, anatomy, rehearsal.probe, "cpu", make_pace()))
    rehearsal.settings = step_settings(rehearsal.scene.tissue, rehearsal.scene.solver)
    rehearsal.take_settled(process.settled())
    process.attach(rehearsal)
    settings, link = initial_settings(rehearsal), LiveLink()
    viewer = NullViewer(settings, everything(rehearsal, settings))
    files = AskedFiles(Path(), rehearsal.scene, rehearsal.probe, Keys(), plan=plan_down(rehearsal, anatomy))
    asked = RehearseOptions(out=tmp_path, link=True)
    each = run.RehearsalRun(rehearsal, anatomy, "cpu", asked, files, viewer, process, link)
    began_s = perf_counter()
    each.in_window()
    took_s = perf_counter() - began_s
    process.pause()
    printed = capsys.readouterr().out

    log = read_log(each.recorder.path)
    assert log.summary["went_back"] == 3 and log.summary["bookmarks"] == 1 and log.summary["presses"] >= 1
    assert each.measurements.guide.figures()["plan_followed"] == 1.0
    lengths = np.rint(60 * log.lengths_s[~np.isnan(log.poses).any(axis=(1, 2))]).astype(int)
    # A busy machine changes the pace later.
    assert lengths[0] in times_longer and said in printed
    assert pace != "slow motion" or log.length_s < 0.8 * took_s
    sweep = read_sweep(tmp_path / "sweep-001.igs.mha")
    assert len(sweep) >= 4 and (np.diff(sweep.times_s) > 0).all()
    # Frozen frames are sent too.
    assert link.images == viewer.frames
    rehearsal.reset()
    rehearsal.settings = step_settings(rehearsal.scene.tissue, rehearsal.scene.solver)
    replay = Replay(rehearsal, log)
    for _ in replay.go_to(log.length_s):
        pass
    assert replay.compared >= 1 and replay.differs_s is None
