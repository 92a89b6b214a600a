"""Which key, and which button of a gamepad, does what: as the key map says, or as the user's file does."""

import difflib
import re
import string
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from errors import UserError
from render.actions import ACTIONS, BY_MOUSE, HELD
from render.viewer import KEY_MAP, KEY_MAP_ENTRIES

# A key as it is printed -> as GGUI names it, which hears no digits and no punctuation.
KEYS = {each: each.lower() for each in string.ascii_uppercase}
KEYS |= {each: each for each in ("Up", "Down", "Left", "Right", "Return")}
KEYS |= {"Esc": "Escape", "Space": " ", "Backspace": "BackSpace"}
# In the order of SDL's game controllers.
BUTTONS = (
    *("A", "B", "X", "Y", "Back", "Guide", "Start", "Left stick", "Right stick"),
    *("Left shoulder", "Right shoulder", "Pad up", "Pad down", "Pad left", "Pad right"),
)
DEFAULT_KEYS = {
    action: key
    for line in KEY_MAP_ENTRIES
    for action, key in zip(line.actions, line.keys, strict=True)
    if action in ACTIONS
}
MOUSE = {
    action: key
    for line in KEY_MAP_ENTRIES
    for action, key in zip(line.actions, line.keys, strict=True)
    if action in BY_MOUSE
}
DEFAULT_BUTTONS = {
    "freeze": "A",
    "undo": "B",
    "bookmark": "X",
    "sweep": "Y",
    "rotate_left": "Left shoulder",
    "rotate_right": "Right shoulder",
    "push": "Pad up",
    "lift": "Pad down",
    "reset": "Start",
}
# Neither held nor begun, but the 3D view's own.
VIEW_ALONE = ("zoom_in", "zoom_out")

HEAD = """# The keys of Nephron's window: change some, leave out the rest, and give the file to rehearse --keys.
# A key is a letter, where a US keyboard has it, or {named}.
# A gamepad's button is {buttons}.
"""


class KeysError(UserError):
    """A file of keys that cannot be used; the message is one line."""


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid")

    keys: dict[str, str] = {}
    gamepad: dict[str, str] = {}


@dataclass(frozen=True)
class Keys:
    """``of`` is action -> key, ``buttons`` action -> gamepad button, both as printed."""

    of: Mapping[str, str] = field(default_factory=lambda: DEFAULT_KEYS)
    buttons: Mapping[str, str] = field(default_factory=lambda: DEFAULT_BUTTONS)

    def action_of(self, pressed: str) -> str:
        """What a key, as GGUI names it, does; empty where it does nothing."""
        return next((action for action, key in self.of.items() if KEYS[key] == pressed), "")

    def held(self) -> list[tuple[str, str]]:
        """Actions that go on while their key is held, each with the key as GGUI names it."""
        return [(action, KEYS[self.of[action]]) for action in (*HELD, *VIEW_ALONE)]

    def lines(self) -> dict[str, list[tuple[str, str]]]:
        """Keys and text of all actions, the mouse's too, in groups, for the reader."""
        return {
            group: [(" / ".join(map(self._printed, line.actions, line.keys)), line.text) for line in lines]
            for group, lines in KEY_MAP.items()
        }

    def _printed(self, action: str, usual: str) -> str:
        return self.of.get(action, usual)

    def worded(self, text: str) -> str:
        """A text with the keys of the actions, the mouse's too, that it names in braces: "{sweep} ends it"."""
        words = {**MOUSE, **self.of}
        return re.sub(r"\{(\w+)\}", lambda found: words.get(found[1], found[0]), text)


def load_keys(path: Path) -> Keys:
    """The keys of a TOML file, those that it leaves out as usual. Raises KeysError."""
    try:
        given = _File.model_validate(tomllib.loads(path.read_text("utf-8")))
    except FileNotFoundError:
        raise KeysError(f"{path}: no such file of keys; app.py keys prints one to begin with") from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise KeysError(
            f"{path}: cannot be read as a TOML file of keys ({str(error).splitlines()[0]})"
        ) from None
    except ValidationError as error:
        raise KeysError(f"{path}: {_explained(error)}") from None
    try:
        buttons = [action for action in ACTIONS if action not in (*VIEW_ALONE, "help")]
        return Keys(
            _with("keys", given.keys, DEFAULT_KEYS, ACTIONS, KEYS),
            _with("gamepad", given.gamepad, DEFAULT_BUTTONS, buttons, BUTTONS),
        )
    except KeysError as error:
        raise KeysError(f"{path}: {error}") from None


def keys_text() -> str:
    """The usual keys as the TOML file that ``load_keys`` reads."""
    named = ", ".join(key for key in KEYS if len(key) > 1)
    head = HEAD.format(named=named, buttons=", ".join(BUTTONS))
    rows = []
    for group, lines in KEY_MAP.items():
        keyed = [(action, line.text) for line in lines for action in line.actions if action in ACTIONS]
        rows += [f"# {group}", *(f'{action} = "{DEFAULT_KEYS[action]}"  # {text}' for action, text in keyed)]
    pad = [f'{action} = "{button}"' for action, button in DEFAULT_BUTTONS.items()]
    return "\n".join([head, "[keys]", *rows, "", "[gamepad]", *pad, ""])


def _with(
    section: str,
    given: Mapping[str, str],
    usual: Mapping[str, str],
    actions: Iterable[str],
    places: Iterable[str],
) -> dict[str, str]:
    """The usual keys or buttons of actions, but for those given. Raises KeysError."""
    printed = {place.lower(): place for place in places}
    chosen = dict(usual)
    for action, place in given.items():
        if action in BY_MOUSE:
            raise KeysError(f"{section}.{action}: is done with the mouse; leave it out")
        if action not in actions:
            raise KeysError(f"{section}.{action}: {_no_such('action', action, actions)}")
        if place.lower() not in printed:
            what = "key" if section == "keys" else "button"
            raise KeysError(f"{section}.{action} = {place!r}: {_no_such(what, place, printed.values())}")
        chosen[action] = printed[place.lower()]
    taken: dict[str, str] = {}
    for action, place in chosen.items():
        if place in taken:
            raise KeysError(f"{section}: {taken[place]} and {action} are both on {place}; give one another")
        taken[place] = action
    return chosen


def _no_such(what: str, found: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(found, list(known), n=1)
    return f"no such {what}; " + (f"did you mean {close[0]}?" if close else f"known: {' '.join(known)}")


def _explained(error: ValidationError) -> str:
    first = error.errors(include_url=False)[0]
    where = ".".join(map(str, first["loc"]))
    if first["type"] == "extra_forbidden":
        return f"{where}: unknown; expected the sections [keys] and [gamepad]"
    return f'{where} = {first["input"]!r}: expected a text such as push = "W"'
