"""Undo, bookmarks, freeze, sweeps, a plan and the link in a window whose solver keeps pace with the clock, at each of its paces."""

from collections.abc import Iterator
from pathlib import Path
from time import perf_counter, sleep
from types import SimpleNamespace

import numpy as np
import pytest
import taichi as ti
from null_viewer import NullViewer
from plan_ball import plan_of, sweep_of

from rehearsal import run
from rehearsal.asked_files import AskedFiles
from rehearsal.build_solver import step_settings
from rehearsal.commands.rehearse_options import RehearseOptions
from rehearsal.measurements.live_measurements import LiveMeasurements
from rehearsal.open_window import initial_settings
from rehearsal.opening import compile_picture
from rehearsal.planning.plan_file import Plan
from rehearsal.real_time.pace import Pace
from rehearsal.real_time.solver_process import SolverProcess
from rehearsal.real_time.started_process import start_process
from rehearsal.rehearsal import Rehearsal
from rehearsal.sessions.replay import Replay
from rehearsal.sessions.session import Session
from rehearsal.sessions.session_file import read_log
from render.keys import Keys
from render.viewer import Controls, Settings
from scenes.anatomy import LoadedAnatomy, fingerprint, load_anatomy
from scenes.phantom.embedded_patient import phantom_folder
from scenes.scene import EMBEDDED, load_scene, with_options
from sim.device import start
from ultrasound.probe_manipulator import advanced, image_plane
from ultrasound.sweep_file import read_sweep

SECONDS = 4.0


class SlowMachine(Pace):
    """Steps take longer than the longest one simulates."""

    def iterations(self, full: int) -> int:
        sleep(0.12)
        return super().iterations(full)


def pace_at(level: int, kind: type[Pace] = Pace) -> Pace:
    """A pace that begins at a level and returns from it only after 90 steps."""
    pace = kind(1 / 60)
    pace.level = level % len(pace.levels)
    return pace


@pytest.fixture(scope="module")
def built() -> Iterator[tuple[Rehearsal, LoadedAnatomy]]:
    """The embedded patient, coarse and with small images."""
    start("cpu")
    scene = with_options(load_scene(EMBEDDED), {"tissue.cell_mm": 8.0, "image.mode": "b-mode"})
    short = dict(press=scene.press.model_copy(update={"warm_up_steps": 20}))
    small = dict(image=scene.image.model_copy(update={"pixels": 32}))
    anatomy = load_anatomy(scene, phantom_folder())
    rehearsal = Rehearsal(scene.model_copy(update=short | small), anatomy)
    # Kernels that the first frame would wait for.
    compile_picture(rehearsal)
    LiveMeasurements(rehearsal).watch(Session(rehearsal), rehearsal.probe)
    yield rehearsal, anatomy
    ti.reset()


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


def everything(rehearsal: Rehearsal, settings: Settings) -> Iterator[Controls]:
    """Press, bookmark, press again, undo, redo, return to the bookmark, freeze; a sweep is recorded meanwhile. Times in seconds."""
    home, began_s = rehearsal.manipulator.home, perf_counter()
    down = home[:3, 3] + 60.0 * home[:3, 2], -home[:3, 2]
    once = dict(bookmark=0.9, sweep=1.0, undo=1.8, redo=2.1, to_bookmark=2.4, freeze=2.7)
    again = dict(sweep=2.6, freeze=3.0)
    due = sorted((at_s, action) for times in (once, again) for action, at_s in times.items())
    while (now_s := perf_counter() - began_s) < SECONDS:
        actions = {due.pop(0)[1]: True} if due and now_s >= due[0][0] else {}
        press = 0.4 < now_s < 0.8 or 1.1 < now_s < 1.7 or now_s > 3.2
        yield Controls(settings, down, press=press, **actions)
    yield Controls(settings, quit=True)


class LiveLink(SimpleNamespace):
    """An open link: counts the images that are sent."""

    images = 0

    def send(self, *image: object) -> None:
        self.images += 1


PACES = {
    "as set": (lambda: pace_at(0), {1}, ""),
    "longer steps": (lambda: pace_at(2), {2, 3, 4}, "LONGER STEPS"),
    "fewer iterations": (lambda: pace_at(-1), {1, 2, 3, 4}, "REDUCED ITERATIONS"),
    "slow motion": (lambda: pace_at(-1, SlowMachine), {1, 2, 3, 4}, "REDUCED ITERATIONS"),
}


@pytest.mark.parametrize("pace", PACES)
def test_every_tool_works_at_every_pace(built, process, tmp_path, capsys, pace):
    rehearsal, anatomy = built
    make_pace, times_longer, said = PACES[pace]
    process.build(rehearsal.scene, anatomy, rehearsal.probe, "cpu", make_pace())
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
    lengths = set(np.rint(60 * log.lengths_s[~np.isnan(log.poses).any(axis=(1, 2))]).astype(int).tolist())
    assert lengths <= times_longer and said in printed
    # All but the frozen 0.3 s are simulated, unless the machine is too slow for it.
    assert (log.length_s > 0.8 * (took_s - 0.3)) == (pace != "slow motion")
    sweep = read_sweep(tmp_path / "sweep-001.igs.mha")
    assert len(sweep) >= 3 and (np.diff(sweep.times_s) > 0).all() and link.images >= viewer.frames - 40
    rehearsal.reset()
    rehearsal.settings = step_settings(rehearsal.scene.tissue, rehearsal.scene.solver)
    replay = Replay(rehearsal, log)
    for _ in replay.go_to(log.length_s):
        pass
    assert replay.compared >= 1 and replay.differs_s is None
