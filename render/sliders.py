"""Sliders, switches and buttons of the settings that have a ``Control``: an engineer's in the strip under the
3D view; the scanner's and those of a resection beside the panel.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from render.keys import with_next
from render.viewer import (
    B_MODE,
    DOPPLER,
    RESECTION,
    TGC,
    Geometry,
    UserSettings,
    WindowSettings,
)
from render.window_layout import Rect, WindowLayout
from settings import Setting, live_settings, section_of, value_of, with_values

# An engineer's groups, in the strip, in their order; where these are too wide, the first are left out.
STRIP = ("Tissue", "Image", "View")
# Dear ImGui's glyphs are 7 pixels wide, its rows 23 pixels high. A slider's label gets 35 % of a box, that of
# a switch or a button all of it, less these pixels around them.
GLYPH_WIDTH, LABEL_SHARE, ROW_HEIGHT, AROUND_ROWS = 7, 0.35, 23, 32
AROUND_LABEL, AROUND_SWITCH = 16, 35
# The least width of a box beside the panel.
LEAST_WIDTH = 120

Groups = dict[str, list[Setting]]


def groups_of(settings: WindowSettings, geometry: Geometry) -> Groups:
    """The settings with a control, by group."""
    # Settings of structures that the scene does not have.
    unused = {"show_tumour", "outline", "margin_mm"} if geometry.tumour is None else set()
    unused |= set() if geometry.parts else {"show_parts"}
    unused |= {"show_support"} if geometry.support is None else set()
    groups: Groups = {}
    for setting in live_settings(settings):
        if setting.control is not None and setting.name not in unused:
            groups.setdefault(setting.control.group, []).append(setting)
    return groups


def boxes_of(settings: WindowSettings, geometry: Geometry, layout: WindowLayout) -> dict[str, Rect]:
    """The box of each group.

    Where boxes would be too narrow for their labels, the first are left out.
    """
    groups = groups_of(settings, geometry)
    in_strip = STRIP if settings.view.show_engineer else ()
    widths = {name: _width(settings, groups[name]) for name in in_strip if name in groups}
    while len(widths) > 1 and sum(widths.values()) > layout.slider_room(len(widths)):
        del widths[next(iter(widths))]
    boxes = dict(zip(widths, layout.sliders(list(widths.values())), strict=True))
    names = [RESECTION] if settings.resection.show_resection else []
    if settings.view.show_scanner:
        names += [B_MODE, TGC if settings.scanner.doppler == "off" else DOPPLER]
        names += [] if settings.view.show_engineer else ["Image"]
    return boxes | _beside_panel(settings, {name: groups[name] for name in names}, layout)


def draw_sliders(
    gui,
    settings: UserSettings,
    geometry: Geometry,
    boxes: dict[str, Rect],
    first_size: tuple[int, int],
    moved: Mapping[str, int],
) -> UserSettings:
    """Draw the groups that have a box; return the settings as the user leaves them.

    GGUI measures in fractions of the window's first size. A box stays where the user moved it, and is never
    freed: there is a new one only in a new place, or where the user ``moved`` it once more.
    """
    groups = groups_of(settings, geometry)
    width, height = first_size
    for name, box in boxes.items():
        place = (box.left / width, box.top / height, box.width / width, box.height / height)
        # Dear ImGui shows what stands before "##", and knows a box by all of it.
        with gui.sub_window(f"{name}##{moved.get(name, 0)} {tuple(box)}", *place):
            for setting in groups[name]:
                settings = _drawn(gui, settings, setting)
    return settings


def _drawn(gui, settings: UserSettings, setting: Setting) -> UserSettings:
    """Draw the control of a setting; return the settings as the user leaves them."""
    value, labels = value_of(settings, setting), _labels(settings, setting)
    if isinstance(value, bool):
        changed = gui.checkbox(labels[0], value)
    elif setting.choices:
        return with_next(settings, setting) if gui.button(labels[0]) else settings
    else:
        limits = setting.limits_in(section_of(settings, setting))
        numbers = value if isinstance(value, tuple) else (value,)
        slid = [_slid(gui, *of, setting.is_whole, *limits) for of in zip(labels, numbers, strict=True)]
        changed = tuple(slid) if isinstance(value, tuple) else slid[0]
    return settings if changed == value else with_values(settings, {setting.path: changed})


def _slid(gui, label: str, value: float, is_whole: bool, low: float, high: float) -> float:
    """A number as its slider leaves it: the same one, unless the user moves it."""
    shown: float
    if is_whole or isinstance(value, int):
        shown = round(value)
        slid = gui.slider_int(label, shown, round(low), round(high))
    else:
        # A slider has single precision.
        shown = float(np.float32(value))
        slid = gui.slider_float(label, shown, low, high)
    return value if slid == shown else type(value)(min(max(slid, low), high))


def _beside_panel(settings: WindowSettings, groups: Groups, layout: WindowLayout) -> dict[str, Rect]:
    """The boxes of the scanner's groups; the last are left out where findings would be covered."""
    sizes = {
        name: (
            max(LEAST_WIDTH, round(_width(settings, members))),
            ROW_HEIGHT * sum(len(_labels(settings, member)) for member in members) + AROUND_ROWS,
        )
        for name, members in groups.items()
    }
    boxes = layout.scanner_sliders(list(sizes.values()))
    while len(boxes) > 1 and min(box.left for box in boxes) < layout.clear.left:
        sizes.popitem()
        boxes = layout.scanner_sliders(list(sizes.values()))
    return dict(zip(sizes, boxes, strict=True))


def _width(settings: WindowSettings, members: Sequence[Setting]) -> float:
    """The width that a group needs for its labels [pixels]."""
    return max(_width_of(settings, member) for member in members)


def _width_of(settings: WindowSettings, member: Setting) -> float:
    label = GLYPH_WIDTH * max(map(len, _labels(settings, member)))
    if member.choices:
        longest = max(len(str(choice)) for choice in member.choices) - len(str(value_of(settings, member)))
        is_switch = isinstance(value_of(settings, member), bool)
        return label + (0 if is_switch else GLYPH_WIDTH * longest) + AROUND_SWITCH
    return (label + AROUND_LABEL) / LABEL_SHARE


def _labels(settings: WindowSettings, member: Setting) -> list[str]:
    """The text of a control: of each number of a tuple one, of a button with the value."""
    value = value_of(settings, member)
    if isinstance(value, tuple):
        return [str(number) for number in range(1, len(value) + 1)]
    is_button = member.choices and not isinstance(value, bool)
    return [f"{member.label}: {value}" if is_button else member.label]
