"""Keys and gamepad buttons: their actions, what these change, and a user's own assignment."""

import re
import string
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from errors import UserError, explained, meant
from render.viewer import Controls, UserSettings
from settings import Setting, live_settings, value_of, with_values
from text_files import TextError, read_toml

# A key as printed -> as GGUI names it. GGUI reports no digits and no punctuation.
KEYS = {letter: letter.lower() for letter in string.ascii_uppercase}
KEYS |= {name: name for name in ("Up", "Down", "Left", "Right", "Return")}
KEYS |= {"Esc": "Escape", "Space": " ", "Backspace": "BackSpace", "Tab": "Tab"}
# The same the other way: how a key is printed that GGUI names.
PRINTED = {name: key for key, name in KEYS.items()}
# With the shift key held; as GGUI names them, after this word.
WITH_SHIFT = "Shift+"
KEYS |= {WITH_SHIFT + key: WITH_SHIFT + name for key, name in KEYS.items()}
# In the order of SDL's game controllers.
BUTTONS = (
    *("A", "B", "X", "Y", "Back", "Guide", "Start", "Left stick", "Right stick"),
    *("Left shoulder", "Right shoulder", "Pad up", "Pad down", "Pad left", "Pad right"),
)
# Group -> text for the user -> actions, each with its key as printed; those of settings are declared beside
# these.
KEY_MAP = {
    "Transducer": {
        "move it over the organ": {"point": "Mouse"},
        "press it in, deeper the longer it is held": {"press": "Left button"},
        "push it in, lift it": {"push": "W", "lift": "S"},
        "rotate it about its axis": {"rotate_left": "A", "rotate_right": "D"},
        "rock it in the image plane, heel to toe": {"rock_left": "Q", "rock_right": "E"},
        "tilt it out of the image plane (fan)": {"tilt_back": "Z", "tilt_forward": "C"},
    },
    "View": {
        "turn the view": {"orbit": "Right drag"},
        "pan the view (also Shift + right drag)": {"pan": "Middle drag"},
        "zoom in and out": {"zoom_in": "Up", "zoom_out": "Down"},
    },
    "Image": {
        "caliper from click to click, in mm; a third removes it": {"measure": "Click on image"},
        "freeze and unfreeze": {"freeze": "F"},
        "while frozen: cine of the last ten seconds": {"cine_back": "Left", "cine_forth": "Right"},
        "save the image (PNG, DICOM) and the organ (PLY)": {"export": "I"},
    },
    "Resection": {
        "score: a mark on the organ": {"score_under": "Shift+Left button"},
        "score: marks beside the tumour's edges in the image": {"score_image": "Shift+M"},
        "score: the marks of the planned line, instead of any others": {"score_planned": "Shift+L"},
        "cut along the score": {"cut_out": "Shift+X"},
        "return to the next attempt, undone or not": {"next_attempt": "Shift+N"},
        "show or hide the table of attempts": {"show_attempts": "Shift+A"},
    },
    "Plan": {
        "plan a sweep of the target": {"plan": "Return"},
        "stop planning; or show the next sweep, then none": {"next_plan": "Backspace"},
    },
    "Session": {
        "undo the last press, turn, path, mark or cut; redo it": {"undo": "U", "redo": "Y"},
        "set a bookmark; return to bookmarks": {"bookmark": "M", "to_bookmark": "J"},
        "start and stop recording a tracked sweep": {"sweep": "L"},
        "take control from a replay or a tracked probe": {"take_over": "K"},
        "warnings of the import: checked": {"acknowledge": "Shift+I"},
        "reset tissue, transducer, marks and view": {"reset": "R"},
        "save a screenshot of the window": {"screenshot": "P"},
        "show or hide this list": {"help": "H"},
        "show or hide the messages of the session": {"log": "Shift+H"},
        "quit; after an action it asks once": {"quit": "Esc"},
    },
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

PUSH_MM_S, ROTATE_DEG_S, TILT_DEG_S = 15.0, 45.0, 30.0
# Actions of held keys: the control that changes, and its rate per second.
HELD = {
    "push": ("push_mm", PUSH_MM_S),
    "lift": ("push_mm", -PUSH_MM_S),
    "rotate_left": ("rotate_deg", ROTATE_DEG_S),
    "rotate_right": ("rotate_deg", -ROTATE_DEG_S),
    "rock_left": ("rock_deg", TILT_DEG_S),
    "rock_right": ("rock_deg", -TILT_DEG_S),
    "tilt_back": ("tilt_deg", -TILT_DEG_S),
    "tilt_forward": ("tilt_deg", TILT_DEG_S),
}
# The others act when the key goes down: cine steps, settings with a key, and controls with the name of the
# action.
STEPS = {"cine_back": -1, "cine_forth": 1}
# Actions of the 3D view itself, and pages over the whole window.
VIEW_ACTIONS = ("zoom_in", "zoom_out")
PAGES = ("help", "log")

SECTIONS = "unknown key; expected the sections [keys] and [gamepad]"
HEAD = """\
# The keys of Nephron's window: change some, leave out the rest, and give the file to rehearse --keys.
# A key is a letter, where a US keyboard has it, or {named}; or one of these with Shift, such as Shift+M.
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
    """The keys of a window.

    ``groups`` has group -> text for the user -> actions, ``of`` action -> key or place of the mouse,
    ``buttons`` action -> gamepad button, all as printed.
    """

    groups: Mapping[str, Mapping[str, tuple[str, ...]]]
    of: Mapping[str, str]
    buttons: Mapping[str, str] = field(default_factory=lambda: DEFAULT_BUTTONS)

    @property
    def keyed(self) -> dict[str, str]:
        """The actions that have a key."""
        return {action: place for action, place in self.of.items() if place in KEYS}

    def action_of(self, pressed: str, with_shift: bool = False) -> str:
        """The action of a key, as GGUI names it; empty where it has none.

        A key that has none with shift has its usual one.
        """
        names = (WITH_SHIFT + pressed, pressed) if with_shift else (pressed,)
        of = {KEYS[key]: action for action, key in self.keyed.items()}
        return next((of[name] for name in names if name in of), "")

    def held(self) -> list[tuple[str, str]]:
        """The actions of held keys, each with its key as GGUI names it."""
        return [(action, KEYS[self.of[action]]) for action in (*HELD, *VIEW_ACTIONS)]

    def lines(self) -> dict[str, list[tuple[str, str]]]:
        """Keys and texts of all actions by group, for the help."""
        return {
            group: [(" / ".join(map(self.of.__getitem__, actions)), text) for text, actions in lines.items()]
            for group, lines in self.groups.items()
        }

    def worded(self, text: str) -> str:
        """A text with actions in braces replaced by their keys: "{sweep} stops it"."""
        return re.sub(r"\{(\w+)\}", lambda braces: self.of.get(braces[1], braces[0]), text)


def default_keys(settings: Iterable[Setting] = ()) -> Keys:
    """The default keys of the window's own actions, and of settings."""
    of = {
        action: key for lines in KEY_MAP.values() for keys in lines.values() for action, key in keys.items()
    }
    groups: dict[str, dict[str, tuple[str, ...]]] = {group: {} for group in KEY_MAP}
    for setting in settings:
        if setting.key is not None:
            groups[setting.key.group][setting.key.text] = (setting.name,)
            of[setting.name] = setting.key.key
    for group, lines in KEY_MAP.items():
        groups[group] |= {text: tuple(keys) for text, keys in lines.items()}
    return Keys(groups, of)


def load_keys(path: Path, usual: Keys) -> Keys:
    """The keys of a TOML file, and the usual ones of those that it leaves out. Raises KeysError."""
    try:
        file = _File.model_validate(read_toml(path))
    except (FileNotFoundError, NotADirectoryError):
        raise KeysError(f"{path}: no such key file; app.py keys prints one to start from") from None
    except TextError as error:
        raise KeysError(f"{path}: cannot be read as a TOML key file ({error})") from None
    except ValidationError as error:
        raise KeysError(f"{path}: {explained(error, lambda _: SECTIONS)}") from None
    mouse = usual.of.keys() - usual.keyed.keys()
    buttons = [action for action in usual.keyed if action not in (*VIEW_ACTIONS, *PAGES)]
    try:
        return replace(
            usual,
            of=dict(usual.of) | _with("keys", file.keys, usual.keyed, usual.keyed, KEYS, mouse),
            buttons=_with("gamepad", file.gamepad, usual.buttons, buttons, BUTTONS, mouse),
        )
    except KeysError as error:
        raise KeysError(f"{path}: {error}") from None


def keys_text(keys: Keys) -> str:
    """The keys as the TOML file that ``load_keys`` reads."""
    named = ", ".join(key for key in KEYS if len(key) > 1 and not key.startswith(WITH_SHIFT))
    rows = [HEAD.format(named=named, buttons=", ".join(BUTTONS)), "[keys]"]
    for group, lines in keys.groups.items():
        rows.append(f"# {group}")
        texts = {action: text for text, actions in lines.items() for action in actions}
        keyed = [action for action in texts if action in keys.keyed]
        rows += [f'{action} = "{keys.of[action]}"  # {texts[action]}' for action in keyed]
    pad = [f'{action} = "{button}"' for action, button in keys.buttons.items()]
    return "\n".join([*rows, "", "[gamepad]", *pad, ""])


def _with(
    section: str,
    changes: Mapping[str, str],
    usual: Mapping[str, str],
    actions: Iterable[str],
    places: Iterable[str],
    mouse: Collection[str],
) -> dict[str, str]:
    """The usual keys or buttons of actions, with some changed. Raises KeysError."""
    printed = {place.lower(): place for place in places}
    chosen = dict(usual)
    for action, place in changes.items():
        if action in mouse:
            raise KeysError(f"{section}.{action}: is an action of the mouse; leave it out")
        if action not in actions:
            raise KeysError(f"{section}.{action}: unknown action; {meant(action, actions)}")
        if place.lower() not in printed:
            what = "key" if section == "keys" else "button"
            raise KeysError(
                f"{section}.{action} = {place!r}: unknown {what}; {meant(place, printed.values())}"
            )
        if action in (*HELD, *VIEW_ACTIONS) and place.lower().startswith(WITH_SHIFT.lower()):
            raise KeysError(
                f"{section}.{action} = {place!r}: is held down, and cannot be with Shift; choose a single key"
            )
        chosen[action] = printed[place.lower()]
    taken: dict[str, str] = {}
    for action, place in chosen.items():
        if place in taken:
            raise KeysError(f"{section}: {taken[place]} and {action} are both on {place}; change one of them")
        taken[place] = action
    return chosen


def hold(action: str, controls: Controls, seconds: float) -> None:
    """Apply an action whose key was held for a time; ignore other actions."""
    if action in HELD:
        name, rate = HELD[action]
        setattr(controls, name, getattr(controls, name) + rate * seconds)


def begin(action: str, controls: Controls) -> None:
    """Apply an action whose key went down; ignore held actions and those of the window itself."""
    keyed = {setting.name: setting for setting in live_settings(controls.settings) if setting.key is not None}
    if action in STEPS:
        controls.cine += STEPS[action]
    elif action in keyed:
        controls.settings = with_next(controls.settings, keyed[action])
    elif hasattr(controls, action):
        setattr(controls, action, True)


def with_next(settings: UserSettings, setting: Setting) -> UserSettings:
    """Settings with the next value of one that has few, the first after the last."""
    values = setting.choices
    following = values[(values.index(value_of(settings, setting)) + 1) % len(values)]
    return with_values(settings, {setting.path: following})
