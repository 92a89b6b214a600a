"""The page behind the 3D view: parts that do not overlap, texts that fit, and what is written over
pictures.
"""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from settings_at_start import settings_with

from render.background_image import (
    ARM,
    BackgroundImage,
    are_apart,
    backdrop,
    clock_box,
    compass_image,
    ends_of,
    findings_image,
    readout_image,
)
from render.camera import OrbitCamera
from render.keys import default_keys
from render.sliders import boxes_of, groups_of
from render.text import fitting_size, font, shortened, write
from render.ultrasound_panel import ALERT, CALIPER, OUTLINE, OUTLINE_AT_REST, QUIET, TEXT, to_plane
from render.viewer import Geometry, View
from render.warning_box import warning_lines, warning_rect
from render.window_layout import Rect, WindowLayout
from scenes.tissue import NeoHookeanTissue, ShapeMatchingTissue
from ultrasound.probe import load_probe

LAYOUT = WindowLayout(1280, 720)
AXES = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, 1.0, 0]])
FIGURES = {f"figure {k}": f"{k} mm" for k in range(14)}
SQUARE = np.array([[[-4.0, 10.0], [4.0, 10.0]], [[4.0, 10.0], [4.0, 20.0]]])
SCREENS = [(1280, 720), (2560, 1440), (3840, 2160)]
each_size = pytest.mark.parametrize("size", [(700, 420), (1024, 600), (1280, 720), (1366, 768), (1920, 1080)])


def view(**changes) -> View:
    pictures = {"B-mode": np.zeros((64, 32), np.uint8), "CT": np.zeros((64, 32), np.uint8)}
    return View(
        **{"transducer_pose": np.eye(4), "images": pictures, "width_mm": 16.0, "depth_mm": 40.0} | changes
    )


def composed(page: BackgroundImage, **changes) -> np.ndarray:
    """The page (rows, columns, 3) with a view on it."""
    page.compose(view(**changes), AXES)
    return page.pixels.transpose(1, 0, 2)[::-1, :, :3].copy()


def image_boxes(layout: WindowLayout) -> list[Rect]:
    return layout.image_boxes(2, 16.0, 40.0)


def coloured(picture: np.ndarray, box: Rect, colour) -> np.ndarray:
    """Rows and columns (n, 2) in a box of the pixels that are near a colour."""
    return np.argwhere(np.abs(picture[box.slices].astype(int) - colour).max(axis=-1) < 12)


def apart(one: Rect, other: Rect) -> bool:
    return (
        one.right <= other.left
        or other.right <= one.left
        or one.bottom <= other.top
        or other.bottom <= one.top
    )


def geometry(**parts) -> Geometry:
    return Geometry((None, np.zeros((0, 3))), np.zeros((2, 3)), **parts)


KEYS = default_keys()
ENGINEER = {"view.show_engineer": True}
ALL_BOXES = ENGINEER | {"view.show_scanner": True, "resection.show_resection": True}
WHOLE = geometry(tumour=(1, 1), parts={"vessel": (1, 1)}, support=(1, 1))


@pytest.mark.parametrize("doppler", ["off", "colour"])
@pytest.mark.parametrize("size", [(700, 420), (1024, 600), *SCREENS])
def test_no_part_of_the_window_overlaps_another(size, doppler):
    layout = WindowLayout(*size, has_engineer=True)
    settings = settings_with(ALL_BOXES | {"scanner.doppler": doppler})
    placed = boxes_of(settings, WHOLE, layout)
    shown = [box for box in placed.values() if box.top < layout.strip.top]
    assert len(shown) == {(700, 420): 1, (1024, 600): 2}.get(size, 3) and "Resection" in placed
    assert ("Doppler" in placed) == (doppler != "off" and len(shown) == 3)
    over = [layout.findings(layout.most_findings), layout.compass, *shown]
    below = [box for box in placed.values() if box.top >= layout.strip.top]
    parts = [*over, *below, layout.readouts, layout.messages, *image_boxes(layout)]
    for one, other in combinations(parts, 2):
        assert apart(one, other) or 0 in (*one[2:], *other[2:])
    for within, area in (
        (over, layout.scene),
        ([*below, layout.readouts], layout.engineer),
        ([layout.messages], layout.strip),
        (image_boxes(layout), layout.panel),
    ):
        for box in within:
            assert area.left <= box.left and box.right <= area.right
            assert area.top <= box.top and box.bottom <= area.bottom


@pytest.mark.parametrize("name", ["drop-in", "micro"])
def test_b_mode_and_ct_of_a_drop_in_probe_fill_the_panel(name):
    width, depth, _ = load_probe(name).extent_mm
    first, last = LAYOUT.image_boxes(2, width, depth)
    across = (last.right - first.left) / (LAYOUT.panel.width - 42 - 30)
    assert max(across, first.height / (720 - 74 - 52)) > 0.95 and LAYOUT.scene.width > 720


@each_size
def test_the_first_sliders_are_left_out_where_there_is_no_room(size):
    layout = WindowLayout(*size, has_engineer=True)
    names = list(boxes_of(settings_with(ENGINEER), WHOLE, layout))
    assert (layout.readouts.width == 0) == (size in ((700, 420), (1024, 600)))
    assert names == (["Image", "View"] if size == (700, 420) else ["Tissue", "Image", "View"])


@pytest.mark.parametrize("width", [*range(704, 1600, 64), 1250, 2560, 3840])
@pytest.mark.parametrize(
    "tissue, doppler",
    [(NeoHookeanTissue(), "off"), (ShapeMatchingTissue(model="shape-matching"), "power")],
    ids=["young", "stiffness"],
)
def test_labels_of_controls_are_whole(width, tissue, doppler):
    settings = settings_with(ALL_BOXES | {"scanner.doppler": doppler}).model_copy(update={"tissue": tissue})
    layout = WindowLayout(width, width * 9 // 16, has_engineer=True)
    groups = groups_of(settings, WHOLE)
    for name, box in boxes_of(settings, WHOLE, layout).items():
        # Rows that do not fit have a scroll bar, 14 pixels wide.
        scrolls = 23 * len(groups[name]) + 31 > box.height
        assert not scrolls or width < 1024
        for setting in groups[name]:
            values = (
                [] if setting.choices in ((), (False, True)) else [f": {value}" for value in setting.choices]
            )
            label = 7 * (len(setting.label) + max(map(len, values), default=0))
            # Pixels around a label, and of a switch or button, as Dear ImGui draws them.
            room = box.width - 35 if setting.choices else 0.35 * box.width - 16
            assert label <= room + 0.2


def test_a_missing_structure_has_no_slider():
    def named(shown: Geometry) -> set[str]:
        groups = groups_of(settings_with(), shown)
        return {each.name for members in groups.values() for each in members}

    whole = named(WHOLE)
    assert {
        "show_tumour",
        "outline",
        "margin_mm",
        "show_parts",
        "show_support",
    } <= whole and "stiffness" not in whole
    assert whole - named(geometry()) == {"show_tumour", "outline", "margin_mm", "show_parts", "show_support"}
    assert whole - named(geometry(tumour=(1, 1), parts={"cyst": (1, 1)})) == {"show_support"}


# Texts


def test_a_long_line_loses_its_last_parts_and_a_long_part_its_end():
    line = "TISSUE COMPRESSED BY 9 mm   SWEEP   122 pictures"
    length = font(17).getlength
    assert shortened(line, 17, 1000) == line and shortened("", 17, 10) == ""
    cut = shortened(line, 17, int(length("TISSUE COMPRESSED BY 9 mm   SWEEP")) + 1)
    assert cut == "TISSUE COMPRESSED BY 9 mm   SWEEP"
    cut = shortened(line, 17, 100)
    assert cut.endswith("...") and line.startswith(cut[:-3]) and 70 < length(cut) <= 100


def test_the_font_is_as_large_as_fits():
    rows = [("Space", "what it is for"), ("W / S", "push it in, lift it")]
    size = fitting_size(rows, 150, 30)
    lengths = [
        font(points).getlength("Space") + font(points).getlength("push it in, lift it")
        for points in (size, size + 1)
    ]
    assert lengths[0] <= 150 < lengths[1]
    assert fitting_size(rows, 900, 15) == 15


def test_a_text_is_in_its_box_or_left_out():
    page, box = np.full((60, 90, 4), 200, np.uint8), Rect(10, 5, 70, 40)
    write(page, box, (12.0, 6.0), "12.3 mm", 13, (0, 255, 0))
    rows, columns = np.nonzero((page[..., :3] != 200).any(axis=-1))
    assert (rows.min(), columns.min()) == (box.top, box.left) and columns.max() < box.right
    assert (page[..., 3] == 200).all() and page[..., 1].max() > 240
    page[:] = 200
    write(page, box, (79.0, 44.0), "12.3 mm", 13, (0, 255, 0))
    rows, columns = np.nonzero((page[..., :3] != 200).any(axis=-1))
    assert (rows.max(), columns.max()) == (box.bottom - 1, box.right - 1)
    before = page.copy()
    write(page, Rect(10, 5, 20, 40), (12.0, 6.0), "12.3 mm", 13, (0, 255, 0))
    assert np.array_equal(page, before)


# Over the pictures


def test_no_contact_is_written_in_the_b_mode_image_only():
    plain, noted = (
        composed(BackgroundImage(LAYOUT), notes=notes) for notes in ({}, {"B-mode": "NO CONTACT"})
    )
    b_mode, ct = image_boxes(LAYOUT)
    at = coloured(noted, b_mode, QUIET)
    assert len(at) > 100 and len(coloured(plain, b_mode, QUIET)) == 0
    assert at.mean(axis=0) == pytest.approx([b_mode.height / 2, b_mode.width / 2], abs=6)
    assert np.array_equal(plain[ct.slices], noted[ct.slices])


@pytest.mark.parametrize("size", [(1024, 576), (1088, 612), (1280, 720), (1920, 1080)])
@pytest.mark.parametrize("hint", ["Left button or W presses", "Left button or Backspace presses"])
def test_what_to_do_stands_whole_under_a_note(size, hint):
    layout = WindowLayout(*size)
    plain, hinted = (
        composed(BackgroundImage(layout), notes={"B-mode": note})
        for note in ("NO CONTACT", f"NO CONTACT\n{hint}")
    )
    b_mode = layout.image_boxes(2, 16.0, 40.0)[0]
    rows, columns = np.nonzero((plain != hinted).any(axis=2))
    assert b_mode.left <= columns.min() and columns.max() < b_mode.right
    assert np.ptp(columns) > 0.4 * b_mode.width
    noted = coloured(plain, b_mode, QUIET)[:, 0].max() + b_mode.top
    assert noted < rows.min() and rows.max() < noted + 50


@pytest.mark.parametrize(
    "points",
    [
        ((-5.0, 8.0), (4.0, 30.0)),
        ((4.0, 10.0), (4.0, 30.0)),
        ((-4.0, 10.0), (-4.0, 30.0)),
        ((-6.0, 36.0), (6.0, 36.0)),
        ((7.0, 20.0), (7.0, 20.0)),
    ],
)
def test_the_calipers_figure_stands_at_its_line(points):
    bare, labelled = (
        composed(BackgroundImage(LAYOUT), caliper_mm=points, caliper=figure)
        for figure in ("", "24.0 mm\nat rest 25.1 mm")
    )
    for box in image_boxes(LAYOUT):
        changed = np.argwhere((bare != labelled)[box.slices].any(axis=-1))
        assert len(changed) > 100
        middle = (np.mean(points, axis=0) + [8.0, 0.0])[::-1] * box.height / 40.0
        # Beside the line, so no farther from its middle than half of the figure and a little more.
        assert np.abs(changed.mean(axis=0) - middle).max() < 75
        # A line down the right half has it on its left, one down the left half on its right.
        assert points[0][0] != points[1][0] or (changed[:, 1].mean() - middle[1]) * points[0][0] < 0
        # The line stays whole.
        assert len(coloured(labelled, box, CALIPER)) > len(coloured(bare, box, CALIPER))
    outside = np.ones(bare.shape[:2], bool)
    for box in image_boxes(LAYOUT):
        outside[box.slices] = False
    assert np.array_equal(bare[outside], labelled[outside])


def test_outlines_have_a_legend_under_the_picture():
    plain, outlined = (
        composed(BackgroundImage(LAYOUT), outline_mm=now, outline_before_mm=now) for now in (None, SQUARE)
    )
    foot = image_boxes(LAYOUT)[0].bottom
    under = Rect(LAYOUT.panel.left, foot, LAYOUT.panel.width, 24)
    for colour in (OUTLINE, OUTLINE_AT_REST):
        assert len(coloured(outlined, under, colour)) > 30 and len(coloured(plain, under, colour)) == 0


# Read-outs


def test_findings_that_become_fewer_leave_nothing_behind():
    page = BackgroundImage(LAYOUT)
    few = composed(page, findings=dict(list(FIGURES.items())[:4]))
    assert not np.array_equal(composed(page, findings=FIGURES), few)
    assert np.array_equal(composed(page, findings=dict(list(FIGURES.items())[:4])), few)


def test_a_figure_without_a_value_is_a_dash():
    pictures = [findings_image(LAYOUT, {"margin": figure}) for figure in ("", "-", "4.2 mm")]
    assert np.array_equal(pictures[0], pictures[1]) and not np.array_equal(pictures[0], pictures[2])


@pytest.mark.parametrize("size", [(1250, 703), (1280, 720), (1920, 1080), (3840, 2160)])
def test_all_readouts_of_a_window_are_shown(size):
    layout = WindowLayout(*size, has_engineer=True)
    ends = [readout_image(layout, dict(list(FIGURES.items())[:count])) for count in (6, 7)]
    rows = np.flatnonzero((ends[0] != ends[1]).any(axis=(1, 2)))
    # In a large window the lines move closer together for the seventh.
    assert len(rows) > 5 and rows.max() < layout.readouts.height - 2


@each_size
@pytest.mark.parametrize("help_key", ["H", "Return"])
def test_clock_and_pace_stand_between_title_and_help_in_every_window(size, help_key):
    layout, texts = WindowLayout(*size), {"clock": "1234.5 s", "title": "A long title of a patient " * 5}
    page = BackgroundImage(layout, replace(KEYS, of={**KEYS.of, "help": help_key}))
    box = clock_box(layout, help_key)
    bare, real, slow = (
        composed(page, **texts | more) for more in ({"clock": ""}, {}, {"pace": "0.2 x real"})
    )
    assert set(np.unique(bare[box.slices])) == {17, 20, 24}
    for before, after, is_caution in ((bare, real, False), (real, slow, True)):
        changed = after[(before != after).any(axis=2)].astype(int)
        assert len(changed) > 50 and len(changed) == (before != after)[box.slices].any(axis=2).sum()
        assert (np.ptp(changed, axis=1).max() > 100) == is_caution
    # Neither is cut at its left end.
    assert (slow[: box.height, box.left] == bare[: box.height, box.left]).all()


@each_size
def test_findings_grow_with_their_lines_and_the_last_are_left_out(size):
    layout = WindowLayout(*size)
    assert layout.findings(11).height > layout.findings(9).height
    assert layout.most_findings >= (11 if size != (700, 420) else 7)
    empty, full = (
        composed(BackgroundImage(layout), findings=figures, alert="figure 0") for figures in ({}, FIGURES)
    )
    rows = np.flatnonzero((empty != full).any(axis=(1, 2)))
    assert rows.max() < layout.compass.top
    assert len(coloured(full, layout.findings(1), ALERT)) > 20


LONG = "a warning of several lines, with figures and what to do " * 4


@each_size
def test_warnings_stand_at_the_foot_of_the_3d_view(size):
    layout = WindowLayout(*size)
    page = BackgroundImage(layout)
    plain, warned = composed(page), composed(page, warnings=("short", LONG))
    changed = np.argwhere((plain != warned).any(axis=2))
    box = warning_rect(layout, ("short", LONG))
    assert (
        box is not None
        and apart(box, layout.compass)
        and box in page.boxes_over_scene(view(warnings=("short", LONG)))
    )
    low, high = changed.min(axis=0), changed.max(axis=0)
    assert (low >= (box.top, box.left)).all() and (high < (box.bottom, box.right)).all()
    assert box.right < layout.panel.left and box.bottom < layout.strip.top
    assert len(coloured(warned, box, ALERT)) > 200
    # No line is longer than the box.
    inner = Rect(box.right - 4, box.top + 2, 3, box.height - 4)
    assert len(coloured(warned, inner, ALERT)) == 0
    # They leave nothing behind.
    assert np.array_equal(composed(page), plain)


@each_size
def test_a_click_on_the_first_line_of_the_warnings_acknowledges_them(size):
    layout = WindowLayout(*size)
    page, warnings = BackgroundImage(layout), ("how to acknowledge", LONG)
    box = warning_rect(layout, warnings)
    first_row, next_row = (box.top + layout.figures_pad + share * layout.px(21) for share in (0.5, 1.5))
    middle = box.left + box.width / 2
    composed(page)
    assert not page.acknowledges_at(middle, first_row)
    composed(page, warnings=warnings)
    assert page.acknowledges_at(middle, first_row)
    assert not page.acknowledges_at(middle, next_row)
    assert not page.acknowledges_at(box.right + 1, first_row)
    assert not page.acknowledges_at(middle, box.top - 1)


@each_size
def test_many_warnings_leave_most_of_the_3d_view_free(size):
    layout = WindowLayout(*size)
    box = warning_rect(layout, (LONG,) * 9)
    assert box is not None and 0.2 < box.height / layout.scene.height < 0.5
    assert warning_lines(layout, (LONG,) * 9)[-1] == "..." and warning_rect(layout, ()) is None


def test_the_help_covers_all_and_leaves_nothing_behind():
    page = BackgroundImage(LAYOUT)
    before = composed(page, findings=FIGURES)
    box = image_boxes(LAYOUT)[0]
    assert page.plane_point_at(box.left + 5, box.top + 5) == pytest.approx(
        to_plane(view(), box, box.left + 5, box.top + 5)
    )
    page.show_page("help", view())
    helped = page.pixels.transpose(1, 0, 2)[::-1, :, :3]
    assert np.ptp(helped[-1], axis=0).max() == 0 and page.plane_point_at(box.left + 5, box.top + 5) is None
    assert np.array_equal(composed(page, findings=FIGURES), before)


# Which way the patient lies


def test_seen_from_the_front_the_patients_left_is_to_the_right_and_the_head_up():
    ends = dict(ends_of(AXES))
    assert set(ends) == {"L", "R", "S", "I"}
    for letter, way in (("L", (1, 0)), ("R", (-1, 0)), ("S", (0, 1)), ("I", (0, -1))):
        assert tuple(ends[letter]) == way


def test_the_ends_turn_with_the_camera_and_the_nearest_is_last():
    camera = OrbitCamera(np.array([[-50.0] * 3, [50.0] * 3]), (0.0, -1.0, 0.0), (0, 0, 1, 1), 1.5)
    right, up, ahead = axes = np.stack(camera.axes())
    ways = {"L": [1, 0, 0], "R": [-1, 0, 0], "P": [0, 1, 0], "A": [0, -1, 0], "S": [0, 0, 1], "I": [0, 0, -1]}
    ends = ends_of(axes)
    depth = [ahead @ ways[letter] for letter, _ in ends]
    assert len(ends) == 6 and depth == sorted(depth, reverse=True)
    for letter, way in ends:
        assert way == pytest.approx([right @ ways[letter], up @ ways[letter]])


def test_what_points_up_in_the_compass_is_drawn_up():
    # From the front and above: the head is up and nearer than the middle, the feet are down and farther.
    sine, cosine = 0.28, 0.96
    picture = compass_image(LAYOUT, np.array([[1.0, 0, 0], [0, sine, cosine], [0, cosine, -sine]]))
    size = len(picture)
    away = round(0.5 * ARM * size)
    column = picture[:, size // 2].astype(int)
    assert (column[size // 2 - away] == TEXT).all() and (column[size // 2 + away] == QUIET).all()


def test_of_two_letters_at_one_place_the_nearer_is_shown():
    near = [(5.0, 0.0), (0.0, 0.0), (9.0, 0.0), (10.0, 0.0)]
    # The second is far from what is shown, the first is not hidden by it, and the third is hidden by the
    # last.
    assert are_apart(np.array(near), 5.0) == [True, True, False, True]
    assert are_apart(np.array(near), 5.5) == [False, True, False, True]
    # Seen along a diagonal of left and back: two letters of the four stay, the nearer one on each side.
    turn = np.pi / 4
    right, ahead = [np.cos(turn), np.sin(turn), 0.0], [-np.sin(turn), np.cos(turn), 0.0]
    axes = np.array([right, [0.0, 0.0, 1.0], ahead])
    ends = ends_of(axes)
    ways = np.array([way for _, way in ends])
    shown = {letter for (letter, _), is_shown in zip(ends, are_apart(ways, 0.1), strict=True) if is_shown}
    assert shown == {"L", "A", "S", "I"}


def test_the_compass_is_drawn_anew_when_the_camera_turns():
    page, turned = BackgroundImage(LAYOUT), np.array([[0, 0, -1.0], [1.0, 0, 0], [0, 1.0, 0]])
    box = LAYOUT.compass
    first = composed(page)[box.slices]
    assert np.array_equal(first, compass_image(LAYOUT, AXES))
    page.compose(view(), turned)
    assert np.array_equal(
        page.pixels.transpose(1, 0, 2)[::-1, :, :3][box.slices], compass_image(LAYOUT, turned)
    )
    assert not np.array_equal(first, compass_image(LAYOUT, turned))


@pytest.mark.parametrize("size", [(1024, 600), *SCREENS])
def test_the_scale_of_doppler_is_in_the_window_and_beside_the_marker_dot(size):
    layout = WindowLayout(*size)
    plain, scaled = (backdrop(layout, view(scale=scale)) for scale in (("", ""), ("+200", "-200")))
    columns = np.flatnonzero((plain != scaled).any(axis=(0, 2)))
    assert columns.max() < layout.width - 1
    # The dot ends four pixels, at scale 1, beside the image.
    assert columns.min() >= image_boxes(layout)[-1].right - layout.px(4)


def test_lines_over_images_are_wider_in_a_larger_window():
    for size, wide in zip(SCREENS, (1, 2, 3), strict=True):
        page = BackgroundImage(WindowLayout(*size))
        drawn = coloured(composed(page, outline_mm=SQUARE[:1]), image_boxes(page.layout)[0], OUTLINE)
        assert len(set(drawn[:, 0])) == wide


def test_a_very_deep_image_has_no_name_where_it_would_cover_the_marker_dot():
    deep = {"width_mm": 16.0, "depth_mm": 300.0}
    with_name, without = (
        backdrop(LAYOUT, view(images={name: np.zeros((64, 32), np.uint8)}, **deep)) for name in ("B-mode", "")
    )
    assert np.array_equal(with_name, without)
    assert not np.array_equal(
        *(backdrop(LAYOUT, view(images={n: np.zeros((64, 32), np.uint8)})) for n in ("CT", ""))
    )
