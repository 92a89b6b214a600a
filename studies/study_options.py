"""Arguments and options that several commands of the studies share."""

from pathlib import Path
from typing import Any

import click

from rehearsal.commands.command_line import NumberRange, WholeRange, load_patient, make_folder, start_taichi
from rehearsal.planning.plan_file import MOST_SWEEPS
from scenes.anatomy import LoadedAnatomy
from scenes.scene import Scene
from scenes.tissue import QUALITIES

out_option = click.option(
    "--out", type=click.Path(path_type=Path), required=True, help="Folder for tables and figures."
)
jobs_option = click.option(
    "--jobs", type=WholeRange(1, 1024), help="Number of processes [one for each processor]."
)
dask_option = click.option(
    "--dask", metavar="ADDRESS", help="Run on the Dask cluster of this scheduler, such as tcp://host:8786."
)
trials_option = click.option(
    "--trials",
    type=WholeRange(MOST_SWEEPS, 100_000),
    default=24,
    show_default=True,
    help="Simulated passes of the probe in the search for a plan.",
)
preset_option = click.option(
    "--quality",
    type=click.Choice(QUALITIES),
    default="balanced",
    show_default=True,
    help="A preset of the model; other options change single values of it.",
)


def scene_argument(default: Path) -> Any:
    """The argument SCENE of a command: a scene file or a patient's folder."""
    return click.argument("scene", type=click.Path(path_type=Path), default=default, required=False)


def number_option(
    *names: str, low: float, high: float, help: str, default: float | None = None, **bounds: bool
) -> Any:
    """An option for a number from low to high; ``bounds`` are ``min_open`` and ``max_open``."""
    range = NumberRange(low, high, **bounds)
    return click.option(*names, type=range, default=default, show_default=default is not None, help=help)


def open_study(out: Path, scene: Path, arch: str) -> tuple[Scene, LoadedAnatomy, str]:
    """Create the folder, load the scene and start Taichi; the scene, its anatomy and the backend's name."""
    make_folder(out)
    loaded, anatomy = load_patient(scene)
    return loaded, anatomy, start_taichi(arch)
