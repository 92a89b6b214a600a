"""The command ``plan``: a sweep that covers a target with little compression, through a trocar."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click
import numpy as np
from pydantic import Field, ValidationError
from tabulate import tabulate
from tqdm import tqdm

from rehearsal.commands.command_line import (
    ARGUMENT,
    CommandError,
    QualityOptions,
    command,
    load_patient,
    make_place,
)
from rehearsal.configuration import probe_of
from rehearsal.planning.plan_file import FASTEST_MM_S, MOST_MARGIN_MM, MOST_SWEEPS, SLOWEST_MM_S, write_plan
from rehearsal.result_files import counted
from scenes.anatomy import fingerprint
from scenes.scene import EMBEDDED, Trocar
from scenes.terminal import shell_command
from ultrasound.target import Target
from version import VERSION

if TYPE_CHECKING:
    from rehearsal.resection.proposal import Proposal


class PlanOptions(QualityOptions):
    """What the user asks of a plan."""

    scene: Annotated[Path, ARGUMENT] = EMBEDDED
    out: Path
    """File for the plan, JSON."""
    resect: bool = False
    """Plan a resection of the tumour with the margin, instead of a sweep of the probe."""
    target: Target | None = None
    """What the sweep covers: the tumour, the tumour with its margin, or the whole organ [margin, or organ
    without a tumour].
    """
    margin_mm: float = Field(5.0, ge=0, le=MOST_MARGIN_MM)
    """Width of the margin around the tumour."""
    trocar: tuple[float, float, float] | None = None
    """Position of the trocar: x y z, LPS, mm [the scene's]."""
    cone_deg: float | None = None
    """Largest angle of the shaft to the axis of the trocar [the scene's]."""
    wrist_deg: float | None = None
    """Largest angle of the probe to the shaft [the scene's]."""
    probe: str | None = None
    """Probe, by its name or as a file [the scene's]."""
    speed_mm_s: float = Field(10.0, ge=SLOWEST_MM_S, le=FASTEST_MM_S)
    """Speed of the planned sweep."""
    trials: int = Field(24, ge=MOST_SWEEPS, le=100_000)
    """Simulated passes of the probe in the search."""
    jobs: int | None = Field(None, ge=1, le=256)
    """Processes [as many as there are processors]."""
    dask: str | None = None
    """Run on the Dask cluster of this scheduler, such as tcp://host:8786."""


@command(PlanOptions)
def plan(asked: PlanOptions) -> None:
    """Plan a sweep over SCENE that covers the target, or a resection.

    SCENE is a scene file or a patient's folder. The organ deforms under the probe.
    """
    if asked.resect:
        plan_resection(asked)
        return
    out = asked.out
    click.echo("Reading the patient.")
    loaded, anatomy = load_patient(asked.scene, asked.changes, asked.quality)
    port, scene_probe = trocar_of(loaded.trocar, asked), probe_of(loaded)
    make_place(out, "--out")
    from rehearsal.planning.plan_search import make_plan, total_work
    from rehearsal.planning.sweep_trial import PlanningProblem, TrialWorkers
    from rehearsal.worker_processes import Workers

    target: Target = asked.target or ("organ" if anatomy.tumour is None else "margin")
    problem = PlanningProblem(loaded, anatomy, scene_probe, target, asked.margin_mm, port)
    if port.at_mm is None:
        click.echo("No trocar is given: all poses count as reachable.")
    with (
        Workers(asked.jobs, asked.dask) as workers,
        tqdm(total=total_work(asked.trials, asked.speed_mm_s), desc="plan", unit="trial") as bar,
    ):
        made = make_plan(TrialWorkers(problem, workers), asked.speed_mm_s, asked.trials, bar.update)
        bar.update(bar.total - bar.n)
    write_plan(made, out)
    click.echo(
        "\n".join(
            [*made.why, *over_limit_warning(made.sweeps[0].parts, loaded.transducer.compression_warning_mm)]
        )
    )
    click.echo(
        f"Wrote {counted(len(made.sweeps), 'sweep')} to {out}; follow the first with: "
        f"{rehearse_command_line(asked.scene, out, asked.probe)}"
    )


def plan_resection(asked: PlanOptions) -> None:
    """Propose technique and line of a resection, and write them. Raises CommandError, ResectionError."""
    from rehearsal.resection.cut import hilum_of
    from rehearsal.resection.proposal import propose, why_first
    from rehearsal.resection.resection_page import draw_page, figures_of
    from rehearsal.resection.resection_plan import ResectionPlan, planned_cut

    scene, anatomy = load_patient(asked.scene, asked.changes, asked.quality)
    if anatomy.tumour is None:
        raise CommandError("--resect: this patient has no tumour; name its label when you import the patient")
    make_place(asked.out, "--out")
    about = anatomy.organ, anatomy.tumour, anatomy.parts, asked.margin_mm, anatomy.labels, anatomy.tissues
    proposals = propose(*about, hilum_of(scene.attachment, np.zeros(3)))
    cuts = [planned_cut(proposal, np.zeros(3)) for proposal in proposals]
    write_plan(
        ResectionPlan(version=VERSION, anatomy=fingerprint(anatomy), margin_mm=asked.margin_mm, cuts=cuts),
        asked.out,
    )
    best, picture = proposals[0], asked.out.with_name(f"{asked.out.name}.png")
    figures = figures_of(best.cut, best.judgement, anatomy.tumour)
    draw_page(best.cut, best.judgement, anatomy.tumour, figures, picture, "Planned resection")
    warnings = [
        f"WARNING {each.settings.technique}: {text}"
        for each in proposals
        for text in each.judgement.warnings()
    ]
    click.echo("\n".join(filter(None, [table_of(proposals), why_first(proposals), *warnings])))
    if asked.margin_mm > 0:
        click.echo("An enucleation has no margin: --margin-mm 0 plans one.")
    click.echo(
        f"Wrote {counted(len(cuts), 'cut')} to {asked.out}, and a picture of the first to {picture}; "
        f"rehearse the first in a window with: {rehearse_command_line(asked.scene, asked.out, asked.probe)}"
    )


def over_limit_warning(parts: dict[str, float], limit_mm: float) -> list[str]:
    """A warning where a sweep compresses the tissue by more than the scene's limit."""
    if parts["compression_max_mm"] <= limit_mm:
        return []
    return [
        f"WARNING the first sweep compresses the tissue by up to {parts['compression_max_mm']:.1f} mm, "
        f"the limit is {limit_mm:g} mm "
        f"(exceeded at {100 * parts['over_limit']:.0f} % of its poses)"
    ]


def table_of(proposals: list["Proposal"]) -> str:
    """The proposals with their main figures, for the terminal."""
    from rehearsal.resection.judgement import NOT_LABELLED

    heads = [
        "technique",
        "cost, points",
        "least margin, mm",
        "parenchyma, ml",
        "collecting system, mm2",
        "vessels",
    ]
    rows = [
        [
            each.settings.technique,
            each.cost_ml,
            each.judgement.margin.least_mm,
            each.judgement.parenchyma_removed_ml,
            each.judgement.collecting_system_opened_mm2,
            None if each.judgement.vessels is None else len(each.judgement.vessels),
        ]
        for each in proposals
    ]
    return tabulate(rows, heads, floatfmt=".1f", missingval=NOT_LABELLED)


def rehearse_command_line(scene: Path, plan_file: Path, probe: str | None) -> str:
    """The command line that follows a plan, with the same probe."""
    scene_argument = [] if scene == EMBEDDED else [scene]
    probe_option = [] if probe is None else ["--probe", probe]
    return shell_command("rehearse", *scene_argument, *probe_option, "--plan", plan_file)


def trocar_of(scenes: Trocar, asked: PlanOptions) -> Trocar:
    """The scene's trocar with the options of the command line. Raises CommandError."""
    given = {"at_mm": asked.trocar, "cone_deg": asked.cone_deg, "wrist_deg": asked.wrist_deg}
    values = scenes.model_dump() | {name: value for name, value in given.items() if value is not None}
    try:
        return Trocar.model_validate(values)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        option = str(first["loc"][0]).replace("at_mm", "trocar").replace("_", "-")
        raise CommandError(f"--{option} = {first['input']!r}: {first['msg'].lower()}") from None
