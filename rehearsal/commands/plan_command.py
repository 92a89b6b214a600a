"""The command ``plan``: a sweep that covers a target with little compression, through a trocar."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import click
import numpy as np
from pydantic import Field
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
from scenes.scene import EMBEDDED
from scenes.terminal import shell_command
from ultrasound.target import Target
from version import VERSION

if TYPE_CHECKING:
    from rehearsal.resection.proposal import Proposal


class PlanOptions(QualityOptions):
    """What the user asks of a plan."""

    scene_sections: ClassVar = ("transducer", "trocar")

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
    speed_mm_s: float = Field(10.0, ge=SLOWEST_MM_S, le=FASTEST_MM_S)
    """Speed of the planned sweep."""
    trials: int = Field(24, ge=MOST_SWEEPS, le=100_000)
    """Simulated passes of the probe in the search."""
    jobs: int | None = Field(None, ge=1, le=256)
    """Processes [as many as there are processors]."""
    dask: str | None = None
    """Run on the Dask cluster of this scheduler, such as tcp://host:8786."""


@command(PlanOptions)
def plan(options: PlanOptions) -> None:
    """Plan a sweep over SCENE that covers the target, or a resection.

    SCENE is a scene file or a patient's folder. The organ deforms under the probe.
    """
    if options.resect:
        plan_resection(options)
        return
    out = options.out
    click.echo("Reading the patient.")
    loaded, anatomy = load_patient(options.scene, options.changes, options.quality)
    scene_probe, trocar = probe_of(loaded), loaded.trocar
    make_place(out, "--out")
    from rehearsal.planning.plan_search import make_plan, total_work
    from rehearsal.planning.sweep_trial import PlanningProblem, TrialWorkers
    from rehearsal.worker_processes import Workers

    target: Target = options.target or ("organ" if anatomy.tumour is None else "margin")
    problem = PlanningProblem(loaded, anatomy, scene_probe, target, options.margin_mm, trocar)
    if trocar.at_mm is None:
        click.echo("No trocar is given: all poses count as reachable.")
    with (
        Workers(options.jobs, options.dask) as workers,
        tqdm(total=total_work(options.trials, options.speed_mm_s), desc="plan", unit="trial") as bar,
    ):
        made = make_plan(TrialWorkers(problem, workers), options.speed_mm_s, options.trials, bar.update)
        bar.update(bar.total - bar.n)
    write_plan(made, out)
    click.echo(
        "\n".join(
            [*made.why, *over_limit_warning(made.sweeps[0].parts, loaded.transducer.compression_warning_mm)]
        )
    )
    click.echo(
        f"Wrote {counted(len(made.sweeps), 'sweep')} to {out}; follow the first with: "
        f"{rehearse_command_line(options)}"
    )


def plan_resection(options: PlanOptions) -> None:
    """Propose technique and line of a resection, and write them. Raises CommandError, ResectionError."""
    from rehearsal.resection.cut import hilum_of
    from rehearsal.resection.proposal import propose, why_first
    from rehearsal.resection.resection_page import draw_page, figures_of
    from rehearsal.resection.resection_plan import ResectionPlan, planned_cut

    scene, anatomy = load_patient(options.scene, options.changes, options.quality)
    if anatomy.tumour is None:
        raise CommandError("--resect: this patient has no tumour; name its label when you import the patient")
    make_place(options.out, "--out")
    about = anatomy.organ, anatomy.tumour, anatomy.parts, options.margin_mm, anatomy.labels, anatomy.tissues
    proposals = propose(*about, hilum_of(scene.attachment, np.zeros(3)))
    cuts = [planned_cut(proposal, np.zeros(3)) for proposal in proposals]
    write_plan(
        ResectionPlan(version=VERSION, anatomy=fingerprint(anatomy), margin_mm=options.margin_mm, cuts=cuts),
        options.out,
    )
    best, picture = proposals[0], options.out.with_name(f"{options.out.name}.png")
    figures = figures_of(best.cut, best.judgement, anatomy.tumour)
    draw_page(best.cut, best.judgement, anatomy.tumour, figures, picture, "Planned resection")
    warnings = [
        f"WARNING {proposal.settings.technique}: {text}"
        for proposal in proposals
        for text in proposal.judgement.warnings()
    ]
    click.echo("\n".join(filter(None, [table_of(proposals), why_first(proposals), *warnings])))
    if options.margin_mm > 0:
        click.echo("An enucleation has no margin: --margin-mm 0 plans one.")
    click.echo(
        f"Wrote {counted(len(cuts), 'cut')} to {options.out}, and a picture of the first to {picture}; "
        f"rehearse the first in a window with: {rehearse_command_line(options)}"
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
            proposal.settings.technique,
            proposal.cost_ml,
            proposal.judgement.margin.least_mm,
            proposal.judgement.parenchyma_removed_ml,
            proposal.judgement.collecting_system_opened_mm2,
            None if proposal.judgement.vessels is None else len(proposal.judgement.vessels),
        ]
        for proposal in proposals
    ]
    return tabulate(rows, heads, floatfmt=".1f", missingval=NOT_LABELLED)


def rehearse_command_line(options: PlanOptions) -> str:
    """The command line that follows a plan, with the same probe."""
    scene = [] if options.scene == EMBEDDED else [options.scene]
    probe = options.changes.get("transducer.probe")
    return shell_command("rehearse", *scene, *(["--probe", probe] if probe else []), "--plan", options.out)
