"""Pictures of one scene against those that are stored in tests/pictures: what no closed form shows may not
change unseen.

Where a change of the pictures is meant, ``pytest tests/render/test_stored_pictures.py --renew-pictures``
stores the new ones: look at them before they are committed. Without a Vulkan driver the 3D view is skipped,
and not renewed.
"""

from pathlib import Path

import numpy as np
import pytest
import taichi as ti
import trimesh
from conftest import rotation_about
from lattice_tissue import put, tissue_of
from PIL import Image
from settings_at_start import settings_with

from render.ultrasound_panel import OUTLINE, draw_segments, image_boxes, paste_image
from render.viewer import Geometry, TransducerHousing, View
from render.window_layout import WindowLayout
from sim.device import start
from sim.embedding import Embedding
from sim.fields import array_of
from sim.skinning import Skin
from ultrasound.probe import Probe
from ultrasound.probe_manipulator import ImagePlane, image_plane, pose_at, pose_of_image_plane
from ultrasound.scanned_anatomy import ScannedAnatomy
from ultrasound.scanner import B_MODE, CT, Scanner, plane_section

STORED = Path(__file__).parent / "pictures"
PIXELS, WIDTH, DEPTH = 256, 36.0, 30.0
ORGAN, TUMOUR, TUMOUR_AT = 13.0, 4.5, np.array([4.0, 1.0, 3.0])
TUMOUR_SURFACE = trimesh.creation.icosphere(subdivisions=2, radius=TUMOUR).apply_translation(TUMOUR_AT)
PROBE = Probe(
    transducer_name="test",
    housing_mm=(WIDTH, 10.0, 20.0),
    transducer_width_mm=WIDTH,
    number_of_scanlines=128,
    number_of_samples_per_scanline=320,
    depth_mm=DEPTH,
)
FACE, DOWN, LATERAL = np.array([1.0, -0.5, 11.0]), np.array([0.15, 0.1, -1.0]), np.array([1.0, 0.3, 0.0])
# Two pictures are alike that differ by so little: by mean grey value, and by the share of pixels that are
# more than SEEN off.
# CT and B-mode: other rounding (no fast_math, LLVM's advanced optimisation) leaves 0.004 and none, the
# organ's points 1e-4 mm off 0.03 and 0.01 %. 3D view: another driver may draw edges half a pixel off, which
# leaves 0.5 and 0.1 %.
LIMITS = {CT: (0.2, 0.001), B_MODE: (0.2, 0.001), "3D": (1.0, 0.005)}
SEEN = 12
# What a millimetre or a degree of the probe must exceed one of them by.
APART = 4.0
SMALL_WINDOW, WINDOW = (640, 360), (1280, 720)
# Of the 3D view blocks of so many pixels are compared; the camera frames so much around the origin [mm].
BLOCK, FRAMED = 8, 10.0


def anatomy() -> ScannedAnatomy:
    """A ball of uneven tissue with a tumour, in fat."""
    axis = np.arange(-20.0, 20.1)
    places = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    labels = (np.linalg.norm(places, axis=-1) < ORGAN).astype(np.int16)
    labels[np.linalg.norm(places - TUMOUR_AT, axis=-1) < TUMOUR] = 2
    uneven = 60.0 * np.sin(places @ [0.9, 0.4, 0.2]) * np.cos(places @ [-0.3, 0.5, 0.8])
    hu = np.choose(labels, [-90.0, 40.0, 90.0]) + uneven
    index_from_mm = np.eye(4)
    index_from_mm[:3, 3] = 20.0
    organ = trimesh.creation.icosphere(subdivisions=3, radius=ORGAN)
    return ScannedAnatomy(
        organ, np.rint(hu).astype(np.int16), index_from_mm, labels, {1: "kidney", 2: "tumour"}
    )


class Scene:
    """A bent organ under a probe. All is given by closed forms, so that machines differ by rounding alone."""

    def __init__(self) -> None:
        self.anatomy = anatomy()
        self.model = tissue_of(self.anatomy.organ, 4.0).model
        rest = self.model.body.rest_points
        put(self.model, rest + 0.008 * rest[:, [1, 2, 0]] ** 2 * [1, -1, 0.5])
        self.surface = Skin(self.model.carrier, self.anatomy.organ.vertices)
        self.tumour = Skin(self.model.carrier, TUMOUR_SURFACE.vertices)
        self.scanner = Scanner(
            self.anatomy, Embedding(self.model.carrier, self.anatomy.organ, 3.0), PROBE, PIXELS
        )

    def plane(self, shift: np.ndarray, turn: np.ndarray) -> ImagePlane:
        """The image plane of the probe shifted by so much along its own axes [mm], and turned about them
        at its face.
        """
        axes = pose_at(FACE, DOWN, LATERAL, 20.0)[:3, :3]
        face, axes = FACE + axes @ shift, axes @ turn
        return image_plane(pose_at(face, -axes[:, 2], axes[:, 0], 20.0), 20.0, WIDTH, DEPTH)

    def images(self, plane: ImagePlane) -> dict[str, np.ndarray]:
        """CT and B-mode as the panel shows them, with the organ's outline, uint8 (rows, columns, 3) each."""
        shown = self.scanner.images(plane, PROBE, "both", "speckle", 350.0, 40.0).by_name
        outline = plane_section(
            array_of(self.surface.vertices), self.anatomy.organ.faces, np.linalg.inv(plane.world_from_plane)
        )
        view, page = View(np.eye(4), shown, WIDTH, DEPTH), np.zeros((*SMALL_WINDOW[::-1], 3), np.uint8)
        pasted = {}
        for (name, picture), box in zip(
            shown.items(), image_boxes(WindowLayout(*SMALL_WINDOW), view), strict=True
        ):
            paste_image(page, box, picture)
            draw_segments(page, view, box, outline, OUTLINE)
            pasted[name] = page[box.slices].copy()
        return pasted


@pytest.fixture(scope="module")
def scene():
    start("cpu")
    yield Scene()
    ti.reset()


def moves() -> dict[str, tuple]:
    """The probe a millimetre and a degree off, along and about each of its axes."""
    axes = dict(zip("xyz", np.eye(3), strict=True))
    shifts = {f"{name} by 1 mm": (way, np.eye(3)) for name, way in axes.items()}
    return shifts | {
        f"{name} by 1 degree": (np.zeros(3), rotation_about(way, 1.0)) for name, way in axes.items()
    }


def stored(name: str, picture: np.ndarray, request: pytest.FixtureRequest) -> np.ndarray:
    """The stored picture (rows, columns, 3), after it was made anew where that is asked for."""
    path = STORED / f"{name}.png"
    if request.config.getoption("--renew-pictures"):
        Image.fromarray(picture).save(path, optimize=True)
    return np.asarray(Image.open(path).convert("RGB"))


def excess(picture: np.ndarray, other: np.ndarray, name: str) -> float:
    """How far two pictures (rows, columns, 3) are apart, in LIMITS of a picture: the larger of both."""
    assert picture.shape == other.shape
    apart = np.abs(picture.astype(int) - other)
    mean, share = LIMITS[name]
    return max(apart.mean() / mean, (apart.max(axis=-1) > SEEN).mean() / share)


def check(name: str, picture_of, request: pytest.FixtureRequest) -> None:
    """The picture of the probe where it belongs is the stored one, and no other."""
    picture = picture_of(np.zeros(3), np.eye(3))
    wanted = stored(name, picture, request)
    assert excess(picture, wanted, name) < 1.0
    for move, moved in moves().items():
        assert excess(picture_of(*moved), wanted, name) > APART, f"{move} is not seen"


@pytest.mark.parametrize("name", [CT, B_MODE])
def test_ct_and_b_mode_are_the_stored_ones(scene, request, name):
    check(name, lambda shift, turn: scene.images(scene.plane(shift, turn))[name], request)


@pytest.fixture
def window(scene):
    """An off-screen window on the scene; skips where Vulkan is missing."""
    from render.window import NoVulkan, Window

    organ = scene.anatomy.organ
    geometry = Geometry(
        (scene.surface.vertices, organ.faces.astype(np.int32)),
        np.array([[-FRAMED] * 3, [FRAMED] * 3]),
        transducer=TransducerHousing((WIDTH, 10.0, 20.0)),
        tumour=(scene.tumour.vertices, TUMOUR_SURFACE.faces.astype(np.int32)),
    )
    try:
        opened = Window(geometry, settings_with(), size=WINDOW, visible=False)
    except NoVulkan as reason:
        pytest.skip(str(reason))
    yield opened
    opened.close()


def drawn(window, scene: Scene, plane: ImagePlane) -> np.ndarray:
    """The 3D view, uint8 (rows, columns, 3), of means over blocks of pixels."""
    shown = scene.scanner.images(plane, PROBE, "ct", "speckle", 350.0, 40.0).by_name
    window.draw(View(pose_of_image_plane(plane.world_from_plane, 20.0), shown, WIDTH, DEPTH))
    area = window.layout.scene
    rows, columns = area.height // BLOCK, area.width // BLOCK
    part = window.picture()[area.slices][: rows * BLOCK, : columns * BLOCK]
    return np.rint(part.reshape(rows, BLOCK, columns, BLOCK, 3).mean(axis=(1, 3))).astype(np.uint8)


def test_the_3d_view_is_the_stored_one(scene, window, request):
    check("3D", lambda shift, turn: drawn(window, scene, scene.plane(shift, turn)), request)
