"""Open a rehearsal: read what the user names, build the model, and for a window start the process of its
solver.
"""

import gc
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from time import perf_counter
from typing import TYPE_CHECKING

import click
import numpy as np
from click.exceptions import Exit

from rehearsal.case import Case, case_of
from rehearsal.commands.command_line import CommandError, make_folder, start_taichi
from rehearsal.commands.rehearse_options import RehearseOptions
from rehearsal.configuration import Setup, scene_of
from rehearsal.input_files import InputFiles, check_anatomy, keys_of, read_files
from rehearsal.real_time.pace import Pace
from rehearsal.real_time.start_times import StartTimes
from rehearsal.real_time.started_process import StartedProcess
from rehearsal.start_progress import (
    ANATOMY,
    AT_REST,
    FIRST_IMAGE,
    FIRST_VIEW,
    SURFACES,
    TISSUE,
    StartProgress,
)
from rehearsal.tracking.openigtlink_options import open_link
from render.display import window_size, wrong_depth
from render.gamepad import Gamepad, SdlPads
from render.keys import Keys
from scenes.anatomy import LoadedAnatomy, load_anatomy
from scenes.import_findings import warning_lines
from scenes.scene import Scene
from scenes.terminal import ReportProgress, stages

if TYPE_CHECKING:
    from rehearsal.deformed_anatomy import DeformedAnatomy
    from rehearsal.live_settings import LiveSettings
    from rehearsal.real_time.solver_process import SolverProcess
    from rehearsal.rehearsal import Rehearsal
    from rehearsal.run import Built, RehearsalRun
    from render.viewer import View
    from render.window import Window


@contextmanager
def opened(options: RehearseOptions, process: StartedProcess | None) -> Iterator["RehearsalRun"]:
    """The rehearsal that the user asks for, in a window with the process for its solver.

    Raises UserError, CommandError.
    """
    start, arch, solver, viewer = StartTimes(), "", None, None
    with ExitStack() as resources:
        if process is not None and options.leaves_patient_open:
            start.begin("Start screen")
            solver = resources.enter_context(solver_process(process))
            check_graphics()
            arch = start_taichi(options.arch)
            viewer = resources.enter_context(window(options, keys_of(options)))
            with start.paused():
                options = with_choice(options, viewer)
        start.begin("Files")
        files = read_files(options)
        for warning in warning_lines(files.warnings, files.folder):
            click.echo(warning)
        for text in files.acknowledged:
            click.echo(f"Acknowledged warning of the import: {text}")
        start.begin("Taichi")
        if process is not None and solver is None:
            solver = resources.enter_context(solver_process(process))
            check_graphics()
        make_folder(options.out)
        arch = arch or start_taichi(options.arch)
        link = open_link(options)
        start.begin("Window")
        # A budget is met by trials, and each starts Taichi anew, which would end a window.
        has_trials = options.budget_ms is not None or options.error_mm is not None
        if viewer is None and not (options.headless or has_trials):
            viewer = resources.enter_context(window(options, files.keys))
        with stages() as line:
            progress = StartProgress(start, line, viewer)
            progress(ANATOMY)
            anatomy = load_anatomy(files.scene, files.folder, progress)
            check_anatomy(files, options, anatomy)
            began, scene, chosen = perf_counter(), files.scene, ""
            if has_trials:
                scene, chosen = scene_within_budget(files, anatomy, arch, progress, options)
                if not options.headless:
                    progress.viewer = viewer = resources.enter_context(window(options, files.keys))
            # A session of this backend is replayed as it was recorded, on however many cores.
            serial = files.log.header.serial if files.log and files.log.header.arch == arch else None
            case = case_of(scene, anatomy, files.probe)
            if solver is None or viewer is None:
                built = built_headless(options, case, anatomy, serial, progress)
            else:
                built = built_for_window(options, case, anatomy, serial, arch, solver, viewer, progress)
            build_s = perf_counter() - began
            if solver is None and not options.no_pictures:
                progress(FIRST_IMAGE)
                compile_picture(built.anatomy)
        # All this lives as long as the rehearsal: to look for garbage in it would delay single frames by a
        # tenth of a second.
        gc.freeze()
        # At the end Python must be able to delete it: Taichi writes its kernels to their cache only when it
        # is deleted.
        resources.callback(gc.unfreeze)
        start.begin("First picture")
        if chosen:
            click.echo(chosen)
        from rehearsal.run import RehearsalRun

        yield RehearsalRun(built, anatomy, arch, options, files, viewer, link, build_s, start)


def with_choice(options: RehearseOptions, viewer: "Window[LiveSettings]") -> RehearseOptions:
    """The options with the patient or session that the user chooses on the start screen.

    Raises Exit where the user quits.
    """
    from rehearsal.start_screen.patient_list import PATIENTS_FOLDER
    from rehearsal.start_screen.patient_page import PatientPage
    from rehearsal.start_screen.start_page import StartScreen

    choice = StartScreen(viewer, PatientPage(PATIENTS_FOLDER, options.out)).choice()
    if choice is None:
        raise Exit
    return options.model_copy(update=dict(scene=choice.scene, replay=choice.replay, at=choice.at_s))


@contextmanager
def solver_process(started: StartedProcess) -> Iterator["SolverProcess"]:
    """The process of a window's solver."""
    from rehearsal.real_time.solver_process import SolverProcess

    solver = SolverProcess(started)
    try:
        yield solver
    finally:
        solver.close()


@contextmanager
def window(options: RehearseOptions, keys: Keys) -> Iterator["Window[LiveSettings]"]:
    """An open window that shows progress. Raises CommandError."""
    from render.window import NoVulkan, Window

    pad = Gamepad(SdlPads(), keys.buttons) if options.gamepad else None
    try:
        opened: Window[LiveSettings] = Window(size=window_size(), keys=keys, gamepad=pad)
    except NoVulkan as reason:
        raise CommandError(f"{reason}; install a Vulkan driver, or run with --headless") from None
    try:
        yield opened
    finally:
        opened.close()


def built_headless(
    options: RehearseOptions,
    case: Case,
    anatomy: LoadedAnatomy,
    serial: bool | None,
    progress: ReportProgress,
) -> "Built":
    """The rehearsal without a window: the solver is in this process."""
    from rehearsal.rehearsal import Rehearsal
    from rehearsal.run import Built

    needs_b_mode = case.scene.image.mode != "ct" and not options.no_pictures
    rehearsal = Rehearsal(case, anatomy, progress, needs_b_mode, serial)
    model = rehearsal.organ.model
    shown = rehearsal.anatomy, rehearsal.timeline, rehearsal.manipulator
    return Built(*shown, model.counts(), model.serial, rehearsal)


def built_for_window(
    options: RehearseOptions,
    case: Case,
    anatomy: LoadedAnatomy,
    serial: bool | None,
    arch: str,
    solver: "SolverProcess",
    viewer: "Window[LiveSettings]",
    progress: StartProgress,
) -> "Built":
    """The rehearsal that a window shows.

    While the process of the solver brings the tissue to rest, this one prepares the first picture.
    """
    from rehearsal.deformed_anatomy import DeformedAnatomy, scanned_ct
    from rehearsal.drawn_geometry import drawn_geometry
    from rehearsal.live_settings import initial_settings
    from rehearsal.loop.frame import at_rest
    from rehearsal.real_time.solver_loop import SolverSetup
    from rehearsal.rehearsal import begin
    from rehearsal.run import Built

    time_step_s = case.scene.solver.time_step_s if options.rate is None else 1.0 / options.rate
    pace = Pace(time_step_s, options.budget_ms or np.inf)
    solver.build(SolverSetup(case, arch, pace, serial))
    scanned = scanned_ct(case, anatomy, case.scene.image.mode != "ct")
    progress(TISSUE)
    model = solver.model(progress.wait)
    progress(SURFACES)
    shown = DeformedAnatomy(case, anatomy, model.interpolation, scanned)
    shown.show(at_rest(case, model.interpolation))
    progress(FIRST_IMAGE)
    viewer.show_scene(drawn_geometry(shown), initial_settings(case))
    first = compile_picture(shown)
    progress(FIRST_VIEW)
    viewer.prepare(first)
    progress(AT_REST)
    solver.begin(progress.wait)
    manipulator = begin(case, shown, solver)
    return Built(shown, solver, manipulator, model.counts, model.serial)


def check_graphics() -> None:
    """Raises CommandError if no window can be opened: screen or driver; before minutes are spent on
    building the model.
    """
    from sim.device import is_available

    if depth := wrong_depth():
        raise CommandError(
            f"the display {os.environ.get('DISPLAY')} has {depth} bits of colour; expected 24, with others "
            "the graphics driver would "
            "end the program; set the screen to 24 bits, or run with --headless"
        )
    if not is_available("vulkan"):
        raise CommandError(
            "no Vulkan driver found: the window needs one; install a Vulkan driver, or run with --headless"
        )


def compile_picture(anatomy: "DeformedAnatomy") -> "View":
    """Compute one view in advance, so that the first frame need not wait for its kernels."""
    from rehearsal.imaging import image_view
    from rehearsal.live_settings import initial_settings

    return image_view(anatomy, initial_settings(anatomy.case))


def scene_within_budget(
    files: InputFiles, anatomy: LoadedAnatomy, arch: str, progress: ReportProgress, options: RehearseOptions
) -> tuple[Scene, str]:
    """The scene with the settings that meet the budgets on this machine, and a text that names them.

    Raises NoPoint.
    """
    from rehearsal.rehearsal import Rehearsal
    from rehearsal.speed_accuracy import choose_within_budget, described, front_of, load_points

    def build(setup: Setup) -> "Rehearsal":
        start_taichi(arch)
        return Rehearsal(case_of(scene_of(files.scene, setup), anatomy, files.probe), anatomy, progress)

    front = front_of(load_points(), options.changes.get("tissue.model"))
    _, point, step_ms = choose_within_budget(front, build, options.budget_ms, options.error_mm)
    start_taichi(arch)
    text = (
        f"Chosen: {described(point.setup)}; a step takes {step_ms:.1f} ms here, expected error "
        f"{point.error_mean_mm:.2f} mm."
    )
    return scene_of(files.scene, point.setup), text
