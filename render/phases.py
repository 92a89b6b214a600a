"""The phases of an operation: the tools of each, as buttons with their keys."""

from dataclasses import dataclass
from typing import Any

from render.keys import Keys
from render.text import font
from render.viewer import PHASES, Phase, WindowSettings
from render.window_layout import Rect, WindowLayout
from settings import live_settings, value_of

TAB_PX, TOOL_PX, AROUND_PX, GAP_PX = 15, 14, 9, 6
# Of each phase the rows of tools: what is written, and the action.
TOOLS: dict[Phase, tuple[dict[str, str], ...]] = {
    "Scan": (
        {
            "Push in": "push",
            "Lift": "lift",
            "Turn left": "rotate_left",
            "right": "rotate_right",
            "Rock heel": "rock_left",
            "toe": "rock_right",
            "Tilt back": "tilt_back",
            "forward": "tilt_forward",
            "View": "approach",
        },
        {
            "Freeze": "freeze",
            "Doppler": "doppler",
            "Sliders": "show_scanner",
            "Outline": "outline",
            "Seen": "show_seen",
            "Plan": "plan",
            "Undo": "undo",
            "Save": "export",
        },
    ),
    "Score": (
        {
            "Marks from the image": "score_image",
            "Planned line": "score_planned",
            "Undo": "undo",
            "Redo": "redo",
            "View": "approach",
        },
        {
            "Technique": "technique",
            "Margin and depth": "show_resection",
            "Outline": "outline",
            "Seen": "show_seen",
        },
    ),
    "Excise": (
        {"Cut along the line": "cut_out", "Undo": "undo", "Redo": "redo", "View": "approach"},
        {"Technique": "technique", "Margin and depth": "show_resection", "Outline": "outline"},
    ),
    "Inspect": (
        {
            "Attempts": "show_attempts",
            "Next attempt": "next_attempt",
            "Cut open": "cut",
            "Translucent": "translucent",
        },
        {
            "View": "approach",
            "Undo": "undo",
            "Redo": "redo",
            "Save": "export",
            "Screenshot": "screenshot",
            "Messages": "log",
        },
    ),
}


@dataclass(frozen=True)
class Tool:
    """A button: its box, its action, what is written on it, its key, and whether it is on."""

    box: Rect
    action: str
    label: str
    key: str
    is_on: bool = False


def tabs_of(layout: WindowLayout) -> dict[Phase, Rect]:
    """The box of each phase, in the title's row."""
    boxes, left = {}, layout.px(GAP_PX)
    for phase in PHASES:
        width = int(font(layout.px(TAB_PX)).getlength(phase)) + 2 * layout.px(AROUND_PX)
        boxes[phase] = Rect(left, 0, width, layout.title.height - 1)
        left += width
    return boxes


def tools_of(layout: WindowLayout, settings: WindowSettings, keys: Keys) -> list[Tool]:
    """The buttons of the present phase, of actions that have a key; of a row that is too long the last are
    left out.
    """
    values = {setting.name: value_of(settings, setting) for setting in live_settings(settings)}
    rows = TOOLS[settings.view.phase]
    tools: list[Tool] = []
    for number, row in enumerate(rows):
        left, room = layout.px(GAP_PX), layout.tool_row(number)
        for bare, action in row.items():
            if action not in keys.of:
                continue
            value = values.get(action)
            label = _with_value(bare, value)
            width = _tool_width(layout, label, keys.of[action])
            if left + width > room.right:
                # Without the value it may fit.
                label = bare
                width = _tool_width(layout, label, keys.of[action])
            if left + width > room.right:
                break
            box = Rect(left, room.top, width, room.height)
            tools.append(Tool(box, action, label, keys.of[action], value is True))
            left += width + layout.px(GAP_PX)
    return tools


def _with_value(label: str, value: Any) -> str:
    """A label with the value of a setting that has several in words."""
    return f"{label}: {value}" if isinstance(value, str) else label


def _tool_width(layout: WindowLayout, label: str, key: str) -> int:
    return _width(layout, label) + _width(layout, key) + layout.px(3 * GAP_PX)


def _width(layout: WindowLayout, text: str) -> int:
    return int(font(layout.px(TOOL_PX)).getlength(text))
