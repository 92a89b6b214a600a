"""The front end: camera, panel picture; the off-screen frame where there is Vulkan."""

import dataclasses
import os
import shutil
import subprocess
import sys
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
import taichi as ti
import trimesh
from conftest import ROOT
from settings_at_start import settings_with

from rehearsal.drawn_geometry import drawn_housing
from rehearsal.live_settings import DEFAULT_KEYS
from render import background_image, display, transducer_shape, ultrasound_panel
from render.camera import OrbitCamera
from render.cut_face import FLESH
from render.display import display_available, fitted, scale_of, window_size
from render.phases import tabs_of, tools_of
from render.sliders import boxes_of, draw_sliders
from render.software_scene import SoftwareScene
from render.viewer import Geometry, TransducerHousing, View
from render.warning_box import warning_image, warning_rect
from render.window import Window
from render.window_layout import FULL_SIZE, Rect, WindowLayout
from settings import with_values
from sim.device import start
from sim.fields import fill, fill_evenly, zeros
from ultrasound.probe import load_probe

BOUNDS = np.array([[-54.0, -33.0, -21.0], [54.0, 27.0, 21.0]])
LAYOUT = WindowLayout(1280, 720)


def _camera(up=(0.0, 0.0, 1.0)) -> OrbitCamera:
    return OrbitCamera(BOUNDS, up, LAYOUT.window_coordinates(LAYOUT.scene), 1280 / 720)


def _view(**changes) -> View:
    pose = np.eye(4)
    pose[:3, 3] = [0.0, 0.0, 31.0]
    rows, columns = np.indices((96, 64))
    grey = ((rows * 2 + columns) % 256).astype(np.uint8)
    return View(
        **{"transducer_pose": pose, "images": {"CT": grey}, "width_mm": 40.0, "depth_mm": 60.0} | changes
    )


def change(opened, path: str, value) -> None:
    opened.settings = with_values(opened.settings, {path: value})


# Camera


def test_the_camera_goes_home():
    camera = _camera()
    eye = camera.eye()
    camera.orbit(0.2, 0.1)
    camera.zoom(0.5)
    camera.pan(0.1, 0.1)
    assert np.abs(camera.eye() - eye).max() > 10.0
    camera.go_home()
    assert np.abs(camera.eye() - eye).max() < 1e-9


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (0.3, -0.8, 0.2)])
def test_the_ray_under_the_mouse_contains_the_projected_point(up):
    camera = _camera(up)
    camera.orbit(0.13, -0.07)
    camera.pan(0.05, 0.02)
    camera.zoom(0.8)
    points = np.random.default_rng(1).uniform(BOUNDS[0], BOUNDS[1], (50, 3))
    for point, cursor in zip(points, camera.project(points), strict=True):
        origin, direction = camera.ray(cursor)
        assert np.linalg.norm(np.cross(point - origin, direction)) < 1e-6
        assert (point - origin) @ direction > 0


def test_bounds_just_fit_the_3d_view():
    camera = _camera()
    corners = np.array([[x, y, z] for x in BOUNDS[:, 0] for y in BOUNDS[:, 1] for z in BOUNDS[:, 2]])
    left, bottom, right, top = LAYOUT.window_coordinates(LAYOUT.scene)
    share = (camera.project(corners) - [left, bottom]) / [right - left, top - bottom]
    assert share.min() > 0.0 and share.max() < 1.0
    # The margin is 4 % of the distance, so one corner comes closer to an edge than that.
    assert min(share.min(), 1.0 - share.max()) < 0.04


def test_target_stays_in_the_middle_of_the_3d_view_when_the_camera_turns_and_zooms():
    camera = _camera()
    left, bottom, right, top = LAYOUT.window_coordinates(LAYOUT.scene)
    camera.orbit(0.4, 0.2)
    camera.zoom(0.5)
    assert np.allclose(camera.project(camera.target), [(left + right) / 2, (bottom + top) / 2], atol=1e-9)


def test_up_is_up_and_the_tissue_follows_a_pan():
    camera = _camera()
    low, high = camera.project(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 10.0]]))
    assert high[1] > low[1]
    target = camera.target
    before = camera.project(target)
    camera.pan(0.1, -0.05)
    assert np.allclose(camera.project(target) - before, [0.1, -0.05], atol=1e-9)


# Solids


HOUSINGS = {
    "flat": TransducerHousing((40.0, 10.0, 20.0)),
    "curved": TransducerHousing((40.0, 10.0, 20.0), face_radius_mm=25.0),
    "drop-in": drawn_housing(load_probe("drop-in")),
}
PARTS = {name: getattr(transducer_shape, name) for name in ("BODY", "LENS", "MARKER", "FIN")}


def solids_of(housing: TransducerHousing) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Corners and normals (n, 3, 3) of the triangles of each part that is one convex solid."""
    shape = transducer_shape.transducer(housing)
    corners, normals = shape.vertices.reshape(-1, 3, 3), shape.normals.reshape(-1, 3, 3)
    own = {name: (shape.colours[::3] == colour).all(axis=1) for name, colour in PARTS.items()}
    return {name: (corners[part], normals[part]) for name, part in own.items() if part.any()}


@pytest.mark.parametrize("housing", HOUSINGS.values(), ids=HOUSINGS)
def test_the_parts_of_the_transducer_are_closed_and_face_outward(housing):
    size, solids = np.array(housing.size_mm), solids_of(housing)
    assert ("FIN" in solids) == all(housing.fin_mm)
    for corners, normals in solids.values():
        middle = corners.reshape(-1, 3).mean(axis=0)
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert np.all(np.einsum("ij,ij->i", cross, corners.mean(axis=1) - middle) > 0)
        assert np.all(np.einsum("ikj,ikj->ik", normals, corners - middle) > 0)
        # The area vectors of a closed surface add up to nothing.
        assert cross.sum(axis=0) == pytest.approx(np.zeros(3), abs=1e-9)
    # The marker stands out by a quarter of a millimetre; a curved array is lowest in its centre, where the
    # image starts.
    own = np.concatenate([solids[name][0].reshape(-1, 3) for name in ("BODY", "LENS", "MARKER")])
    assert own.min(axis=0) == pytest.approx(-size / 2)
    assert own.max(axis=0)[:2] == pytest.approx(size[:2] / 2 + [0.25, 0.0])


def test_the_edges_of_the_drawn_housing_are_as_round_as_those_in_contact():
    """Each vertex is on the surface of the union of all balls within the half-spaces."""
    housing = HOUSINGS["drop-in"]
    solids, core = solids_of(housing), np.array(housing.size_mm) / 2 - housing.edge_radius_mm
    outer = np.concatenate([solids[name][0].reshape(-1, 3) for name in ("BODY", "LENS")])
    beyond = np.linalg.norm(np.maximum(np.abs(outer) - core, 0), axis=1)
    assert beyond == pytest.approx(np.full(len(outer), housing.edge_radius_mm), abs=1e-6)


def test_the_fin_is_on_the_back_and_the_cable_leaves_the_end_without_the_mark():
    housing = HOUSINGS["drop-in"]
    x, _, z = housing.size_mm
    fin = solids_of(housing)["FIN"][0].reshape(-1, 3)
    assert np.ptp(fin, axis=0) == pytest.approx(housing.fin_mm) and fin[:, 2].min() == pytest.approx(z / 2)
    shape = transducer_shape.transducer(housing)
    cable = shape.vertices[(shape.colours == transducer_shape.CABLE).all(axis=1)]
    first = cable[cable[:, 0] > -x / 2 - 1e-9]
    assert cable[:, 0].max() == pytest.approx(-x / 2) and np.ptp(first[:, 2]) == pytest.approx(
        housing.cable_mm
    )
    # It bends away from the tissue.
    assert cable[:, 2].min() >= -z / 2 and cable[:, 0].min() < -x and cable[:, 2].max() > 2 * z


def test_the_image_plane_shows_the_image_in_the_right_orientation():
    shares = transducer_shape.image_plane_grid(6, 4)
    indices = transducer_shape.grid_triangles(6, 4)
    grey = np.zeros((60, 40), dtype=np.uint8)
    grey[0, -1] = 255
    view = _view(images={"CT": grey})
    places = transducer_shape.on_plane(shares, view)
    bright = transducer_shape.on_transducer(places)[transducer_shape.sampled(grey, places, view) == 1.0]
    assert np.allclose(bright, [[20.0, 0.0, 0.0]])
    assert indices.max() == len(shares) - 1 and indices.size == 6 * 5 * 3


def test_a_sector_fans_out_from_its_arc():
    radius, half, depth = 60.0, np.radians(30), 120.0
    above, width = radius * (1 - np.cos(half)), 2 * (radius + depth) * np.sin(half)
    grey = np.zeros((180, 180), dtype=np.uint8)
    view = _view(
        images={"B-mode": grey},
        width_mm=width,
        depth_mm=depth + above,
        above_mm=above,
        sector=(radius, -half, half),
    )
    places = transducer_shape.on_plane(np.array([[0.5, 0.0], [0.5, 1.0], [1.0, 0.0], [1.0, 1.0]]), view)
    wanted = [[0, 0], [0, depth], [30, -above], [width / 2, (radius + depth) * np.cos(half) - radius]]
    assert places == pytest.approx(np.array(wanted), abs=1e-9)
    # The deepest place of the middle line is the middle of the last row.
    grey[-1, 88:92] = 255
    assert list(transducer_shape.sampled(grey, places, view)) == [0.0, 1.0, 0.0, 0.0]
    frame_points = transducer_shape.image_plane_frame(view)
    assert frame_points.shape == (2 * transducer_shape.FRAME_SIDES, 3) and frame_points[:, 2].min() < -depth


def test_a_place_in_a_picture_is_found_again_under_its_pixel():
    shown = _view(depth_mm=68.0, above_mm=8.0)
    for box in ultrasound_panel.image_boxes(LAYOUT, shown):
        column, row = ultrasound_panel.to_pixels(shown, box, np.array([-7.0, 31.0]))
        assert ultrasound_panel.to_plane(shown, box, column, row) == pytest.approx((-7.0, 31.0))
        # Zero depth is the face's middle, an eighth of 68 mm below the top.
        assert ultrasound_panel.to_pixels(shown, box, np.zeros(2))[1] == pytest.approx(
            box.top + 8 / 68 * box.height
        )


def test_segments_are_drawn_where_they_are_and_nowhere_else():
    shown = _view()
    box = ultrasound_panel.image_boxes(LAYOUT, shown)[0]
    page = np.zeros((720, 1280, 4), np.uint8)
    ultrasound_panel.draw_segments(
        page, shown, box, np.array([[[-10.0, 20.0], [10.0, 20.0]], [[0.0, 50.0], [0.0, 90.0]]]), (1, 2, 3)
    )
    rows, columns = np.nonzero((page[..., :3] == (1, 2, 3)).all(axis=2))
    level = ultrasound_panel.to_pixels(shown, box, np.array([0.0, 20.0]))[1]
    assert set(rows[rows < level + 5]) == {int(level)}
    across = columns[rows == int(level)]
    left, right = (ultrasound_panel.to_pixels(shown, box, np.array([u, 20.0]))[0] for u in (-10.0, 10.0))
    assert (
        across.min() == int(left)
        and across.max() == int(right)
        and len(set(across)) == int(right) - int(left) + 1
    )
    # What leaves the picture ends at its edge.
    assert rows.max() == box.bottom - 1 and page[..., 3].max() == 0
    ultrasound_panel.draw_segments(page, shown, box, np.empty((0, 2, 2)), (9, 9, 9))
    assert not (page == 9).any()


# Front ends


ORGAN_MM = 22.0


@pytest.fixture(params=[None])
def window(request):
    """An off-screen window on a ball, its vertices as a field and as an array; skips where Vulkan is missing.

    The parameter says whether the processor draws the 3D view; None as on this machine.
    """
    from render.window import NoVulkan, Window

    start("cpu")
    ball = trimesh.creation.icosphere(subdivisions=3, radius=ORGAN_MM)
    vertices = ball.vertices.astype(np.float32)
    field = zeros(len(vertices), 3, within=1)
    fill((field, vertices))
    geometry = Geometry((field, ball.faces.astype(np.int32)), np.array([[-45.0] * 3, [45.0] * 3]))
    try:
        opened = Window(
            geometry,
            settings_with({"view.translucent": False}),
            size=(640, 360),
            visible=False,
            keys=DEFAULT_KEYS,
            by_processor=request.param,
        )
    except NoVulkan as reason:
        ti.reset()
        pytest.skip(str(reason))
    yield opened, field, vertices
    opened.close()
    ti.reset()


def _organ_pixels(picture: np.ndarray) -> np.ndarray:
    """Where the picture is as red as the organ, bool (height, width). Nothing else in the window is."""
    red, green, blue = (picture[..., i].astype(int) for i in range(3))
    return (red > 60) & (red > 3 * green // 2) & (red > 3 * blue // 2)


def _far_view() -> View:
    # The transducer stands aside, so that it hides nothing.
    pose = np.eye(4)
    pose[:3, 3] = [0.0, 200.0, 200.0]
    return _view(transducer_pose=pose)


def test_picture_before_any_view_is_refused(window):
    with pytest.raises(RuntimeError, match="nothing was drawn"):
        window[0].picture()


def test_organ_is_drawn_where_the_camera_projects_it(window):
    opened, field, vertices = window
    fill_evenly(field, 0.0)
    opened.draw(_far_view())
    empty = opened.picture()
    for shift in ([0.0, 0.0, 0.0], [18.0, 0.0, 0.0], [0.0, 0.0, 15.0]):
        moved = (vertices + np.float32(shift)).astype(np.float32)
        fill((field, moved))
        opened.draw(_far_view())
        picture = opened.picture()
        rows, columns = np.nonzero(np.any(picture != empty, axis=2))
        assert _organ_pixels(picture).sum() > len(rows) / 2
        # The outline of the vertices, in pixels from the bottom left. A pixel is drawn if its middle is
        # inside.
        outline = opened.camera.project(moved) * [640, 360]
        drawn = [[columns.min(), 360 - rows.max() - 1], [columns.max() + 1, 360 - rows.min()]]
        assert np.allclose(drawn, [outline.min(axis=0), outline.max(axis=0)], atol=1.0)


def for_an_engineer(opened: Window) -> None:
    """Show an engineer's sliders."""
    change(opened, "view.show_engineer", True)
    opened._change_layout(dataclasses.replace(opened.layout, has_engineer=True))
    opened._place_sliders()


@pytest.mark.parametrize("window", [False, True], indirect=True)
def test_organ_never_covers_the_panel_the_title_or_the_readouts(window):
    opened, _, _ = window
    for_an_engineer(opened)
    opened.camera.zoom(0.01)
    left, bottom, right, top = opened.camera.part
    opened.camera.pan(0.62 - (left + right) / 2, 0.5 - (bottom + top) / 2)
    warnings = ("Import: check the side of the organ in check.png",)
    opened.draw(dataclasses.replace(_far_view(), warnings=warnings, findings={"to tumour": "4.2 mm"}))
    picture = opened.picture()
    red = _organ_pixels(picture)
    layout = opened.layout
    assert red[layout.scene.slices][:, -1].any(), "the organ does not reach the panel: this proves nothing"
    tools = tools_of(layout, opened.settings, opened.keys)
    assert tools
    expected = background_image.backdrop(layout, _view(), tools=tools)
    ultrasound_panel.paste_image(expected, layout.image_boxes(1, 40.0, 60.0)[0], _view().images["CT"])
    for rect in (layout.panel, layout.title, layout.tools):
        assert np.array_equal(picture[rect.slices], expected[rect.slices]), rect
    assert np.array_equal(picture[layout.readouts.slices], background_image.readout_image(layout, {}))
    warned, image = warning_rect(layout, warnings), warning_image(layout, warnings)
    assert np.array_equal(picture[warned.slices], image)


def test_processor_and_vulkan_draw_the_same_picture(window):
    """But for the pixels at edges, which each assigns by its own rounding."""
    opened, _, _ = window
    change(opened, "view.translucent", True)
    shown = {}
    for by_processor in (False, True):
        opened._software = SoftwareScene(opened.camera, (640, 360)) if by_processor else None
        opened._background = background_image.BackgroundImage(opened.layout)
        opened.draw(_view())
        shown[by_processor] = opened.picture()[opened.layout.scene.slices].astype(int)
    away = np.abs(shown[True] - shown[False]).max(axis=2)
    # The view has no more than 2 % of its pixels at edges of organ, transducer and image plane; inside,
    # colours are rounded once for each layer that is blended.
    assert np.mean(away > 3) < 0.02 and np.ptp(shown[True]) > 100


@pytest.mark.parametrize("window", [True], indirect=True)
def test_a_3d_view_that_was_drawn_ahead_is_shown_beside_a_newer_image(window):
    opened, field, vertices = window
    opened.draw(_far_view())
    first = opened.picture()
    opened.draw_scene(_far_view(), may_wait=False)
    fill((field, (vertices + np.float32([18.0, 0.0, 0.0])).astype(np.float32)))
    newer = dataclasses.replace(_far_view(), images={"CT": 255 - _far_view().images["CT"]})
    opened.draw(newer)
    scene, panel = opened.layout.scene.slices, opened.layout.panel.slices
    ahead, moved = opened.picture(), opened.picture()
    assert np.array_equal(ahead[scene], first[scene]) and np.any(ahead[panel] != first[panel])
    assert np.any(moved[scene] != ahead[scene]) and np.array_equal(moved[panel], ahead[panel])


class Mouse:
    """Stands for GGUI's window: a mouse at a pixel of a window of 640 x 360, and what was pressed and
    released since the last frame.
    """

    running = True

    def __init__(self) -> None:
        self.at, self.held, self.events = (0.0, 0.0), set(), {"Press": [], "Release": []}

    def goes(self, column: float, row: float) -> None:
        self.at = column / 640, 1 - row / 360

    def presses(self, key: str) -> None:
        self.held.add(key)
        self.events["Press"].append(SimpleNamespace(key=key))

    def releases(self, key: str) -> None:
        self.held.discard(key)
        self.events["Release"].append(SimpleNamespace(key=key))

    def get_cursor_pos(self) -> tuple[float, float]:
        return self.at

    def is_pressed(self, *keys: str) -> bool:
        return any(key in self.held for key in keys)

    def get_events(self, tag: str) -> list[SimpleNamespace]:
        events, self.events[tag] = self.events[tag], []
        return events


@pytest.fixture
def mouse(window, monkeypatch):
    """The mouse of a visible window, its boxes of sliders placed."""
    opened, _, _ = window
    opened.draw(_view())
    opened.picture()
    mouse = Mouse()
    with monkeypatch.context() as patch:
        patch.setattr(opened, "_window", mouse)
        patch.setattr(opened, "_visible", True)
        yield mouse


@pytest.mark.parametrize(
    ("box", "way", "changes", "restored"),
    [
        ("Image", (20, 0), False, ["Image"]),
        ("Image", (0, 0), False, []),
        ("Image", (20, 0), True, []),
        ("", (20, 0), False, []),
    ],
)
def test_only_a_box_of_sliders_that_was_moved_is_made_anew(window, mouse, box, way, changes, restored):
    opened, _, _ = window
    for_an_engineer(opened)
    left, top = opened._slider_boxes[box][:2] if box else opened.layout.panel[:2]
    mouse.goes(left + 30, top + 8)
    opened.read_controls()
    mouse.presses(ti.ui.LMB)
    opened.read_controls()
    change(opened, "image.level_hu", 40.0 + changes)
    mouse.goes(left + 30 + way[0], top + 8 + way[1])
    opened.read_controls()
    mouse.releases(ti.ui.LMB)
    opened.read_controls()
    assert list(opened._boxes_moved) == restored


def middle_of(box: Rect) -> tuple[float, float]:
    return box.left + box.width / 2, box.top + box.height / 2


def test_a_click_on_a_phase_or_a_tool_does_what_its_key_does(window, mouse):
    opened, _, _ = window
    mouse.goes(*middle_of(tabs_of(opened.layout)["Score"]))
    mouse.presses(ti.ui.LMB)
    assert opened.read_controls().settings.view.phase == "Score"
    mouse.releases(ti.ui.LMB)
    opened.read_controls()
    opened._tools = {"undo": opened.layout.tool_row(0), "push": opened.layout.tool_row(1)}
    mouse.goes(*middle_of(opened.layout.tool_row(0)))
    mouse.presses(ti.ui.LMB)
    controls = opened.read_controls()
    assert controls.undo and not controls.push_mm and not controls.press
    mouse.releases(ti.ui.LMB)
    opened.read_controls()
    # One that acts while its key is held acts as long as the button is.
    mouse.goes(*middle_of(opened.layout.tool_row(1)))
    mouse.presses(ti.ui.LMB)
    pushed = [opened.read_controls().push_mm for _ in range(3)]
    mouse.releases(ti.ui.LMB)
    opened.read_controls()
    assert min(pushed) > 0 and opened.read_controls().push_mm == 0
    mouse.goes(*middle_of(opened.layout.messages))
    mouse.presses(ti.ui.LMB)
    assert opened.read_controls().dismiss
    mouse.releases(ti.ui.LMB)
    assert not opened.read_controls().dismiss


def test_escape_closes_the_key_list_first(window, mouse):
    opened, _, _ = window
    for key, quits, is_open in (
        ("h", False, True),
        (ti.ui.ESCAPE, False, False),
        (ti.ui.ESCAPE, True, False),
    ):
        mouse.presses(key)
        assert opened.read_controls().quit == quits and bool(opened._page) == is_open
        mouse.releases(key)
        opened.read_controls()


def test_the_mouse_over_the_scanners_sliders_does_not_move_the_probe(window, mouse):
    opened, _, _ = window
    change(opened, "view.show_scanner", True)
    opened._place_sliders()
    left, top, width, height = opened._slider_boxes["B-mode"]
    mouse.goes(left + width / 2, top + height / 2)
    assert opened.read_controls().ray is None
    mouse.goes(left - 20, top + height / 2)
    assert opened.read_controls().ray is not None


def test_boxes_of_sliders_are_known_again_when_they_come_back():
    names = set()

    class Gui:
        def sub_window(self, name, *place):
            names.add(name)
            return nullcontext()

        def checkbox(self, label, value):
            return value

        def button(self, label):
            return False

        def slider_int(self, label, value, low, high):
            return value

        slider_float = slider_int

    geometry = Geometry((None, np.zeros((0, 3))), BOUNDS)
    for shown in (True, False, True):
        settings = settings_with({"view.show_scanner": shown})
        draw_sliders(Gui(), settings, geometry, boxes_of(settings, geometry, LAYOUT), FULL_SIZE, {})
    assert len(names) == 3
    draw_sliders(Gui(), settings, geometry, boxes_of(settings, geometry, LAYOUT), FULL_SIZE, {"TGC": 1})
    assert len(names) == 4


@pytest.mark.parametrize("window", [True], indirect=True)
def test_the_scanners_sliders_are_in_the_first_picture(window):
    opened, _, _ = window
    opened.draw(_view())
    before = opened.picture()
    change(opened, "view.show_scanner", True)
    after = opened.picture()
    changed = np.any(before != after, axis=2)
    assert changed[opened._slider_boxes["B-mode"].slices].mean() > 0.5


def test_a_button_that_is_pressed_again_within_a_slow_frame_stays_pressed(window, mouse):
    opened, _, _ = window
    mouse.goes(opened.layout.clear.left + 100, opened.layout.clear.top + 60)
    assert not opened.read_controls().press
    mouse.presses(ti.ui.LMB)
    assert opened.read_controls().press
    mouse.releases(ti.ui.LMB)
    mouse.presses(ti.ui.LMB)
    assert opened.read_controls().press
    mouse.releases(ti.ui.LMB)
    assert not opened.read_controls().press


def test_shift_counts_for_the_keys_pressed_with_it_also_in_a_slow_frame(window, mouse):
    opened, _, _ = window

    def cuts(*presses: str, releases: tuple[str, ...] = ()) -> tuple[bool, bool]:
        """Whether the frame cuts along the score, and whether it toggles the section of the view."""
        before = opened.settings.view.cut
        for key in presses:
            mouse.presses(key)
        for key in releases:
            mouse.releases(key)
        return opened.read_controls().cut_out, opened.settings.view.cut != before

    assert cuts("x", releases=("x",)) == (False, True)
    assert cuts(ti.ui.SHIFT, "x", releases=("x", ti.ui.SHIFT)) == (True, False)
    assert cuts("x", ti.ui.SHIFT, releases=("x",)) == (False, True)
    assert cuts("x", releases=("x", ti.ui.SHIFT)) == (True, False)
    assert cuts("x", releases=("x",)) == (False, True)


def test_other_geometry_has_its_own_sliders(window):
    opened, field, _ = window
    for_an_engineer(opened)
    faces = opened._geometry.organ[1]
    opened.draw(_view())
    before = opened.picture()
    opened.change_geometry(dataclasses.replace(opened._geometry, tumour=(field, faces)))
    after = opened.picture()
    assert np.any(before != after, axis=2)[opened.layout.strip.slices].any()


@pytest.mark.parametrize("translucent", [False, True])
def test_the_bed_of_a_cut_has_its_own_colour(window, translucent):
    opened, field, _ = window
    faces = opened._geometry.organ[1]
    change(opened, "view.translucent", translucent)
    opened.draw(_far_view())
    before = opened.picture().astype(int)
    opened.change_geometry(dataclasses.replace(opened._geometry, bed=(field, faces[: len(faces) // 2])))
    brighter = (opened.picture() - before).max(axis=2) > 20
    # Also in a translucent organ, where the organ itself is dark.
    assert brighter[opened.layout.clear.slices].any()


@pytest.mark.parametrize(
    ("setting", "value"), [("view.translucent", True), ("view.cut", True), ("image.level_hu", 90.0)]
)
def test_settings_are_seen(window, setting, value):
    opened, _, _ = window
    for_an_engineer(opened)
    opened.draw(_view())
    before = opened.picture()
    change(opened, setting, value)
    assert np.any(opened.picture() != before)
    assert opened.read_controls().settings is opened.settings


def test_the_cut_is_filled_and_the_half_before_it_removed(window):
    opened, _, _ = window
    change(opened, "view.cut", True)
    pose = np.array(_view().transducer_pose)
    # The image plane is square to the view, but for the height that it is seen from.
    _, _, ahead = opened.camera.axes()
    pose[:3, 1] = [*(ahead[:2] / np.linalg.norm(ahead[:2])), 0.0]
    pose[:3, 0] = np.cross(pose[:3, 1], pose[:3, 2])
    for way in (1.0, -1.0):
        turned = pose * [way, way, 1.0, 1.0]
        opened.draw(_view(transducer_pose=turned, width_mm=4.0))
        places = np.array([12.0, -12.0])[:, None] * pose[:3, 0]
        columns, rows = (opened.camera.project(places) * [640, 360]).astype(int).T
        shown = opened.picture()[359 - rows, columns].astype(float)
        # Flesh, evenly lit: the organ's own colour is redder, and its half before the plane would hide it.
        assert shown / shown.max(axis=1, keepdims=True) == pytest.approx(
            np.tile(FLESH, (2, 1)) / FLESH[0], abs=0.06
        )
        assert np.ptp(shown, axis=0).max() < 12


PROBE = """
import numpy as np
from sim.device import start
from sim.fields import zeros
start("cpu")
from render.software_scene import SoftwareScene
from render.viewer import Geometry
from render.window import NoVulkan, Window
field = zeros(3, 3, within=1)
try:
    Window(Geometry((field, np.array([[0, 1, 2]])), np.array([[-1.0] * 3, [1.0] * 3])), visible=False)
except NoVulkan as reason:
    assert "\\n" not in str(reason)
    print("said", reason)
"""


def test_missing_vulkan_is_an_error_with_a_message():
    nowhere = {"VK_ICD_FILENAMES": "/nonexistent", "VK_DRIVER_FILES": "/nonexistent"}
    done = subprocess.run(
        [sys.executable, "-c", PROBE],
        cwd=ROOT,
        check=False,
        env=os.environ | nowhere,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert "said no Vulkan driver" in done.stdout


@pytest.mark.skipif(sys.platform in ("win32", "darwin"), reason="these always have a display")
@pytest.mark.parametrize("display", [None, ":4242"])
def test_a_missing_display_is_detected(monkeypatch, display):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    if display:
        monkeypatch.setenv("DISPLAY", display)
    assert not display_available() and window_size() == FULL_SIZE


@pytest.mark.skipif(shutil.which("Xvfb") is None, reason="needs Xvfb")
@pytest.mark.parametrize("depth", [16, 24])
def test_the_depth_of_a_screen_is_asked(monkeypatch, depth):
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", "1", "-screen", "0", f"640x480x{depth}"],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    display._of_x11.cache_clear()
    try:
        monkeypatch.setenv("DISPLAY", f":{server.stdout.readline().decode().strip()}")
        assert display.wrong_depth() == (None if depth == 24 else depth)
    finally:
        display._of_x11.cache_clear()
        server.terminate()
        server.wait()


@pytest.mark.parametrize(
    ("screen", "size"),
    [
        ((1920, 1080), (1280, 720)),
        ((3840, 2160, 1.0), (1280, 720)),
        ((3840, 2160, 2.0), (2560, 1440)),
        ((2880, 1620, 1.5), (1920, 1080)),
        ((1920, 1080, 2.0), (1664, 936)),
        ((1366, 768), (1152, 648)),
        ((1080, 1920), (1024, 576)),
    ],
)
def test_a_window_fits_its_screen(screen, size):
    assert fitted(*screen) == size


@pytest.mark.parametrize(
    ("resources", "scale"),
    [
        (b"", 1.0),
        (b"Xcursor.size:\t24\nXft.dpi:\t192\nXft.rgba:\tnone\n", 2.0),
        (b"Xft.dpi: 144.0", 1.5),
        (b"Xft.dpi:\t72\n", 1.0),
        (b"Xft.dpi: 9600", 4.0),
        (b"*Xft.dpi.other: 192", 1.0),
    ],
)
def test_the_scale_is_that_of_the_desktop(resources, scale):
    assert scale_of(resources) == scale


def test_the_tumour_is_seen_in_the_specimen_from_all_sides(window):
    opened, field, _ = window
    fill_evenly(field, 0.0)
    around, inner = (trimesh.creation.icosphere(subdivisions=2, radius=radius) for radius in (12.0, 6.0))
    change(opened, "view.translucent", False)
    seen = []
    for cut_out in (None, (inner.vertices.astype(np.float32), inner.faces.astype(np.int32))):
        specimen = around.vertices.astype(np.float32), around.faces.astype(np.int32)
        new = dataclasses.replace(opened._geometry, specimen=specimen, tumour_cut_out=cut_out)
        opened.change_geometry(new)
        opened.camera.go_home()
        opened.draw(_far_view())
        first = opened.picture().astype(int)
        opened.camera.orbit(0.4, 0.1)
        seen.append((first, opened.picture().astype(int)))
    for without, with_tumour in zip(*seen, strict=True):
        # Gold has more green than the specimen.
        assert (with_tumour - without)[..., 1].max() > 20
