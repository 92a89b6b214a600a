"""What a front end is given, what it gives back, and the front end that draws nothing.

Lengths are in mm, angles in degrees, patient coordinates LPS. Nothing here needs a screen, Vulkan or Taichi.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np

from ultrasound.probe import DetailLevel, Mode
from ultrasound.target import Target

B_MODE, TGC = "Echo", "Gain over depth"
# Groups of settings that stand beside the picture, as on a scanner.
ASIDE = (B_MODE, TGC)


class KeyMapEntry(NamedTuple):
    """One line of the key map: ``keys`` as they are printed, ``actions`` (their names in the code), ``text`` for the reader."""

    keys: tuple[str, ...]
    actions: tuple[str, ...]
    text: str


KEY_MAP = {
    "Transducer": (
        KeyMapEntry(("Mouse",), ("point",), "move it over the organ"),
        KeyMapEntry(("Left button",), ("press",), "press it in, the deeper the longer it is held"),
        KeyMapEntry(("W", "S"), ("push", "lift"), "push it in, lift it"),
        KeyMapEntry(("A", "D"), ("rotate_left", "rotate_right"), "roll it about its axis, left and right"),
        KeyMapEntry(
            ("Q", "E"), ("rock_left", "rock_right"), "turn the beam in the image plane, left and right"
        ),
        KeyMapEntry(("Z", "C"), ("tilt_back", "tilt_forward"), "tilt it out of the image plane, either way"),
    ),
    "View": (
        KeyMapEntry(("Right drag",), ("orbit",), "turn it"),
        KeyMapEntry(("Middle drag",), ("pan",), "shift it (also Shift + right drag)"),
        KeyMapEntry(("Up", "Down"), ("zoom_in", "zoom_out"), "zoom in and out"),
        KeyMapEntry(("T",), ("translucent",), "organ translucent or solid"),
        KeyMapEntry(("X",), ("cut",), "organ cut along the image plane"),
        KeyMapEntry(("N",), ("show_seen",), "what has been in the picture, in green"),
    ),
    "Picture": (
        KeyMapEntry(("B",), ("mode",), "echo and CT, echo alone, CT alone"),
        KeyMapEntry(("V",), ("detail_level",), "echo: how much of it is computed"),
        KeyMapEntry(("G",), ("show_scanner",), "the scanner's sliders, gain over depth too"),
        KeyMapEntry(("O",), ("outline",), "outline of the tumour, now and in the CT"),
        KeyMapEntry(
            ("Click on picture",), ("measure",), "caliper from click to click, in mm; a third ends it"
        ),
        KeyMapEntry(("F",), ("freeze",), "freeze and go on"),
        KeyMapEntry(
            ("Left", "Right"),
            ("cine_back", "cine_forth"),
            "while frozen: back through the last ten seconds, forth",
        ),
        KeyMapEntry(("I",), ("export",), "save the picture (PNG, DICOM) and the organ (PLY)"),
    ),
    "Plan": (
        KeyMapEntry(("Space",), ("plan_for",), "what it is for: tumour and margin, tumour, kidney"),
        KeyMapEntry(("Return",), ("plan",), "make one: a sweep that shows that"),
        KeyMapEntry(("Backspace",), ("next_plan",), "stop planning; or its next sweep, then none"),
    ),
    "Session": (
        KeyMapEntry(("U", "Y"), ("undo", "redo"), "undo the last press, turn or way; take that back"),
        KeyMapEntry(("M", "J"), ("bookmark", "to_bookmark"), "bookmark this moment; go back to bookmarks"),
        KeyMapEntry(("L",), ("sweep",), "begin to record a tracked sweep, or end it"),
        KeyMapEntry(("K",), ("take_over",), "take the lead from a replay or a tracked probe"),
        KeyMapEntry(("R",), ("reset",), "reset tissue, transducer and view"),
        KeyMapEntry(("P",), ("screenshot",), "save a picture of the window"),
        KeyMapEntry(("H",), ("help",), "show or hide this list"),
        KeyMapEntry(("Esc",), ("quit",), "quit"),
    ),
}
KEY_MAP_ENTRIES = tuple(line for group in KEY_MAP.values() for line in group)


def key_table() -> str:
    """The key map as a Markdown table, for the README."""
    rows = ["| Key | What it does |", "| --- | --- |"]
    for group, lines in KEY_MAP.items():
        rows += [f"| **{group}** | |", *(f"| {' / '.join(line.keys)} | {line.text} |" for line in lines)]
    return "\n".join(rows)


def _slider(default, label: str, unit: str, low, high, group: str):
    about = {"label": label, "unit": unit, "low": low, "high": high, "group": group}
    return field(default=default, metadata=about)


def _switch(default: bool, label: str):
    return _slider(default, label, "", False, True, "View")


def _level(number: int):
    return _slider(50, f"{number}", "", 0, 100, TGC)


@dataclass
class Settings:
    """What the user sets. The metadata of a field (label, unit, low, high, group) is all that its slider is made of.

    A field that is None or has no metadata has no slider: of the first two, each tissue model has one.
    """

    young_kpa: float | None = _slider(None, "Young", "kPa", 1.0, 100.0, "Tissue")
    stiffness: float | None = _slider(None, "Stiffness", "", 0.1, 1.0, "Tissue")
    iterations: int = _slider(9, "Iter.", "", 1, 40, "Tissue")
    substeps: int = _slider(3, "Substeps", "", 1, 10, "Tissue")
    gravity_m_s2: float = _slider(9.81, "g", "m/s2", 0.0, 20.0, "Tissue")
    depth_mm: int = _slider(60, "Depth", "mm", 5, 300, "Picture")
    window_hu: int = _slider(350, "W", "HU", 1, 2000, "Picture")
    level_hu: int = _slider(40, "L", "HU", -500, 500, "Picture")
    margin_mm: int = _slider(5, "Margin", "mm", 0, 20, "Picture")
    gain_percent: int = _slider(50, "Gain", "%", 0, 100, B_MODE)
    dyn_range_db: int = _slider(60, "DR", "dB", 20, 120, B_MODE)
    frequency_mhz: float = _slider(7.5, "", "MHz", 2.0, 15.0, B_MODE)
    focus_percent: int = _slider(40, "Focus", "%", 0, 100, B_MODE)
    tgc_1: int = _level(1)
    tgc_2: int = _level(2)
    tgc_3: int = _level(3)
    tgc_4: int = _level(4)
    tgc_5: int = _level(5)
    tgc_6: int = _level(6)
    tgc_7: int = _level(7)
    tgc_8: int = _level(8)
    translucent: bool = _switch(True, "Translucent")
    cut: bool = _switch(False, "Cut open")
    show_tumour: bool = _switch(True, "Tumour")
    show_parts: bool = _switch(True, "Vessels")
    show_support: bool = _switch(True, "Support")
    outline: bool = _switch(False, "Outline")
    show_scanner: bool = False
    show_seen: bool = False
    mode: Mode = "both"
    detail_level: DetailLevel = "speckle"
    plan_for: Target = "margin"


@dataclass(frozen=True)
class Geometry:
    """What is fixed for a scene. Vertices that move are Taichi fields, which the app keeps up to date."""

    organ_vertices: Any
    """Surface of the organ [mm], ti.Vector.field(3, ti.f32), shape (n,)."""
    organ_faces: np.ndarray
    """Triangles, normals outward, int32, shape (m, 3)."""
    bounds: np.ndarray
    """Box that the camera frames, least and greatest corner [mm], shape (2, 3)."""
    up: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    """Direction opposite to gravity, shape (3,)."""
    transducer_size_mm: np.ndarray = field(default_factory=lambda: np.array([40.0, 10.0, 20.0]))
    """The cuboid, shape (3,): x lateral and to the marked side, y elevation, z axis. The image leaves at z = -size/2."""
    transducer_radius_mm: float = 0.0
    """Radius of a curved face, in the x-z plane; 0 where it is flat."""
    frequency_range_mhz: tuple[float, float] = (2.0, 15.0)
    """What the probe can be set to."""
    tumour_vertices: Any = None
    """As organ_vertices, or None."""
    tumour_faces: np.ndarray | None = None
    parts: dict[str, tuple[Any, np.ndarray]] = field(default_factory=dict)
    """What else is in the organ: tissue -> vertices and triangles, as the organ's."""
    support_vertices: np.ndarray | None = None
    """Fixed [mm], shape (k, 3), or None."""
    support_faces: np.ndarray | None = None


@dataclass(frozen=True)
class Guidance:
    """A plan's sweep, to be followed."""

    goal: np.ndarray | None
    """Where the transducer is to go next, world from transducer [mm], shape (4, 4); None where all of the sweep is behind."""
    path_mm: np.ndarray
    """The way of the face's middle, segments of shape (n, 2, 3)."""
    done: np.ndarray
    """Which of them are behind, bool, shape (n,)."""


@dataclass(frozen=True)
class View:
    """What changes each frame."""

    transducer_pose: np.ndarray
    """World from transducer [mm], shape (4, 4)."""
    pictures: dict[str, np.ndarray]
    """Name -> grey values, uint8, shape (rows = depth, columns = lateral, local x growing to the right); the first is the one that
    the 3D view shows on the image plane."""
    width_mm: float
    depth_mm: float
    above_mm: float = 0.0
    """How much of the depth lies behind the middle of the array's face."""
    sector: tuple[float, float, float] | None = None
    """Radius of the array's face [mm] and the angles of the first and last line [rad], where lines fan out."""
    focus_mm: float | None = None
    outline_mm: np.ndarray | None = None
    """Line segments on the plane, shape (n, 2, 2) [mm]: x from the middle to the right, y down from the face."""
    outline_before_mm: np.ndarray | None = None
    """The same of where it was in the CT."""
    seen: dict[str, np.ndarray] = field(default_factory=dict)
    """Which vertices of "organ" and "tumour" lie in tissue that has been in the picture, bool, shape (n,)."""
    guidance: Guidance | None = None
    caliper_mm: tuple[tuple[float, float], ...] = ()
    """Up to two points on the plane [mm]."""
    caliper: str = ""
    """What is between them."""
    notes: dict[str, str] = field(default_factory=dict)
    """Name of a picture -> what is written in it, such as that it is black for want of contact; in a second line what to do."""
    captions: tuple[str, str, str] = ("", "", "")
    """What is said around the pictures: the probe, above; the echo's and the CT's settings, below."""
    readouts: dict[str, str] = field(default_factory=dict)
    """Name -> text with its unit, in the order of display: {"step": "9.1 ms"}."""
    findings: dict[str, str] = field(default_factory=dict)
    """The same of what the surgeon looks for: {"to tumour": "4.2 mm"}."""
    alert: str = ""
    """Which of them is more than it should be."""
    status: str = ""
    """Short words over the picture, such as FROZEN, three spaces apart; the weightiest first: the last go where room ends."""
    clock: str = ""
    """The session's time, in simulated seconds: "42.6 s"."""
    pace: str = ""
    """How slowly that goes, where it is slower than real: "0.2 x real"."""
    title: str = ""
    """What is shown (scene or case); no patient's name, id or date."""
    marked_side: str = "right"
    """Where the marker dot stands in the picture: "right" is local +x, "left" for a probe that is marked at -x."""


@dataclass
class Controls:
    """What the user did since the last frame: lengths and angles are the changes asked for in that time.

    Angles are right-handed about the transducer's own axes.
    """

    settings: Settings
    ray: tuple[np.ndarray, np.ndarray] | None = None
    """Origin [mm] and unit direction under the mouse, world, each (3,); None off the 3D view or while the view turns."""
    press: bool = False
    """The button that presses the transducer in is held."""
    press_share: float = 1.0
    """How far a press goes, as a share of the deepest: less under a trigger that is pulled halfway."""
    slide_mm: tuple[float, float] = (0.0, 0.0)
    """Over the organ's surface, along the transducer's own x (lateral) and y (elevation)."""
    push_mm: float = 0.0
    """Along the transducer's axis, positive into the tissue, negative lifts."""
    rotate_deg: float = 0.0
    """About the transducer's axis (local z)."""
    rock_deg: float = 0.0
    """In the image plane (about local y); positive swings the beam towards -x."""
    tilt_deg: float = 0.0
    """Out of the image plane (about local x); positive swings the beam towards +y."""
    reset: bool = False
    undo: bool = False
    redo: bool = False
    bookmark: bool = False
    to_bookmark: bool = False
    sweep: bool = False
    """The key that begins and ends a sweep went down."""
    take_over: bool = False
    plan: bool = False
    next_plan: bool = False
    pointed_mm: tuple[float, float] | None = None
    """The place on the image plane that was clicked on in a picture."""
    cine: int = 0
    """Pictures to go on (or back, negative) in those of the last seconds."""
    export: bool = False
    freeze: bool = False
    """The freeze key went down: the app toggles."""
    screenshot: bool = False
    quit: bool = False
    message: str = ""
    """What a device has to say, such as that it was unplugged."""


class Viewer(Protocol):
    """A front end. The loop is: while running: read_controls, step, draw."""

    settings: Settings

    @property
    def running(self) -> bool: ...

    def read_controls(self) -> Controls: ...

    def draw(self, view: View) -> None: ...

    def picture(self) -> np.ndarray:
        """The last view drawn, uint8, shape (height, width, 3), top row first."""
        ...

    def close(self) -> None: ...


class NullViewer:
    """Draws nothing: for tests and benches. It runs until `close`; `script` feeds it controls, frame by frame."""

    def __init__(self, settings: Settings | None = None, script=(), size: tuple[int, int] = (1280, 720)):
        self.settings = settings or Settings()
        self.frames = 0
        self._script = iter(script)
        self._size = size
        self._running = True

    @property
    def running(self) -> bool:
        return self._running

    def read_controls(self) -> Controls:
        controls = next(self._script, None) or Controls(settings=self.settings)
        self._running = self._running and not controls.quit
        return controls

    def draw(self, view: View) -> None:
        self.frames += 1

    def picture(self) -> np.ndarray:
        width, height = self._size
        return np.zeros((height, width, 3), dtype=np.uint8)

    def close(self) -> None:
        self._running = False
