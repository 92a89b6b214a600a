"""Effects of the key map's actions on controls and settings."""

from render.viewer import KEY_MAP_ENTRIES, Controls
from ultrasound.probe import DETAIL_LEVELS, MODES
from ultrasound.target import TARGETS

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
# The others act when the key goes down: cine steps, settings of several values, settings that are on or off, and controls with the
# name of the action.
STEPS = {"cine_back": -1, "cine_forth": 1}
CYCLES = {"mode": MODES, "detail_level": DETAIL_LEVELS, "plan_for": TARGETS}
# Actions of the mouse only.
BY_MOUSE = ("point", "press", "orbit", "pan", "measure")
ACTIONS = tuple(action for line in KEY_MAP_ENTRIES for action in line.actions if action not in BY_MOUSE)


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
