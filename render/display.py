"""The screen that a window would open on, asked of the system itself: GLFW ends the process where there is none."""

import ctypes
import os
import sys
from functools import cache

from render.window_layout import FULL_SIZE

# So much of a small screen's height a window takes, as its title and a task bar leave; its width is a multiple of STEP.
SHARE, STEP = 0.88, 64


def display_available() -> bool:
    """Whether a window can be opened."""
    return sys.platform in ("win32", "darwin") or _of_x11(os.environ.get("DISPLAY")) is not None


def window_size() -> tuple[int, int]:
    """Width and height in pixels that suit the screen: FULL_SIZE where nothing is known of it."""
    screen = None
    if sys.platform == "win32":
        metrics = ctypes.windll.user32.GetSystemMetrics
        screen = metrics(0), metrics(1)
    elif sys.platform != "darwin":
        screen = _of_x11(os.environ.get("DISPLAY"))
    return FULL_SIZE if screen is None else fitted(*screen)


def fitted(width: int, height: int) -> tuple[int, int]:
    """The size of a window on a screen of so many pixels: FULL_SIZE, or as large as there is room for."""
    room = min(width, SHARE * height * FULL_SIZE[0] / FULL_SIZE[1])
    wide = min(FULL_SIZE[0], int(room) // STEP * STEP)
    return wide, wide * FULL_SIZE[1] // FULL_SIZE[0]


@cache
def _of_x11(display: str | None) -> tuple[int, int] | None:
    """Width and height of an X server's screen. It is asked once: one that nobody is connected to may begin anew."""
    if not display:
        return None
    try:
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError:
        return None
    x11.XOpenDisplay.restype = ctypes.c_void_p
    connection = x11.XOpenDisplay(None)
    if not connection:
        return None
    server = ctypes.c_void_p(connection)
    screen = x11.XDefaultScreen(server)
    size = x11.XDisplayWidth(server, screen), x11.XDisplayHeight(server, screen)
    x11.XCloseDisplay(server)
    return size
