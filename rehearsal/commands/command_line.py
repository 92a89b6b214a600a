"""What commands share: their faults, the numbers, scenes and folders that they take, and the start of Taichi."""

import math
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

# The exit status of a program that Ctrl-C has ended.
STOPPED = 130


class CommandError(click.ClickException):
    """What the user must know, in one line."""


class Number(click.types.FloatParamType):
    """A number, by that name in the help."""

    name = "number"


class WholeRange(click.IntRange):
    """Whole numbers between two."""

    name = "integer"


class NumberRange(click.FloatRange):
    """Numbers between two; click's own range lets nan through."""

    name = "number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is no number", param, ctx)
        return number


def start_taichi(arch: str) -> str:
    """Initialise Taichi where the user wants it; the backend it is. Raises CommandError."""
    from sim.device import NoDevice, start

    try:
        return start(arch)
    except NoDevice as error:
        raise CommandError(f"--arch {arch}: {error}") from None


def make_folder(folder: Path, option: str = "--out") -> None:
    """Make sure that a folder can be written to before time is spent on what goes there. Raises CommandError.

    Of a command that ends without anything in it the folder goes again.
    """
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    if context := click.get_current_context(silent=True):
        context.call_on_close(partial(_remove_empty, made))
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CommandError(
            f"{folder}: cannot be made a folder for results ({error.strerror}); choose another {option}"
        ) from None
    try:
        check_writable(folder)
    except OSError as error:
        raise CommandError(
            f"{folder}: cannot be written to ({error.strerror}); choose another {option}"
        ) from None


def _remove_empty(folders: list[Path]) -> None:
    """Remove folders, each within the next, as far as nothing is in them."""
    with suppress(OSError):
        for each in folders:
            each.rmdir()


def make_place(json_file: Path | None) -> None:
    """Make sure that the file of --json, where it is asked for, can be written before time is spent. Raises CommandError."""
    if json_file is None:
        return
    make_folder(json_file.parent, "--json")
    if json_file.is_dir():
        raise CommandError(f"{json_file}: is a folder; name a file after --json")


def save_figures(figures: dict[str, Any], json_file: Path) -> None:
    """Write figures to the file of --json and say so. Raises CommandError."""
    try:
        write_json(figures, json_file)
    except OSError as error:
        raise CommandError(
            f"{json_file}: cannot be written ({error.strerror}); choose another --json"
        ) from None
    click.echo(f"\nWrote {json_file}")


def load_patient(scene: Path) -> tuple[Scene, LoadedAnatomy]:
    """A scene file or a patient's folder, and the anatomy that it names. Raises SceneError, PatientError."""
    path = scene_file(scene)
    loaded = load_scene(path)
    return loaded, load_anatomy(loaded, path.parent)


def numbers(text: str, option: str, least: float, most: float) -> list[float]:
    """Different numbers of an option's text, such as "2.2,2.7", in ascending order. Raises CommandError."""
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
    help="Size and passes as a preset of the tissue model has them [the scene's].",
)
