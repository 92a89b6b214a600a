"""The command ``plan``: where to move the probe so that a target is seen, with little pressing and through a trocar."""

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
    help="What must be seen: the tumour, the tumour with its margin, or the whole organ [margin, or organ without a tumour].",
)
@click.option(
    "--margin-mm",
    type=NumberRange(0, MOST_MARGIN_MM),
    default=5.0,
    show_default=True,
    help="How much around the tumour is to be seen.",
)
@click.option(
    "--trocar", nargs=3, type=Number(), help="Where the instrument comes in: x y z, LPS, mm [the scene's]."
)
@click.option(
    "--cone-deg", type=Number(), help="How far the shaft may lean from its middle direction [the scene's]."
)
@click.option(
    "--wrist-deg", type=Number(), help="How far the probe may look aside from the shaft [the scene's]."
)
@click.option("--probe", help="Probe, by its name or as a file [the scene's].")
@quality_option
@click.option(
    "--speed-mm-s",
    type=NumberRange(SLOWEST_MM_S, FASTEST_MM_S),
    default=10.0,
    show_default=True,
    help="How fast the sweep will be gone.",
)
@click.option(
    "--trials",
    type=WholeRange(MOST_SWEEPS, 100_000),
    default=96,
    show_default=True,
    help="Scans that the search may make.",
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
    """Plan a sweep over SCENE that shows the target.

    SCENE is a scene file or a patient's folder; the plan's poses show the target on the deforming organ.
    """
    path = scene_file(scene)
    loaded = with_quality(with_options(load_scene(path), {"transducer.probe": probe}), quality)
    port = trocar_of(loaded.trocar, trocar, cone_deg, wrist_deg)
    anatomy = load_anatomy(loaded, path.parent)
    held = probe_of(loaded)
    make_folder(out.parent)
    if out.is_dir():
        raise CommandError(f"{out}: is a folder; name a file after --out")
    from rehearsal.planning.make_plan import make_plan
    from rehearsal.planning.search import length_of
    from rehearsal.planning.trial_workers import Problem, workers

    aim: Target = target or ("organ" if anatomy.tumour is None else "margin")
    problem = Problem(loaded, anatomy, held, aim, margin_mm, port)
    if port.at_mm is None:
        click.echo("No trocar is given: every way in counts as free.")
    with (
        workers(problem, jobs) as crew,
        tqdm(total=length_of(trials, speed_mm_s), desc="plan", unit="trial") as bar,
    ):
        made = make_plan(problem, crew, speed_mm_s, trials, bar.update)
        bar.update(bar.total - bar.n)
    write_plan(made, out)
    click.echo("\n".join(made.why))
    click.echo(
        f"Wrote {len(made.sweeps)} sweeps to {out}; follow the first with: {following(scene, out, probe)}"
    )


def following(scene: Path, plan_file: Path, probe: str | None) -> str:
    """The command line that follows a plan; it needs the probe that was planned for."""
    named = [] if scene == EMBEDDED else [scene]
    held = [] if probe is None else ["--probe", probe]
    return shell_command("rehearse", *named, *held, "--plan", plan_file)


def trocar_of(
    scenes: Trocar, at_mm: tuple[float, float, float] | None, cone_deg: float | None, wrist_deg: float | None
) -> Trocar:
    """The scene's trocar with what the command line changes. Raises CommandError."""
    given = {"at_mm": at_mm, "cone_deg": cone_deg, "wrist_deg": wrist_deg}
    values = scenes.model_dump() | {name: value for name, value in given.items() if value is not None}
    try:
        return Trocar.model_validate(values)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        option = str(first["loc"][0]).replace("at_mm", "trocar").replace("_", "-")
        raise CommandError(f"--{option} = {first['input']!r}: {first['msg'].lower()}") from None
