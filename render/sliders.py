"""Sliders and switches from the metadata of ``Settings``: in the strip under the 3D view; the scanner's beside the panel.

They are drawn into the background image, because those of GGUI have one size of letters in windows of all sizes.
"""

import dataclasses
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, ImageDraw

from render.text import LEAST_FONT_PX, font
from render.ultrasound_panel import FINDINGS, LINE, MARK, QUIET, TEXT
from render.viewer import B_MODE, DOPPLER, RESECTION, SCANNER_GROUPS, TGC, Geometry, Settings
from render.window_layout import ROW_HEIGHT, Rect, WindowLayout

TRACK, FILLED = (37, 45, 55), (32, 92, 122)
# In heights of a row: letters, tracks, which a switch is as wide as, the gap beside a label, the least length of a track, and handles.
LETTERS, TRACK_HEIGHT, GAP, LEAST_TRACK, HANDLE = 0.6, 0.72, 0.35, 3.6, 0.14
# A slider of fractions has at least so many values.
FINENESS = 100
# With shift held the handle moves by this share of the mouse's way.
FINE = 0.1


class Slider(NamedTuple):
    """A slider, or a switch where ``low`` is a bool; ``row`` is all of it and ``track`` its part without the label."""

    name: str
    label: str
    value: Any
    low: Any
    high: Any
    row: Rect
    track: Rect

    @property
    def is_switch(self) -> bool:
        return isinstance(self.low, bool)

    @property
    def share(self) -> float:
        """Where the value is in the range."""
        return float(np.clip((self.value - self.low) / (self.high - self.low), 0.0, 1.0))

    @property
    def text(self) -> str:
        """The value."""
        return f"{self.value:.4g}" if isinstance(self.low, float) else f"{self.value}"

    def value_at(self, share: float) -> Any:
        """The value at a share of the track, rounded to one that can be read."""
        value = self.low + min(max(share, 0.0), 1.0) * (self.high - self.low)
        if isinstance(self.low, int):
            return round(value)
        decimals = int(np.ceil(np.log10(FINENESS / (self.high - self.low))))
        return min(max(round(value, decimals), self.low), self.high)


class SliderBox(NamedTuple):
    """A group of sliders and its box."""

    name: str
    box: Rect
    sliders: tuple[Slider, ...]
    pitch: float
    """Height of a row; the name of the group has one too."""

    @property
    def is_over_scene(self) -> bool:
        """Whether it covers some of the 3D view."""
        return self.name in SCANNER_GROUPS


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


def boxes_of(settings: Settings, geometry: Geometry, layout: WindowLayout) -> tuple[SliderBox, ...]:
    """Return the shown groups with their sliders."""
    groups = groups_of(settings, geometry)
    widths = {name: _width(members, layout) for name, members in groups.items() if name not in SCANNER_GROUPS}
    # Where boxes would be too narrow for their labels, leave out the first.
    while len(widths) > 1 and sum(widths.values()) > layout.slider_room(len(widths)):
        del widths[next(iter(widths))]
    boxes = dict(zip(widths, layout.sliders(list(widths.values())), strict=True))
    shown = [B_MODE, TGC if settings.doppler == "off" else DOPPLER] if settings.show_scanner else []
    shown += [RESECTION] if settings.show_resection else []
    if shown:
        boxes |= dict(zip(shown, layout.scanner_sliders([len(groups[name]) for name in shown]), strict=True))
    return tuple(_placed(name, box, groups[name], settings, geometry, layout) for name, box in boxes.items())


def slider_at(boxes: tuple[SliderBox, ...], column: float, row: float) -> Slider | None:
    """Return the slider under a pixel."""
    sliders = (slider for box in boxes if box.box.contains(column, row) for slider in box.sliders)
    return next((slider for slider in sliders if slider.row.contains(column, row)), None)


@lru_cache(maxsize=32)
def slider_image(shown: SliderBox) -> np.ndarray:
    """Return a group as an image, uint8, shape of its box."""
    box, letters, gap = shown.box, font(_letters(shown.pitch)), GAP * shown.pitch
    image = Image.new("RGB", (box.width, box.height), FINDINGS)
    draw = ImageDraw.Draw(image)
    draw.rectangle([0, 0, box.width - 1, box.height - 1], outline=LINE)
    left, top = shown.sliders[0].row[:2]
    name_at = left - box.left, top - box.top - shown.pitch / 2
    draw.text(name_at, shown.name, font=letters, fill=QUIET, anchor="lm")
    for slider in shown.sliders:
        track = slider.track.moved(-box.left, -box.top)
        (_draw_switch if slider.is_switch else _draw_track)(draw, slider, track, shown.pitch)
        label_at = track.right + gap, track.top + track.height / 2
        draw.text(label_at, slider.label, font=letters, fill=TEXT, anchor="lm")
    return np.asarray(image)


def _draw_switch(draw: ImageDraw.ImageDraw, slider: Slider, track: Rect, pitch: float) -> None:
    draw.rectangle([*track[:2], track.right - 1, track.bottom - 1], fill=TRACK)
    if slider.value:
        tick = np.array([[0.22, 0.52], [0.43, 0.73], [0.8, 0.25]]) * track.width + track[:2]
        draw.line([tuple(corner) for corner in tick], fill=MARK, width=max(2, round(HANDLE * pitch)))


def _draw_track(draw: ImageDraw.ImageDraw, slider: Slider, track: Rect, pitch: float) -> None:
    handle = track.left + slider.share * (track.width - 1)
    half = HANDLE * pitch / 2
    draw.rectangle([*track[:2], track.right - 1, track.bottom - 1], fill=TRACK)
    draw.rectangle([*track[:2], handle, track.bottom - 1], fill=FILLED)
    handle = min(max(handle, track.left + half), track.right - 1 - half)
    draw.rectangle([handle - half, track.top, handle + half, track.bottom - 1], fill=MARK)
    # The value stands in the half where the handle is not.
    middle = track.left + track.width * (0.25 if slider.share >= 0.5 else 0.75), track.top + track.height / 2
    draw.text(middle, slider.text, font=font(_letters(pitch)), fill=TEXT, anchor="mm")


def _placed(
    name: str,
    box: Rect,
    members: list[dataclasses.Field],
    settings: Settings,
    geometry: Geometry,
    layout: WindowLayout,
) -> SliderBox:
    """Return a group in its box, its rows one under the other, below its name."""
    pitch = layout.slider_pitch(box, len(members))
    pad, height = layout.slider_pad, round(TRACK_HEIGHT * pitch)
    sliding = [member for member in members if not isinstance(member.metadata["low"], bool)]
    longest = _longest(sliding, pitch)
    width = box.width - 2 * pad
    sliders = []
    for place, member in enumerate(members):
        low, high = member.metadata["low"], member.metadata["high"]
        if member.name == "frequency_mhz":
            low, high = geometry.frequency_range_mhz
        row = Rect(box.left + pad, round(box.top + pad + (place + 1) * pitch), width, round(pitch))
        length = height if isinstance(low, bool) else round(width - longest - GAP * pitch)
        track = Rect(row.left, row.top + (row.height - height) // 2, length, height)
        sliders.append(
            Slider(member.name, _label(member), getattr(settings, member.name), low, high, row, track)
        )
    return SliderBox(name, box, tuple(sliders), pitch)


def _width(members: list[dataclasses.Field], layout: WindowLayout) -> float:
    """Return the width that a group needs [pixels]."""
    pitch = layout.px(ROW_HEIGHT)
    track = TRACK_HEIGHT if isinstance(members[0].metadata["low"], bool) else LEAST_TRACK
    return _longest(members, pitch) + (track + GAP) * pitch + 2 * layout.slider_pad


def _longest(members: list[dataclasses.Field], pitch: float) -> float:
    """Return the length of the longest label [pixels]."""
    return max((font(_letters(pitch)).getlength(_label(member)) for member in members), default=0.0)


def _letters(pitch: float) -> int:
    return max(LEAST_FONT_PX, int(LETTERS * pitch))


def _label(member: dataclasses.Field) -> str:
    return f"{member.metadata['label']} {member.metadata['unit']}".strip()
