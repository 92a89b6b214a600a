"""The command ``plan``: a sweep that covers a target with little compression, through a trocar."""

from pathlib import Path

import click
from pydantic import ValidationError
from tqdm import tqdm

from rehearsal.commands.command_line import (
    CommandError,
    Number,
    NumberRange,
    WholeRange,
    make_folder,
    quality_option,
)
from rehearsal.configuration import probe_of, with_quality
from rehearsal.planning.plan_file import FASTEST_MM_S, MOST_MARGIN_MM, MOST_SWEEPS, SLOWEST_MM_S, write_plan
from scenes.anatomy import load_anatomy
from scenes.scene import EMBEDDED, Trocar, load_scene, scene_file, with_options
from scenes.terminal import shell_command
from ultrasound.target import TARGETS, Target


@click.command()
@click.argument("scene", type=click.Path(path_type=Path), default=EMBEDDED, required=False)
@click.option("--out", type=click.Path(path_type=Path), required=True, help="File for the plan, JSON.")
@click.option(
    "--target",
    type=click.Choice(TARGETS),
    help="What the sweep covers: the tumour, the tumour with its margin, or the whole organ [margin, or organ without a tumour].",
)
@click.option(
    "--margin-mm",
    type=NumberRange(0, MOST_MARGIN_MM),
    default=5.0,
    show_default=True,
    help="Width of the margin around the tumour.",
)
@click.option(
    "--trocar", nargs=3, type=Number(), help="Position of the trocar: x y z, LPS, mm [the scene's]."
)
@click.option(
    "--cone-deg", type=Number(), help="Largest angle of the shaft to the axis of the trocar [the scene's]."
)
@click.option("--wrist-deg", type=Number(), help="Largest angle of the probe to the shaft [the scene's].")
@click.option("--probe", help="Probe, by its name or as a file [the scene's].")
@quality_option
@click.option(
    "--speed-mm-s",
    type=NumberRange(SLOWEST_MM_S, FASTEST_MM_S),
    default=10.0,
    show_default=True,
    help="Speed of the planned sweep.",
)
@click.option(
    "--trials",
    type=WholeRange(MOST_SWEEPS, 100_000),
    default=96,
    show_default=True,
    help="Simulated sweeps in the search.",
)
@click.option("--jobs", type=WholeRange(1, 256), help="Processes [as many as there are processors].")
def plan(
    scene: Path,
    out: Path,
    target: Target | None,
    margin_mm: float,
    trocar: tuple[float, float, float] | None,
    cone_deg: float | None,
    wrist_deg: float | None,
    probe: str | None,
    quality: str | None,
    speed_mm_s: float,
    trials: int,
    jobs: int | None,
) -> None:
    """Plan a sweep over SCENE that covers the target.

    SCENE is a scene file or a patient's folder. The organ deforms under the probe.
    """
    path = scene_file(scene)
    loaded = with_quality(with_options(load_scene(path), {"transducer.probe": probe}), quality)
    port = trocar_of(loaded.trocar, trocar, cone_deg, wrist_deg)
    anatomy = load_anatomy(loaded, path.parent)
    scene_probe = probe_of(loaded)
    make_folder(out.parent)
    if out.is_dir():
        raise CommandError(f"{out}: is a folder; name a file after --out")
    from rehearsal.planning.plan_search import make_plan, total_work
    from rehearsal.planning.sweep_trial import PlanningProblem
    from rehearsal.planning.trial_workers import TrialWorkers

    chosen: Target = target or ("organ" if anatomy.tumour is None else "margin")
    problem = PlanningProblem(loaded, anatomy, scene_probe, chosen, margin_mm, port)
    if port.at_mm is None:
        click.echo("No trocar is given: all poses count as reachable.")
    with (
        TrialWorkers(problem, jobs) as workers,
        tqdm(total=total_work(trials, speed_mm_s), desc="plan", unit="trial") as bar,
    ):
        made = make_plan(workers, speed_mm_s, trials, bar.update)
        bar.update(bar.total - bar.n)
    write_plan(made, out)
    click.echo("\n".join(made.why))
    click.echo(
        f"Wrote {len(made.sweeps)} sweeps to {out}; follow the first with: {rehearse_command_line(scene, out, probe)}"
    )


def rehearse_command_line(scene: Path, plan_file: Path, probe: str | None) -> str:
    """The command line that follows a plan, with the same probe."""
    scene_argument = [] if scene == EMBEDDED else [scene]
    probe_option = [] if probe is None else ["--probe", probe]
    return shell_command("rehearse", *scene_argument, *probe_option, "--plan", plan_file)


def trocar_of(
    scenes: Trocar, at_mm: tuple[float, float, float] | None, cone_deg: float | None, wrist_deg: float | None
) -> Trocar:
    """The scene's trocar with the options of the command line. Raises CommandError."""
    given = {"at_mm": at_mm, "cone_deg": cone_deg, "wrist_deg": wrist_deg}
    values = scenes.model_dump() | {name: value for name, value in given.items() if value is not None}
    try:
        return Trocar.model_validate(values)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        option = str(first["loc"][0]).replace("at_mm", "trocar").replace("_", "-")
        raise CommandError(f"--{option} = {first['input']!r}: {first['msg'].lower()}") from None
