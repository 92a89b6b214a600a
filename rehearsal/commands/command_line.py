"""Shared by the commands: errors, types of options, scenes, output folders, the start of Taichi."""

import math
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import click

from rehearsal.result_files import write_json
from scenes.anatomy import LoadedAnatomy, load_anatomy
from scenes.atomic_files import check_writable
from scenes.scene import Scene, load_scene, scene_file
from scenes.tissue import QUALITIES
from ultrasound.probe import DETAIL_LEVELS, MODES

# Exit status after Ctrl-C.
STOPPED = 130


class CommandError(click.ClickException):
    """An error of the command line, in one line."""


class Number(click.types.FloatParamType):
    """A number, shown as such in the help."""

    name = "number"


class WholeRange(click.IntRange):
    """An integer within a range, shown as such in the help."""

    name = "integer"


class NumberRange(click.FloatRange):
    """A number within a range; click's own range accepts nan."""

    name = "number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is no number", param, ctx)
        return number


def start_taichi(arch: str) -> str:
    """Initialise Taichi on the chosen backend and return its name. Raises CommandError."""
    from sim.device import NoDevice, start

    try:
        return start(arch)
    except NoDevice as error:
        raise CommandError(f"--arch {arch}: {error}") from None


def make_folder(folder: Path, option: str = "--out") -> None:
    """Create a folder and check that it is writable before time is spent. Raises CommandError.

    If the command ends without output, the folder is removed.
    """
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    if context := click.get_current_context(silent=True):
        context.call_on_close(partial(_remove_empty, made))
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CommandError(
            f"{folder}: cannot be created ({error.strerror}); choose another {option}"
        ) from None
    try:
        check_writable(folder)
    except OSError as error:
        raise CommandError(
            f"{folder}: cannot be written to ({error.strerror}); choose another {option}"
        ) from None


def _remove_empty(folders: list[Path]) -> None:
    """Remove folders, each within the next, while they are empty."""
    with suppress(OSError):
        for each in folders:
            each.rmdir()


def make_place(json_file: Path | None) -> None:
    """Check that the file of --json, if given, can be written. Raises CommandError."""
    if json_file is None:
        return
    make_folder(json_file.parent, "--json")
    if json_file.is_dir():
        raise CommandError(f"{json_file}: is a folder; name a file after --json")


def save_figures(figures: dict[str, Any], json_file: Path) -> None:
    """Write figures to the file of --json. Raises CommandError."""
    try:
        write_json(figures, json_file)
    except OSError as error:
        raise CommandError(
            f"{json_file}: cannot be written ({error.strerror}); choose another --json"
        ) from None
    click.echo(f"\nWrote {json_file}")


def load_patient(scene: Path) -> tuple[Scene, LoadedAnatomy]:
    """Load a scene file or a patient's folder, and its anatomy. Raises SceneError, PatientError."""
    path = scene_file(scene)
    loaded = load_scene(path)
    return loaded, load_anatomy(loaded, path.parent)


def numbers(text: str, option: str, least: float, most: float) -> list[float]:
    """The distinct numbers of an option such as "2.2,2.7", ascending. Raises CommandError."""
    try:
        values = sorted({float(value) for value in text.split(",")})
    except ValueError:
        values = []
    if not values or not all(least <= value <= most for value in values):
        raise CommandError(
            f"{option} is {text!r}: expected numbers from {least:g} to {most:g} such as 2.2,2.7"
        )
    return values


arch_option = click.option(
    "--arch",
    type=click.Choice(["auto", "cuda", "vulkan", "cpu"]),
    default="auto",
    show_default=True,
    help="Where to compute; auto is CUDA where there is one, else the CPU.",
)
quality_option = click.option(
    "--quality",
    type=click.Choice(QUALITIES),
    help="Resolution and iterations of a preset of the tissue model [the scene's].",
)


def image_options(command: Callable) -> Callable:
    """Add --probe, --picture and --detail-level to a command."""
    options = (
        click.option("--probe", help="Probe, by its name or as a file [the scene's]."),
        click.option("--picture", type=click.Choice(MODES), help="B-mode, CT or both [the scene's]."),
        click.option(
            "--detail-level",
            "--rung",
            "detail_level",
            type=click.Choice(DETAIL_LEVELS),
            help="Detail level (realism) of the B-mode image [the scene's].",
        ),
    )
    for option in reversed(options):
        command = option(command)
    return command
