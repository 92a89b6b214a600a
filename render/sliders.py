"""Sliders and switches, generated from the metadata of ``Settings``: in the strip under the 3D view, and the scanner's in the panel."""

import dataclasses

from render.layout import Layout, Rect
from render.viewer import ASIDE, Settings

# Dear ImGui's glyphs are 7 pixels wide, its labels get 35 % of a box, its rows are 23 pixels high.
GLYPH_WIDTH, LABEL_SHARE, ROW_HEIGHT = 7, 0.35, 23


def groups_of(settings: Settings) -> dict[str, list[dataclasses.Field]]:
    """Name of a group -> its settings that there is something to set of."""
    groups: dict[str, list[dataclasses.Field]] = {}
    for each in dataclasses.fields(settings):
        if each.metadata and getattr(settings, each.name) is not None:
            groups.setdefault(each.metadata["group"], []).append(each)
    return groups


def boxes_of(settings: Settings, layout: Layout) -> dict[str, Rect]:
    """Where each group is now."""
    groups = groups_of(settings)
    below = [name for name in groups if name not in ASIDE]
    boxes = dict(zip(below, layout.sliders([_width(groups[name]) for name in below]), strict=True))
    if settings.show_scanner:
        beside = [name for name in ASIDE if name in groups]
        heights = [ROW_HEIGHT * len(groups[name]) + 32 for name in beside]
        boxes |= dict(zip(beside, layout.aside(heights), strict=True))
    return boxes


def draw_sliders(
    gui,
    settings: Settings,
    layout: Layout,
    first_size: tuple[int, int],
    placed: int,
    mhz: tuple[float, float],
) -> None:
    """Draw all, and write into the settings what the user set.

    GGUI measures in shares of the size that the window was opened with, and keeps a box where it first was: another ``placed`` makes
    new ones. ``mhz`` are the least and greatest frequency of the probe.
    """
    groups = groups_of(settings)
    width, height = first_size
    for name, box in boxes_of(settings, layout).items():
        place = (box.left / width, box.top / height, box.width / width, box.height / height)
        with gui.sub_window(f"{name}##{placed}", *place):
            for member in groups[name]:
                _draw_slider(gui, settings, member, mhz)


def _draw_slider(gui, settings: Settings, member: dataclasses.Field, mhz: tuple[float, float]) -> None:
    value, about = getattr(settings, member.name), member.metadata
    low, high = mhz if member.name == "frequency_mhz" else (about["low"], about["high"])
    label = _label(member)
    if isinstance(low, bool):
        value = gui.checkbox(label, bool(value))
    elif isinstance(low, int):
        value = gui.slider_int(label, int(value), low, high)
    else:
        value = gui.slider_float(label, float(value), low, high)
    setattr(settings, member.name, value)


def _width(members: list[dataclasses.Field]) -> float:
    """Pixels that a group asks for."""
    longest = max(GLYPH_WIDTH * len(_label(member)) for member in members)
    if isinstance(members[0].metadata["low"], bool):
        return longest + 46
    return (longest + 16) / LABEL_SHARE


def _label(member: dataclasses.Field) -> str:
    return f"{member.metadata['label']} {member.metadata['unit']}".strip()
