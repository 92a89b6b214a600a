"""The command ``rehearse``: press a kidney, in a window or without one."""

import os
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import click

from rehearsal.commands.command_line import (
    CommandError,
    Number,
    NumberRange,
    arch_option,
    image_options,
    make_folder,
    quality_option,
    start_taichi,
)
from rehearsal.commands.option_checks import (
    as_recorded,
    check_files,
    refuse_headless,
    refuse_inputs,
    refuse_no_pictures,
    refuse_no_vulkan,
    refuse_sizes,
    session_of,
)
from rehearsal.configuration import Setup, probe_of, scene_of, with_quality
from rehearsal.planning.plan_file import read_plan
from rehearsal.tracking.openigtlink_options import link_options, open_link
from rehearsal.tracking.track_file import PROBE_IN_PATIENT, load_track
from render.display import display_available
from render.keys import Keys, keys_text, load_keys
from scenes.anatomy import LoadedAnatomy, load_anatomy
from scenes.scene import EMBEDDED, OPTIONS, Scene, load_scene, scene_file, with_options
from scenes.terminal import ReportProgress, Stages
from scenes.tissue import TISSUES
from ultrasound.probe import Probe

if TYPE_CHECKING:
    from rehearsal.rehearsal import Rehearsal


@click.command()
@click.argument("scene", type=click.Path(path_type=Path), default=EMBEDDED, required=False)
@click.option(
    "--headless", is_flag=True, help="No window: run the scripted press, write images and a report."
)
@click.option(
    "--no-pictures",
    is_flag=True,
    help="With --headless: no images, which take most of the time; only report, surfaces and session.",
)
@click.option(
    "--seconds",
    type=NumberRange(0.02, 3600),
    help="Simulated seconds without a window [the scene's press]; the scripted press is stretched to them, a replay or a track is cut off.",
)
@click.option(
    "--replay",
    type=click.Path(path_type=Path),
    help="Replay a recorded session of this SCENE, bit for bit.",
)
@click.option("--at", type=NumberRange(0), default=0.0, help="With --replay: start at this second.")
@click.option(
    "--track",
    "track_file",
    type=click.Path(path_type=Path),
    help="Recorded poses that move the probe: a tracked sweep (.igs.mha), or poses with times (CSV, JSON).",
)
@click.option(
    "--track-from", help=f"With --track: the sweep's transform from probe to patient [{PROBE_IN_PATIENT}]."
)
@click.option("--gamepad", is_flag=True, help="Use a gamepad beside mouse and keys.")
@click.option(
    "--keys",
    "keys_file",
    type=click.Path(path_type=Path),
    help="Your own key map: a TOML file as printed by app.py keys.",
)
@click.option(
    "--plan", "plan_file", type=click.Path(path_type=Path), help="A sweep to follow: a file of app.py plan."
)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("out"),
    show_default=True,
    help="Folder for images and report; a run without a window replaces those of an earlier one.",
)
@arch_option
@click.option("--model", type=click.Choice(list(TISSUES)), help="Tissue model [the scene's].")
@click.option("--cell", type=Number(), help="neo-hookean: width of a cell in mm [the scene's].")
@click.option("--young-kpa", type=Number(), help="neo-hookean: Young's modulus in kPa [the scene's].")
@click.option("--poisson", type=Number(), help="neo-hookean: Poisson's ratio [the scene's].")
@click.option("--radius", type=Number(), help="shape-matching: particle radius in mm [the scene's].")
@click.option("--stiffness", type=Number(), help="shape-matching: cluster stiffness, 0 to 1 [the scene's].")
@click.option("--substeps", type=int, help="Substeps of a time step [the model's].")
@click.option("--iterations", type=int, help="Iterations of the solver in a substep [the model's].")
@quality_option
@image_options
@click.option(
    "--budget-ms",
    type=NumberRange(0.01, 10_000),
    help="Choose the most accurate resolution and iterations whose step takes no longer on this machine (measured first).",
)
@click.option(
    "--error-mm",
    type=NumberRange(0, 100),
    help="Choose the fastest resolution and iterations whose mean bead error (study trade) is no larger.",
)
@link_options
def rehearse(
    scene: Path,
    headless: bool,
    no_pictures: bool,
    seconds: float | None,
    replay: Path | None,
    at: float,
    track_file: Path | None,
    track_from: str | None,
    gamepad: bool,
    keys_file: Path | None,
    plan_file: Path | None,
    out: Path,
    arch: str,
    quality: str | None,
    budget_ms: float | None,
    error_mm: float | None,
    link: bool,
    link_host: str | None,
    link_port: int | None,
    link_leads: bool,
    **changes: Any,
) -> None:
    """Press the kidney of SCENE with the probe and see its ultrasound image.

    SCENE is a scene file or a patient's folder; without one it is the embedded patient.
    """
    path = scene_file(scene)
    changed = {key: changes[option.strip("-").replace("-", "_")] for key, option in OPTIONS.items()}
    choosers = {"--quality": quality, "--budget-ms": budget_ms, "--error-mm": error_mm}
    before = load_scene(path)
    keys = load_keys(keys_file) if keys_file is not None else Keys()
    refuse_inputs(track_file, track_from, replay, link_leads)
    refuse_sizes(changed, choosers)
    track = load_track(track_file, track_from) if track_file is not None else None
    plan = read_plan(plan_file) if plan_file is not None else None
    log = session_of(replay, at, changed, choosers)
    loaded, probe = as_asked(before, changed, quality) if log is None else as_recorded(log, before)
    headless = headless or not found_display()
    refuse_headless(headless, gamepad, link_leads)
    refuse_no_vulkan(headless)
    if no_pictures:
        refuse_no_pictures(headless, link)
    make_folder(out)
    used = start_taichi(arch)
    server = open_link(link, link_host, link_port, link_leads)
    with Stages() as progress:
        anatomy = load_anatomy(loaded, path.parent, progress)
        check_files(anatomy, before.title, probe, log, track_file, track, plan)
        started, chosen = perf_counter(), ""
        if budget_ms is not None or error_mm is not None:
            model = changed["tissue.model"]
            rehearsal, chosen = built_within(
                loaded, anatomy, probe, used, progress, model, budget_ms, error_mm
            )
        else:
            rehearsal = built(loaded, anatomy, probe, progress, not no_pictures)
        build_s = perf_counter() - started
        if not no_pictures:
            progress("Building the model: the first picture")
            compile_picture(rehearsal)
    if chosen:
        click.echo(chosen)
    from rehearsal.run import RehearsalRun

    tracked = server.received_pose if server is not None and link_leads else None
    named = None if scene == EMBEDDED else scene
    run = RehearsalRun(
        rehearsal, anatomy, used, out, budget_ms, tracked, track, keys, gamepad, server, plan, named
    )
    if headless:
        run.headless(log, at, seconds, build_s, not no_pictures)
    else:
        run.in_window(log, at)


def as_asked(
    scene: Scene, changed: dict[str, float | str | None], quality: str | None
) -> tuple[Scene, Probe]:
    """A scene with the options of the command line, and its probe; prints if they change the tissue model.

    Raises SceneError, ProbeError.
    """
    asked = with_quality(with_options(scene, changed), quality)
    if changed["tissue.model"] is None and asked.tissue.model != scene.tissue.model:
        click.echo(f"Tissue model: {asked.tissue.model}, as the options ask for it.")
    return asked, probe_of(asked)


@click.command("keys")
def keys_command() -> None:
    """Print the keys as a file to change, for rehearse --keys."""
    click.echo(keys_text(), nl=False)


def found_display() -> bool:
    """Whether there is a screen for a window; prints if there is none."""
    found = display_available()
    if not found:
        display = os.environ.get("DISPLAY")
        why = f"DISPLAY is {display}, which does not answer" if display else "DISPLAY is not set"
        click.echo(f"No display ({why}): running the scripted press without a window.")
    return found


def built(
    scene: Scene, anatomy: LoadedAnatomy, probe: Probe, progress: ReportProgress, draws: bool = True
) -> "Rehearsal":
    """The rehearsal of a scene; ``draws``: images will be computed."""
    from rehearsal.rehearsal import Rehearsal

    return Rehearsal(scene, anatomy, probe, progress, needs_b_mode=draws and scene.image.mode != "ct")


def compile_picture(rehearsal: "Rehearsal") -> None:
    """Compute one image in advance, so that the first frame need not wait for its kernels."""
    from rehearsal.frame import image_view
    from rehearsal.frame_view import initial_settings
    from rehearsal.measurements.run_report import Tally

    image_view(rehearsal, rehearsal.probe, initial_settings(rehearsal), Tally(0.0))


def built_within(
    scene: Scene,
    anatomy: LoadedAnatomy,
    probe: Probe,
    arch: str,
    progress: ReportProgress,
    model: Any,
    budget_ms: float | None,
    error_mm: float | None,
) -> tuple["Rehearsal", str]:
    """The rehearsal with the settings that meet the budgets on this machine, and a text that names them. Raises CommandError."""
    from rehearsal.speed_accuracy.budget_choice import NoPoint, choose, described
    from rehearsal.speed_accuracy.pareto_front import front_of, load_points

    def build(setup: Setup) -> "Rehearsal":
        start_taichi(arch)
        return built(scene_of(scene, setup), anatomy, probe, progress)

    try:
        rehearsal, point, step_ms = choose(front_of(load_points(), model), build, budget_ms, error_mm)
    except NoPoint as reason:
        raise CommandError(str(reason)) from None
    return rehearsal, (
        f"Chosen: {described(point.setup)}; a step takes {step_ms:.1f} ms here, expected error {point.error_mean_mm:.2f} mm."
    )
