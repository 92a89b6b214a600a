"""The image behind the 3D view: ultrasound panel, title, clock, help, read-outs, findings and compass. Images
are uint8 (height, width, 3).

Each frame redraws only what changed.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from itertools import islice

import numpy as np
from PIL import Image, ImageDraw

from render.keys import Keys, default_keys
from render.message_box import log_image, message_image
from render.phases import GAP_PX, TAB_PX, TOOL_PX, Tool, tabs_of
from render.sign_row import meaning_image, meaning_rect, sign_at, sign_boxes, sign_image
from render.table_box import table_image, table_rect
from render.text import fitting_size, font, shortened
from render.ultrasound_panel import (
    ALERT,
    FINDINGS,
    LINE,
    MARK,
    OUTLINE,
    OUTLINE_AT_REST,
    QUIET,
    RESECTION_LINE,
    TEXT,
    draw_caliper,
    draw_note,
    draw_panel,
    draw_segments,
    image_boxes,
    paste_image,
    status_image,
    to_plane,
)
from render.viewer import Phase, Sign, View
from render.warning_box import acknowledge_rect, warning_image, warning_rect
from render.window_layout import CLOCK_WIDTH, FIGURE_HEIGHT, Rect, WindowLayout

READOUT_PERIOD_S = 0.4

# Read-outs, findings, the finding above its limit, clock and pace.
Figures = tuple[dict[str, str], dict[str, str], str, str, str]
BACKDROP_TOP, BACKDROP_FOOT = (30, 35, 42), (13, 15, 19)
STRIP, HELP = (17, 20, 24), (22, 26, 31)
# Least distance of lines of figures, in a small window.
LEAST_PITCH = 19
# A figure without a value.
NO_VALUE = "-"
# The compass. Patient coordinates are LPS: towards the patient's left, back and head; and the other way.
LETTERS = (("R", "L"), ("A", "P"), ("I", "S"))
# In fractions of its box.
ARM, BEYOND = 0.27, 0.11
LETTER_PX, LINE_PX = 14, 2
# A shorter projected axis has no letters.
LEAST_LENGTH = 0.3
HELP_HINT = "{}  keys"
PROGRAM_PX = 40
BAR_PX, BAR_HIGH_PX = 320, 4
# In less room the title is left out.
LEAST_TITLE = 60
HELP_COLUMNS, HELP_PX, HELP_GAP_PX, FIGURES_GAP_PX = 2, 17, 12, 18


class BackgroundImage:
    """``pixels`` uint8 (width, height, 4) as GGUI wants them: columns first, bottom up.

    ``has_scene`` says whether ``draw_scene`` has drawn the 3D view since what is around it changed.
    """

    def __init__(self, layout: WindowLayout, keys: Keys | None = None) -> None:
        self.layout, self.keys = layout, keys or default_keys()
        self.pixels = np.full((layout.width, layout.height, 4), 255, dtype=np.uint8)
        # The same memory as rows, top down, for drawing.
        self._rows = self.pixels.transpose(1, 0, 2)[::-1]
        self._view: View | None = None
        self._taken = 0
        self._pointed: tuple[float, float] | None = None
        self._backdrop: tuple = ()
        self.has_scene = False
        # The page over everything, with what is on it; empty without one.
        self._page: tuple = ()
        self._axes: np.ndarray | None = None
        self._status: str | None = None
        self._messages: tuple[object, ...] | None = None
        self._tools: tuple[Phase, list[Tool]] = ("Scan", [])
        self._figures: Figures | None = None
        self._figures_at = 0.0

    def compose(
        self,
        view: View,
        axes: np.ndarray,
        taken: int = 0,
        slow_figures: bool = False,
        pointed: tuple[float, float] | None = None,
    ) -> None:
        """Draw a view, with the compass for a camera's axes (3, 3): right, up and ahead, in patient
        coordinates.

        A sign at the column and row ``pointed`` at shows its meaning. Sliders beside warnings and signs have
        ``taken`` so many pixels at the right of the 3D view.
        With ``slow_figures``, figures change only every READOUT_PERIOD_S, so that they can be read.
        """
        findings = self._findings_of(view)
        # What the backdrop depends on.
        plane = view.width_mm, view.depth_mm, view.above_mm, view.focus_mm, view.outline_mm is not None
        parts = (
            *plane,
            tuple(view.images),
            view.captions,
            view.scale,
            view.title,
            len(findings),
            view.warnings,
            taken,
            table_rect(self.layout, view.table),
            sign_boxes(self.layout, view.signs, taken),
            sign_at(self.layout, view.signs, pointed, taken),
        )
        if self._page or self._backdrop != parts:
            self._rows[:, :, :3] = backdrop(self.layout, view, self.keys.of["help"], *self._tools)
            self._figures, self._axes, self._status, self._messages, self._page = None, None, None, None, ()
            self._empty_scene, self.has_scene = self._scene.copy(), False
        self._view, self._backdrop, self._taken, self._pointed = view, parts, taken, pointed
        for (name, image), box in zip(view.shown.items(), image_boxes(self.layout, view), strict=True):
            paste_image(self._rows, box, image)
            self._draw_over(view, name, box)
        if view.status != self._status:
            self._put(self.layout.status, status_image(self.layout, view.status))
            self._status = view.status
        messages = view.messages, view.hint
        if messages != self._messages:
            self._put(self.layout.messages, message_image(self.layout, *messages))
            self._messages = messages
        figures = dict(view.readouts), findings, view.alert, view.clock, view.pace
        self._compose_figures(figures, slow_figures)
        if self._axes is None or not np.array_equal(axes, self._axes):
            self._put(self.layout.compass, compass_image(self.layout, axes))
            self._axes = axes
        if (warned := self._warning_rect(view)) is not None:
            self._put(warned, warning_image(self.layout, view.warnings, self._taken))
        if view.table is not None and (over := table_rect(self.layout, view.table)) is not None:
            self._put(over, table_image(self.layout, view.table))
        for sign, box in zip(view.signs, sign_boxes(self.layout, view.signs, taken), strict=False):
            self._put(box, sign_image(self.layout, sign))
        if (over_sign := self._pointed_sign(view)) is not None:
            self._put(meaning_rect(self.layout, over_sign), meaning_image(self.layout, over_sign))

    def put_tools(self, phase: Phase, tools: list[Tool]) -> None:
        """Have the tools of a phase in the images that follow."""
        if (phase, tools) != self._tools:
            self._tools, self._backdrop = (phase, tools), ()

    def draw_scene(self, draw: Callable[[np.ndarray], None]) -> None:
        """Draw the 3D view into ``pixels``, behind what ``compose`` has drawn; ``draw`` does it."""
        boxes = [] if self._view is None else self.boxes_over_scene(self._view)
        over = [self._rows[box.slices].copy() for box in boxes]
        self._scene[:] = self._empty_scene
        draw(self.pixels)
        for box, image in zip(boxes, over, strict=True):
            self._rows[box.slices] = image
        self.has_scene = True

    def boxes_over_scene(self, view: View) -> list[Rect]:
        """The boxes that cover the 3D view: compass, findings, warnings, table, signs."""
        count = len(self._findings_of(view))
        findings = self.layout.findings(count) if count else None
        table = table_rect(self.layout, view.table)
        sign = self._pointed_sign(view)
        meaning = None if sign is None else meaning_rect(self.layout, sign)
        signs = sign_boxes(self.layout, view.signs, self._taken)
        boxes = self.layout.compass, findings, self._warning_rect(view), table, *signs, meaning
        return [box for box in boxes if box is not None]

    def acknowledges_at(self, column: float, row: float) -> bool:
        """Whether a click there acknowledges the warnings."""
        warnings = () if self._view is None else self._view.warnings
        box = acknowledge_rect(self.layout, warnings, self._taken)
        return box is not None and box.contains(column, row)

    def _findings_of(self, view: View) -> dict[str, str]:
        """The findings that are shown: none where a table has their place."""
        return first_of(view.findings, self.layout.most_findings) if view.table is None else {}

    def _pointed_sign(self, view: View) -> Sign | None:
        return sign_at(self.layout, view.signs, self._pointed, self._taken)

    def _warning_rect(self, view: View) -> Rect | None:
        return warning_rect(self.layout, view.warnings, self._taken)

    @property
    def _scene(self) -> np.ndarray:
        """The 3D view's part of ``pixels``."""
        box, height = self.layout.scene, self.layout.height
        return self.pixels[box.left : box.right, height - box.bottom : height - box.top]

    def show_progress(self, text: str, share: float) -> None:
        """Draw what is being prepared, and the share that is done, until the first ``compose``."""
        self.show_image(progress_image(self.layout, text, share))

    def show_image(self, image: np.ndarray) -> None:
        """Draw an image over everything, uint8 (height, width, 3), until the first ``compose``."""
        self._put(self.layout.whole, image)

    def show_page(self, name: str, view: View) -> None:
        """Draw a page (``keys.PAGES``) over everything, until the next ``compose``."""
        page = (name, view.log) if name == "log" else (name,)
        if self._page != page:
            is_log = name == "log"
            shown = log_image(self.layout, view.log) if is_log else help_image(self.layout, self.keys.lines())
            self._put(self.layout.whole, shown)
            self._page = page

    def _draw_over(self, view: View, name: str, box: Rect) -> None:
        """Draw outlines, note and caliper over an image."""
        width = self.layout.line_width
        if view.outline_before_mm is not None:
            draw_segments(self._rows, view, box, view.outline_before_mm, OUTLINE_AT_REST, width)
        if view.outline_mm is not None:
            draw_segments(self._rows, view, box, view.outline_mm, OUTLINE, width)
        if view.resection_mm is not None:
            draw_segments(self._rows, view, box, view.resection_mm, RESECTION_LINE, width)
        if note := view.notes.get(name):
            draw_note(self._rows, self.layout, box, note)
        draw_caliper(self._rows, self.layout, view, box)

    def _compose_figures(self, figures: Figures, slow: bool) -> None:
        now = time.perf_counter()
        waits = slow and now - self._figures_at < READOUT_PERIOD_S
        if self._figures is not None and (waits or figures == self._figures):
            return
        readouts, findings, alert, clock, pace = figures
        box = clock_box(self.layout, self.keys.of["help"])
        self._put(box, clock_image(self.layout, box, clock, pace))
        if self.layout.readouts.width:
            self._put(self.layout.readouts, readout_image(self.layout, readouts))
        if findings:
            box = self.layout.findings(len(findings))
            self._put(box, findings_image(self.layout, findings, alert))
        self._figures, self._figures_at = figures, now

    def _put(self, box: Rect, image: np.ndarray) -> None:
        self._rows[box.slices][..., :3] = image

    def plane_point_at(self, column: float, row: float) -> tuple[float, float] | None:
        """The point of the image plane [mm] at a pixel of one of the images, None elsewhere."""
        if self._view is None or self._page:
            return None
        hit = (box for box in image_boxes(self.layout, self._view) if box.contains(column, row))
        return next((to_plane(self._view, box, column, row) for box in hit), None)


def backdrop(
    layout: WindowLayout, view: View, help_key: str = "H", phase: Phase = "Scan", tools: Sequence[Tool] = ()
) -> np.ndarray:
    """What stays the same from frame to frame, uint8, shape (height, width, 3)."""
    fade = np.linspace(0, 1, layout.scene.height)[:, None]
    rows = (1 - fade) * np.array(BACKDROP_TOP) + fade * np.array(BACKDROP_FOOT)
    page = np.empty((layout.height, layout.width, 3), dtype=np.uint8)
    page[:] = STRIP
    page[layout.scene.slices] = np.round(rows).astype(np.uint8)[:, None]
    image = Image.fromarray(page)
    draw = ImageDraw.Draw(image)
    px, middle, clock = layout.px, layout.title.height // 2, clock_box(layout, help_key)
    left = max(box.right for box in tabs_of(layout).values()) + px(16)
    draw.text(
        (layout.title.right - px(16), middle),
        HELP_HINT.format(help_key),
        font=font(px(14)),
        fill=TEXT,
        anchor="rm",
    )
    room = clock.left - left - px(16)
    if room > px(LEAST_TITLE):
        title = shortened(view.title or "Nephron", px(15), room)
        draw.text((left, middle), title, font=font(px(15)), fill=QUIET, anchor="lm")
    draw_panel(draw, layout, view)
    for y in (layout.title.bottom - 1, layout.strip.top):
        draw.line([(0, y), (layout.strip.right, y)], fill=LINE)
    _draw_tabs(draw, layout, phase)
    for tool in tools:
        _draw_tool(draw, layout, tool)
    return np.array(image)


def _draw_tabs(draw: ImageDraw.ImageDraw, layout: WindowLayout, phase: Phase) -> None:
    """Draw the phases; the present one is underlined."""
    for name, box in tabs_of(layout).items():
        is_on, place = name == phase, (box.left + box.width / 2, box.height / 2)
        colour, letters = TEXT if is_on else QUIET, font(layout.px(TAB_PX))
        draw.text(place, name, font=letters, fill=colour, anchor="mm")
        if is_on:
            y, around = box.bottom - layout.px(2), layout.px(8)
            draw.line([(box.left + around, y), (box.right - around, y)], fill=MARK, width=layout.px(3))


def _draw_tool(draw: ImageDraw.ImageDraw, layout: WindowLayout, tool: Tool) -> None:
    """Draw a button: what it does, and its key."""
    box, px, letters = tool.box, layout.px, font(layout.px(TOOL_PX))
    edges, middle = [box.left, box.top, box.right - 1, box.bottom - 1], box.top + box.height / 2
    draw.rounded_rectangle(edges, px(4), fill=HELP, outline=MARK if tool.is_on else LINE)
    draw.text((box.left + px(GAP_PX), middle), tool.label, font=letters, fill=TEXT, anchor="lm")
    draw.text((box.right - px(GAP_PX), middle), tool.key, font=letters, fill=MARK, anchor="rm")


def clock_box(layout: WindowLayout, help_key: str = "H") -> Rect:
    """The box of the clock, in the title's row, between the phases and the help hint."""
    px = layout.px
    right = layout.title.right - 2 * px(16) - int(font(px(14)).getlength(HELP_HINT.format(help_key)))
    left = max(right - px(CLOCK_WIDTH), *(box.right for box in tabs_of(layout).values()))
    return Rect(left, 0, right - left, layout.title.height - 1)


def clock_image(layout: WindowLayout, box: Rect, clock: str, pace: str) -> np.ndarray:
    """The session's time and its rate, uint8, shape of the box."""
    image = Image.new("RGB", (box.width, box.height), STRIP)
    draw, letters, middle = ImageDraw.Draw(image), font(layout.px(14)), layout.title.height // 2
    draw.text((box.width, middle), clock, font=letters, fill=TEXT, anchor="rm")
    right = box.width - int(letters.getlength(clock)) - layout.px(12)
    # A part of it would be another figure.
    if letters.getlength(pace) < right:
        draw.text((right, middle), pace, font=letters, fill=ALERT, anchor="rm")
    return np.asarray(image)


def progress_image(layout: WindowLayout, text: str, share: float) -> np.ndarray:
    """The program's name, what it prepares, and a bar of the share that is done, uint8, shape (height, width,
    3).
    """
    box, px = layout.whole, layout.px
    image = Image.new("RGB", (box.width, box.height), HELP)
    draw, middle = ImageDraw.Draw(image), (box.width // 2, box.height // 2)
    draw.text(middle, "Nephron", font=font(px(PROGRAM_PX)), fill=TEXT, anchor="ms")
    draw.text((middle[0], middle[1] + px(PROGRAM_PX)), text, font=font(px(HELP_PX)), fill=QUIET, anchor="mm")
    left, top, width = middle[0] - px(BAR_PX) // 2, middle[1] + 2 * px(PROGRAM_PX), px(BAR_PX)
    for part, colour in ((1.0, LINE), (share, MARK)):
        draw.rectangle([left, top, left + part * width, top + px(BAR_HIGH_PX)], fill=colour)
    return np.asarray(image)


def help_image(layout: WindowLayout, groups: Mapping[str, list[tuple[str, str]]]) -> np.ndarray:
    """The list of keys by group, uint8, shape (height, width, 3)."""
    box, px = layout.whole, layout.px
    image = Image.new("RGB", (box.width, box.height), HELP)
    draw = ImageDraw.Draw(image)
    columns = in_columns(groups)
    pitch = (box.height - px(28)) / max(map(len, columns))
    width, gap = box.width // HELP_COLUMNS - 2 * px(16), px(HELP_GAP_PX)
    rows = [row for lines in groups.values() for row in lines]
    size = fitting_size(rows, width - gap, min(int(0.75 * pitch), px(HELP_PX)))
    key_width = max(font(size).getlength(key) for key, _ in rows)
    for number, column in enumerate(columns):
        x = px(16) + number * box.width // HELP_COLUMNS + key_width
        for place, (key, text) in enumerate(column):
            y = px(14) + (place + 0.5) * pitch
            draw.text((x, y), key, font=font(size), fill=MARK, anchor="rm")
            draw.text((x + gap, y), text, font=font(size), fill=TEXT if key else QUIET, anchor="lm")
    return np.asarray(image)


def in_columns(groups: Mapping[str, list[tuple[str, str]]]) -> list[list[tuple[str, str]]]:
    """Groups of rows in HELP_COLUMNS columns, none split, each under its name."""
    blocks = [[("", name), *rows, ("", "")] for name, rows in groups.items()]
    columns: list[list[tuple[str, str]]] = [[] for _ in range(HELP_COLUMNS)]
    share = sum(map(len, blocks)) / HELP_COLUMNS
    for block in blocks:
        column = next(
            (candidate for candidate in columns if len(candidate) + len(block) / 2 <= share), columns[-1]
        )
        column += block
    return columns


def readout_image(layout: WindowLayout, readouts: Mapping[str, str]) -> np.ndarray:
    """Names and values, one line each, as many as fit, uint8, shape of layout.readouts."""
    box = layout.readouts
    image = Image.new("RGB", (box.width, box.height), STRIP)
    draw = ImageDraw.Draw(image)
    draw.line([(0, 0), (box.width, 0)], fill=LINE)
    room = box.height - 2 * layout.figures_pad
    pitch = min(layout.px(FIGURE_HEIGHT), max(LEAST_PITCH, room // max(1, len(readouts))))
    _draw_figures(draw, layout, box, first_of(readouts, room // pitch), "", pitch)
    return np.asarray(image)


def findings_image(layout: WindowLayout, findings: Mapping[str, str], alert: str = "") -> np.ndarray:
    """Names and values, uint8, shape of layout.findings(count); the one named ``alert`` is highlighted."""
    box = layout.findings(len(findings))
    image = Image.new("RGB", (box.width, box.height), FINDINGS)
    draw = ImageDraw.Draw(image)
    draw.rectangle([0, 0, box.width - 1, box.height - 1], outline=ALERT if alert else LINE)
    _draw_figures(draw, layout, box, findings, alert, layout.px(FIGURE_HEIGHT))
    return np.asarray(image)


def first_of(figures: Mapping[str, str], most: int) -> dict[str, str]:
    """The first figures, at most ``most``."""
    return dict(islice(figures.items(), most))


def _draw_figures(
    draw: ImageDraw.ImageDraw,
    layout: WindowLayout,
    box: Rect,
    figures: Mapping[str, str],
    alert: str,
    pitch: float,
) -> None:
    px, pad, most = layout.px, layout.figures_pad, int(0.68 * pitch)
    room = box.width - px(FIGURES_GAP_PX)
    size = min(
        (fitting_size([(f"{name}  {value}",)], room, most) for name, value in figures.items()), default=most
    )
    for i, (name, value) in enumerate(figures.items()):
        y = pad + (i + 0.5) * pitch
        colours = (ALERT, ALERT) if name == alert else (QUIET, TEXT)
        draw.text((px(8), y), name, font=font(size), fill=colours[0], anchor="lm")
        draw.text((box.width - px(10), y), value or NO_VALUE, font=font(size), fill=colours[1], anchor="rm")


def ends_of(axes: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """The letters of the patient's axes and their directions on the screen (2,), right and up, the farthest
    first.

    ``axes`` (3, 3) are the camera's right, up and ahead, in the patient.
    """
    ends = [
        (letters[side > 0], side * axes[:, axis])
        for axis, letters in enumerate(LETTERS)
        for side in (-1, 1)
        if np.hypot(*axes[:2, axis]) > LEAST_LENGTH
    ]
    return [(letter, end[:2]) for letter, end in sorted(ends, key=lambda end: -end[1][2])]


def are_apart(places: np.ndarray, least: float) -> list[bool]:
    """Whether each of some places (n, 2), the nearest last, is at least so far from all nearer ones for
    which that is true.
    """
    free: list[np.ndarray] = []
    apart = []
    for place in places[::-1]:
        apart.append(all(np.linalg.norm(place - other) >= least for other in free))
        free += [place] * apart[-1]
    return apart[::-1]


def compass_image(layout: WindowLayout, axes: np.ndarray) -> np.ndarray:
    """The compass for a camera's axes (3, 3), uint8, shape of layout.compass.

    Of two letters at the same place the nearer one is shown: at the opposite place it is the other axis's.
    """
    size = layout.compass.width
    image = Image.new("RGB", (size, size), FINDINGS)
    draw = ImageDraw.Draw(image)
    draw.rectangle([0, 0, size - 1, size - 1], outline=LINE)
    middle = np.array([size, size]) / 2
    ends = ends_of(axes)
    down = np.array([axis for _, axis in ends]) * [1, -1]
    tips = middle + size * ARM * down
    places = tips + size * BEYOND * down / np.linalg.norm(down, axis=1, keepdims=True)
    for rank, shows_letter in enumerate(are_apart(places, layout.px(LETTER_PX))):
        colour = TEXT if rank >= len(ends) / 2 else QUIET
        draw.line([*middle, *tips[rank]], fill=colour, width=layout.px(LINE_PX))
        if shows_letter:
            draw.text(
                tuple(places[rank]), ends[rank][0], font=font(layout.px(LETTER_PX)), fill=colour, anchor="mm"
            )
    return np.asarray(image)
