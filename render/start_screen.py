"""The start screen as images: patients and sessions to choose, the import of a patient, and what it has made.

What can be clicked on has an action, a text; the keys of arrows go from one to the next.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw

from render.text import font, shortened
from render.ultrasound_panel import ALERT, FINDINGS, LINE, MARK, QUIET, TEXT
from render.window_layout import Rect, WindowLayout

PAGE, BUTTON, CHOSEN = (22, 26, 31), (34, 40, 47), (40, 62, 76)
TITLE_PX, HEADING_PX, LETTERS_PX, PITCH_PX = 28, 18, 16, 21
EDGE_PX, GAP_PX, BUTTON_PX, PAD_PX = 24, 10, 32, 9
TOP_PX, FOOT_PX = 72, 54
CARDS_PX, CARD_PX, PICTURE_PX, CARD_COLUMNS = 832, (411, 162), 112, 2
SESSION_PX = 84
ROW_PX, LABELS_PX = 42, 96
NAME_PX, TISSUE_PX, VOLUME_PX = 330, 190, 90
# The parts of a check picture besides its text, as shares of its size: left, top, right, bottom.
SECTIONS, SURFACES, COLOURS = (0.0, 0.05, 1.0, 0.52), (0.0, 0.52, 0.66, 1.0), (0.66, 0.905, 1.0, 1.0)
SECTIONS_PX, SURFACES_PX, COLOURS_PX = 400, 760, 84
TOWARDS = {"Up": (0, -1), "Down": (0, 1), "Left": (-1, 0), "Right": (1, 0)}
# Beside the way along an arrow, the way across it counts so many times.
ACROSS = 3.0
# And an action further to its side than this share allows is not in its direction.
LEAST_AHEAD = 1 / 3


@dataclass(frozen=True)
class PatientCard:
    """A patient to choose."""

    action: str
    title: str
    lines: tuple[str, ...]
    alert: str = ""
    """What must be checked first."""
    picture: np.ndarray | None = None
    """Uint8, shape (height, width, 3)."""


@dataclass(frozen=True)
class SessionRow:
    """A session to replay; ``buttons`` has the text of each action."""

    title: str
    lines: tuple[str, ...]
    """Up to two."""
    buttons: Mapping[str, str]
    picture: np.ndarray | None = None
    """That of its patient, uint8, shape (height, width, 3)."""


@dataclass(frozen=True)
class Button:
    """A button, with its key if it has one."""

    action: str
    text: str
    key: str = ""
    is_on: bool = False


@dataclass(frozen=True)
class FormRow:
    """A choice of the import: its name, what is chosen, and the buttons that change it."""

    name: str
    text: str
    buttons: tuple[Button, ...]
    is_chosen: bool = False


@dataclass(frozen=True)
class LabelRow:
    """A label of the user's files, and the buttons that say what it is."""

    name: str
    tissue: str
    volume: str
    buttons: tuple[Button, ...]


@dataclass(frozen=True)
class DrawnScreen:
    """An image uint8 (height, width, 3) of the whole window, and the box of each action."""

    image: np.ndarray
    boxes: dict[str, Rect]

    def action_at(self, column: float, row: float) -> str:
        """The action at a pixel; empty where there is none."""
        return next((action for action, box in self.boxes.items() if box.contains(column, row)), "")

    def neighbour(self, action: str, key: str) -> str:
        """The nearest action from one in the direction of an arrow's key; itself where there is none."""
        here, (x, y) = _middle(self.boxes[action]), TOWARDS[key]
        ways = {other: _middle(box) - here for other, box in self.boxes.items()}
        ahead = {
            other: way @ (x, y)
            for other, way in ways.items()
            if way @ (x, y) > max(1.0, LEAST_AHEAD * abs(way @ (y, x)))
        }
        return min(ahead, key=lambda other: ahead[other] + ACROSS * abs(ways[other] @ (y, x)), default=action)


def _middle(box: Rect) -> np.ndarray:
    return np.array([box.left + box.width / 2, box.top + box.height / 2])


def list_screen(
    layout: WindowLayout,
    cards: Iterable[PatientCard],
    sessions: Iterable[SessionRow],
    buttons: Iterable[Button],
    message: str = "",
    selected: str = "",
) -> DrawnScreen:
    """Patients at the left, the last sessions at the right; ``cards_that_fit`` of them."""
    page, px = _Page(layout, "Nephron", selected), layout.px
    page.write(px(EDGE_PX + 140), px(34), "Choose a patient, or import one", HEADING_PX, QUIET)
    width, height = map(px, CARD_PX)
    for place, card in enumerate(cards):
        row, column = divmod(place, CARD_COLUMNS)
        left, top = page.left + column * (width + px(GAP_PX)), px(TOP_PX) + row * (height + px(GAP_PX))
        page.card(Rect(left, top, width, height), card)
    left, top = page.left + px(CARDS_PX + GAP_PX), px(TOP_PX)
    page.write(left, top + px(PAD_PX), "Last sessions", HEADING_PX, TEXT)
    top += px(PITCH_PX + PAD_PX)
    listed = list(sessions)
    if not listed:
        page.lines(left, top, page.right - left, "There are none yet.", QUIET)
    for session in listed:
        page.session(Rect(left, top, page.right - left, px(SESSION_PX - 6)), session)
        top += px(SESSION_PX)
    page.footer(buttons, message)
    return page.drawn()


def cards_that_fit(layout: WindowLayout, message: str) -> int:
    """How many cards of patients fit above a message and the buttons."""
    room = _message_top(layout, message) - layout.px(TOP_PX)
    return CARD_COLUMNS * max(1, room // layout.px(CARD_PX[1] + GAP_PX))


def form_screen(
    layout: WindowLayout,
    rows: Iterable[FormRow],
    labels: Iterable[LabelRow],
    heading: str,
    buttons: Iterable[Button],
    message: str = "",
    selected: str = "",
) -> DrawnScreen:
    """The choices of an import, and the labels, ``labels_that_fit`` of them, under a heading."""
    page, px = _Page(layout, "Import a patient", selected), layout.px
    top = px(TOP_PX)
    for row in rows:
        middle = top + px(BUTTON_PX) // 2
        page.write(page.left, middle, row.name, HEADING_PX, TEXT)
        left = page.left + px(LABELS_PX)
        for button in row.buttons:
            left = page.button(left, top, button).right + px(GAP_PX)
        page.write(left, middle, row.text, LETTERS_PX, TEXT if row.is_chosen else QUIET, page.right - left)
        top += px(ROW_PX)
    page.lines(page.left, top + px(4), page.right - page.left, heading, TEXT)
    top += px(ROW_PX - 6)
    for label in labels:
        middle, left = top + px(BUTTON_PX) // 2, page.left
        for text, width in ((label.name, NAME_PX), (label.tissue, TISSUE_PX), (label.volume, VOLUME_PX)):
            page.write(left, middle, text, LETTERS_PX, TEXT, px(width - GAP_PX))
            left += px(width)
        for button in label.buttons:
            left = page.button(left, top, button).right + px(6)
        top += px(BUTTON_PX + 4)
    page.footer(buttons, message)
    return page.drawn()


def labels_that_fit(layout: WindowLayout, rows: int, message: str) -> int:
    """How many labels fit between so many rows of choices and a message."""
    room = _message_top(layout, message) - layout.px(TOP_PX) - (rows + 1) * layout.px(ROW_PX)
    return max(1, room // layout.px(BUTTON_PX + 4))


def progress_screen(
    layout: WindowLayout, title: str, steps: Iterable[str], buttons: Iterable[Button], selected: str = ""
) -> DrawnScreen:
    """The steps of a task, the present one last."""
    page, px = _Page(layout, title, selected), layout.px
    top, listed = px(TOP_PX), list(steps)
    for place, step in enumerate(listed):
        is_last = place == len(listed) - 1
        colour = TEXT if is_last else QUIET
        top = page.lines(page.left, top, page.right - page.left, step, colour, HEADING_PX) + px(6)
    page.footer(buttons, "")
    return page.drawn()


def result_screen(
    layout: WindowLayout,
    title: str,
    picture: np.ndarray,
    rows: Sequence[tuple[str, str]],
    buttons: Iterable[Button],
    selected: str = "",
    number: int = 0,
) -> DrawnScreen:
    """A check picture, uint8 (height, width, 3), and its text: rows of a title and a text, of which warnings
    stand out.

    Page 0 has the sections and what fits of the text; those after it, of ``result_pages``, have the surfaces
    and all of the text.
    """
    page, px = _Page(layout, title, selected), layout.px
    width, foot = page.right - page.left, layout.height - px(FOOT_PX)
    if number == 0:
        height = px(SECTIONS_PX)
        page.picture(Rect(page.left, px(TOP_PX), width, height), _part(picture, SECTIONS))
        left, top = page.left, px(TOP_PX) + height + px(GAP_PX)
        lines = _result_lines(layout, rows, width)
        fit = (foot - top) // px(PITCH_PX)
        if len(lines) > fit:
            lines = [*lines[: fit - 1], ("...", TEXT)]
    else:
        beside, colours = px(SURFACES_PX), px(COLOURS_PX)
        whole = Rect(page.left, px(TOP_PX), beside, foot - px(TOP_PX) - colours)
        page.picture(whole, _part(picture, SURFACES))
        page.picture(Rect(page.left, foot - colours, beside, colours), _part(picture, COLOURS))
        left, top = page.left + beside + px(GAP_PX), px(TOP_PX)
        fit = (foot - top) // px(PITCH_PX)
        lines = _result_lines(layout, rows, page.right - left)[(number - 1) * fit : number * fit]
    for line, colour in lines:
        page.write(left, top + px(PITCH_PX) // 2, line, LETTERS_PX, colour)
        top += px(PITCH_PX)
    page.footer(buttons, "")
    return page.drawn()


def result_pages(layout: WindowLayout, rows: Sequence[tuple[str, str]]) -> int:
    """How many pages a result has."""
    px = layout.px
    lines = _result_lines(layout, rows, layout.width - px(2 * EDGE_PX + SURFACES_PX + GAP_PX))
    return 1 + -(-len(lines) // ((layout.height - px(FOOT_PX) - px(TOP_PX)) // px(PITCH_PX)))


def _result_lines(
    layout: WindowLayout, rows: Iterable[tuple[str, str]], width: int
) -> list[tuple[str, tuple[int, int, int]]]:
    return [
        (line, ALERT if name in ("WARNING", "DRAFT") else TEXT)
        for name, text in rows
        for line in folded(f"{name}: {text}", layout.px(LETTERS_PX), width)
    ]


def _part(picture: np.ndarray, shares: tuple[float, float, float, float]) -> np.ndarray:
    height, width = picture.shape[:2]
    left, top, right, bottom = shares
    return picture[round(top * height) : round(bottom * height), round(left * width) : round(right * width)]


def _message_lines(layout: WindowLayout, message: str) -> list[str]:
    return folded(message, layout.px(LETTERS_PX), layout.width - layout.px(2 * EDGE_PX))


def _message_top(layout: WindowLayout, message: str) -> int:
    """Where a message begins, above the buttons."""
    lines = len(_message_lines(layout, message))
    return layout.height - layout.px(FOOT_PX) - lines * layout.px(PITCH_PX)


def folded(text: str, size: int, width: int) -> list[str]:
    """The lines of a text that are no wider than so many pixels; a longer word is divided."""
    letters, lines, line = font(size), list[str](), ""
    for word in text.split():
        longer = f"{line} {word}" if line else word
        if line and letters.getlength(longer) > width:
            lines.append(line)
            longer = word
        while letters.getlength(longer) > width and len(longer) > 1:
            fits = len(longer) - 1
            while fits > 1 and letters.getlength(longer[:fits]) > width:
                fits -= 1
            lines.append(longer[:fits])
            longer = longer[fits:]
        line = longer
    return [*lines, line] if line else lines


class _Page:
    """An image that is drawn, and the boxes of its actions; lengths are in pixels of the window."""

    def __init__(self, layout: WindowLayout, title: str, selected: str) -> None:
        self.layout, self._selected = layout, selected
        self._image = Image.new("RGB", (layout.width, layout.height), PAGE)
        self._draw, self._boxes = ImageDraw.Draw(self._image), dict[str, Rect]()
        self.left, self.right = layout.px(EDGE_PX), layout.width - layout.px(EDGE_PX)
        self.write(self.left, layout.px(34), title, TITLE_PX, TEXT)
        self._draw.line([(self.left, layout.px(60)), (self.right, layout.px(60))], fill=LINE)

    def drawn(self) -> DrawnScreen:
        return DrawnScreen(np.asarray(self._image), self._boxes)

    def write(self, left: int, middle: int, text: str, size: int, colour, width: int | None = None) -> None:
        """A line of text; what is wider than a width is shortened."""
        letters = self.layout.px(size)
        line = text if width is None or not text else shortened(text, letters, width)
        self._draw.text((left, middle), line, font=font(letters), fill=colour, anchor="lm")

    def lines(self, left: int, top: int, width: int, text: str, colour, size: int = LETTERS_PX) -> int:
        """A text in lines of a width; return where it ends."""
        pitch = self.layout.px(size + PITCH_PX - LETTERS_PX)
        for line in folded(text, self.layout.px(size), width):
            self.write(left, top + pitch // 2, line, size, colour)
            top += pitch
        return top

    def button(self, left: int, top: int, button: Button) -> Rect:
        px, letters = self.layout.px, font(self.layout.px(LETTERS_PX))
        label, key = letters.getlength(button.text), letters.getlength(button.key)
        width = int(label + key) + px(2 * PAD_PX) + (px(PAD_PX) if button.key else 0)
        box = self._box(
            Rect(left, top, width, px(BUTTON_PX)), button.action, CHOSEN if button.is_on else BUTTON
        )
        middle = top + box.height // 2
        self.write(left + px(PAD_PX), middle, button.text, LETTERS_PX, TEXT)
        self.write(box.right - px(PAD_PX) - int(key), middle, button.key, LETTERS_PX, MARK)
        return box

    def card(self, box: Rect, card: PatientCard) -> None:
        self._box(box, card.action, FINDINGS)
        px, top = self.layout.px, box.top + self.layout.px(PAD_PX)
        left, size = box.left + px(PAD_PX), px(PICTURE_PX)
        if card.picture is not None:
            self.picture(Rect(left, top, size, size), card.picture)
        left += size + px(PAD_PX)
        width = box.right - px(PAD_PX) - left
        top = self.lines(left, top, width, card.title, TEXT, HEADING_PX)
        for text in card.lines:
            top = self.lines(left, top, width, text, QUIET)
        self.lines(left, top, width, card.alert, ALERT)

    def session(self, box: Rect, row: SessionRow) -> None:
        px, left = self.layout.px, box.right
        self._draw.rectangle(_edges(box), fill=FINDINGS, outline=LINE)
        for action, text in reversed([*row.buttons.items()]):
            button, letters = Button(action, text), font(self.layout.px(LETTERS_PX))
            left -= int(letters.getlength(text)) + px(3 * PAD_PX)
            self.button(left, box.top + (box.height - px(BUTTON_PX)) // 2, button)
        at = box.left + px(PAD_PX)
        if row.picture is not None:
            size = box.height - px(PAD_PX)
            self.picture(Rect(box.left + px(PAD_PX) // 2, box.top + px(PAD_PX) // 2, size, size), row.picture)
            at += size
        room = left - at - px(PAD_PX)
        self.write(at, box.top + px(18), row.title, HEADING_PX, TEXT, room)
        for place, text in enumerate(row.lines, 1):
            self.write(at, box.top + px(18 + place * PITCH_PX), text, LETTERS_PX, QUIET, room)

    def footer(self, buttons: Iterable[Button], message: str) -> None:
        """Buttons at the foot, and a message above them."""
        px, left = self.layout.px, self.left
        for button in buttons:
            box = self.button(left, self.layout.height - px(FOOT_PX - 14), button)
            left = box.right + px(GAP_PX)
        top = _message_top(self.layout, message)
        for line in _message_lines(self.layout, message):
            self.write(self.left, top + px(PITCH_PX) // 2, line, LETTERS_PX, ALERT)
            top += px(PITCH_PX)

    def picture(self, box: Rect, picture: np.ndarray) -> None:
        """A picture in the middle of a box, as large as fits."""
        image = Image.fromarray(np.ascontiguousarray(picture))
        scale = min(box.width / image.width, box.height / image.height)
        size = max(1, round(scale * image.width)), max(1, round(scale * image.height))
        at = box.left + (box.width - size[0]) // 2, box.top + (box.height - size[1]) // 2
        self._image.paste(image.resize(size, Image.Resampling.LANCZOS), at)

    def _box(self, box: Rect, action: str, colour) -> Rect:
        """A box that can be clicked on; the selected one has a frame."""
        is_selected, px = action == self._selected, self.layout.px
        self._draw.rounded_rectangle(
            _edges(box),
            px(4),
            fill=colour,
            outline=MARK if is_selected else LINE,
            width=px(3) if is_selected else self.layout.line_width,
        )
        self._boxes[action] = box
        return box


def _edges(box: Rect) -> list[int]:
    return [box.left, box.top, box.right - 1, box.bottom - 1]
