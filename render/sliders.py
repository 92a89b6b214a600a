"""Sliders and switches from the metadata of ``Settings``: in the strip under the 3D view; the scanner's beside the panel."""

import dataclasses

from render.viewer import B_MODE, DOPPLER, RESECTION, SCANNER_GROUPS, TGC, Geometry, Settings
from render.window_layout import Rect, WindowLayout

# Dear ImGui's glyphs are 7 pixels wide, its rows 23 pixels high. A slider's label gets 35 % of a box, a switch's all of it, less
# these pixels around them.
GLYPH_WIDTH, LABEL_SHARE, ROW_HEIGHT = 7, 0.35, 23
AROUND_LABEL, AROUND_SWITCH = 16, 35


def groups_of(settings: Settings, geometry: Geometry) -> dict[str, list[dataclasses.Field]]:
    """Return the adjustable settings by group."""
    # Settings of structures that the scene does not have.
    unused = {"show_tumour", "outline", "margin_mm"} if geometry.tumour is None else set()
    unused |= set() if geometry.parts else {"show_parts"}
    unused |= {"show_support"} if geometry.support is None else set()
    groups: dict[str, list[dataclasses.Field]] = {}
    for each in dataclasses.fields(settings):
        if each.metadata and getattr(settings, each.name) is not None and each.name not in unused:
            groups.setdefault(each.metadata["group"], []).append(each)
    return groups


def boxes_of(settings: Settings, geometry: Geometry, layout: WindowLayout) -> dict[str, Rect]:
    """Return the box of each group."""
    groups = groups_of(settings, geometry)
    below = {name: _width(members) for name, members in groups.items() if name not in SCANNER_GROUPS}
    # Where boxes would be too narrow for their labels, leave out the first.
    while len(below) > 1 and sum(below.values()) > layout.slider_room(len(below)):
        del below[next(iter(below))]
    boxes = dict(zip(below, layout.sliders(list(below.values())), strict=True))
    shown = [B_MODE, TGC if settings.doppler == "off" else DOPPLER] if settings.show_scanner else []
    shown += [RESECTION] if settings.show_resection else []
    if shown:
        heights = [ROW_HEIGHT * len(groups[name]) + 32 for name in shown]
        boxes |= dict(zip(shown, layout.scanner_sliders(heights), strict=True))
    return boxes


def draw_sliders(
    gui,
    settings: Settings,
    geometry: Geometry,
    boxes: dict[str, Rect],
    first_size: tuple[int, int],
    placed: int,
) -> None:
    """Draw the groups that have a box, and update the settings from them.

    GGUI measures in fractions of the window's first size, and keeps the position of a box: a new ``placed`` makes new boxes.
    """
    groups = groups_of(settings, geometry)
    width, height = first_size
    for name, box in boxes.items():
        place = (box.left / width, box.top / height, box.width / width, box.height / height)
        with gui.sub_window(f"{name}##{placed}", *place):
            for member in groups[name]:
                value, about, label = getattr(settings, member.name), member.metadata, _label(member)
                low, high = about["low"], about["high"]
                if member.name == "frequency_mhz":
                    low, high = geometry.frequency_range_mhz
                if isinstance(low, bool):
                    value = gui.checkbox(label, bool(value))
                elif isinstance(low, int):
                    value = gui.slider_int(label, int(value), low, high)
                else:
                    value = gui.slider_float(label, float(value), low, high)
                setattr(settings, member.name, value)


def _width(members: list[dataclasses.Field]) -> float:
    """Return the width that the labels of a group need [pixels]."""
    longest = max(GLYPH_WIDTH * len(_label(member)) for member in members)
    if isinstance(members[0].metadata["low"], bool):
        return longest + AROUND_SWITCH
    return (longest + AROUND_LABEL) / LABEL_SHARE


def _label(member: dataclasses.Field) -> str:
    return f"{member.metadata['label']} {member.metadata['unit']}".strip()
