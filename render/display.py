"""The screen, as reported by the system: GLFW would end the process where there is none."""

import ctypes
import os
import sys
from functools import cache

from render.window_layout import FULL_SIZE

# Fraction of a small screen's height for a window below its title and a task bar; its width is a multiple of STEP.
HEIGHT_FRACTION, STEP = 0.88, 64


def display_available() -> bool:
    """Whether a window can be opened."""
    return sys.platform in ("win32", "darwin") or _of_x11(os.environ.get("DISPLAY")) is not None


def window_size() -> tuple[int, int]:
    """Return width and height of a window [pixels] that fit the screen; FULL_SIZE where it is unknown."""
    screen = None
    if sys.platform == "win32":
        metrics = ctypes.windll.user32.GetSystemMetrics
        screen = metrics(0), metrics(1)
    elif sys.platform != "darwin":
        screen = _of_x11(os.environ.get("DISPLAY"))
    return FULL_SIZE if screen is None else fitted(*screen)


def fitted(width: int, height: int) -> tuple[int, int]:
    """Return the size of a window on a screen of a size [pixels]: FULL_SIZE, or as large as fits."""
    room = min(width, HEIGHT_FRACTION * height * FULL_SIZE[0] / FULL_SIZE[1])
    wide = min(FULL_SIZE[0], int(room) // STEP * STEP)
    return wide, wide * FULL_SIZE[1] // FULL_SIZE[0]


@cache
def _of_x11(display: str | None) -> tuple[int, int] | None:
    """Return width and height of an X server's screen. Cached: a server without clients may reset when asked again."""
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
