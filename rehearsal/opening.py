"""Open a rehearsal: read what the user names, build the model, and for a window start the process of its solver."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import click
import numpy as np
from pydantic import ValidationError

from errors import explained
from rehearsal.commands.command_line import CommandError, make_folder, start_taichi
from rehearsal.commands.rehearse_options import RehearseOptions
from rehearsal.configuration import Setup, probe_of, scene_of, with_quality
from rehearsal.planning.plan_file import Plan, PlanError, is_plan, read_plan
from rehearsal.real_time.pace import Pace
from rehearsal.real_time.start_times import StartTimes
from rehearsal.sessions.session_file import Log, SessionError, read_log, scene_of_log
from rehearsal.tracking.openigtlink_options import open_link
from rehearsal.tracking.track_file import check_near, load_track
from render.keys import Keys, load_keys
from scenes.anatomy import LoadedAnatomy, fingerprint, load_anatomy
from scenes.scene import Scene, load_scene, scene_file, with_options
from scenes.terminal import ReportProgress, stages
from ultrasound.probe import Probe, ProbeError, probe_of_values

if TYPE_CHECKING:
    from rehearsal.real_time.solver_process import SolverProcess
    from rehearsal.rehearsal import Rehearsal
    from rehearsal.run import RehearsalRun


@contextmanager
def opened(asked: RehearseOptions) -> Iterator["RehearsalRun"]:
    """The rehearsal that the user asks for. Raises UserError, CommandError."""
    start = StartTimes()
    start.begin("Files")
    path = scene_file(asked.scene)
    before = load_scene(path)
    keys = load_keys(asked.keys) if asked.keys else Keys()
    asked.check()
    track = load_track(asked.track, asked.track_from) if asked.track else None
    plan = read_plan(asked.plan) if asked.plan else None
    log = session_of(asked.replay, asked.at) if asked.replay else None
    scene, probe = as_asked(before, asked) if log is None else as_recorded(log, before)
    with nullcontext() if asked.headless else solver_process() as solver:
        start.begin("Taichi")
        if solver is not None:
            check_vulkan()
        make_folder(asked.out)
        arch = start_taichi(asked.arch)
        link = open_link(asked)
        with stages() as line:
            progress = start.reporting(line)
            progress("Anatomy")
            anatomy = load_anatomy(scene, path.parent, progress)
            if log is not None and fingerprint(anatomy) != log.header.anatomy:
                raise SessionError(
                    f"the session belongs to other anatomy than this scene ({before.title or 'no title'}): name "
                    "its scene or patient's folder before --replay; a patient imported again counts as another"
                )
            if track is not None and asked.track is not None:
                check_near(track, anatomy.organ.vertices, asked.track)
                if is_plan(asked.track):
                    check_plan(read_plan(asked.track), fingerprint(anatomy), probe)
            if plan is not None:
                check_plan(plan, fingerprint(anatomy), probe)
            started = perf_counter()
            rehearsal, chosen = built(asked, scene, anatomy, probe, arch, solver, progress)
            build_s = perf_counter() - started
            if not asked.no_pictures:
                progress("Building the model: the first picture")
                compile_picture(rehearsal)
        if chosen:
            click.echo(chosen)
        from rehearsal.run import RehearsalRun

        yield RehearsalRun(
            rehearsal,
            anatomy,
            arch,
            asked,
            solver,
            log,
            track,
            keys,
            link,
            plan,
            build_s=build_s,
            start=start,
        )


@contextmanager
def solver_process() -> Iterator["SolverProcess"]:
    """The process of a window's solver: started at once, because it loads Taichi too."""
    from rehearsal.real_time.solver_process import SolverProcess

    solver = SolverProcess()
    try:
        yield solver
    finally:
        solver.close()


def built(
    asked: RehearseOptions,
    scene: Scene,
    anatomy: LoadedAnatomy,
    probe: Probe,
    arch: str,
    solver: "SolverProcess | None",
    progress: ReportProgress,
) -> tuple["Rehearsal", str]:
    """The rehearsal, and a text that names the settings if a budget chose them; the process of the solver builds its part."""
    from rehearsal.rehearsal import Rehearsal

    chosen = ""
    if asked.budget_ms is not None or asked.error_mm is not None:
        setup, chosen = setup_within_budget(scene, anatomy, probe, arch, progress, asked)
        scene = scene_of(scene, setup)
        start_taichi(arch)
    if solver is not None:
        time_step_s = scene.solver.time_step_s if asked.rate is None else 1.0 / asked.rate
        solver.build(scene, anatomy, probe, arch, Pace(time_step_s, asked.budget_ms or np.inf))
    needs_b_mode = scene.image.mode != "ct" and not asked.no_pictures
    settled = None if solver is None else solver.settled
    rehearsal = Rehearsal(scene, anatomy, probe, progress, needs_b_mode, settled)
    if solver is not None:
        solver.attach(rehearsal)
    return rehearsal, chosen


def check_vulkan() -> None:
    """Raises CommandError if a window has no Vulkan driver, before minutes are spent on building the model."""
    from sim.device import is_available

    if not is_available("vulkan"):
        raise CommandError(
            "no Vulkan driver found: the window needs one; install a Vulkan driver, or run with --headless"
        )


def as_asked(scene: Scene, asked: RehearseOptions) -> tuple[Scene, Probe]:
    """A scene with the options of the command line, and its probe; prints if they change the tissue model.

    Raises SceneError, ProbeError.
    """
    changed = with_quality(with_options(scene, asked.changes), asked.quality)
    if asked.model is None and changed.tissue.model != scene.tissue.model:
        click.echo(f"Tissue model: {changed.tissue.model}, as the options ask for it.")
    return changed, probe_of(changed)


def session_of(path: Path, at_s: float) -> Log:
    """The session to replay from a second on. Raises CommandError, SessionError."""
    log = read_log(path)
    if at_s > log.length_s:
        raise CommandError(
            f"--at {at_s:g}: the session is {log.length_s:.1f} s long; choose an earlier second"
        )
    return log


def as_recorded(log: Log, scene: Scene) -> tuple[Scene, Probe]:
    """The patient of a scene with all other settings of a session, and the session's probe. Raises SessionError."""
    try:
        return scene_of_log(log.header, scene), probe_of_values(log.header.probe)
    except ValidationError as error:
        raise SessionError(f"the session's scene cannot be used: {explained(error)}") from None
    except ProbeError as error:
        raise SessionError(f"the session's probe cannot be used: {error}") from None


def check_plan(plan: Plan, anatomy: str, probe: Probe) -> None:
    """Raises PlanError if a plan is for other anatomy (by its fingerprint) or for another probe."""
    if plan.anatomy != anatomy:
        raise PlanError(
            "the plan is for other anatomy than this scene: name its scene or patient's folder before --plan; "
            "a patient imported again counts as another"
        )
    planned = _probe_name(plan.probe.get("TransducerName"), plan.probe.get("HousingMm"))
    found = _probe_name(probe.transducer_name, probe.housing_mm)
    if planned != found:
        raise PlanError(
            f"the plan is for the probe {planned}, found {found}: choose it with --probe, or plan anew"
        )


def _probe_name(name: Any, housing_mm: Any) -> str:
    return f"{name!r} of {' x '.join(f'{each:g}' for each in housing_mm or ())} mm"


def compile_picture(rehearsal: "Rehearsal") -> None:
    """Compute one image in advance, so that the first frame need not wait for its kernels."""
    from rehearsal.frame import image_view
    from rehearsal.measurements.run_report import Tally
    from rehearsal.open_window import initial_settings

    image_view(rehearsal, rehearsal.probe, initial_settings(rehearsal), Tally(0.0))


def setup_within_budget(
    scene: Scene,
    anatomy: LoadedAnatomy,
    probe: Probe,
    arch: str,
    progress: ReportProgress,
    asked: RehearseOptions,
) -> tuple[Setup, str]:
    """The settings that meet the budgets on this machine, and a text that names them. Raises NoPoint."""
    from rehearsal.rehearsal import Rehearsal
    from rehearsal.speed_accuracy import choose_within_budget, described, front_of, load_points

    def build(setup: Setup) -> "Rehearsal":
        start_taichi(arch)
        return Rehearsal(scene_of(scene, setup), anatomy, probe, progress)

    front = front_of(load_points(), asked.model)
    _, point, step_ms = choose_within_budget(front, build, asked.budget_ms, asked.error_mm)
    return point.setup, (
        f"Chosen: {described(point.setup)}; a step takes {step_ms:.1f} ms here, expected error {point.error_mean_mm:.2f} mm."
    )
