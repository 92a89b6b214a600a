"""The command ``rehearse``: press a kidney, in a window or without one."""

import os
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import click
import numpy as np
from pydantic import ValidationError

from errors import explained
from rehearsal.commands.command_line import CommandError, command, make_folder, start_taichi
from rehearsal.commands.rehearse_options import RehearseOptions
from rehearsal.configuration import Setup, probe_of, scene_of, with_quality
from rehearsal.planning.plan_file import Plan, PlanError, is_plan, read_plan
from rehearsal.sessions.session_file import Log, SessionError, read_log, scene_of_log
from rehearsal.tracking.openigtlink_options import open_link
from rehearsal.tracking.track_file import check_near, load_track
from render.display import display_available
from render.keys import Keys, keys_text, load_keys
from scenes.anatomy import LoadedAnatomy, fingerprint, load_anatomy
from scenes.scene import Scene, load_scene, scene_file, with_options
from scenes.terminal import ReportProgress, stages
from ultrasound.probe import Probe, ProbeError, probe_of_values

if TYPE_CHECKING:
    from rehearsal.pressed_organ import OrganState
    from rehearsal.real_time.solver_process import SolverProcess
    from rehearsal.rehearsal import Rehearsal


@command(RehearseOptions)
def rehearse(asked: RehearseOptions) -> None:
    """Press the kidney of SCENE with the probe and see its ultrasound image.

    SCENE is a scene file or a patient's folder; without one it is the embedded patient.
    """
    no_display = not asked.headless and not display_available()
    asked.headless |= no_display
    path = scene_file(asked.scene)
    before = load_scene(path)
    keys = load_keys(asked.keys) if asked.keys else Keys()
    asked.check()
    track = load_track(asked.track, asked.track_from) if asked.track else None
    plan = read_plan(asked.plan) if asked.plan else None
    log = session_of(asked.replay, asked.at) if asked.replay else None
    loaded, probe = as_asked(before, asked) if log is None else as_recorded(log, before)
    if no_display:
        click.echo(f"No display ({why_no_display()}): running the scripted press without a window.")
    if not asked.headless:
        check_vulkan()
    make_folder(asked.out)
    used = start_taichi(asked.arch)
    link = open_link(asked)
    with stages() as progress:
        anatomy = load_anatomy(loaded, path.parent, progress)
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
        started, chosen, solver = perf_counter(), "", None
        if asked.budget_ms is not None or asked.error_mm is not None:
            rehearsal, chosen = built_within(loaded, anatomy, probe, used, progress, asked)
            loaded = rehearsal.scene
        if not asked.headless:
            solver = start_solver(loaded, anatomy, probe, used, asked)
        if not chosen:
            settled = None if solver is None else solver.settled
            rehearsal = built(loaded, anatomy, probe, progress, not asked.no_pictures, settled)
        build_s = perf_counter() - started
        if not asked.no_pictures:
            progress("Building the model: the first picture")
            compile_picture(rehearsal)
    if chosen:
        click.echo(chosen)
    from rehearsal.run import RehearsalRun

    run = RehearsalRun(rehearsal, anatomy, used, asked, track, keys, link, plan)
    if solver is None:
        run.headless(log, build_s)
        return
    if chosen:
        solver.settled()
    try:
        solver.attach(rehearsal)
        run.in_window(log, solver)
    finally:
        solver.close()


def start_solver(
    scene: Scene, anatomy: LoadedAnatomy, probe: Probe, arch: str, asked: RehearseOptions
) -> "SolverProcess":
    """Start the process that makes the steps of a window, so that it builds its model while this one builds the rest."""
    from rehearsal.real_time.solver_process import SolverProcess

    return SolverProcess(scene, anatomy, probe, arch, asked.budget_ms or np.inf)


@click.command("keys")
def keys_command() -> None:
    """Print the keys as a file to change, for rehearse --keys."""
    click.echo(keys_text(), nl=False)


def why_no_display() -> str:
    """What is wrong with the screen."""
    display = os.environ.get("DISPLAY")
    return f"DISPLAY is {display}, which does not answer" if display else "DISPLAY is not set"


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


def built(
    scene: Scene,
    anatomy: LoadedAnatomy,
    probe: Probe,
    progress: ReportProgress,
    draws: bool = True,
    settled: Callable[[], "OrganState"] | None = None,
) -> "Rehearsal":
    """The rehearsal of a scene; ``draws``: images will be computed; ``settled`` waits for the organ at rest, if another process makes it."""
    from rehearsal.rehearsal import Rehearsal

    needs_b_mode = draws and scene.image.mode != "ct"
    return Rehearsal(scene, anatomy, probe, progress, needs_b_mode, settled)


def compile_picture(rehearsal: "Rehearsal") -> None:
    """Compute one image in advance, so that the first frame need not wait for its kernels."""
    from rehearsal.frame import image_view
    from rehearsal.measurements.run_report import Tally
    from rehearsal.open_window import initial_settings

    image_view(rehearsal, rehearsal.probe, initial_settings(rehearsal), Tally(0.0))


def built_within(
    scene: Scene,
    anatomy: LoadedAnatomy,
    probe: Probe,
    arch: str,
    progress: ReportProgress,
    asked: RehearseOptions,
) -> tuple["Rehearsal", str]:
    """The rehearsal with the settings that meet the budgets on this machine, and a text that names them. Raises CommandError."""
    from rehearsal.speed_accuracy import choose_within_budget, described, front_of, load_points

    def build(setup: Setup) -> "Rehearsal":
        start_taichi(arch)
        return built(scene_of(scene, setup), anatomy, probe, progress)

    front = front_of(load_points(), asked.model)
    rehearsal, point, step_ms = choose_within_budget(front, build, asked.budget_ms, asked.error_mm)
    return rehearsal, (
        f"Chosen: {described(point.setup)}; a step takes {step_ms:.1f} ms here, expected error {point.error_mean_mm:.2f} mm."
    )
