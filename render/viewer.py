"""What the window is given and gives back: geometry, views, settings, controls.

Lengths are in mm, angles in degrees, patient coordinates LPS. Nothing here needs a screen, Vulkan or Taichi.
"""

from dataclasses import dataclass, field
from typing import Annotated, Any, Generic, Literal, TypeVar, get_args

import numpy as np
from pydantic import Field

from settings import Control, Key, Section
from ultrasound.probe import Probe, ScannerSettings

Technique = Literal["enucleation", "enucleoresection", "wedge"]
# Where the kidney is seen from: from beside the supine patient; as the scope of a transperitoneal operation
# sees it, with the patient on the other side; from the front; from the back.
Approach = Literal["bedside", "surgeon's scope", "from above", "from behind"]
Phase = Literal["Scan", "Score", "Excise", "Inspect"]
PHASES: tuple[Phase, ...] = get_args(Phase)

# Groups of controls beside the image, as on a scanner: TGC or Doppler, and those of a resection, where the
# user asks for them.
B_MODE, TGC, DOPPLER, RESECTION = "B-mode", "TGC", "Doppler", "Resection"


class ViewSettings(Section):
    """What the window shows."""

    phase: Annotated[Phase, Key("Shift+Return", "View", "next phase: scan, score, excise, inspect")] = "Scan"
    approach: Annotated[
        Approach, Key("Shift+V", "View", "view: bedside, surgeon's scope, from above, from behind")
    ] = "bedside"
    translucent: Annotated[
        bool, Control("Translucent", "View"), Key("T", "View", "organ translucent or solid")
    ] = True
    cut: Annotated[bool, Control("Cut open", "View"), Key("X", "View", "organ cut along the image plane")] = (
        False
    )
    show_tumour: Annotated[bool, Control("Tumour", "View")] = True
    show_parts: Annotated[bool, Control("Vessels", "View")] = True
    show_support: Annotated[bool, Control("Support", "View")] = True
    show_scanner: Annotated[bool, Key("G", "Image", "the scanner's sliders, with TGC")] = False
    show_engineer: Annotated[
        bool, Key("Shift+E", "View", "an engineer's sliders and figures: tissue, steps, speed")
    ] = False
    outline: Annotated[
        bool, Control("Outline", "View"), Key("O", "Image", "outline of the tumour, now and in the CT")
    ] = False
    show_seen: Annotated[bool, Key("N", "View", "coverage: imaged tissue in green")] = False


class ResectionSettings(Section):
    """How the next cut is made.

    ``cut_depth_mm`` is below the score; 0: as deep as tumour and margin were seen in the image.
    """

    technique: Annotated[
        Technique, Key("Shift+T", "Resection", "technique: enucleoresection, wedge, enucleation")
    ] = "enucleoresection"
    show_resection: Annotated[
        bool, Key("Shift+G", "Resection", "depth of the cut; air or fluid in the crater")
    ] = False
    cut_depth_mm: Annotated[float, Control("Cut", RESECTION, is_whole=True)] = Field(0.0, ge=0, le=60)
    air_in_crater: Annotated[bool, Control("Air in crater", RESECTION)] = False


class WindowSettings(Section):
    """What the user sets, as far as the window itself depends on it; the application has further sections."""

    probe: Probe
    scanner: ScannerSettings = ScannerSettings()
    view: ViewSettings = ViewSettings()
    resection: ResectionSettings = ResectionSettings()


UserSettings = TypeVar("UserSettings", bound=WindowSettings)


# Vertices [mm], a Taichi field (n,) where they move and an array (n, 3) where they do not, and triangles,
# normals outward, int32 (m, 3).
Surface = tuple[Any, np.ndarray]


@dataclass(frozen=True)
class TransducerHousing:
    """The transducer as it is drawn. Lengths in mm."""

    size_mm: tuple[float, float, float]
    """The cuboid: x lateral and to the marked side, y elevation, z axis. The image leaves at z = -size/2."""
    edge_radius_mm: float = 0.0
    """Radius of its rounded edges."""
    face_radius_mm: float = 0.0
    """Radius of a curved array face, in the x-z plane; 0 where it is flat."""
    fin_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The fin on its back, along the same axes; 0 where there is none."""
    cable_mm: float = 0.0
    """Diameter of the cable, which leaves the end at x = -size/2; 0 where there is none."""


@dataclass(frozen=True)
class Geometry:
    """The geometry of a scene. The application updates the vertices that move."""

    organ: Surface
    bounds: np.ndarray
    """Box that the camera frames, minimum and maximum corner [mm], shape (2, 3)."""
    up: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    """Direction opposite to gravity, shape (3,)."""
    lateral: np.ndarray = field(default_factory=lambda: np.array([1.0, 0.0, 0.0]))
    """Direction to the side of the patient that the organ is on, shape (3,)."""
    transducer: TransducerHousing = TransducerHousing((40.0, 10.0, 20.0))
    tumour: Surface | None = None
    parts: dict[str, Surface] = field(default_factory=dict)
    """Other structures in the organ, by tissue."""
    vessel_kinds: np.ndarray | None = None
    """Of each vertex of the part "vessel": artery, vein, or vessel where that is not known, shape (n,)."""
    support: Surface | None = None
    """It does not move."""
    specimen: Surface | None = None
    """What was cut out, beside the organ. It does not move."""
    tumour_cut_out: Surface | None = None
    """The tumour in the specimen. It does not move."""
    bed: Surface | None = None
    """The faces of the organ that a cut has made."""
    seen_vertices: np.ndarray | None = None
    """For each vertex of the organ its index in the coverage, shape (n,); None where they are the same."""


@dataclass(frozen=True)
class Guidance:
    """A planned sweep to follow."""

    goal: np.ndarray | None
    """Next pose, world from transducer [mm], shape (4, 4); None at the end of the sweep."""
    path_mm: np.ndarray
    """Path of the centre of the array face, segments of shape (n, 2, 3)."""
    done: np.ndarray
    """Whether each segment is done, bool, shape (n,)."""
    arrows_mm: tuple[np.ndarray, ...] = ()
    """Paths that lead to the next pose, each of shape (k, 3)."""


@dataclass(frozen=True)
class Score:
    """The score on the organ, as it lies now [mm]."""

    line_mm: np.ndarray
    """Points of the closed line, shape (k, 3); none of it where there is no line yet."""
    marks_mm: np.ndarray
    """Shape (n, 3)."""
    is_near: np.ndarray
    """Whether each point of the line is nearer to the tumour than the margin asks, bool, shape (k,)."""
    planned_mm: np.ndarray
    """Points of the planned closed line, shape (p, 3); none of it without a plan."""


@dataclass(frozen=True)
class Sign:
    """A state of the machine, such as that a sweep is recorded, in a few words, and what it means."""

    text: str
    meaning: str
    is_recording: bool = False


@dataclass(frozen=True)
class TextTable:
    """A table of texts under headings; ``marked`` is the index of the row that is marked, if one is."""

    title: str
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    marked: int | None = None


@dataclass(frozen=True)
class View:
    """The content of one frame."""

    transducer_pose: np.ndarray
    """World from transducer [mm], shape (4, 4)."""
    images: dict[str, np.ndarray]
    """Name -> grey values, uint8, shape (rows = depth, columns = lateral, local x to the right).

    The 3D view shows the first.
    """
    width_mm: float
    depth_mm: float
    hand_pose: np.ndarray | None = None
    """The pose (4, 4) that the hand asks for, where the transducer stays behind it: drawn as a ghost."""
    doppler: np.ndarray | None = None
    """The first image with Doppler over it, uint8, shape (rows, columns, 3)."""
    scale: tuple[str, str] = ("", "")
    """Texts at both ends of the scale of Doppler."""
    scale_colours: np.ndarray | None = None
    """Its colours from the top, uint8, shape (n, 3)."""
    above_mm: float = 0.0
    """Part of the depth behind the centre of the array face."""
    sector: tuple[float, float, float] | None = None
    """Radius of the array face [mm] and angles of the first and last scanline [rad]; None for parallel
    scanlines.
    """
    focus_mm: float | None = None
    outline_mm: np.ndarray | None = None
    """Outline of the tumour: segments on the plane, shape (n, 2, 2) [mm], x from the centre to the right,
    y down from the face.
    """
    outline_before_mm: np.ndarray | None = None
    """The same at rest, in the CT."""
    resection_mm: np.ndarray | None = None
    """The same of the resection surface that a cut would have now."""
    score: Score | None = None
    seen: dict[str, np.ndarray] = field(default_factory=dict)
    """Coverage: whether the tissue at each vertex of "organ" and "tumour" has been imaged, bool, shape
    (n,).
    """
    guidance: Guidance | None = None
    caliper_mm: tuple[tuple[float, float], ...] = ()
    """Up to two points on the plane [mm]."""
    caliper: str = ""
    """The distance between them, as text."""
    notes: dict[str, str] = field(default_factory=dict)
    """Image name -> text written in it, such as NO CONTACT; a second line says what to do."""
    captions: tuple[str, str, str] = ("", "", "")
    """Texts around the images: the probe, above; settings of B-mode and CT, below."""
    readouts: dict[str, str] = field(default_factory=dict)
    """Name -> value with unit, in the order of display: {"step": "9.1 ms"}."""
    findings: dict[str, str] = field(default_factory=dict)
    """The same for clinical measurements: {"to tumour": "4.2 mm"}."""
    alert: str = ""
    """Name of the finding that exceeds its limit."""
    status: str = ""
    """Short texts over the image of what makes it other than it seems, such as FROZEN, three spaces apart, by
    falling priority: the last are left out first.
    """
    signs: tuple[Sign, ...] = ()
    """States of the machine that the image does not depend on, by falling priority."""
    clock: str = ""
    """The session's time, in simulated seconds: "42.6 s"."""
    pace: str = ""
    """Its rate, where slower than real time: "0.2 x real"."""
    messages: tuple[str, ...] = ()
    """Messages to the user, the oldest first."""
    hint: str = ""
    """What to do next, where there is no message."""
    log: tuple[tuple[str, str], ...] = ()
    """All messages of the session, each with its time before it: ("42.6 s", "Bookmark 1")."""
    warnings: tuple[str, ...] = ()
    """Warnings that nobody has acknowledged, of the import."""
    title: str = ""
    """Scene or case; no identifiers of the patient."""
    table: TextTable | None = None
    """A table over the 3D view, such as of the attempts."""

    @property
    def shown(self) -> dict[str, np.ndarray]:
        """The images by name, the first with Doppler over it if there is any."""
        if self.doppler is None:
            return self.images
        return self.images | {next(iter(self.images)): self.doppler}


@dataclass(frozen=True)
class KeyOrClick:
    """A key that went down, as printed, or where the left mouse button went down: column and row [pixels]."""

    key: str = ""
    place: tuple[float, float] | None = None


@dataclass
class Controls(Generic[UserSettings]):
    """The user's input since the last frame; lengths and angles are changes in that time.

    Angles are right-handed about the transducer's own axes.
    """

    settings: UserSettings
    ray: tuple[np.ndarray, np.ndarray] | None = None
    """Origin [mm] and unit direction under the mouse, world, each (3,); None off the 3D view or while the
    view turns.
    """
    press: bool = False
    """The press button is held."""
    press_share: float = 1.0
    """Depth of a press as a fraction of the greatest; below 1 for a trigger that is pulled partly."""
    slide_mm: tuple[float, float] = (0.0, 0.0)
    """Over the organ's surface, along the transducer's x (lateral) and y (elevation)."""
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
    next_attempt: bool = False
    """Restore the state right after the next cut of this session."""
    show_attempts: bool = False
    """Show or hide the table of the attempts."""
    sweep: bool = False
    """Start or stop recording a sweep."""
    take_over: bool = False
    plan: bool = False
    next_plan: bool = False
    pointed_mm: tuple[float, float] | None = None
    """The point of the image plane that was clicked on."""
    score_image: bool = False
    """Set marks of the score at both edges of tumour and margin in the image."""
    score_under: tuple[np.ndarray, np.ndarray] | None = None
    """Set a mark of the score where this ray meets the organ: origin [mm] and unit direction, each (3,)."""
    score_planned: bool = False
    """Replace the marks of the score by those of the planned line."""
    cut_out: bool = False
    """Cut along the score."""
    dismiss: bool = False
    """The messages on the screen were read: the user clicked on them."""
    acknowledge: bool = False
    """The warnings of the import were checked."""
    cine: int = 0
    """Frames to move forward (negative: back) in the cine memory."""
    export: bool = False
    freeze: bool = False
    """Freeze or unfreeze."""
    frozen: bool = False
    """The rehearsal stands still."""
    screenshot: bool = False
    quit: bool = False
    message: str = ""
    """Message of an input device, such as that it was unplugged."""

    @property
    def restores(self) -> bool:
        """Whether a state is restored or kept."""
        return self.reset or self.undo or self.redo or self.bookmark or self.to_bookmark or self.next_attempt

    @property
    def operates(self) -> bool:
        """Whether a mark of the score is set, or a cut made."""
        return self.score_image or self.score_under is not None or self.score_planned or self.cut_out
