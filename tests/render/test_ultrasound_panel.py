"""The ultrasound panel: where its pictures lie and what is drawn around and over them."""

import numpy as np
import pytest
from PIL import Image, ImageDraw

from render import background_image, ultrasound_panel
from render.text import font
from render.viewer import View
from render.window_layout import HEADER_HEIGHT, OTHERS_SHARE, RULER_WIDTH, WindowLayout

LAYOUT = WindowLayout(1280, 720)


def ct_view(width_mm: float = 40.0, depth_mm: float = 60.0, **more) -> View:
    """A CT slice alone."""
    return View(np.eye(4), {"CT": np.zeros((2, 2), np.uint8)}, width_mm, depth_mm, **more)


def test_slice_of_the_size_of_its_box_appears_unchanged_and_nothing_else_is_written():
    box = LAYOUT.image_boxes(1, 40.0, 60.0)[0]
    grey = np.random.default_rng(2).integers(0, 256, (box.height, box.width), dtype=np.uint8)
    picture = np.full((720, 1280, 4), 7, dtype=np.uint8)
    ultrasound_panel.paste_image(picture, box, grey)
    assert np.array_equal(picture[box.slices][..., :3], np.repeat(grey[..., None], 3, axis=2))
    assert np.all(picture[..., 3] == 7)
    picture[box.slices] = 7
    assert np.all(picture == 7)


def test_resampled_slice_keeps_its_sides():
    box = LAYOUT.image_boxes(1, 40.0, 60.0)[0]
    grey = np.zeros((512, 512), dtype=np.uint8)
    grey[:256, :256] = 200
    picture = np.zeros((720, 1280, 3), dtype=np.uint8)
    ultrasound_panel.paste_image(picture, box, grey)
    inside = picture[box.slices][..., 0]
    rows, columns = box.height // 2, box.width // 2
    assert np.all(inside[: rows - 2, : columns - 2] == 200)
    assert np.all(inside[rows + 2 :] == 0) and np.all(inside[:, columns + 2 :] == 0)


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize(
    ("width_mm", "depth_mm"),
    [(16.0, 40.0), (40.0, 60.0), (40.0, 20.0), (40.0, 120.0), (60.0, 45.0), (180.0, 128.0)],
)
def test_images_share_the_panel_without_overlap_in_the_shape_of_the_image_plane(count, width_mm, depth_mm):
    boxes, taken = LAYOUT.image_boxes(count, width_mm, depth_mm), np.zeros((720, 1280), int)
    for box in boxes:
        taken[box.slices] += 1
        assert box.left >= LAYOUT.panel.left + RULER_WIDTH and box.right <= LAYOUT.panel.right
        assert box.top >= HEADER_HEIGHT and box.bottom <= LAYOUT.panel.bottom
        # Each side is rounded to whole pixels: half a pixel on either.
        assert abs(box.width * depth_mm - box.height * width_mm) <= 0.5 * (width_mm + depth_mm)
    assert taken.max() == 1
    first, last = boxes[0], boxes[-1]
    if first[2:] != last[2:]:
        # Smaller than the first, which would not be as large as the room lets it otherwise.
        assert last.width / first.width == pytest.approx(OTHERS_SHARE, abs=0.01)
        assert last.right - LAYOUT.px(RULER_WIDTH) - LAYOUT.panel.left > 0.9 * (LAYOUT.panel.width - 72)
    assert count == 1 or (boxes[0].left == boxes[1].left) == (width_mm > depth_mm)


def test_the_panel_writes_the_depth_below_the_face_and_the_ends_of_the_scale():
    """An image of 130 mm begins 10 mm behind the middle of a curved face."""
    written: dict[str, float] = {}
    draw = ImageDraw.Draw(Image.new("RGB", (1280, 720)))
    draw.text = lambda at, text, **_: written.update({text: at[1]})
    view = ct_view(60.0, 130.0, above_mm=10.0, captions=("probe", "", ""), scale=("+18", "-18"))
    ultrasound_panel.draw_panel(draw, LAYOUT, view)
    assert "Depth 12.0 cm" in written and written["+18"] < written["-18"]
    # The ruler begins at the face.
    box = LAYOUT.image_boxes(1, 60.0, 130.0)[0]
    per_cm = 10 * box.height / 130
    assert written["cm"] == pytest.approx(box.top + per_cm, abs=1)
    assert written["12"] == pytest.approx(box.bottom, abs=1) and "13" not in written


def test_image_plane_without_extent_is_refused():
    with pytest.raises(ValueError, match="positive"):
        LAYOUT.image_boxes(1, 40.0, 0.0)[0]


@pytest.mark.parametrize("depth_mm", [20.0, 60.0, 87.0, 120.0])
def test_ruler_ticks_stand_at_their_depth(depth_mm):
    box = LAYOUT.image_boxes(1, 40.0, depth_mm)[0]
    ticks = ultrasound_panel.ruler_ticks(ct_view(depth_mm=depth_mm), box)
    assert len(ticks) == int(depth_mm // 5) + 1
    for i, (row, centimetres) in enumerate(ticks):
        depth = (row - box.top) / (box.height - 1) * depth_mm
        assert abs(depth - 5.0 * i) <= 0.5 * depth_mm / (box.height - 1) + 1e-9
        assert centimetres == (i // 2 if i % 2 == 0 else None)


def test_ruler_is_drawn_where_its_ticks_say():
    drawn_with = ct_view()
    box = LAYOUT.image_boxes(1, 40.0, 60.0)[0]
    picture = background_image.backdrop(LAYOUT, drawn_with)
    column = picture[box.top : box.bottom, box.left - 8]
    drawn = {box.top + int(row) for row in np.flatnonzero(np.any(column != ultrasound_panel.PANEL, axis=1))}
    assert drawn == {row for row, _ in ultrasound_panel.ruler_ticks(drawn_with, box)}


def test_marker_dot_is_on_the_right():
    page = background_image.backdrop(LAYOUT, ct_view())
    box = LAYOUT.image_boxes(1, 40.0, 60.0)[0]
    marked = np.all(page == ultrasound_panel.MARK, axis=2)[:, LAYOUT.panel.left :]
    columns = LAYOUT.panel.left + np.flatnonzero(marked.any(axis=0))
    assert len(columns) > 0 and np.all(columns > (box.left + box.right) / 2)


def test_panel_title_scene_and_strip_tile_the_window():
    taken = np.zeros((720, 1280), dtype=int)
    for rect in [LAYOUT.panel, LAYOUT.title, LAYOUT.scene, LAYOUT.strip]:
        taken[rect.slices] += 1
    assert np.all(taken == 1)


def test_a_status_is_in_its_own_box_and_nothing_of_it_is_left():
    composed, shown = background_image.BackgroundImage(LAYOUT), []
    for status in ("", "FROZEN", ""):
        composed.compose(ct_view(status=status), np.eye(3))
        shown.append(composed.pixels.transpose(1, 0, 2)[::-1].astype(int))
    changed = np.argwhere(np.any(shown[0] != shown[1], axis=2))
    low, high = changed.min(axis=0), changed.max(axis=0)
    assert LAYOUT.status.contains(low[1], low[0]) and LAYOUT.status.contains(high[1], high[0])
    assert np.array_equal(shown[0], shown[2])


@pytest.mark.parametrize("size", [(1280, 720), (1920, 1080)])
@pytest.mark.parametrize(
    "status",
    ["FROZEN", "PREPARING THE IMAGE", "TISSUE COMPRESSED BY 12 mm   TRACKING LOST"],
)
def test_a_status_is_as_large_as_it_can_be_in_the_panel(size, status):
    layout = WindowLayout(*size)
    plain, with_status = (ultrasound_panel.status_image(layout, text).astype(int) for text in ("", status))
    columns = np.flatnonzero(np.any(plain != with_status, axis=(0, 2)))
    room = layout.panel.width - 2 * layout.px(16)
    assert layout.status.width == room
    # The usual font where that fits, but for the room beside its first and last letter; else one size more
    # would not, which makes it wider by a ninth at most.
    usual = font(layout.px(17)).getlength(status)
    fits = usual <= room
    assert (
        np.ptp(columns) == pytest.approx(usual, abs=layout.px(5)) if fits else np.ptp(columns) > 0.88 * room
    )
