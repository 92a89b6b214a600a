"""Settings: each is declared once, as a field of a ``Section``: name, unit, range, default, texts and key.

    young_kpa: Annotated[float, "--young-kpa", Control("Young", "Tissue", 1, 100)] = Field(15.0, gt=0, le=1e6)
    \"\"\"Young's modulus in kPa.\"\"\"

From this follow the key in the section's file, the option of the command line with its help, and where a
``Control`` or a ``Key`` stands beside it, the slider, the key in the window, and the value in a session's
file, by its path: "tissue.young_kpa".
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, TypeVar, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic.fields import FieldInfo

from errors import UserError, explained

# The end of a name -> the unit as it is printed.
UNITS = {
    "n_mm": "N/mm",
    "kpa_mm": "kPa/mm",
    "kpa": "kPa",
    "mm2": "mm2",
    "mm": "mm",
    "m_s2": "m/s2",
    "cm_s": "cm/s",
    "mm_s": "mm/s",
    "g_cm3": "g/cm3",
    "per_mm": "/mm",
    "per_s": "/s",
    "deg": "°",
    "percent": "%",
    "mhz": "MHz",
    "db": "dB",
    "hu": "HU",
    "s": "s",
}
Value = bool | int | float | str | None | tuple[float, ...]
Sections = TypeVar("Sections", bound=BaseModel)


class SettingError(UserError):
    """A setting that does not exist, or a value that it cannot have."""


class Section(BaseModel):
    """Its keys are all that there are, and its values do not change. A text is no number."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, strict=True, use_attribute_docstrings=True
    )

    @property
    def fixed(self) -> frozenset[str]:
        """Names of the settings that cannot be other than they are, beside the others."""
        return frozenset()


@dataclass(frozen=True)
class Control:
    """The user changes the setting in the window, in a group of controls.

    A number has a slider from ``low`` to ``high``, by default its whole range, or that of another field of
    its section (``limits``); in steps of 1 where it ``is_whole``. A tuple has a slider for each number.
    """

    label: str
    group: str
    low: float | None = None
    high: float | None = None
    is_whole: bool = False
    limits: str = ""


@dataclass(frozen=True)
class Key:
    """A key of the window changes the setting to its next value; ``group`` and ``text`` are for the help."""

    key: str
    group: str
    text: str


@dataclass(frozen=True)
class Setting:
    """A field with its path, and how the user changes it in the window."""

    path: str
    field: FieldInfo
    control: Control | None = None
    key: Key | None = None

    @property
    def name(self) -> str:
        """Its name, without that of its section."""
        return self.path.rpartition(".")[2]

    @property
    def unit(self) -> str:
        """The unit as it is printed; empty without one."""
        return next((unit for end, unit in UNITS.items() if self.name.endswith(f"_{end}")), "")

    @property
    def choices(self) -> tuple[Any, ...]:
        """All values, where these are few."""
        kinds = get_args(self.field.annotation) or (self.field.annotation,)
        kind = next((kind for kind in kinds if get_origin(kind) is Literal), self.field.annotation)
        return (False, True) if kind is bool else get_args(kind) if get_origin(kind) is Literal else ()

    @property
    def label(self) -> str:
        """Its text in the window, with the unit."""
        return "" if self.control is None else f"{self.control.label} {self.unit}".strip()

    @property
    def is_whole(self) -> bool:
        """Whether its slider goes in steps of 1."""
        return self.control is not None and self.control.is_whole

    @property
    def option(self) -> str | None:
        """The option of the command line."""
        return next((mark for mark in self.field.metadata if isinstance(mark, str)), None)

    def limits_in(self, section: Any) -> tuple[float, float]:
        """Both ends of its slider."""
        control = self.control
        if control is None:
            return self._bound("ge", "gt"), self._bound("le", "lt")
        if control.limits:
            return getattr(section, control.limits)
        low = self._bound("ge", "gt") if control.low is None else control.low
        return low, self._bound("le", "lt") if control.high is None else control.high

    def _bound(self, *names: str) -> float:
        marks = self.field.metadata
        return next(getattr(mark, name) for mark in marks for name in names if hasattr(mark, name))


def settings_of(name: str, section: type[BaseModel]) -> tuple[Setting, ...]:
    """The settings of a section with a name."""
    return tuple(
        Setting(f"{name}.{key}", field, _mark(field, Control), _mark(field, Key))
        for key, field in section.model_fields.items()
    )


def settings_in(sections: BaseModel | type[BaseModel]) -> tuple[Setting, ...]:
    """The settings of all sections, in their order."""
    return _settings_of(_kinds(sections))


def live_settings(sections: BaseModel) -> list[Setting]:
    """Those that the user can change while a rehearsal runs: with a control or a key, and not fixed."""
    return [
        setting
        for setting in _live_of(_kinds(sections))
        if setting.name not in section_of(sections, setting).fixed and value_of(sections, setting) is not None
    ]


def section_of(sections: BaseModel, setting: Setting) -> Any:
    """The section of a setting."""
    return getattr(sections, setting.path.split(".")[0])


def value_of(sections: BaseModel, setting: Setting) -> Any:
    """The value of a setting."""
    return getattr(section_of(sections, setting), setting.name)


def live_values(sections: BaseModel) -> dict[str, Value]:
    """The values of the live settings by path."""
    return {setting.path: value_of(sections, setting) for setting in live_settings(sections)}


def with_values(sections: Sections, values: Mapping[str, Any]) -> Sections:
    """The sections with values by path. Raises SettingError where they cannot be so."""
    changes: dict[str, dict[str, Any]] = {}
    known = {setting.path for setting in settings_in(sections)}
    for path, value in values.items():
        section, _, name = path.partition(".")
        if path not in known:
            raise SettingError(f"{path}: there is no such setting")
        changes.setdefault(section, {})[name] = value
    return sections.model_copy(
        update={name: _changed(name, getattr(sections, name), of) for name, of in changes.items()}
    )


def _changed(name: str, section: Any, values: dict[str, Any]) -> Any:
    try:
        changed = type(section).model_validate(section.model_dump() | values)
    except ValidationError as error:
        raise SettingError(f"{name}.{explained(error)}") from None
    # Which values a section was given, and which are defaults, stays known.
    return section.model_copy(update={key: getattr(changed, key) for key in values})


def _mark(field: FieldInfo, kind: type) -> Any:
    return next((mark for mark in field.metadata if isinstance(mark, kind)), None)


def _kinds(sections: BaseModel | type[BaseModel]) -> tuple[tuple[str, Any], ...]:
    if isinstance(sections, BaseModel):
        return tuple((name, type(getattr(sections, name))) for name in type(sections).model_fields)
    return tuple((name, field.annotation) for name, field in sections.model_fields.items())


@lru_cache
def _settings_of(kinds: tuple[tuple[str, Any], ...]) -> tuple[Setting, ...]:
    return tuple(
        setting
        for name, kind in kinds
        if isinstance(kind, type) and issubclass(kind, BaseModel)
        for setting in settings_of(name, kind)
    )


@lru_cache
def _live_of(kinds: tuple[tuple[str, Any], ...]) -> tuple[Setting, ...]:
    return tuple(
        setting for setting in _settings_of(kinds) if setting.control is not None or setting.key is not None
    )
