"""The screen, as reported by the system: GLFW would end the process where there is none."""

import ctypes
import os
import re
import sys
from functools import cache
from typing import NamedTuple

from render.window_layout import FULL_SIZE, MOST_SCALE

# Fraction of a small screen's height for a window below its title and a task bar; its width is a multiple of
# STEP.
HEIGHT_FRACTION, STEP = 0.88, 64
# Dots per inch at scale 1.
USUAL_DPI = 96
# Bits of colour of a screen on which a window can be opened: with 16 or 30, the drivers end the process.
DEPTHS = (24, 32)


class X11Screen(NamedTuple):
    """A screen's size [pixels], its scale, and its bits of colour."""

    width: int
    height: int
    scale: float
    depth: int


def display_available() -> bool:
    """Whether a window can be opened."""
    return sys.platform in ("win32", "darwin") or _of_x11(os.environ.get("DISPLAY")) is not None


def wrong_depth() -> int | None:
    """The screen's bits of colour, where no window can be opened on it for them."""
    screen = None if sys.platform in ("win32", "darwin") else _of_x11(os.environ.get("DISPLAY"))
    return None if screen is None or screen.depth in DEPTHS else screen.depth


def window_size() -> tuple[int, int]:
    """Width and height of a window [pixels] that fit the screen; FULL_SIZE where it is unknown."""
    screen = _of_windows()
    if sys.platform not in ("win32", "darwin"):
        of_x11 = _of_x11(os.environ.get("DISPLAY"))
        screen = of_x11 and of_x11[:3]
    return FULL_SIZE if screen is None else fitted(*screen)


def fitted(width: int, height: int, scale: float = 1.0) -> tuple[int, int]:
    """The size of a window on a screen of a size [pixels]: FULL_SIZE, enlarged by the screen's scale, or as
    large as fits.
    """
    room = min(width, HEIGHT_FRACTION * height * FULL_SIZE[0] / FULL_SIZE[1])
    wide = int(min(scale * FULL_SIZE[0], room)) // STEP * STEP
    return wide, wide * FULL_SIZE[1] // FULL_SIZE[0]


def _of_windows() -> tuple[int, int, float] | None:
    """Width, height and scale of the screen on Windows, in its own pixels, as GLFW does."""
    if sys.platform != "win32":
        return None
    user = ctypes.windll.user32
    user.SetProcessDPIAware()
    # Windows 10 and later.
    dpi = user.GetDpiForSystem() if hasattr(user, "GetDpiForSystem") else USUAL_DPI
    return user.GetSystemMetrics(0), user.GetSystemMetrics(1), dpi / USUAL_DPI


@cache
def _of_x11(display: str | None) -> X11Screen | None:
    """An X server's screen. Cached: a server without clients may reset when asked again."""
    if not display:
        return None
    try:
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError:
        return None
    x11.XOpenDisplay.restype = ctypes.c_void_p
    x11.XResourceManagerString.restype = ctypes.c_char_p
    connection = x11.XOpenDisplay(None)
    if not connection:
        return None
    server = ctypes.c_void_p(connection)
    screen = x11.XDefaultScreen(server)
    scale = scale_of(x11.XResourceManagerString(server) or b"")
    size = x11.XDisplayWidth(server, screen), x11.XDisplayHeight(server, screen)
    depth = x11.XDefaultDepth(server, screen)
    x11.XCloseDisplay(server)
    return X11Screen(*size, scale, depth)


def scale_of(resources: bytes) -> float:
    """The scale in the resources of an X server, where desktops set it: Xft.dpi, from 96; 1 where it is not
    there.
    """
    match = re.search(rb"^Xft\.dpi:\s*(\d+(\.\d+)?)", resources, re.MULTILINE)
    return min(max(float(match[1]) / USUAL_DPI, 1.0), MOST_SCALE) if match else 1.0
