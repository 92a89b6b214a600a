"""Signs for the states of the machine: where they are, what is written, and what they mean."""

import numpy as np
import pytest

from render.background_image import BackgroundImage
from render.scene_view import MASKS
from render.sign_row import meaning_image, meaning_rect, sign_at, sign_boxes, sign_image
from render.ultrasound_panel import FINDINGS, RECORDING
from render.viewer import Sign, View
from render.window_layout import FULL_SIZE, Rect, WindowLayout

SIZES = [(700, 420), (1024, 600), FULL_SIZE, (1920, 1080), (3840, 2160)]
WORDS = "What this state means, in as many words as need two lines of the box over the row of all signs."
SIGNS = (
    Sign("Recording 12 s", WORDS, is_recording=True),
    Sign("Longer steps 1/15 s", "Steps are longer."),
    Sign("Reduced iterations 2 of 8", WORDS),
    Sign("Planning 43 %, about 18 min left", WORDS),
)
LAYOUT = WindowLayout(*FULL_SIZE)


def view_with(*signs: Sign, **changed) -> View:
    images = {"B-mode": np.zeros((60, 40), np.uint8)}
    return View(np.eye(4), images, width_mm=40.0, depth_mm=60.0, signs=signs, **changed)


def overlap(one: Rect, other: Rect) -> bool:
    apart = one.right <= other.left or other.right <= one.left
    return not (apart or one.bottom <= other.top or other.bottom <= one.top)


@pytest.mark.parametrize("size", SIZES)
def test_signs_are_in_a_row_in_the_3d_view_and_cover_nothing_that_is_read(size):
    layout = WindowLayout(*size)
    boxes = sign_boxes(layout, SIGNS)
    assert len(boxes) == len(SIGNS) or size[0] < 1280
    for sign, box in zip(SIGNS, boxes, strict=False):
        assert layout.scene.left <= box.left and box.right <= layout.scene.right
        assert layout.scene.top <= box.top and box.bottom <= layout.scene.bottom
        assert sign_image(layout, sign).shape == (box.height, box.width, 3)
        over = meaning_rect(layout, sign)
        assert layout.scene.contains(over.left, over.top) and over.right <= layout.scene.right
        assert not overlap(over, box) and not overlap(over, layout.compass)
        image = meaning_image(layout, sign)
        assert image.shape == (over.height, over.width, 3)
        # All letters are inside.
        assert (image[2:-2, 2:-2] != FINDINGS).any() and (image[1:-1, -3:-1] == FINDINGS).all()
    highest = layout.highest_warning
    warned = layout.foot._replace(top=highest, height=layout.foot.bottom - highest)
    others = layout.findings(layout.most_findings), layout.compass, warned
    for box in boxes:
        assert not any(overlap(box, other) for other in (*others, *(one for one in boxes if one != box)))


def test_signs_leave_the_place_of_sliders_and_the_last_are_left_out():
    assert len(sign_boxes(LAYOUT, SIGNS, taken=LAYOUT.signs.width // 2)) < len(SIGNS)
    assert sign_boxes(LAYOUT, SIGNS, taken=LAYOUT.signs.width) == []


def test_a_recording_has_a_red_dot_and_no_other_sign():
    has_dot = [(sign_image(LAYOUT, sign) == RECORDING).all(axis=2).sum() > 30 for sign in SIGNS]
    assert has_dot == [True, False, False, False]


def test_the_boxes_stay_where_they_are_as_numbers_change():
    texts = "Recording 11 s", "Recording 48 s"
    (one, after), (other, beside) = (
        sign_boxes(LAYOUT, (Sign(text, "", is_recording=True), SIGNS[1])) for text in texts
    )
    assert one == other and after == beside


def test_the_sign_under_the_mouse_shows_what_it_means_and_nothing_of_it_is_left():
    composed, pictures = BackgroundImage(LAYOUT), []
    first, second = sign_boxes(LAYOUT, SIGNS[:2])
    inside = first.left + 3.0, first.top + 3.0
    assert sign_at(LAYOUT, SIGNS, inside) == SIGNS[0]
    assert sign_at(LAYOUT, SIGNS, (second.left + 3.0, second.top + 3.0)) == SIGNS[1]
    assert sign_at(LAYOUT, SIGNS, None) is None and sign_at(LAYOUT, SIGNS, (3.0, 3.0)) is None
    for signs, pointed in (((), None), (SIGNS[:2], None), (SIGNS[:2], inside), ((), inside)):
        view = view_with(*signs)
        composed.compose(view, np.eye(3), pointed=pointed)
        pictures.append(composed.pixels.transpose(1, 0, 2)[::-1, :, :3].astype(int))
        boxes = composed.boxes_over_scene(view)
        assert [box in boxes for box in (first, second)] == [bool(signs)] * 2
    assert np.array_equal(pictures[0], pictures[3])
    changed = (pictures[1] != pictures[2]).any(axis=2)
    over = meaning_rect(LAYOUT, SIGNS[0])
    assert changed[over.slices].any() and changed.sum() == changed[over.slices].sum()
    assert np.array_equal(pictures[2][over.slices], meaning_image(LAYOUT, SIGNS[0]))
    changed = (pictures[0] != pictures[1]).any(axis=2)
    assert changed.sum() == changed[first.slices].sum() + changed[second.slices].sum() > 0
    # Nothing is written over the ultrasound image.
    assert not changed[LAYOUT.panel.slices].any()


def test_all_boxes_over_the_3d_view_can_be_masked():
    five = (*SIGNS[:3], Sign("Replay 3 s", WORDS), Sign("Planning", WORDS))
    composed = BackgroundImage(LAYOUT)
    view = view_with(*five, findings={"margin": "3 mm"}, warnings=("one",))
    box = sign_boxes(LAYOUT, five)[0]
    composed.compose(view, np.eye(3), pointed=(box.left + 1.0, box.top + 1.0))
    boxes = composed.boxes_over_scene(view)
    # With panel, title and strip.
    assert len(boxes) == 3 + 5 + 1 and len(boxes) + 3 <= MASKS
