"""What the actions of the key map do to the controls and settings, by whichever key or button they come."""

from render.viewer import KEY_MAP_ENTRIES, Controls
from ultrasound.probe import DETAIL_LEVELS, MODES
from ultrasound.target import TARGETS

PUSH_MM_S, ROTATE_DEG_S, TILT_DEG_S = 15.0, 45.0, 30.0
# While held: what of the controls changes, and how much in a second.
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
# The rest begins as the key goes down: steps through pictures, settings of several values, settings that are on or off,
# and what the controls name as the action is named.
STEPS = {"cine_back": -1, "cine_forth": 1}
CYCLES = {"mode": MODES, "detail_level": DETAIL_LEVELS, "plan_for": TARGETS}
# What is the mouse's alone.
BY_MOUSE = ("point", "press", "orbit", "pan", "measure")
ACTIONS = tuple(action for line in KEY_MAP_ENTRIES for action in line.actions if action not in BY_MOUSE)


def hold(action: str, controls: Controls, seconds: float) -> None:
    """An action's key was held for so long; nothing for one that is not held."""
    if action in HELD:
        name, rate = HELD[action]
        setattr(controls, name, getattr(controls, name) + rate * seconds)


def begin(action: str, controls: Controls) -> None:
    """An action's key went down; nothing for one that is held, or is the window's own."""
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
