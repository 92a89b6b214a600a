"""A window that draws nothing."""

import numpy as np
from settings_at_start import settings_with

from rehearsal.live_settings import LiveSettings
from render.viewer import Controls, Geometry, View


class NullViewer:
    """What a ``WindowLoop`` asks of a window; ``script`` has controls frame by frame, until one quits."""

    def __init__(self, settings: LiveSettings | None = None, script=(), size: tuple[int, int] = (1280, 720)):
        self.settings = settings or settings_with()
        self.frames = 0
        self._script = iter(script)
        self._size = size
        self._running = True

    @property
    def running(self) -> bool:
        return self._running

    def read_controls(self) -> Controls:
        controls = next(self._script, None) or Controls(None)
        # Those that the window has, where the script does not set others.
        self.settings = controls.settings = controls.settings or self.settings
        self._running = self._running and not controls.quit
        return controls

    def quit(self) -> None:
        self._running = False

    def image_shape(self, count: int, width_mm: float, depth_mm: float) -> tuple[int, int]:
        return self._size

    def change_geometry(self, geometry: Geometry) -> None: ...

    def draw_scene(self, view: View, may_wait: bool) -> None: ...

    def draw(self, view: View) -> None:
        self.frames += 1

    def picture(self) -> np.ndarray:
        width, height = self._size
        return np.zeros((height, width, 3), dtype=np.uint8)
