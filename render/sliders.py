"""Sliders and switches from the metadata of ``Settings``: in the strip under the 3D view; the scanner's
beside the panel.
"""

import dataclasses
from collections.abc import Mapping

from render.viewer import B_MODE, DOPPLER, RESECTION, SCANNER_GROUPS, TGC, Geometry, Settings
from render.window_layout import Rect, WindowLayout

# Dear ImGui's glyphs are 7 pixels wide, its rows 23 pixels high. A slider's label gets 35 % of a box, a
# switch's all of it, less these pixels around them.
GLYPH_WIDTH, LABEL_SHARE, ROW_HEIGHT, AROUND_ROWS = 7, 0.35, 23, 32
AROUND_LABEL, AROUND_SWITCH = 16, 35
# The least width of a box beside the panel.
LEAST_WIDTH = 120


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
    """Return the box of each group.

    Where boxes would be too narrow for their labels, the first are left out.
    """
    groups = groups_of(settings, geometry)
    widths = {name: _width(members) for name, members in groups.items() if name not in SCANNER_GROUPS}
    while len(widths) > 1 and sum(widths.values()) > layout.slider_room(len(widths)):
        del widths[next(iter(widths))]
    boxes = dict(zip(widths, layout.sliders(list(widths.values())), strict=True))
    shown = [RESECTION] if settings.show_resection else []
    shown += [B_MODE, TGC if settings.doppler == "off" else DOPPLER] if settings.show_scanner else []
    return boxes | _beside_panel({name: groups[name] for name in shown}, layout)


def draw_sliders(
    gui,
    settings: Settings,
    geometry: Geometry,
    boxes: dict[str, Rect],
    first_size: tuple[int, int],
    moved: Mapping[str, int],
) -> None:
    """Draw the groups that have a box, and update the settings from them.

    GGUI measures in fractions of the window's first size. A box stays where the user moved it, and is never
    freed: there is a new one only in a new place, or where the user ``moved`` it once more.
    """
    groups = groups_of(settings, geometry)
    width, height = first_size
    for name, box in boxes.items():
        place = (box.left / width, box.top / height, box.width / width, box.height / height)
        # Dear ImGui shows what stands before "##", and knows a box by all of it.
        with gui.sub_window(f"{name}##{moved.get(name, 0)} {tuple(box)}", *place):
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


def _beside_panel(groups: dict[str, list[dataclasses.Field]], layout: WindowLayout) -> dict[str, Rect]:
    """Return the boxes of the scanner's groups; the last are left out where findings would be covered."""
    sizes = {
        name: (max(LEAST_WIDTH, round(_width(members))), ROW_HEIGHT * len(members) + AROUND_ROWS)
        for name, members in groups.items()
    }
    boxes = layout.scanner_sliders(list(sizes.values()))
    while len(boxes) > 1 and min(box.left for box in boxes) < layout.clear.left:
        sizes.popitem()
        boxes = layout.scanner_sliders(list(sizes.values()))
    return dict(zip(sizes, boxes, strict=True))


def _width(members: list[dataclasses.Field]) -> float:
    """Return the width that a group needs for its labels [pixels]."""
    return max(_width_of(member) for member in members)


def _width_of(member: dataclasses.Field) -> float:
    label = GLYPH_WIDTH * len(_label(member))
    if isinstance(member.metadata["low"], bool):
        return label + AROUND_SWITCH
    return (label + AROUND_LABEL) / LABEL_SHARE


def _label(member: dataclasses.Field) -> str:
    return f"{member.metadata['label']} {member.metadata['unit']}".strip()
