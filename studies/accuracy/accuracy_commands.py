"""The commands ``validate`` and ``calibrate``: the tissue models against bead experiments."""

from pathlib import Path
from time import perf_counter

import click
from tqdm import tqdm

from rehearsal.commands.command_line import (
    WholeRange,
    arch_option,
    make_folder,
    make_place,
    numbers,
    save_figures,
    start_taichi,
)
from rehearsal.configuration import choose_setup
from scenes.scene import model_with
from scenes.tissue import TISSUES, USUAL
from studies.accuracy.bead_case import load_case
from studies.study_options import jobs_option, number_option, out_option, preset_option


@click.command()
@click.argument("case", type=click.Path(path_type=Path))
@click.option(
    "--model", type=click.Choice(list(TISSUES)), help=f"[{USUAL}, or what the options below belong to]"
)
@preset_option
@number_option(
    "--cell", "cell_mm", low=0.5, high=20, help="neo-hookean: width of a cell in mm [the preset's]."
)
@number_option(
    "--young-kpa", low=0, high=1e6, min_open=True, help="neo-hookean: Young's modulus in kPa [the case's]."
)
@number_option("--poisson", low=0, high=0.4999, help="neo-hookean: Poisson's ratio [the case's].")
@number_option(
    "--radius", "radius_mm", low=0.5, high=20, help="shape-matching: particle radius in mm [the preset's]."
)
@number_option("--stiffness", low=0, high=1, help="shape-matching: cluster stiffness [the preset's].")
@click.option("--substeps", type=WholeRange(1, 100), help="Substeps of a time step [the preset's].")
@click.option(
    "--iterations",
    type=WholeRange(1, 1000),
    help="Iterations over the constraints in a substep [the preset's].",
)
@number_option("--time-step", "time_step_s", low=1e-4, high=0.1, help="Time step in s [1/60].")
@click.option(
    "--check",
    "checked",
    is_flag=True,
    help="Also a convergence study of time step, iterations and size; takes long.",
)
@arch_option
@click.option("--json", "json_file", type=click.Path(path_type=Path), help="Write the figures to this file.")
def validate(
    case: Path,
    model: str | None,
    quality: str,
    checked: bool,
    arch: str,
    json_file: Path | None,
    **changes: float | None,
) -> None:
    """Compare with the bead experiment of CASE, a folder.

    The organ is pressed as in the experiment, and its beads compared with the measured ones.
    """
    given = [name for name, value in changes.items() if value is not None]
    setup = choose_setup(model or model_with(given, USUAL), quality, **changes)
    loaded = load_case(case)
    make_place(json_file)
    used = start_taichi(arch)
    from studies.accuracy import convergence_study
    from studies.accuracy.bead_errors import report, summary, table
    from studies.accuracy.bead_experiment import BeadExperiment

    if checked:
        convergence_study.changes_of(setup)
    started = perf_counter()
    experiment = BeadExperiment(loaded, setup)
    built_s = perf_counter() - started
    run = experiment.run(setup)
    figures = report(experiment, setup, run)
    click.echo(f"{summary(figures, experiment.describe(setup))}\nbuilt  in {built_s:.1f} s, on {used}\n")
    click.echo(table(loaded, run.beads))
    try:
        if checked:
            figures["independence"] = []
            click.echo(f"\n{convergence_study.HEAD}")
            for row in convergence_study.moved(experiment, setup, run.beads):
                click.echo(convergence_study.line(row))
                figures["independence"].append(row)
    finally:
        if json_file is not None:
            save_figures(figures, json_file)


@click.command()
@click.argument("cases", metavar="CASE...", type=click.Path(path_type=Path), nargs=-1, required=True)
@out_option
@click.option("--radii", default="2.2,2.5,2.7,3.0,3.3", show_default=True, help="Particle radii in mm.")
@click.option(
    "--hold-out",
    type=click.Choice(["stages", "beads", "cases"]),
    default="stages",
    show_default=True,
    help="Data that is not fitted but judges the fit: each case's deepest stage, every third bead, or the last CASE.",
)
@number_option(
    "--grid",
    "spacing",
    low=0.01,
    high=0.5,
    default=0.05,
    help="Spacing of the stiffnesses tried; around the best it is a fifth of that.",
)
@click.option(
    "--search",
    "generations",
    type=WholeRange(1, 1000),
    help="Instead of the stiffness alone, search stiffness, over-relaxation and iterations for this many generations.",
)
@jobs_option
@click.option("--dask", "address", help="Run on the Dask cluster of this scheduler, such as tcp://host:8786.")
def calibrate(
    cases: tuple[Path, ...],
    out: Path,
    radii: str,
    hold_out: str,
    spacing: float,
    generations: int | None,
    jobs: int | None,
    address: str | None,
) -> None:
    """Fit shape matching to bead experiments, as the paper did.

    Every stiffness is tried for each particle radius, on the folders CASE..., and judged on held-out data.
    """
    radii_mm = numbers(radii, "--radii", 0.5, 20)
    loaded = [load_case(case) for case in cases]
    make_folder(out)
    from studies.accuracy import calibration, calibration_results, case_workers

    split = calibration.split_of(loaded, hold_out)
    with case_workers.dask_workers(address) if address else case_workers.local_workers(jobs) as work:
        if generations:
            count = calibration.search_count(len(loaded), len(radii_mm), generations)
        else:
            count = calibration.exhaustive_count(len(loaded), len(radii_mm), spacing)
        with tqdm(total=count, desc="calibrate", unit="press") as bar:
            found = calibration.Calibration(loaded, split, work, bar.update)
            if generations:
                found.search(radii_mm, generations)
            else:
                found.exhaustive(radii_mm, spacing)
            bar.total = bar.n
    tables = calibration_results.tables_of(found)
    for table in tables:
        table.write_csv(out)
        table.write_png(out)
        click.echo(f"\n{table.text()}")
    calibration_results.write_calibration(found, tables, out / "calibration.json")
    calibration_results.write_figure5(found, out / "figure5.png")
    if generations:
        calibration_results.write_search(found, out / "search.png")
    else:
        calibration_results.write_figure4(found, out / "figure4.png")
    click.echo(
        f"\n{calibration_results.summary_of(found)}\nWrote tables, figures and calibration.json to {out}"
    )
