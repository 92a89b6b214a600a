"""Keys and gamepad buttons: their actions, what these change, and a user's own assignment."""

import re
import string
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from errors import UserError, explained, meant
from render.viewer import TECHNIQUES, Controls
from text_files import TextError, read_toml
from ultrasound.probe import DETAIL_LEVELS, DOPPLER_MODES, MODES
from ultrasound.target import TARGETS

# A key as printed -> as GGUI names it. GGUI reports no digits and no punctuation.
KEYS = {each: each.lower() for each in string.ascii_uppercase}
KEYS |= {each: each for each in ("Up", "Down", "Left", "Right", "Return")}
KEYS |= {"Esc": "Escape", "Space": " ", "Backspace": "BackSpace", "Tab": "Tab"}
# With the shift key held; as GGUI names them, after this word.
WITH_SHIFT = "Shift+"
KEYS |= {WITH_SHIFT + each: WITH_SHIFT + name for each, name in KEYS.items()}
# In the order of SDL's game controllers.
BUTTONS = (
    *("A", "B", "X", "Y", "Back", "Guide", "Start", "Left stick", "Right stick"),
    *("Left shoulder", "Right shoulder", "Pad up", "Pad down", "Pad left", "Pad right"),
)
# Group -> text for the user -> actions, each with its key as printed.
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
        "organ translucent or solid": {"translucent": "T"},
        "organ cut along the image plane": {"cut": "X"},
        "coverage: imaged tissue in green": {"show_seen": "N"},
    },
    "Image": {
        "B-mode and CT, B-mode alone, CT alone": {"mode": "B"},
        "detail level of the B-mode image": {"detail_level": "V"},
        "Doppler: colour, power, off": {"doppler": "Tab"},
        "the scanner's sliders, with TGC": {"show_scanner": "G"},
        "outline of the tumour, now and in the CT": {"outline": "O"},
        "caliper from click to click, in mm; a third removes it": {"measure": "Click on image"},
        "freeze and unfreeze": {"freeze": "F"},
        "while frozen: cine of the last ten seconds": {"cine_back": "Left", "cine_forth": "Right"},
        "save the image (PNG, DICOM) and the organ (PLY)": {"export": "I"},
    },
    "Resection": {
        "score: a mark on the organ": {"score_under": "Shift+Left button"},
        "score: marks beside the tumour's edges in the image": {"score_image": "Shift+M"},
        "score: the marks of the planned line, instead of any others": {"score_planned": "Shift+L"},
        "technique: enucleoresection, wedge, enucleation": {"technique": "Shift+T"},
        "depth of the cut; air or fluid in the crater": {"show_resection": "Shift+G"},
        "cut along the score": {"cut_out": "Shift+X"},
    },
    "Plan": {
        "target: tumour and margin, tumour, kidney": {"plan_for": "Space"},
        "plan a sweep of the target": {"plan": "Return"},
        "stop planning; or show the next sweep, then none": {"next_plan": "Backspace"},
    },
    "Session": {
        "undo the last press, turn, path, mark or cut; redo it": {"undo": "U", "redo": "Y"},
        "set a bookmark; return to bookmarks": {"bookmark": "M", "to_bookmark": "J"},
        "start and stop recording a tracked sweep": {"sweep": "L"},
        "take control from a replay or a tracked probe": {"take_over": "K"},
        "warnings of the import: checked": {"acknowledge": "Shift+I"},
        "reset tissue, transducer and view": {"reset": "R"},
        "save a screenshot of the window": {"screenshot": "P"},
        "show or hide this list": {"help": "H"},
        "quit": {"quit": "Esc"},
    },
}
_ALL = {action: key for group in KEY_MAP.values() for keys in group.values() for action, key in keys.items()}
MOUSE = {action: place for action, place in _ALL.items() if place not in KEYS}
DEFAULT_KEYS = {action: key for action, key in _ALL.items() if key in KEYS}
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
# The others act when the key goes down: cine steps, settings of several values, settings that are on or off,
# and controls with the name of the action.
STEPS = {"cine_back": -1, "cine_forth": 1}
CYCLES = {
    "mode": MODES,
    "detail_level": DETAIL_LEVELS,
    "doppler": DOPPLER_MODES,
    "plan_for": TARGETS,
    "technique": TECHNIQUES,
}
# Actions of the 3D view itself.
VIEW_ACTIONS = ("zoom_in", "zoom_out")

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
    """``of`` is action -> key, ``buttons`` action -> gamepad button, both as printed."""

    of: Mapping[str, str] = field(default_factory=lambda: DEFAULT_KEYS)
    buttons: Mapping[str, str] = field(default_factory=lambda: DEFAULT_BUTTONS)

    def action_of(self, pressed: str, with_shift: bool = False) -> str:
        """Return the action of a key, as GGUI names it; empty where it has none.

        A key that has none with shift has its usual one.
        """
        names = (WITH_SHIFT + pressed, pressed) if with_shift else (pressed,)
        of = {KEYS[key]: action for action, key in self.of.items()}
        return next((of[name] for name in names if name in of), "")

    def held(self) -> list[tuple[str, str]]:
        """Return the actions of held keys, each with its key as GGUI names it."""
        return [(action, KEYS[self.of[action]]) for action in (*HELD, *VIEW_ACTIONS)]

    def lines(self) -> dict[str, list[tuple[str, str]]]:
        """Return keys and texts of all actions by group, for the help."""
        return {
            group: [
                (" / ".join(self.of.get(*usual) for usual in keys.items()), text)
                for text, keys in lines.items()
            ]
            for group, lines in KEY_MAP.items()
        }

    def worded(self, text: str) -> str:
        """Return a text with actions in braces replaced by their keys: "{sweep} stops it"."""
        words = {**MOUSE, **self.of}
        return re.sub(r"\{(\w+)\}", lambda found: words.get(found[1], found[0]), text)


def load_keys(path: Path) -> Keys:
    """Return the keys of a TOML file, with defaults for those it leaves out. Raises KeysError."""
    try:
        given = _File.model_validate(read_toml(path))
    except (FileNotFoundError, NotADirectoryError):
        raise KeysError(f"{path}: no such key file; app.py keys prints one to start from") from None
    except TextError as error:
        raise KeysError(f"{path}: cannot be read as a TOML key file ({error})") from None
    except ValidationError as error:
        raise KeysError(f"{path}: {explained(error, lambda _: SECTIONS)}") from None
    try:
        buttons = [action for action in DEFAULT_KEYS if action not in (*VIEW_ACTIONS, "help")]
        return Keys(
            _with("keys", given.keys, DEFAULT_KEYS, DEFAULT_KEYS, KEYS),
            _with("gamepad", given.gamepad, DEFAULT_BUTTONS, buttons, BUTTONS),
        )
    except KeysError as error:
        raise KeysError(f"{path}: {error}") from None


def keys_text() -> str:
    """Return the default keys as the TOML file that ``load_keys`` reads."""
    named = ", ".join(key for key in KEYS if len(key) > 1 and not key.startswith(WITH_SHIFT))
    head = HEAD.format(named=named, buttons=", ".join(BUTTONS))
    rows = []
    for group, lines in KEY_MAP.items():
        rows.append(f"# {group}")
        keyed = [(action, text) for text, keys in lines.items() for action in keys if action in DEFAULT_KEYS]
        rows += [f'{action} = "{DEFAULT_KEYS[action]}"  # {text}' for action, text in keyed]
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
        if action in MOUSE:
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
    settings = controls.settings
    if action in STEPS:
        controls.cine += STEPS[action]
    elif action in CYCLES:
        values = CYCLES[action]
        at = values.index(getattr(settings, action))
        setattr(settings, action, values[(at + 1) % len(values)])
    elif hasattr(settings, action):
        setattr(settings, action, not getattr(settings, action))
    elif hasattr(controls, action):
        setattr(controls, action, True)
