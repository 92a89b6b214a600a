"""The start screen as images: what is shown fits, and what can be chosen can be reached by mouse and keys."""

from itertools import combinations

import numpy as np
import pytest
from conftest import ROOT
from PIL import Image

from render.start_screen import (
    COLOURS,
    PAGE,
    SECTIONS,
    SURFACES,
    Button,
    DrawnScreen,
    FormRow,
    LabelRow,
    PatientCard,
    SessionRow,
    cards_that_fit,
    folded,
    form_screen,
    labels_that_fit,
    list_screen,
    result_pages,
    result_screen,
)
from render.text import font
from render.ultrasound_panel import ALERT
from render.window_layout import Rect, WindowLayout

# The longest lines that patients have.
LINES = (
    "Tumour of 104 mm, largest of 12",
    "R.E.N.A.L. 10-12xh, moderate to high",
    "PADUA 10-12a, intermediate to high",
    "Imported 59 minutes ago",
)
BUTTONS = [Button("import", "Import a patient", "I"), Button("back", "Quit", "Esc")]
REFUSAL = "the labels are outside the CT, with 0 % of the organ in it: expected both to overlap. " * 9
SIZES = [(1088, 612), (1280, 720), (1920, 1080), (3840, 2160)]

each_size = pytest.mark.parametrize("size", SIZES, ids=str)


def cards(count: int) -> list[PatientCard]:
    picture = np.full((100, 100, 3), 90, np.uint8)
    alert = "12 warnings of the import to check"
    return [PatientCard(f"patient {n}", "Left kidney (draft)", LINES, alert, picture) for n in range(count)]


def sessions(count: int) -> list[SessionRow]:
    of = {"Replay": "replay", "Go on": "go on"}
    return [
        SessionRow(
            "Right kidney", ("3600 s, 12 cuts", "59 minutes ago"), {f"{of[text]} {n}": text for text in of}
        )
        for n in range(count)
    ]


def patients(size: tuple[int, int], message: str = "", selected: str = "") -> DrawnScreen:
    layout = WindowLayout(*size)
    shown = cards(cards_that_fit(layout, message))
    return list_screen(layout, shown, sessions(5), BUTTONS, message, selected)


def form(size: tuple[int, int], message: str = "") -> DrawnScreen:
    layout, roles = WindowLayout(*size), ("by name", "kidney", "tumour", "cyst", "collecting system")
    rows = [FormRow("Labels", "a" * 200, (Button(f"{n} file", "Choose a file", "C"),)) for n in range(3)]
    labels = [
        LabelRow("1  kidney", "kidney", "188.8 ml", tuple(Button(f"label {n} {of}", of) for of in roles))
        for n in range(labels_that_fit(layout, len(rows), message))
    ]
    return form_screen(layout, rows, labels, "What each label is", BUTTONS, message)


def is_blank(screen: DrawnScreen, box: Rect) -> bool:
    return bool((screen.image[box.slices] == PAGE).all())


def overlap(one: Rect, other: Rect) -> bool:
    return max(one.left, other.left) < min(one.right, other.right) and max(one.top, other.top) < min(
        one.bottom, other.bottom
    )


@each_size
@pytest.mark.parametrize("page", [patients, form])
@pytest.mark.parametrize("message", ["", REFUSAL], ids=["", "refusal"])
def test_all_boxes_are_in_the_window_and_apart(page, size, message):
    screen, whole = page(size, message), WindowLayout(*size).whole
    assert screen.image.shape == (size[1], size[0], 3)
    assert all(box.left >= 0 and box.top >= 0 for box in screen.boxes.values())
    assert all(box.right <= whole.right and box.bottom <= whole.bottom for box in screen.boxes.values())
    assert not [pair for pair in combinations(screen.boxes.values(), 2) if overlap(*pair)]


@each_size
def test_the_longest_texts_of_a_patient_stay_in_the_card(size):
    screen, gap = patients(size), WindowLayout(*size).px(6)
    for action, box in screen.boxes.items():
        if action.startswith("patient"):
            assert is_blank(screen, Rect(box.left, box.bottom + 1, box.width, gap)), action
            assert is_blank(screen, Rect(box.right + 1, box.top, gap, box.height)), action


@each_size
def test_letters_have_fourteen_pixels_at_least(size):
    # By the height of a capital, which is 0.7 of the letters' size.
    screen = patients(size, "HHHH")
    rows = np.flatnonzero((screen.image == ALERT).all(axis=2)[:, : size[0] // 20].any(axis=1))
    assert np.ptp(rows) + 1 >= 0.65 * 13


@each_size
def test_a_long_refusal_is_shown_whole(size):
    layout = WindowLayout(*size)
    screen, empty = form(size, REFUSAL), form(size)
    # So many lines of letters in its colour as it has when folded.
    rows = (screen.image == ALERT).all(axis=2).any(axis=1)
    begins = np.flatnonzero(rows[1:] & ~rows[:-1])
    lines = folded(REFUSAL, layout.px(16), layout.width - layout.px(48))
    assert len(lines) > 3 and len(begins) >= len(lines)
    assert not (empty.image == ALERT).all(axis=2).any()
    assert " ".join(lines) == REFUSAL.strip()


def test_a_word_wider_than_its_line_is_divided_and_keeps_all_letters():
    path = "/data/" + "very-long-folder/" * 20
    lines = folded(f"no file: {path}", 16, 200)
    assert max(map(font(16).getlength, lines)) <= 200
    assert "".join(lines).replace(" ", "") == f"nofile:{path}"


def test_a_click_finds_the_action_under_it():
    screen = patients((1280, 720))
    for action, box in screen.boxes.items():
        assert screen.action_at(box.left + 1, box.bottom - 2) == action
    assert screen.action_at(1, 1) == ""


def test_arrows_reach_every_action_and_stay_at_the_edge():
    screen = patients((1280, 720))
    reached, ahead = {"patient 0"}, ["patient 0"]
    while ahead:
        action = ahead.pop()
        new = {screen.neighbour(action, key) for key in ("Up", "Down", "Left", "Right")} - reached
        reached |= new
        ahead += new
    assert reached == set(screen.boxes)
    assert screen.neighbour("patient 0", "Right") == "patient 1"
    assert screen.neighbour("patient 0", "Down") == "patient 2"
    assert screen.neighbour("patient 0", "Left") == screen.neighbour("patient 0", "Up") == "patient 0"


def test_what_is_selected_has_a_frame_of_its_own():
    plain, selected = patients((1280, 720)), patients((1280, 720), selected="patient 1")
    changed = (plain.image != selected.image).any(axis=2)
    box = selected.boxes["patient 1"]
    assert changed[box.slices].any()
    changed[box.slices] = False
    assert not changed.any()


@pytest.mark.parametrize("part", [SECTIONS, SURFACES, COLOURS])
def test_no_part_of_a_check_picture_is_cut_through(part):
    # That of the embedded patient has the tallest sections, and all colours.
    picture = np.asarray(Image.open(ROOT / "docs" / "check.png").convert("RGB")).astype(int)
    left, top, right, bottom = (
        round(share * size) for share, size in zip(part, (1300, 960) * 2, strict=True)
    )
    ink = np.abs(picture - picture[0, 0]).max(axis=2) > 8
    assert ink[top:bottom, left:right].any()
    for edge in (ink[top, left:right], ink[bottom - 1, left:right], ink[top:bottom, left]):
        assert not edge.any()
    assert not ink[top:bottom, right - 1].any()


class TestResult:
    ROWS = tuple([("WARNING", "the labels are shifted by 4 mm " * 4)] + [("organ", "left kidney " * 6)] * 30)
    PICTURE = np.full((960, 1300, 3), 77, np.uint8)

    def page(self, size: tuple[int, int], number: int) -> DrawnScreen:
        return result_screen(WindowLayout(*size), "Imported", self.PICTURE, self.ROWS, BUTTONS, "", number)

    @each_size
    def test_the_warning_is_on_the_first_page_under_the_sections(self, size):
        screen = self.page(size, 0)
        sections = np.flatnonzero((screen.image == 77).all(axis=2).any(axis=1))
        warning = np.flatnonzero((screen.image == ALERT).all(axis=2).any(axis=1))
        assert len(sections) > 0.5 * size[1] and warning.min() > sections.max()
        assert warning.max() < screen.boxes["import"].top

    @each_size
    def test_the_pages_have_all_of_the_text(self, size):
        layout = WindowLayout(*size)
        count = result_pages(layout, self.ROWS)
        assert count > 2
        # The last page has a text, and one more would have none.
        right = layout.width * 3 // 4
        last, beyond = (
            self.page(size, number).image[layout.px(72) : -layout.px(60), right:]
            for number in (count - 1, count)
        )
        assert (last != PAGE).any() and (beyond == PAGE).all()
