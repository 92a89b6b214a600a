"""The checking picture shows what was imported where it is, the way up that its letters say."""

import re
from dataclasses import replace

import matplotlib.image
import numpy as np
import pytest
import SimpleITK as sitk
import trimesh
from ellipsoid_kidney import HALF_AXES, ball, kidney
from matplotlib.figure import Figure
from synthetic_body import LEFT, TUMOUR, body, coarsely, points_of, with_voxels

from scenes.ct_slices import COLOUR, PIXEL_MM, VIEWS, draw_scale_bar, resample_plane
from scenes.patients.check_picture import (
    OVERVIEW,
    _draw_surfaces,
    colours_of,
    draw_check,
    is_wider,
    summary_rows,
)
from scenes.patients.part_surfaces import PARTS
from scenes.patients.patient_complexity import complexity_of_patient
from scenes.patients.patient_import import import_patient
from scenes.patients.readers.label_maps import LabelMap
from scenes.volumes.lazy_volume import LazyVolume
from scenes.volumes.voxel_grid import VoxelGrid

LETTER = {(1, 0, 0): "L", (-1, 0, 0): "R", (0, 1, 0): "P", (0, -1, 0): "A", (0, 0, 1): "S", (0, 0, -1): "I"}
NAMES = {2: "kidney_left", 3: "tumour"}


@pytest.fixture(scope="module")
def patient():
    ct, labels = body(spacing=(3.0, 3.0, 3.0))
    with pytest.MonkeyPatch.context() as patch:
        coarsely(patch)
        return import_patient(LazyVolume.of(ct), LabelMap.of(labels, NAMES), side="left", margin_mm=30.0)


def drawn_check(patient, folder, rows=None) -> np.ndarray:
    """The picture (rows, columns, 3) of a patient."""
    draw_check(patient, summary_rows(patient) if rows is None else rows, folder)
    return matplotlib.image.imread(folder / "check.png")[..., :3]


@pytest.fixture(scope="module")
def file(patient, tmp_path_factory):
    """The picture's file, of the patient with a sinus."""
    folder = tmp_path_factory.mktemp("picture")
    parts = {**patient.parts, "sinus": ball(patient.organ.centroid, 8.0)}
    drawn_check(replace(patient, parts=parts), folder, summary_rows(patient))
    return folder / "check.png"


@pytest.fixture(scope="module")
def picture(file):
    return matplotlib.image.imread(file)[..., :3]


def shown(picture, name):
    """Where (rows, columns) a structure's colour is."""
    colour = np.array([int(COLOUR[name][n : n + 2], 16) for n in (1, 3, 5)]) / 255
    return np.argwhere(np.abs(picture - colour).max(axis=2) < 0.1)


@pytest.mark.parametrize("view", [*VIEWS, OVERVIEW], ids=lambda view: view.name)
def test_letters_are_those_of_the_axes(view):
    right, down = np.array(view.right), np.array(view.down)
    assert view.letters == tuple(LETTER[tuple(axis)] for axis in (-right, right, -down, down))
    # Seen from the feet, the front and the left: what is ahead comes towards the viewer.
    towards = {"axial": (0, 0, -1), "coronal": (0, -1, 0), "sagittal": (1, 0, 0)}[view.name.split(",")[0]]
    assert np.array_equal(-np.cross(right, down), towards)


@pytest.mark.parametrize("view", VIEWS, ids=lambda view: view.name)
def test_a_spot_is_drawn_on_its_side(patient, view):
    """A bright spot to the left, front and head of the middle appears where the letters say."""
    low, high = VoxelGrid.of(patient.ct).bounds()
    spot = (low + high) / 2 + [18.0, -15.0, 21.0]
    voxels = np.zeros(patient.ct.GetSize()[::-1], np.int16)
    voxels[patient.ct.TransformPhysicalPointToIndex(spot.tolist())[::-1]] = 1000
    right, down = np.array(view.right, float), np.array(view.down, float)
    spans = [sorted((low @ axis, high @ axis)) for axis in (right, down)]
    picture = resample_plane(with_voxels(patient.ct, voxels), right, down, spans, spot)
    row, column = np.unravel_index(picture.argmax(), picture.shape)
    assert column * PIXEL_MM + spans[0][0] == pytest.approx(spot @ right, abs=2.0)  # a voxel is 3 mm
    assert row * PIXEL_MM + spans[1][0] == pytest.approx(spot @ down, abs=2.0)


def test_a_slice_tells_where_it_lies_as_viewers_of_ct_do():
    at = np.array([-31.4, 12.6, -118.2])
    assert [view.position(at) for view in VIEWS] == ["I 118 mm", "P 13 mm", "R 31 mm"]
    assert [view.position(-at) for view in VIEWS] == ["S 118 mm", "A 13 mm", "L 31 mm"]


def test_outlines_and_surfaces_are_in_the_picture_under_their_letters(picture):
    """The tumour is in all cuts, to the left, in front and above the kidney's middle: the first cut is
    axial, where left is the picture's right.
    """
    assert picture.shape[:2] == (960, 1300) and TUMOUR[0][0] > LEFT[0][0] + 20
    assert set(PARTS) < set(COLOUR) and len(shown(picture, "sinus")) > 100
    for name in ("organ", "tumour"):
        assert len(shown(picture[:480], name)) > 300, name
    for n, (sense, least) in enumerate(((1, 20), (1, 3), (-1, 3))):
        panel = panel_of(picture, n)[0]
        organ, tumour = (shown(panel, name) for name in ("organ", "tumour"))
        assert len(organ) > 60 and len(tumour) > 60, n
        down, right = tumour.mean(axis=0) - organ.mean(axis=0)
        assert sense * right > least and down < -3, n


def test_files_own_colours_are_shown_brightly(patient):
    own = replace(patient, colours={"organ": (0.2, 0.1, 0.1), "tumour": (0.0, 1.0, 0.5)})
    assert colours_of(own)["organ"] == pytest.approx((0.85, 0.425, 0.425))
    assert colours_of(own)["tumour"] == (0.0, 1.0, 0.5)
    assert colours_of(own)["support"] == colours_of(patient)["support"]


@pytest.mark.parametrize(
    "colours",
    [
        {"organ": (0.9, 0.1, 0.1), "tumour": (0.9, 0.1, 0.1)},
        {"organ": (0.0, 0.0, 0.0), "tumour": (0.02, 0.02, 0.02)},
        {"organ": (0.5, 0.5, 0.0), "tumour": (0.5, 0.52, 0.0)},
        # As the tumour is drawn where no file says its colour.
        {"organ": (1.0, 0.88, 0.3)},
    ],
)
def test_colours_that_look_alike_are_not_used(patient, colours):
    assert colours_of(replace(patient, colours=colours)) == colours_of(patient)


def test_every_section_has_a_scale_bar(patient, tmp_path):
    """Its white pixels are as long as 20 mm of the image beside it."""
    dark = replace(patient, ct=with_voxels(patient.ct, np.full(patient.ct.GetSize()[::-1], -1000, np.int16)))
    picture = drawn_check(dark, tmp_path)
    low, high = VoxelGrid.of(patient.ct).bounds()
    for n, view in enumerate(VIEWS):
        panel = panel_of(picture, n)[0]
        lengths = [longest_run(row > 0.97) for row in panel.min(axis=2)]
        # The image is black from one side to the other.
        width_px = max(longest_run(row < 0.03) for row in panel.max(axis=2))
        width_mm = (high - low) @ np.abs(view.right)
        assert max(lengths) == pytest.approx(20.0 / width_mm * width_px, abs=3.0), view.name


def longest_run(row) -> int:
    """Length of the longest run of true values."""
    ends = np.flatnonzero(np.diff(np.concatenate([[False], row, [False]]).astype(int)))
    return int((ends[1::2] - ends[::2]).max(initial=0))


@pytest.mark.parametrize("extent", [(-30.0, 90.0, 60.0, -20.0), (40.0, 130.0, 200.0, 90.0)])
def test_the_scale_bar_is_as_long_as_it_says_and_in_the_picture(extent):
    axes = Figure().add_subplot()
    draw_scale_bar(axes, extent)
    (bar,), (label,) = axes.lines, axes.texts
    (start, end), (height, _) = bar.get_data()
    assert label.get_text() == f"{end - start:g} mm" and start > (extent[0] + extent[1]) / 2
    assert extent[1] - end == pytest.approx(0.05 * (extent[1] - extent[0]))
    assert extent[2] - height == pytest.approx(0.05 * (extent[2] - extent[3]))


@pytest.mark.parametrize(
    "view, brightest", [("from the front", [-0.4, -0.8, 0.45]), ("from behind", [0.4, 0.8, 0.45])]
)
def test_surfaces_are_lit_from_above_and_from_the_viewers_side(view, brightest):
    """Front is -y, and above z; shades are 0.35 and 0.65 times the cosine of the angle to the light."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=20.0)
    axes = Figure().add_subplot(projection="3d")
    _draw_surfaces(axes, view, {"organ": ball}, {"organ": (1.0, 1.0, 1.0)})
    shade = axes.collections[0].get_facecolor()[:, 0]
    light = np.array(brightest) / np.linalg.norm(brightest)
    assert len(shade) == len(ball.faces) and shade.max() == pytest.approx(1.0, abs=0.01)
    np.testing.assert_allclose(
        np.sort(shade), np.sort(0.35 + 0.65 * np.clip(ball.face_normals @ light, 0, 1)), atol=1e-6
    )


def test_the_file_says_nothing_of_its_maker(file):
    content = file.read_bytes()
    assert not any(word in content for word in (b"tEXt", b"iTXt", b"eXIf", str(file.parent).encode()))


def panel_of(picture, n):
    """One of the three cuts, and its middle's column and row."""
    height, width = picture.shape[:2]
    return (
        picture[: height // 2, n * width // 3 : (n + 1) * width // 3],
        (0.03 + 0.94 * (n + 0.5) / 3 - n / 3) * width,
        0.297 * height,
    )


def test_ct_lies_under_its_letters(patient, tmp_path):
    """A block on the patient's left, in front and above: right and up, right and up, left and up."""
    places = points_of(patient.ct)
    block = ((places > (85, 5, 14)) & (places < (105, 32, 40))).all(axis=-1)
    bright = with_voxels(patient.ct, np.where(block, 1000, -1000).astype(np.int16))
    picture = drawn_check(replace(patient, ct=bright), tmp_path)
    for n, sense in enumerate((1, 1, -1)):
        panel, column, row = panel_of(picture, n)
        at = np.median(np.argwhere(panel.min(axis=2) > 0.97), axis=0)
        assert sense * (at[1] - column) > 15 and row - at[0] > 15, n


def test_the_whole_width_is_shown_where_it_is_wider_than_the_cuts(patient, picture, tmp_path):
    """Else the surface is shown once more: below the middle it is shaded, and has no grey in it."""
    assert is_wider(patient.overview, patient.ct) and not is_wider(patient.ct, patient.ct)
    panels = [
        image[560:, 460:840]
        for image in (picture, drawn_check(replace(patient, overview=patient.ct), tmp_path))
    ]
    wide, narrow = (((np.ptp(panel, axis=2) < 0.01) & (panel[..., 0] > 0.3)).sum() for panel in panels)
    assert wide > 20 * narrow


def test_long_text_ends_above_the_names_of_the_colours(patient, picture, tmp_path):
    """The text is white, the names are not."""
    rows = [("WARNING", "a warning of several lines, with what to do " * 5)] * 4 + summary_rows(patient)
    panels = [image[500:, 860:] for image in (drawn_check(patient, tmp_path, rows), picture)]
    long, short = (np.flatnonzero((panel.min(axis=2) > 0.75).any(axis=1)) for panel in panels)
    # The first name is 370 pixels below the middle of the picture.
    assert long.max() < 368 and short.max() < 368 and len(long) > len(short)


def test_the_summary_has_the_measures_of_the_labels(patient):
    """An ellipsoid of half axes 25, 20 and 45 mm, and a ball of 11 mm that goes 8 mm beyond it to the
    left.
    """
    values = sitk.GetArrayFromImage(body(spacing=(3.0, 3.0, 3.0))[1])
    volumes = dict(organ=np.isin(values, [2, 3]).sum() * 0.027, tumour=(values == 3).sum() * 0.027)
    assert patient.volumes_ml == pytest.approx(volumes)
    rows = dict(summary_rows(replace(patient, volumes_ml=dict(organ=151.64, tumour=8.24))))
    assert rows["organ"] == f"left kidney, 151.6 ml (surface {patient.organ.volume / 1000:.1f})"
    assert rows["tumour"] == f"8.2 ml, {len(patient.tumour.faces)} faces"
    extent = re.fullmatch(r"(\d+) x (\d+) x (\d+) mm .*", rows["extent"]).groups()
    # A voxel in each direction, and half a millimetre by rounding.
    assert np.array(extent, float) == pytest.approx([92 + 11 - 45, 40, 90], abs=3.5)
    assert float(rows["length"].split()[0]) == pytest.approx(90, abs=3.5)
    # A tumour on a pole is not of the length: where it was, the contour ends below the pole.
    pole = np.array([0.0, 0.0, HALF_AXES[2]]), 14.0
    polar = replace(patient, organ=kidney(pole), parts={"tumour": ball(*pole)})
    assert 2 * HALF_AXES[2] - 14 < polar.length_mm < 2 * HALF_AXES[2] < polar.organ.extents[2] - 10


def test_the_complexity_of_the_tumour_is_in_the_summary(patient):
    """The tumour is a ball of 11 mm that protrudes half from the left kidney, towards the front and the
    head.
    """
    rows = dict(summary_rows(patient, complexity_of_patient(patient)))
    assert rows["size"].startswith("2") and "exophytic" in rows["size"]
    assert "R 1 (2" in rows["R.E.N.A.L."] and "N 1-3" in rows["R.E.N.A.L."] and "size 1" in rows["PADUA"]
    assert "label the collecting system, renal sinus" in rows["not known"]
    without = dict(
        summary_rows(replace(patient, parts={}), complexity_of_patient(replace(patient, parts={})))
    )
    assert not {"size", "R.E.N.A.L.", "PADUA", "not known"} & set(without)
