"""Shared by the commands: errors, options, scenes, output folders, the start of Taichi."""

import inspect
import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import MappingProxyType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeVar, Union, get_args, get_origin

import click
from pydantic import BaseModel, ConfigDict
from pydantic.fields import FieldInfo

from rehearsal.configuration import with_quality
from rehearsal.result_files import write_json
from scenes.atomic_files import check_writable
from scenes.import_findings import open_warnings, warning_lines
from scenes.scene import OPTIONS, SETTINGS, Scene, load_scene, scene_file, with_options
from scenes.tissue import QUALITIES, TISSUES

if TYPE_CHECKING:
    from scenes.anatomy import LoadedAnatomy

# Exit status after Ctrl-C.
STOPPED = 130
# What pydantic calls the ends of a range.
BOUNDS = "ge", "gt", "le", "lt"
# Marks an argument among ``CommandOptions``: given by its place, without a name.
ARGUMENT = "argument"


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
    made = [missing for missing in (folder, *folder.parents) if not missing.exists()]
    if context := click.get_current_context(silent=True):
        context.call_on_close(partial(_remove_empty, made))
    fault = "created"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        fault = "written to"
        check_writable(folder)
    except OSError as error:
        raise CommandError(
            f"{folder}: cannot be {fault} ({error.strerror}); choose another {option}"
        ) from None


def _remove_empty(folders: list[Path]) -> None:
    """Remove folders, each within the next, while they are empty."""
    with suppress(OSError):
        for folder in folders:
            folder.rmdir()


def make_place(file: Path | None, option: str = "--json") -> None:
    """Check that the file of an option, if given, can be written. Raises CommandError."""
    if file is not None:
        make_folder(file.parent, option)
        if file.is_dir():
            raise CommandError(f"{file}: is a folder; name a file after {option}")


def save_figures(figures: dict[str, Any], json_file: Path) -> None:
    """Write figures to the file of --json. Raises CommandError."""
    try:
        write_json(figures, json_file)
    except OSError as error:
        raise CommandError(
            f"{json_file}: cannot be written ({error.strerror}); choose another --json"
        ) from None
    click.echo(f"\nWrote {json_file}")


def load_patient(
    scene: Path, changes: Mapping[str, Any] = MappingProxyType({}), quality: str | None = None
) -> tuple[Scene, "LoadedAnatomy"]:
    """Load a scene file or a patient's folder, changed by options, and its anatomy; print the warnings of its
    import.

    Raises SceneError, PatientError.
    """
    from scenes.anatomy import load_anatomy

    path = scene_file(scene)
    loaded = with_quality(with_options(load_scene(path), changes), quality)
    echo_import_warnings(loaded, path.parent)
    return loaded, load_anatomy(loaded, path.parent)


def echo_import_warnings(scene: Scene, folder: Path) -> None:
    """Print the warnings of a patient's import that nobody has acknowledged. Raises SceneError."""
    for line in warning_lines(open_warnings(scene, folder), folder):
        click.echo(line)


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


def _option(field: str) -> str:
    return f"--{field.replace('_', '-')}"


class CommandOptions(BaseModel):
    """The arguments and options of a command: each field is one, with its default, its range, and as help the
    text below it.

    A type may carry names that are not the field's (``Annotated[float, "--cell"]``), ARGUMENT, or the
    ``click.Choice`` it is among.
    """

    model_config = ConfigDict(use_attribute_docstrings=True, extra="forbid")

    scene_sections: ClassVar[tuple[str, ...]] = ()
    """Sections of a scene whose settings with an option are options of the command too."""

    changes: dict[str, Any] = {}
    """The values of a scene that options change, by path."""

    def set_by_user(self, *names: str) -> list[str]:
        """Those options among some fields and settings of a scene that the user gave, as the user names
        them.
        """
        fields = type(self).model_fields
        options = {name: OPTIONS[name].split("/")[0] for name in names if name in self.changes}
        return [
            options.get(name) or _option(name)
            for name in names
            if name in options or (name in fields and getattr(self, name) != fields[name].default)
        ]


Given = TypeVar("Given", bound=CommandOptions)


def command(
    options: type[Given], name: str | None = None
) -> Callable[[Callable[[Given], None]], click.Command]:
    """Make a function of some options a command; its help lists own options before inherited ones."""
    fields = {name: field for name, field in options.model_fields.items() if name != "changes"}
    own_first = sorted(fields, key=lambda field: field not in options.__annotations__)
    of_scene = {
        path.replace(".", "_"): path for path in OPTIONS if path.split(".")[0] in options.scene_sections
    }
    parameters: list[click.Parameter] = [_parameter(field, fields[field]) for field in own_first]
    parameters += [_scene_option(name, path) for name, path in of_scene.items()]

    def made(run: Callable[[Given], None]) -> click.Command:
        def called(**values: Any) -> None:
            changes = {path: values.pop(name) for name, path in of_scene.items()}
            run(options(**values, changes={path: of for path, of in changes.items() if of is not None}))

        return click.Command(
            name or run.__name__, callback=called, params=parameters, help=inspect.getdoc(run)
        )

    return made


def _scene_option(name: str, path: str) -> click.Option:
    """The option of a setting of a scene; where only one tissue model has it, the help names that."""
    settings = [setting for setting in SETTINGS if setting.path == path]
    models = [name for name, section in TISSUES.items() if settings[0].name in section.model_fields]
    of_model = f" ({models[0]})" if path.startswith("tissue.") and len(models) == 1 else ""
    help = f"{str(settings[0].field.description).removesuffix('.')}{of_model} [the scene's]."
    choices = [choice for setting in settings for choice in setting.choices]
    if choices == [False, True]:
        return click.Option([OPTIONS[path], name], default=None, help=help)
    kind = _kind_of(settings[0].field)
    numbers = get_args(kind) if get_origin(kind) is tuple else (kind,)
    shown = click.Choice(choices) if choices else _click_type(numbers[0], [])
    return click.Option([OPTIONS[path], name], type=shown, nargs=len(numbers), help=help)


def _kind_of(field: FieldInfo) -> Any:
    """The type of a field, without None."""
    is_union = get_origin(field.annotation) in (Union, UnionType)
    kind = get_args(field.annotation)[0] if is_union else field.annotation
    return get_args(kind)[0] if get_origin(kind) is Annotated else kind


def _parameter(name: str, field: FieldInfo) -> click.Parameter:
    kind = _kind_of(field)
    items = get_args(kind) if get_origin(kind) is tuple else (kind,)
    marks = [mark for mark in field.metadata if isinstance(mark, str)]
    common: dict[str, Any] = dict(
        type=_click_type(items[0], field.metadata),
        nargs=-1 if Ellipsis in items else len(items),
        required=field.is_required(),
    )
    if not field.is_required():
        common["default"] = field.default
    if ARGUMENT in marks:
        return click.Argument([name], **common)
    names = [*(marks or [_option(name)]), name]
    shown = not (field.is_required() or field.default is None or kind is bool)
    return click.Option(names, is_flag=kind is bool, help=field.description, show_default=shown, **common)


def _click_type(kind: Any, about: list[Any]) -> click.ParamType:
    """The type that click checks, from a field's type and what is annotated beside it."""
    for choice in about:
        if isinstance(choice, click.Choice):
            return choice
    if get_origin(kind) is Literal:
        return click.Choice(get_args(kind))
    bounds = {end: getattr(bound, end) for bound in about for end in BOUNDS if hasattr(bound, end)}
    if bounds:
        low, high = bounds.get("ge", bounds.get("gt")), bounds.get("le", bounds.get("lt"))
        range_of = WholeRange if kind is int else NumberRange
        return range_of(low, high, min_open="gt" in bounds, max_open="lt" in bounds)
    return {Path: click.Path(path_type=Path), float: Number()}.get(kind) or click.types.convert_type(kind)


class ArchOptions(CommandOptions):
    """Where to compute."""

    arch: Literal["auto", "cuda", "vulkan", "cpu"] = "auto"
    """Where to compute; auto is CUDA where there is one, else the CPU."""


class QualityOptions(CommandOptions):
    """A preset."""

    quality: Annotated[str | None, click.Choice(QUALITIES)] = None
    """Resolution and iterations of a preset of the tissue model [the scene's]."""
