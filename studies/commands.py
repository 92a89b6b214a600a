"""The commands that measure how true a model is: ``validate`` and ``calibrate``."""

import json
import os
from pathlib import Path
from time import perf_counter

import click

from studies.case import load_case
from studies.setup import PRESETS, QUALITIES, choose_setup


class Fault(click.ClickException):
    """What the user must know, in one line."""


def start_taichi(arch: str) -> str:
    """Initialise Taichi where the user wants it; the backend it is. Raises Fault."""
    from sim.device import NoDevice, start

    try:
        return start(arch)
    except NoDevice as error:
        raise Fault(f"--arch {arch}: {error}") from None


def make_folder(folder: Path, option: str = "--out") -> None:
    """Make sure that a folder can be written to before time is spent on what goes there. Raises Fault."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise Fault(
            f"{folder}: cannot be made a folder for results ({error.strerror}); choose another {option}"
        ) from None
    if not os.access(folder, os.W_OK):
        raise Fault(f"{folder}: cannot be written to; choose another {option}")


arch_option = click.option(
    "--arch",
    type=click.Choice(["auto", "cuda", "vulkan", "cpu"]),
    default="auto",
    show_default=True,
    help="Where to compute; auto is CUDA where there is one, else the CPU.",
)


@click.command()
@click.argument("case", type=click.Path(path_type=Path))
@click.option("--model", type=click.Choice(list(PRESETS)), default="shape-matching", show_default=True)
@click.option(
    "--quality",
    type=click.Choice(QUALITIES),
    default="balanced",
    show_default=True,
    help="A preset of the model, the same for every case; the options below change single values of it.",
)
@click.option("--radius", "radius_mm", type=click.FloatRange(0.5, 20), help="Particle radius in mm.")
@click.option("--stiffness", type=click.FloatRange(0, 1), help="Cluster stiffness.")
@click.option("--substeps", type=click.IntRange(1, 1000), help="Substeps of a time step.")
@click.option("--iterations", type=click.IntRange(1, 1000), help="Passes over the constraints in a substep.")
@click.option(
    "--young-kpa",
    type=click.FloatRange(0, 1e6, min_open=True),
    help="Young's modulus in kPa [the case's].",
)
@click.option("--poisson", type=click.FloatRange(0, 0.5, max_open=True), help="Poisson's ratio [the case's].")
@arch_option
@click.option("--json", "json_file", type=click.Path(path_type=Path), help="Write the figures to this file.")
def validate(
    case: Path, model: str, quality: str, arch: str, json_file: Path | None, **changes: float | None
) -> None:
    """Press the organ of CASE, a folder with a bead experiment, and compare the beads with the measured ones."""
    setup = choose_setup(model, quality, **changes)
    loaded = load_case(case)
    if json_file is not None:
        make_folder(json_file.parent, "--json")
        if json_file.is_dir():
            raise Fault(f"{json_file}: is a folder; name a file after --json")
    used = start_taichi(arch)
    from studies.accuracy import report, summary, table
    from studies.experiment import Experiment

    started = perf_counter()
    experiment = Experiment(loaded, setup)
    built_s = perf_counter() - started
    run = experiment.run(setup)
    figures = report(experiment, setup, run)
    click.echo(f"{summary(figures, setup)} on {used}, built in {built_s:.1f} s\n")
    click.echo(table(loaded, run.beads))
    if json_file is not None:
        json_file.write_text(json.dumps(figures, indent=2) + "\n", "utf-8")
        click.echo(f"\nWrote {json_file}")
