"""The box of messages and the page of all of them: nothing is cut off."""

import numpy as np
import pytest

from render.message_box import PAGE, STRIP, log_image, message_image, message_lines
from render.text import font, wrapped
from render.window_layout import FULL_SIZE, MESSAGE_LINES, MESSAGE_PITCH, WindowLayout

SIZES = [(700, 420), (1024, 600), FULL_SIZE, (1920, 1080), (3840, 2160)]
LONGEST = (
    "The cut is refused: the line of 84 mm is nearer to the tumour than the margin of 5 mm at two places, "
    "where it is red; set marks further away there with Shift+Left button, or ask for a smaller margin with "
    "the slider, and cut again"
)


def test_wrapped_lines_have_all_words_and_fit():
    lines = wrapped(LONGEST, 15, 300)
    assert " ".join(lines) == LONGEST and len(lines) > 3
    assert max(font(15).getlength(line) for line in lines) <= 300
    assert wrapped("incomprehensibilities no", 15, 20) == ["incomprehensibilities", "no"]


@pytest.mark.parametrize("size", SIZES)
def test_the_longest_message_is_whole_in_every_window(size):
    layout = WindowLayout(*size)
    lines, letters = message_lines(layout, (LONGEST,))
    assert " ".join(lines) == LONGEST and len(lines) <= MESSAGE_LINES
    assert max(font(letters).getlength(line) for line in lines) <= layout.messages.width
    image = message_image(layout, (LONGEST,))
    assert image.shape == (layout.messages.height, layout.messages.width, 3)
    written = (image != STRIP).any(axis=2)
    assert written.any() and not written[-2:].any() and not written[:, -4:].any()
    if size == FULL_SIZE:
        assert letters >= 14


def test_what_is_longer_than_the_box_ends_in_dots():
    lines, _ = message_lines(WindowLayout(*FULL_SIZE), (LONGEST, LONGEST, LONGEST))
    assert len(lines) == MESSAGE_LINES and lines[-1].endswith("...")


def test_without_messages_the_box_is_empty():
    assert (message_image(WindowLayout(*FULL_SIZE), ()) == STRIP).all()


def test_each_line_of_a_hint_is_a_line():
    layout = WindowLayout(*FULL_SIZE)
    image = message_image(layout, (), "one\ntwo")
    assert not np.array_equal(image, message_image(layout, (), "one two"))
    above = message_image(layout, (), "one")
    row = layout.figures_pad // 2 + layout.px(MESSAGE_PITCH)
    assert np.array_equal(image[:row], above[:row]) and (image[row:] != above[row:]).any()


@pytest.mark.parametrize("size", SIZES)
def test_the_page_shows_the_newest_first_and_none_in_part(size):
    layout = WindowLayout(*size)
    few, many = ([(f"{n} s", LONGEST) for n in range(count)] for count in (2, 90))
    assert not np.array_equal(log_image(layout, few), log_image(layout, few[::-1]))
    page = log_image(layout, many)
    assert (page[-1] == PAGE).all()
    # Older ones than fit change nothing.
    assert np.array_equal(page, log_image(layout, [("0 s", "another"), *many]))
    assert not np.array_equal(page, log_image(layout, [*many, ("99 s", "another")]))
