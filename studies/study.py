"""A study: its command, its options, and the files that it leaves."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from tqdm import tqdm

from rehearsal.commands.command_line import (
    NumberRange,
    WholeRange,
    arch_option,
    load_patient,
    make_folder,
    start_taichi,
)
from rehearsal.result_files import save_figure, write_csv, write_json
from scenes.scene import Scene
from scenes.tissue import QUALITIES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from rehearsal.worker_processes import Workers
    from scenes.anatomy import LoadedAnatomy

DPI = 130


@dataclass(frozen=True)
class Results:
    """What a study has measured: its report in JSON, the text for the terminal, rows for CSV, a figure."""

    report: dict[str, Any]
    text: str
    rows: list[dict[str, Any]] | None = None
    figure: "Figure | None" = None


@dataclass(frozen=True)
class Study:
    """A study that runs: its name, its folder and, where it has them, the backend, the loaded SCENE, and what
    --jobs and --dask say.
    """

    name: str
    out: Path
    backend: str = ""
    loaded: "tuple[Scene, LoadedAnatomy] | None" = None
    jobs: int | None = None
    dask: str | None = None

    @property
    def scene(self) -> "tuple[Scene, LoadedAnatomy]":
        """The SCENE of a study that has this argument, and its anatomy."""
        assert self.loaded is not None
        return self.loaded

    def workers(self) -> "Workers":
        """The processes of --jobs or --dask; a context manager."""
        # Not of each study.
        from rehearsal.worker_processes import Workers

        return Workers(self.jobs, self.dask)

    def progress(self, total: int, unit: str, work: Iterable[Any] | None = None) -> tqdm:
        """A progress bar: a context manager, or what iterates over the work."""
        return tqdm(work, self.name, total, unit=unit)


Option = Callable[[Any], Any]
# The backend of a study that the user chooses.
CHOSEN = "chosen"


def study_command(
    name: str,
    *options: Option,
    scene: Path | None = None,
    arch: str | None = None,
    has_workers: bool = False,
) -> Callable[[Callable[..., Results | None]], click.Command]:
    """Make a function of a ``Study`` and the values of options a command, which writes its results, unless
    the function has written them.

    ``scene`` is the default of the argument SCENE, a scene file or a patient's folder; ``arch`` the backend
    that Taichi is started on, CHOSEN where the user chooses. The folder of --out is made before all else.
    """
    shared = [
        *([_scene_argument(scene)] if scene else []),
        _out_option,
        *options,
        *(_worker_options if has_workers else []),
        *([arch_option] if arch == CHOSEN else []),
    ]

    def made(measure: Callable[..., Results | None]) -> click.Command:
        def run(out: Path, jobs: int | None = None, dask: str | None = None, **values: Any) -> None:
            make_folder(out)
            loaded = load_patient(values.pop("scene")) if scene else None
            wanted = values.pop("arch", arch)
            backend = start_taichi(wanted) if wanted else ""
            results = measure(Study(name, out, backend, loaded, jobs, dask), **values)
            if results is not None:
                write_results(out, name, results)

        command: Callable[..., None] = run
        for option in reversed(shared):
            command = option(command)
        return click.command(name, help=measure.__doc__)(command)

    return made


def write_results(out: Path, name: str, results: Results) -> None:
    """Write name.json and, if there are any, name.csv and name.png; print the text and their names."""
    files = [f"{name}.json"]
    write_json(results.report, out / files[0])
    if results.rows is not None:
        files.append(f"{name}.csv")
        write_csv(results.rows, out / files[-1])
    if results.figure is not None:
        files.append(f"{name}.png")
        save_figure(results.figure, out / files[-1], dpi=DPI)
    click.echo(f"\n{results.text}\n\nWrote {', '.join(files)} to {out}")


_out_option = click.option(
    "--out", type=click.Path(path_type=Path), required=True, help="Folder for tables and figures."
)
_worker_options = (
    click.option("--jobs", type=WholeRange(1, 1024), help="Number of processes [one for each processor]."),
    click.option(
        "--dask",
        metavar="ADDRESS",
        help="Run on the Dask cluster of this scheduler, such as tcp://host:8786.",
    ),
)
preset_option = click.option(
    "--quality",
    type=click.Choice(QUALITIES),
    default="balanced",
    show_default=True,
    help="A preset of the model; other options change single values of it.",
)


def _scene_argument(default: Path) -> Option:
    return click.argument("scene", type=click.Path(path_type=Path), default=default, required=False)


def paths_argument(name: str, metavar: str | None = None, **options: Any) -> Option:
    """An argument of several files or folders."""
    kind = click.Path(path_type=Path, readable=False)
    return click.argument(name, metavar=metavar, type=kind, nargs=-1, **options)


def quick_option(help: str) -> Option:
    """The option --quick."""
    return click.option("--quick", is_flag=True, help=help)


def number_option(
    *names: str, low: float, high: float, help: str, default: float | None = None, **bounds: bool
) -> Option:
    """An option for a number from low to high; ``bounds`` are ``min_open`` and ``max_open``."""
    range = NumberRange(low, high, **bounds)
    return click.option(*names, type=range, default=default, show_default=default is not None, help=help)


def whole_option(name: str, low: int, high: int, default: int, help: str | None = None) -> Option:
    """An option for an integer from low to high."""
    return click.option(name, type=WholeRange(low, high), default=default, show_default=True, help=help)
