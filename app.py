"""The command line: reads a scene, wires the parts, runs the loop. ``python app.py --help`` lists what it does."""

import json
import sys
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import click
import numpy as np
from PIL import Image
from tqdm import tqdm

from scenes.anatomy import LoadedAnatomy, load_anatomy
from scenes.command import import_patient_command
from scenes.reading import PatientError
from scenes.scene import (
    EMBEDDED,
    OPTIONS,
    TISSUES,
    NeoHookeanTissue,
    Scene,
    SceneError,
    load_scene,
    with_options,
)
from sim.sampling import SamplingError
from studies.beam.command import beam
from studies.case import CaseError
from studies.commands import Fault, arch_option, calibrate, make_folder, start_taichi, validate
from studies.reference.command import reference
from studies.setup import Setup, SetupError, scene_of
from studies.study import study

if TYPE_CHECKING:
    from render.viewer import Controls, Settings, View, Viewer
    from studies.rehearsal import Rehearsal
    from studies.report import Record
    from studies.trade.ladder import Ladder


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
def cli() -> None:
    """Nephron: rehearse ultrasound on a patient's own deformable kidney.

    Without a command it is `rehearse` on the embedded patient.
    """


@cli.command()
@click.argument("scene", type=click.Path(path_type=Path), default=EMBEDDED, required=False)
@click.option(
    "--headless", is_flag=True, help="No window: run the scripted press, write pictures and a report."
)
@click.option(
    "--seconds", type=click.FloatRange(0.02, 3600), help="Simulated seconds for the press [the scene's]."
)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("out"),
    show_default=True,
    help="Folder for pictures and the report.",
)
@arch_option
@click.option("--model", type=click.Choice(list(TISSUES)), help="Tissue model [the scene's].")
@click.option("--cell", type=float, help="neo-hookean: width of a cell in mm [the scene's].")
@click.option("--young-kpa", type=float, help="neo-hookean: Young's modulus in kPa [the scene's].")
@click.option("--poisson", type=float, help="neo-hookean: Poisson's ratio [the scene's].")
@click.option("--radius", type=float, help="shape-matching: particle radius in mm [the scene's].")
@click.option("--stiffness", type=float, help="shape-matching: cluster stiffness, 0 to 1 [the scene's].")
@click.option("--substeps", type=int, help="Substeps of a time step [the model's].")
@click.option("--iterations", type=int, help="Passes over the constraints in a substep [the model's].")
@click.option(
    "--budget-ms",
    type=click.FloatRange(0.01, 10_000),
    help="Choose size and passes: the truest whose step takes no longer on this machine, measured first.",
)
@click.option(
    "--error-mm",
    type=click.FloatRange(0, 100),
    help="Choose size and passes: the fastest whose mean error, as study trade measured it, is no larger.",
)
def rehearse(
    scene: Path,
    headless: bool,
    seconds: float | None,
    out: Path,
    arch: str,
    budget_ms: float | None,
    error_mm: float | None,
    **changes: float | str | None,
) -> None:
    """Press the kidney of SCENE, a scene file or a patient's folder, and see what the transducer sees."""
    path = scene / "scene.toml" if scene.is_dir() else scene
    if scene.is_dir() and not path.is_file():
        raise Fault(f"{scene}: holds no scene.toml; make a patient's folder of a CT with: app.py import")
    changed = {key: changes[option.strip("-").replace("-", "_")] for key, option in OPTIONS.items()}
    before = load_scene(path)
    loaded = with_options(before, changed)
    if changed["tissue.model"] is None and loaded.tissue.model != before.tissue.model:
        click.echo(f"Tissue model: {loaded.tissue.model}, as the options ask for it.")
    anatomy = load_anatomy(loaded, path.parent)
    budgeted = budget_ms is not None or error_mm is not None
    if budgeted:
        refuse_sizes(changed)
    used = start_taichi(arch)
    from render.window import display_available
    from studies.rehearsal import Rehearsal

    if not headless and not display_available():
        click.echo("No display: running the scripted press without a window.")
        headless = True
    make_folder(out)
    click.echo("Building the model.")
    started = perf_counter()
    if budgeted:
        rehearsal = build_within(loaded, anatomy, used, changed["tissue.model"], budget_ms, error_mm)
    else:
        rehearsal = Rehearsal(loaded, anatomy)
    if headless:
        run_headless(rehearsal, used, seconds, out, perf_counter() - started)
    else:
        run_window(rehearsal, out, budget_ms)


def refuse_sizes(changed: dict[str, float | str | None]) -> None:
    """Raises Fault where the command line gives both a budget and what the budget is to choose."""
    for key, value in changed.items():
        if value is not None and key not in ("tissue.model", "tissue.young_kpa", "tissue.poisson"):
            raise Fault(f"{OPTIONS[key]}: --budget-ms and --error-mm choose this; leave one of them out")


def build_within(
    scene: Scene,
    anatomy: LoadedAnatomy,
    arch: str,
    model: Any,
    budget_ms: float | None,
    error_mm: float | None,
) -> "Rehearsal":
    """The rehearsal with the settings that fit the budgets on this machine. Raises Fault."""
    from studies.rehearsal import Rehearsal
    from studies.trade.choice import NoPoint, choose, described
    from studies.trade.front import front_of, load_points

    def build(setup: Setup) -> Rehearsal:
        start_taichi(arch)
        return Rehearsal(scene_of(scene, setup), anatomy)

    try:
        rehearsal, point, step_ms = choose(front_of(load_points(), model), build, budget_ms, error_mm)
    except NoPoint as reason:
        raise Fault(str(reason)) from None
    click.echo(
        f"Chosen: {described(point.setup)}; a step takes {step_ms:.1f} ms here, expected error {point.error_mean_mm:.2f} mm."
    )
    return rehearsal


cli.add_command(import_patient_command)
cli.add_command(validate)
cli.add_command(calibrate)
cli.add_command(beam)
cli.add_command(reference)
cli.add_command(study)


def settings_of(rehearsal: "Rehearsal") -> "Settings":
    """What the sliders start from."""
    from render.viewer import Settings

    scene, step = rehearsal.scene, rehearsal.settings
    tissue = scene.tissue
    return Settings(
        young_kpa=tissue.young_kpa if isinstance(tissue, NeoHookeanTissue) else None,
        stiffness=None if isinstance(tissue, NeoHookeanTissue) else step.stiffness,
        iterations=step.iterations,
        substeps=step.substeps,
        gravity_m_s2=scene.gravity.acceleration_m_s2,
        window_hu=round(scene.image.window_hu),
        level_hu=round(scene.image.level_hu),
        depth_mm=round(scene.image.depth_mm),
    )


def open_viewer(rehearsal: "Rehearsal", visible: bool) -> "Viewer":
    """The window, or its off-screen twin. Raises NoVulkan."""
    from render.viewer import Geometry
    from render.window import Window

    support, tumour = rehearsal.supports, rehearsal.tumour
    return Window(
        Geometry(
            organ_vertices=rehearsal.organ_skin.vertices,
            organ_faces=np.asarray(rehearsal.organ.faces, np.int32),
            bounds=rehearsal.organ.bounds,
            up=-rehearsal.gravity_direction,
            transducer_size_mm=rehearsal.size_mm,
            tumour_vertices=rehearsal.tumour_skin and rehearsal.tumour_skin.vertices,
            tumour_faces=None if tumour is None else np.asarray(tumour.faces, np.int32),
            support_vertices=np.asarray(support[0].vertices, np.float32) if support else None,
            support_faces=np.asarray(support[0].faces, np.int32) if support else None,
        ),
        settings_of(rehearsal),
        visible=visible,
    )


def run_frame(
    rehearsal: "Rehearsal",
    settings: "Settings",
    pose: np.ndarray | None,
    record: "Record",
    status: str = "",
) -> "View":
    """One frame, on screen and off: step with the transducer going to a pose, carry the surfaces, take the picture.

    Without a pose, as when frozen, the picture alone is taken anew.
    """
    from render.viewer import View
    from studies.report import timed

    if pose is not None:
        timed(partial(rehearsal.advance, pose), record.step_ms)
        rehearsal.update_surfaces()
    picture = timed(
        lambda: rehearsal.image(settings.window_hu, settings.level_hu, settings.depth_mm), record.slice_ms
    )
    size, count = next(iter(rehearsal.model.counts().items()))
    error = rehearsal.expected_error_mm()
    readouts = {
        "step": f"{np.median(record.step_ms[-30:]):.1f} ms",
        "error": "not known" if error is None else f"± {error:.2f} mm",
        "slice": f"{np.median(record.slice_ms[-30:]):.1f} ms",
        size: f"{count}",
        "indentation": f"{max(rehearsal.indentation_mm(), 0.0):.1f} mm",
    }
    return View(
        transducer_pose=rehearsal.pose,
        slice_image=picture,
        width_mm=rehearsal.scene.image.width_mm,
        depth_mm=settings.depth_mm,
        readouts=readouts,
        status=status,
        title=rehearsal.scene.title,
    )


def run_headless(rehearsal: "Rehearsal", arch: str, seconds: float | None, out: Path, build_s: float) -> None:
    """The scripted press without a screen: frames, slices, an animated picture and report.json."""
    from render.pictures import PICTURES_A_SECOND, empty_folder, in_proportion, save_animation, smaller
    from render.window import NoVulkan
    from studies.report import Record, summary

    try:
        viewer: Viewer | None = open_viewer(rehearsal, visible=False)
    except NoVulkan as reason:
        click.echo(f"{reason}; writing the slices and the report without 3D frames.")
        viewer = None
    settings = settings_of(rehearsal)
    record = Record(build_s)
    length_s = seconds or rehearsal.script_length_s()
    dt = rehearsal.settings.time_step_s
    steps = max(1, round(length_s / dt))
    every = max(1, round(1 / (PICTURES_A_SECOND * dt)))
    frames, slices = empty_folder(out / "frames"), empty_folder(out / "slices")
    animation: list[Image.Image] = []
    for step in tqdm(range(1, steps + 1), desc="press", unit="step"):
        goal = rehearsal.scripted_pose(rehearsal.script_length_s() * step / steps)
        view = run_frame(rehearsal, settings, rehearsal.pose_towards(goal), record)
        record.watch(rehearsal)
        if step % every == 0 or step == steps:
            picture = in_proportion(view)
            picture.save(slices / f"{step:05d}.png")
            if viewer is not None:
                viewer.draw(view)
                picture = Image.fromarray(viewer.picture())
                picture.save(frames / f"{step:05d}.png")
            animation.append(smaller(picture))
    save_animation(animation, out / "press.gif")
    report = record.report(rehearsal, arch)
    (out / "report.json").write_text(json.dumps(report, indent=2) + "\n", "utf-8")
    click.echo(summary(report))
    click.echo(f"Wrote {len(animation)} pictures, press.gif and report.json to {out}")


def run_window(rehearsal: "Rehearsal", out: Path, budget_ms: float | None) -> None:
    """The interactive loop: input -> transducer -> step -> surfaces and slice -> picture.

    A step that takes longer than its budget, or else than the time that it simulates, makes iterations give way.
    """
    from render.window import NoVulkan
    from studies.report import Notices, Record
    from studies.trade.ladder import Ladder

    try:
        viewer = open_viewer(rehearsal, visible=True)
    except NoVulkan as reason:
        raise Fault(f"{reason}; install a Vulkan driver, or run with --headless") from None
    record = Record(0.0)
    ladder = Ladder(budget_ms or 1000 * rehearsal.settings.time_step_s)
    notices = Notices(click.echo)
    click.echo("The window is open; H shows the keys, Esc quits.")
    frozen = False
    before = perf_counter()
    rate = 0.0
    view = run_frame(rehearsal, viewer.settings, rehearsal.pose, record)
    while viewer.running:
        controls = viewer.read_controls()
        frozen ^= controls.freeze
        pose = None if frozen else steer(rehearsal, controls, ladder)
        asked = controls.settings.iterations
        status = "FROZEN" if frozen else notices.shown or ladder.says(asked)
        view = run_frame(rehearsal, controls.settings, pose, record, status)
        if pose is not None:
            notices.tell(rehearsal.notice)
            if ladder.watch(record.step_ms[-1]) and ladder.says(asked) != status:
                click.echo(ladder.says(asked) or f"Back to all {asked} iterations.")
        now = perf_counter()
        rate = 0.9 * rate + 0.1 / max(now - before, 1e-6)
        before = now
        view.readouts["frames"] = f"{rate:.0f} /s"
        view.readouts["time"] = f"{rate * rehearsal.settings.time_step_s:.1f} x real"
        viewer.draw(view)
        if controls.screenshot:
            save_screenshot(viewer.picture(), out)
    viewer.close()


def steer(rehearsal: "Rehearsal", controls: "Controls", ladder: "Ladder") -> np.ndarray:
    """Hand the user's input to the hand that holds the transducer and to the solver; the pose to go to then."""
    step, hand, asked = rehearsal.settings, rehearsal.hand, controls.settings
    step.iterations, step.substeps = ladder.iterations(asked.iterations), asked.substeps
    if asked.stiffness is not None:
        step.stiffness = asked.stiffness
    if asked.young_kpa is not None:
        rehearsal.set_young(asked.young_kpa)
    rehearsal.set_gravity(asked.gravity_m_s2)
    if controls.reset:
        rehearsal.reset()
    elif controls.ray is not None:
        hand.point(*controls.ray)
    hand.hold(controls.press, step.time_step_s)
    hand.push(controls.push_mm)
    hand.turn(controls.fan_deg, controls.tilt_deg, controls.roll_deg)
    return rehearsal.pose_towards(hand.pose())


def save_screenshot(picture: np.ndarray, out: Path) -> None:
    """Save a picture under the next free number, and say where."""
    number = 1 + max([int(path.stem[-3:]) for path in out.glob("screenshot-[0-9][0-9][0-9].png")], default=0)
    path = out / f"screenshot-{number:03d}.png"
    Image.fromarray(picture).save(path)
    click.echo(f"Saved {path}")


def main(arguments: list[str]) -> int:
    """Run a command line; what the user must mend is one line, and the exit status 2."""
    if not arguments or (arguments[0].startswith("-") and arguments[0] not in ("-h", "--help")):
        arguments = ["rehearse", *arguments]
    try:
        cli.main(args=arguments, prog_name="app.py", standalone_mode=False)
        return 0
    except click.ClickException as error:
        message = error.format_message()
    except (SceneError, PatientError, SamplingError, CaseError, SetupError) as error:
        message = str(error)
    except (click.Abort, KeyboardInterrupt):
        click.echo("Stopped.", err=True)
        return 130
    click.echo(f"nephron: {' '.join(message.split())}", err=True)
    return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
