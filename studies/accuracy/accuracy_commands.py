"""The commands ``validate`` and ``calibrate``: the tissue models against bead experiments."""

from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Annotated, Literal

import click
import numpy as np
from pydantic import Field
from tqdm import tqdm

from rehearsal.commands.command_line import (
    ARGUMENT,
    ArchOptions,
    CommandOptions,
    command,
    make_folder,
    make_place,
    numbers,
    save_figures,
    start_taichi,
)
from rehearsal.configuration import choose_setup
from rehearsal.worker_processes import Workers
from scenes.folder_files import without_system_files
from scenes.scene import model_with
from scenes.tissue import QUALITIES, TISSUES, USUAL
from studies.accuracy.bead_case import load_case


class ValidateOptions(ArchOptions):
    """What the user asks of a validation."""

    case: Annotated[Path, ARGUMENT]
    model: Annotated[str | None, click.Choice(list(TISSUES))] = None
    """[neo-hookean, or what the options below belong to]"""
    quality: Annotated[str, click.Choice(QUALITIES)] = "balanced"
    """A preset of the model; other options change single values of it."""
    cell_mm: Annotated[float | None, "--cell"] = Field(None, ge=0.5, le=20)
    """neo-hookean: width of a cell in mm [the preset's]."""
    young_kpa: float | None = Field(None, gt=0, le=1e6)
    """neo-hookean: Young's modulus in kPa [the case's]."""
    poisson: float | None = Field(None, ge=0, le=0.4999)
    """neo-hookean: Poisson's ratio [the case's]."""
    radius_mm: Annotated[float | None, "--radius"] = Field(None, ge=0.5, le=20)
    """shape-matching: particle radius in mm [the preset's]."""
    stiffness: float | None = Field(None, ge=0, le=1)
    """shape-matching: cluster stiffness [the preset's]."""
    substeps: int | None = Field(None, ge=1, le=100)
    """Substeps of a time step [the preset's]."""
    iterations: int | None = Field(None, ge=1, le=1000)
    """Iterations over the constraints in a substep [the preset's]."""
    time_step_s: Annotated[float | None, "--time-step"] = Field(None, ge=1e-4, le=0.1)
    """Time step in s [1/60]."""
    check: bool = False
    """Also a convergence study of time step, iterations and size; takes long."""
    json_file: Annotated[Path | None, "--json"] = None
    """Write the figures to this file."""


@command(ValidateOptions)
def validate(options: ValidateOptions) -> None:
    """Compare with the bead experiment of CASE, a folder.

    The organ is pressed as in the experiment, and its beads compared with the measured ones.
    """
    changes = options.model_dump(
        exclude={"case", "model", "quality", "check", "arch", "json_file", "changes"}, exclude_none=True
    )
    setup = choose_setup(options.model or model_with(changes, USUAL), options.quality, **changes)
    loaded = load_case(options.case)
    make_place(options.json_file)
    used = start_taichi(options.arch)
    from studies.accuracy import convergence_study
    from studies.accuracy.bead_errors import force_table, report, summary, table
    from studies.accuracy.bead_experiment import BeadExperiment

    if options.check:
        convergence_study.changes_of(setup)
    started = perf_counter()
    experiment = BeadExperiment(loaded, setup)
    built_s = perf_counter() - started
    run = experiment.run(setup)
    figures = report(experiment, setup, run)
    click.echo(f"{summary(figures, experiment.describe(setup))}\nbuilt  in {built_s:.1f} s, on {used}\n")
    click.echo(table(loaded, run.beads))
    if np.isfinite(run.force_n).all():
        click.echo(f"\n{force_table(loaded, run)}")
    try:
        if options.check:
            figures["independence"] = []
            click.echo(f"\n{convergence_study.HEAD}")
            for row in convergence_study.moved(experiment, setup, run.beads):
                click.echo(convergence_study.line(row))
                figures["independence"].append(row)
    finally:
        if options.json_file is not None:
            save_figures(figures, options.json_file)


class CalibrateOptions(CommandOptions):
    """What the user asks of a calibration."""

    case: Annotated[tuple[Path, ...], ARGUMENT]
    out: Path
    """Folder for tables and figures."""
    model: Annotated[str, click.Choice(list(TISSUES))] = "shape-matching"
    """neo-hookean: estimate moduli and friction; the options for radii, hold-out, grid and search are of
    shape-matching.
    """
    quality: Annotated[str, click.Choice(QUALITIES)] = "balanced"
    """neo-hookean: a preset."""
    radii: str = "2.2,2.5,2.7,3.0,3.3"
    """Particle radii in mm."""
    hold_out: Literal["stages", "beads", "cases"] = "stages"
    """Data that is not fitted but judges the fit: each case's deepest stage, every third bead, or the last
    CASE.
    """
    grid: float = Field(0.05, ge=0.01, le=0.5)
    """Spacing of the stiffnesses tried; around the best it is a fifth of that."""
    search: int | None = Field(None, ge=1, le=1000)
    """Instead of the stiffness alone, search stiffness, over-relaxation and iterations for this many
    generations.
    """
    jobs: int | None = Field(None, ge=1, le=1024)
    """Processes on this machine [one a processor]."""
    dask: str | None = None
    """Run on the Dask cluster of this scheduler, such as tcp://host:8786."""


@command(CalibrateOptions)
def calibrate(options: CalibrateOptions) -> None:
    """Fit a tissue model to bead experiments.

    The experiments are the folders CASE.
    Shape matching as the paper did: every stiffness is tried for each particle radius, and judged on held-out
    data. neo-hookean: moduli, Poisson's ratio and friction by least squares, from beads and, where the case
    has them, forces on the probe.
    """
    options = options.model_copy(update={"case": without_system_files(options.case) or options.case})
    if options.model == USUAL:
        _fit_material(options)
    else:
        _fit_shape_matching(options)


def _fit_material(options: CalibrateOptions) -> None:
    loaded = [load_case(case) for case in options.case]
    make_folder(options.out)
    from studies.accuracy import material_fit

    setup = choose_setup(options.model, options.quality)
    with Workers(options.jobs, options.dask) as workers, tqdm(desc="calibrate", unit="press") as bar:
        fit = material_fit.fitted(loaded, setup, workers, bar.update)
    figures = fit.report()
    save_figures(figures, options.out / "material.json")
    click.echo(f"\n{material_fit.table(figures)}")


def _fit_shape_matching(options: CalibrateOptions) -> None:
    out, generations, spacing = options.out, options.search, options.grid
    radii_mm = numbers(options.radii, "--radii", 0.5, 20)
    loaded = [load_case(case) for case in options.case]
    make_folder(out)
    from studies.accuracy import calibration, calibration_results, case_workers

    split, sizes = calibration.split_of(loaded, options.hold_out), (len(loaded), len(radii_mm))
    if generations:
        count = calibration.search_count(*sizes, generations)
    else:
        count = calibration.exhaustive_count(*sizes, spacing)
    with (
        Workers(options.jobs, options.dask) as workers,
        tqdm(total=count, desc="calibrate", unit="press") as bar,
    ):
        evaluate = partial(workers.map, case_workers.evaluate)
        fit = calibration.Calibration(loaded, split, evaluate, bar.update)
        if generations:
            fit.search(radii_mm, generations)
        else:
            fit.exhaustive(radii_mm, spacing)
        bar.total = bar.n
    calibration_results.write(fit, out, searched=bool(generations))
