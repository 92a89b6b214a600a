"""The window, on a screen or off-screen: 3D view, ultrasound panel, sliders, mouse and keys.

The only file that uses ti.ui. A frame is drawn in this order:
1. a full-window background image (background_image.py): panel, images, texts; where no graphics card draws,
   the 3D view too (software_scene.py);
2. elsewhere, invisible quads near the camera, over the panel and the strip, which fill the depth buffer
   there, so that no organ covers them;
3. support, transducer, image plane, tumour, and last the organ, whose faces may be translucent;
4. the controls of the settings (sliders.py).
"""

import atexit
import time
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Generic

import numpy as np
import taichi as ti

from render.approaches import look_by
from render.background_image import BackgroundImage
from render.camera import FIELD_OF_VIEW_DEG, OrbitCamera
from render.display import display_available
from render.gamepad import Gamepad
from render.graphics_scene import GraphicsScene
from render.keys import HELD, PAGES, PRINTED, Keys, begin, default_keys, hold
from render.phases import tabs_of, tools_of
from render.scene_view import SceneView
from render.sliders import boxes_of, draw_sliders
from render.software_scene import SoftwareScene
from render.viewer import Controls, Geometry, KeyOrClick, UserSettings, View
from render.vulkan_device import draws_by_processor
from render.window_layout import FULL_SIZE, Rect, WindowLayout
from settings import with_values
from sim.device import on_cpu
from sim.taichi_internals import set_image

ZOOM_S = 0.5
# A window that is lower or narrower, such as one that is hidden, keeps its layout [pixels].
LEAST_PX = 200
# How far beside a box of sliders the mouse still takes its edge [pixels], and how far it goes in a drag, in
# shares of the window.
BOX_EDGE_PX, DRAG = 4, 0.002
ZOOM_SENSE = {"zoom_in": -1.0, "zoom_out": 1.0}
FRAMES_A_SECOND = 60
# Where a frame takes longer than the first, the processor draws the 3D view only this often.
SLOW_FRAME_S, SCENE_S = 1 / 20, 1 / 8


class NoVulkan(RuntimeError):
    """Taichi found no Vulkan driver to draw with."""


class Window(Generic[UserSettings]):
    """A window on GGUI. The loop is: while running: read_controls, step, draw.

    `ti.init` comes before it, and one window is open at a time. ``geometry`` is the fixed geometry of the
    scene; without it the window shows progress until `show_scene`. ``settings`` are what the user changes,
    shown by the sliders; ``size`` is width and height [pixels]; ``keys`` are the assignment of keys, and a
    ``gamepad`` is read beside mouse and keys. A ``visible`` window is a real one, at most FRAMES_A_SECOND;
    else it is off-screen, drawn only by `picture`. With ``by_processor`` the 3D view is drawn by our own
    kernels on the processor; None: where no graphics card draws.

    Raises NoVulkan where there is no Vulkan loader, driver or device, and RuntimeError where a visible window
    has no display.
    """

    def __init__(
        self,
        geometry: Geometry | None = None,
        settings: UserSettings | None = None,
        size: tuple[int, int] = FULL_SIZE,
        visible=True,
        keys: Keys | None = None,
        gamepad: Gamepad | None = None,
        by_processor: bool | None = None,
    ):
        if visible and not display_available():
            raise RuntimeError("no display to open a window on")
        self.keys, self._gamepad = keys or default_keys(), gamepad
        self.layout = WindowLayout(*size)
        # GGUI measures sliders in fractions of the size that the window was opened with.
        self._first_size = size
        self._visible = visible
        self._ini_was_there = Path("imgui.ini").exists()
        try:
            self._window = ti.ui.Window(
                "Nephron", tuple(size), show_window=visible, fps_limit=FRAMES_A_SECOND
            )
        except RuntimeError as error:
            raise NoVulkan("no Vulkan driver found: the window and its pictures need one") from error
        atexit.register(self.close)
        self._canvas = self._window.get_canvas()
        self._scene: Any = GraphicsScene(self._window.get_scene())
        self._gui = self._window.get_gui()
        self._view: View | None = None
        self._quit = False
        # The page over the whole window, if any.
        self._page = ""
        self._warm_up = 2
        self._drag: str | None = None
        self._cursor: np.ndarray | None = None
        self._pressing = self._held_shift = False
        # The boxes of the tools by action, and the tool that the mouse holds.
        self._tools: dict[str, Rect] = {}
        # The layout and the settings that these are of.
        self._tools_of: tuple[WindowLayout | None, UserSettings | None] = None, None
        self._held_tool = ""
        # The boxes of sliders by group, and how often the user moved each.
        self._slider_boxes: dict[str, Rect] = {}
        self._boxes_moved: Counter[str] = Counter()
        # Groups under a press, where it was, and the settings then.
        self._before_drag: tuple[list[str], np.ndarray, UserSettings] | None = None
        self._last_read = time.perf_counter()
        self._ui_camera = ti.ui.Camera()
        self._background = BackgroundImage(self.layout, self.keys)
        self._by_processor = draws_by_processor() and on_cpu() if by_processor is None else by_processor
        if geometry is not None and settings is not None:
            self.show_scene(geometry, settings)

    def show_scene(self, geometry: Geometry, settings: UserSettings) -> None:
        """Show a scene from now on, with these settings."""
        self.settings, self._geometry = settings, geometry
        part, size = (
            self.layout.window_coordinates(self.layout.clear),
            (self.layout.width, self.layout.height),
        )
        self.camera = OrbitCamera(geometry.bounds, geometry.up, part, size[0] / size[1])
        self._look()
        self._scene_view = SceneView(geometry, self.camera)
        self._software = SoftwareScene(self.camera, size) if self._by_processor else None
        self._frame_at = self._scene_at = 0.0
        # Whether `draw_scene` has dealt with the 3D view of the next frame.
        self._is_ahead = False
        self._seen: tuple[object, ...] = ()

    def change_geometry(self, geometry: Geometry) -> None:
        """Show other surfaces from now on, with camera and settings as they are."""
        self._geometry = geometry
        self._scene_view = SceneView(geometry, self.camera, self._scene_view)
        self._seen = ()

    def prepare(self, view: View) -> None:
        """Where the processor draws the 3D view, draw it once without showing it, so that the first `draw`
        need not wait for its kernels.
        """
        if self._software is not None:
            self._render(self._software, view, self._background.pixels.copy())

    def show_progress(self, text: str, share: float) -> None:
        """Show what is being prepared, and the share that is done, 0 to 1."""
        if self._visible:
            self._background.show_progress(text, share)
            self._put_image()
            self._window.show()

    # Before a scene is shown

    def show_image(self, image: np.ndarray) -> None:
        """Show an image over the whole window, uint8, shape (height, width, 3) of ``layout``."""
        if self._visible:
            self._background.show_image(image)
            self._put_image()
            self._window.show()
            width, height = self._window.get_window_shape()
            if (width, height) != image.shape[1::-1] and min(width, height) >= LEAST_PX:
                self.layout = replace(self.layout, width=width, height=height)
                self._background = BackgroundImage(self.layout, self.keys)

    def presses(self) -> list[KeyOrClick]:
        """The keys and clicks since the last call."""
        if not self._visible:
            return []
        self._read_cursor()
        keys = [event.key for event in self._window.get_events(ti.ui.PRESS)]
        return [press for key in keys if (press := self._key_or_click(key)) is not None]

    def _key_or_click(self, key: str) -> KeyOrClick | None:
        if key == ti.ui.LMB:
            return None if self._cursor is None else KeyOrClick(place=self._pixel(self._cursor))
        return KeyOrClick(PRINTED[key]) if key in PRINTED else None

    # Input

    @property
    def running(self) -> bool:
        return not self._quit and (self._window.running if self._visible else True)

    def quit(self) -> None:
        """Run no longer."""
        self._quit = True

    def read_controls(self) -> Controls[UserSettings]:
        controls, before = Controls(settings=self.settings), self.settings.view.approach
        self._read(controls)
        self.settings = controls.settings
        if (approach := self.settings.view.approach) != before:
            controls.message = f"View: {approach}."
        return controls

    def _look(self) -> None:
        """See the organ by the approach that is set."""
        self._approach = self.settings.view.approach
        look_by(self.camera, self._approach, self._geometry.lateral)

    def _read(self, controls: Controls) -> None:
        now = time.perf_counter()
        elapsed, self._last_read = min(now - self._last_read, 0.1), now
        if not self._visible:
            return
        self._read_cursor()
        self._read_events(controls)
        # With shift a key has another action.
        has_shift = self._window.is_pressed(ti.ui.SHIFT)
        held = [] if has_shift else self.keys.held()
        pressed = [action for action, key in held if self._window.is_pressed(key)]
        for action in {*pressed, self._held_tool} - {""}:
            hold(action, controls, elapsed)
            if action in ZOOM_SENSE:
                self.camera.zoom(np.exp(ZOOM_SENSE[action] * elapsed / ZOOM_S))
        if self._drag is not None:
            {"orbit": self.camera.orbit, "pan": self.camera.pan}[self._drag](*self._moved)
        controls.press = self._pressing
        # With shift the mouse marks the score, and the probe stays where it is.
        if self._drag is None and self._over_scene() and not self._window.is_pressed(ti.ui.SHIFT):
            controls.ray = self.camera.ray(self._cursor)
        if self._gamepad is not None:
            self._gamepad.read(controls, elapsed)
        if controls.reset:
            self._look()

    def _read_cursor(self) -> None:
        cursor = np.array(self._window.get_cursor_pos(), dtype=np.float64)
        # Before the mouse first moves GGUI reports (0, 1).
        known = self._cursor is not None or tuple(cursor) != (0.0, 1.0)
        self._moved = cursor - self._cursor if self._cursor is not None else np.zeros(2)
        self._cursor = cursor if known else None

    def _over_scene(self) -> bool:
        if self._cursor is None:
            return False
        place = self._pixel(self._cursor)
        over = [*self._boxes_over_scene(), *self._slider_boxes.values()]
        return self.layout.scene.contains(*place) and not any(box.contains(*place) for box in over)

    def _boxes_over_scene(self) -> list[Rect]:
        """The boxes of the background image that cover the 3D view."""
        if self._page:
            return [self.layout.whole]
        if self._view is None:
            return [self.layout.compass]
        return self._background.boxes_over_scene(self._view)

    def _pixel(self, cursor: np.ndarray) -> tuple[float, float]:
        """Column and row at window coordinates."""
        return cursor[0] * self.layout.width, (1 - cursor[1]) * self.layout.height

    def _read_events(self, controls: Controls) -> None:
        # In a slow frame shift may be released before the frame reads its keys: it counts if it was held
        # before, or pressed before the key.
        with_shift, self._held_shift = self._held_shift, self._window.is_pressed(ti.ui.SHIFT)
        for event in self._window.get_events(ti.ui.PRESS):
            with_shift = with_shift or event.key == ti.ui.SHIFT
            self._key_down(event.key, with_shift, controls)
        for event in self._window.get_events(ti.ui.RELEASE):
            # GGUI tells presses and releases of a slow frame apart, but not their order: what is held now was
            # pressed last.
            if self._window.is_pressed(event.key):
                continue
            if event.key == ti.ui.LMB:
                self._pressing, self._held_tool = False, ""
                self._restore_sliders()
            elif event.key in (ti.ui.RMB, ti.ui.MMB):
                self._drag = None

    def _key_down(self, key: str, with_shift: bool, controls: Controls) -> None:
        if key == ti.ui.LMB and with_shift and self._over_scene():
            controls.score_under = self.camera.ray(self._cursor)
        elif key == ti.ui.LMB:
            self._pressing = self._over_scene()
            if self._cursor is not None and not self._page:
                place = self._pixel(self._cursor)
                controls.dismiss = self.layout.messages.contains(*place)
                controls.acknowledge = self._background.acknowledges_at(*place)
                self._click(place, controls)
                controls.pointed_mm = self._background.plane_point_at(*place)
                boxes = self._slider_boxes.items()
                pressed = [name for name, box in boxes if box.widened(BOX_EDGE_PX).contains(*place)]
                self._before_drag = pressed, self._cursor, self.settings
        elif key in (ti.ui.RMB, ti.ui.MMB) and self._over_scene():
            pans = key == ti.ui.MMB or with_shift
            self._drag = "pan" if pans else "orbit"
        else:
            self._begin(self.keys.action_of(key, with_shift), controls)

    def _begin(self, action: str, controls: Controls) -> None:
        """Apply an action whose key went down, or whose tool was clicked on."""
        if action in PAGES:
            self._page = "" if self._page == action else action
        elif action == "quit" and self._page:
            # The question whether to quit would be under the page.
            self._page = ""
        else:
            begin(action, controls)

    def _click(self, place: tuple[float, float], controls: Controls) -> None:
        """Choose a phase, or use a tool, that is at a column and row."""
        for phase, box in tabs_of(self.layout).items():
            if box.contains(*place):
                controls.settings = with_values(controls.settings, {"view.phase": phase})
        for action, box in self._tools.items():
            if box.contains(*place):
                self._held_tool = action if action in HELD else ""
                self._begin(action, controls)

    def _restore_sliders(self) -> None:
        """After a drag that may have moved a box of sliders, have a new one: GGUI cannot move a box."""
        before_drag, self._before_drag = self._before_drag, None
        if before_drag is None or self._cursor is None:
            return
        pressed, cursor, settings = before_drag
        if np.abs(self._cursor - cursor).max() > DRAG and settings == self.settings:
            self._boxes_moved.update(pressed)

    # Drawing

    def image_shape(self, count: int, width_mm: float, depth_mm: float) -> tuple[int, int]:
        """Rows and columns of the boxes in which so many images of a width and a depth [mm] are drawn."""
        box = self.layout.image_boxes(count, width_mm, depth_mm)[0]
        return box.height, box.width

    def draw_scene(self, view: View, may_wait: bool) -> None:
        """Where the processor draws the 3D view, draw it already, for the next `draw`; with `may_wait`
        only if the user changed it.
        """
        if self._software is not None and not self._page and self._background.has_scene:
            self._is_ahead = True
            if not self._keeps_scene(may_wait):
                self._draw_by_processor(self._software, view)

    def draw(self, view: View) -> None:
        """Show a view. Off-screen, only store it for `picture`."""
        if self.settings.view.approach != self._approach:
            self._look()
        self._view = view
        if self._visible:
            self._draw_frame(view)
            self._window.show()
            self._update_size()

    def picture(self) -> np.ndarray:
        """The last view drawn, uint8, shape (height, width, 3).

        Raises RuntimeError if nothing was drawn.
        """
        if self._view is None:
            raise RuntimeError("nothing was drawn yet")
        self._place_sliders()
        # Dear ImGui shows a new box one frame late, and in the first frames of some drivers a body may be
        # missing.
        while not self._visible and self._warm_up > 0:
            self._warm_up -= 1
            self._draw_frame(self._view)
            self._window.get_image_buffer_as_numpy()
        self._draw_frame(self._view)
        colours = self._window.get_image_buffer_as_numpy()
        if self._visible:
            self._window.show()
        levels = (colours * np.float32(255.0) + np.float32(0.5)).astype(np.uint8)
        return np.ascontiguousarray(levels.transpose(1, 0, 2)[::-1, :, :3])

    def close(self) -> None:
        """Close the window. A second call does nothing."""
        if self._window is None:
            return
        window, self._window, self._quit = self._window, None, True
        self._canvas = self._scene = self._gui = None
        window.destroy()
        # Dear ImGui writes its layout file into the working directory; GGUI has no option against it.
        if not self._ini_was_there:
            Path("imgui.ini").unlink(missing_ok=True)
        atexit.unregister(self.close)

    def _update_size(self) -> None:
        width, height = self._window.get_window_shape()
        if (width, height) != (self.layout.width, self.layout.height) and min(width, height) >= LEAST_PX:
            self._change_layout(replace(self.layout, width=width, height=height))

    def _change_layout(self, layout: WindowLayout) -> None:
        self.layout, size = layout, (layout.width, layout.height)
        self._background = BackgroundImage(self.layout, self.keys)
        if self._software is not None:
            self._software = SoftwareScene(self.camera, size)
        self.camera.aspect = size[0] / size[1]
        self.camera.part = self.layout.window_coordinates(self.layout.clear)

    def _draw_frame(self, view: View) -> None:
        if self._page:
            self._background.show_page(self._page, view)
        else:
            if self.layout.has_engineer != self.settings.view.show_engineer:
                self._change_layout(replace(self.layout, has_engineer=self.settings.view.show_engineer))
            self._place_sliders()
            self._place_tools()
            pointed = None if self._cursor is None else self._pixel(self._cursor)
            axes = np.stack(self.camera.axes())
            self._background.compose(view, axes, self._taken(), self._visible, pointed)
            keeps = self._is_ahead or self._keeps_scene()
            if self._software is not None and not (keeps and self._background.has_scene):
                self._draw_by_processor(self._software, view)
            self._is_ahead = False
        self._put_image()
        if self._software is None:
            self._draw_scene(view)
        if not self._page:
            placed = self._slider_boxes, self._first_size, self._boxes_moved
            self.settings = draw_sliders(self._gui, self.settings, self._geometry, *placed)

    def _place_tools(self) -> None:
        """Have the tools of the present settings and layout."""
        of = self.layout, self.settings
        if any(one is not other for one, other in zip(of, self._tools_of, strict=True)):
            tools = tools_of(self.layout, self.settings, self.keys)
            self._tools, self._tools_of = {tool.action: tool.box for tool in tools}, of
            self._background.put_tools(self.settings.view.phase, tools)

    def _place_sliders(self) -> None:
        """Have the boxes of the present settings."""
        boxes = boxes_of(self.settings, self._geometry, self.layout)
        if self._view is not None and self._view.table is not None:
            # The table has the width of the 3D view.
            boxes = {name: box for name, box in boxes.items() if box.top >= self.layout.strip.top}
        if boxes != self._slider_boxes:
            self._slider_boxes, self._warm_up = boxes, 2

    def _taken(self) -> int:
        """The width that the scanner's sliders take beside the warnings."""
        scene, warned = self.layout.scene, self.layout.highest_warning
        beside = [box for box in self._slider_boxes.values() if warned < box.bottom <= scene.bottom]
        return max((scene.right - box.left for box in beside), default=0)

    def _put_image(self) -> None:
        # Without the 10 ms that Canvas.set_image needs to pack the pixels.
        set_image(self._canvas, self._background.pixels.view(np.uint32)[..., 0])

    def _draw_by_processor(self, software: SoftwareScene, view: View) -> None:
        """Draw the 3D view into the background image."""
        self._background.draw_scene(partial(self._render, software, view))

    def _render(self, software: SoftwareScene, view: View, pixels: np.ndarray) -> None:
        """Render the 3D view into pixels as those of the background image."""
        software.look()
        self._scene_view.draw(software, view, self.settings.view)
        software.render(self.layout.scene, pixels)

    def _keeps_scene(self, may_wait: bool = False) -> bool:
        """Whether the 3D view may stay as it is in this frame: for SCENE_S where frames are slow, or where it
        may wait, unless the user changes the view.
        """
        now, seen = time.perf_counter(), (*self.camera.state, self.settings)
        is_slow, self._frame_at = now - self._frame_at > SLOW_FRAME_S, now
        waits = may_wait or now - self._scene_at < SCENE_S
        keeps = is_slow and waits and seen == self._seen and self._visible
        if not keeps:
            self._scene_at, self._seen = now, seen
        return keeps

    def _draw_scene(self, view: View) -> None:
        """Draw the 3D view over the background image."""
        self._set_camera()
        rects = [self.layout.panel, self.layout.title, self.layout.strip, *self._boxes_over_scene()]
        masked = [self.layout.window_coordinates(rect) for rect in rects]
        self._scene_view.draw(self._scene, view, self.settings.view, masked)
        self._canvas.scene(self._scene.ggui_scene)

    def _set_camera(self) -> None:
        _, up, ahead = self.camera.axes()
        eye = self.camera.eye()
        self._ui_camera.position(*eye)
        self._ui_camera.lookat(*(eye + ahead * self.camera.distance))
        self._ui_camera.up(*up)
        self._ui_camera.fov(FIELD_OF_VIEW_DEG)
        near, far = self.camera.near_far()
        self._ui_camera.z_near(near)
        self._ui_camera.z_far(far)
        self._scene.ggui_scene.set_camera(self._ui_camera)
