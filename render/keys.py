"""Assignment of keys and gamepad buttons to actions: the default, or a user's file."""

import re
import string
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from errors import UserError, explained, meant
from render.actions import ACTIONS, BY_MOUSE, HELD
from render.viewer import KEY_MAP, KEY_MAP_ENTRIES

# A key as printed -> as GGUI names it. GGUI reports no digits and no punctuation.
KEYS = {each: each.lower() for each in string.ascii_uppercase}
KEYS |= {each: each for each in ("Up", "Down", "Left", "Right", "Return")}
KEYS |= {"Esc": "Escape", "Space": " ", "Backspace": "BackSpace"}
# In the order of SDL's game controllers.
BUTTONS = (
    *("A", "B", "X", "Y", "Back", "Guide", "Start", "Left stick", "Right stick"),
    *("Left shoulder", "Right shoulder", "Pad up", "Pad down", "Pad left", "Pad right"),
)
_ALL_KEYS = {
    action: key for line in KEY_MAP_ENTRIES for action, key in zip(line.actions, line.keys, strict=True)
}
DEFAULT_KEYS = {action: _ALL_KEYS[action] for action in ACTIONS}
MOUSE = {action: _ALL_KEYS[action] for action in BY_MOUSE}
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
# Actions of the 3D view itself.
VIEW_ACTIONS = ("zoom_in", "zoom_out")

SECTIONS = "unknown key; expected the sections [keys] and [gamepad]"
HEAD = """# The keys of Nephron's window: change some, leave out the rest, and give the file to rehearse --keys.
# A key is a letter, where a US keyboard has it, or {named}.
# A gamepad's button is {buttons}.
"""


class KeysError(UserError):
    """A key file that cannot be used; the message is one line."""


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
        """Return the action of a key, as GGUI names it; empty where it has none."""
        return next((action for action, key in self.of.items() if KEYS[key] == pressed), "")

    def held(self) -> list[tuple[str, str]]:
        """Return the actions of held keys, each with its key as GGUI names it."""
        return [(action, KEYS[self.of[action]]) for action in (*HELD, *VIEW_ACTIONS)]

    def lines(self) -> dict[str, list[tuple[str, str]]]:
        """Return keys and texts of all actions by group, for the help."""
        return {
            group: [(" / ".join(map(self._printed, line.actions, line.keys)), line.text) for line in lines]
            for group, lines in KEY_MAP.items()
        }

    def _printed(self, action: str, usual: str) -> str:
        return self.of.get(action, usual)

    def worded(self, text: str) -> str:
        """Return a text with actions in braces replaced by their keys: "{sweep} stops it"."""
        words = {**MOUSE, **self.of}
        return re.sub(r"\{(\w+)\}", lambda found: words.get(found[1], found[0]), text)


def load_keys(path: Path) -> Keys:
    """Return the keys of a TOML file, with defaults for those it leaves out. Raises KeysError."""
    try:
        given = _File.model_validate(tomllib.loads(path.read_text("utf-8")))
    except FileNotFoundError:
        raise KeysError(f"{path}: no such key file; app.py keys prints one to start from") from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise KeysError(f"{path}: cannot be read as a TOML key file ({str(error).splitlines()[0]})") from None
    except ValidationError as error:
        raise KeysError(f"{path}: {explained(error, lambda _: SECTIONS)}") from None
    try:
        buttons = [action for action in ACTIONS if action not in (*VIEW_ACTIONS, "help")]
        return Keys(
            _with("keys", given.keys, DEFAULT_KEYS, ACTIONS, KEYS),
            _with("gamepad", given.gamepad, DEFAULT_BUTTONS, buttons, BUTTONS),
        )
    except KeysError as error:
        raise KeysError(f"{path}: {error}") from None


def keys_text() -> str:
    """Return the default keys as the TOML file that ``load_keys`` reads."""
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
    """Return the default keys or buttons of actions, replaced by those given. Raises KeysError."""
    printed = {place.lower(): place for place in places}
    chosen = dict(usual)
    for action, place in given.items():
        if action in BY_MOUSE:
            raise KeysError(f"{section}.{action}: is an action of the mouse; leave it out")
        if action not in actions:
            raise KeysError(f"{section}.{action}: unknown action; {meant(action, actions)}")
        if place.lower() not in printed:
            what = "key" if section == "keys" else "button"
            raise KeysError(
                f"{section}.{action} = {place!r}: unknown {what}; {meant(place, printed.values())}"
            )
        chosen[action] = printed[place.lower()]
    taken: dict[str, str] = {}
    for action, place in chosen.items():
        if place in taken:
            raise KeysError(f"{section}: {taken[place]} and {action} are both on {place}; change one of them")
        taken[place] = action
    return chosen
