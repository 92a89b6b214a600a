"""Volumes of tracked sweeps: balls in closed form on oblique images, and a small soft block, pressed."""

import csv
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import SimpleITK as sitk
import trimesh
from conftest import rotation_about
from PIL import Image

from rehearsal.configuration import PRESETS
from rehearsal.reconstruction import compression_correction
from rehearsal.reconstruction.patient_comparison import (
    compare_with_surfaces,
    enclosing,
    segmentation_metrics,
    voxels_inside,
)
from rehearsal.reconstruction.reconstruction_files import save_slices_figure, save_volumes
from rehearsal.reconstruction.sweep_volumes import (
    SweepVolumes,
    image_poses_of,
    lit_pixels,
    reconstruct_volumes,
)
from rehearsal.result_files import write_csv
from scenes.anatomy import Grid, LoadedAnatomy
from scenes.scene import PlaneShape, Scene, with_options
from studies.freehand import freehand_accuracy, freehand_sweeps
from studies.freehand.freehand_accuracy import figure_of, rows_of, table
from studies.freehand.freehand_sweeps import sweep_of
from ultrasound.reconstruction import VoxelBox
from ultrasound.sweep import PixelLabel, Sweep, SweepError

ROWS, COLUMNS = 60, 92
# Pixels of 0.5 x 0.8 mm, pictures 0.8 mm apart, square to none of the axes.
ON_PROBE = np.diag([0.5, 0.8, 1.0, 1.0])
ON_PROBE[:2, 3] = -23.0, -24.0
CENTRE, RADIUS = np.array([31.0, -14.0, 52.0]), 19.0
TUMOUR, TUMOUR_RADIUS = CENTRE + [6.0, -5.0, 4.0], 8.0
BEADS, BEAD_RADIUS = np.array([CENTRE + [-9.0, 2.0, 3.0], TUMOUR + [1.0, 2.0, -3.0]]), 2.0
SECTOR = np.abs(np.arange(COLUMNS) - 45.5) < 10 + 0.6 * np.arange(ROWS)[:, None]
ALL = np.ones((ROWS, COLUMNS), bool)


def poses() -> np.ndarray:
    """Of a probe that goes along its elevation over the ball."""
    steps = np.arange(-23.0, 23.0, 0.8)
    way = np.tile(np.eye(4), (len(steps), 1, 1))
    way[:, :3, :3] = rotation_about([1, 2, 3], 35)
    way[:, :3, 3] = CENTRE + steps[:, None] * way[0, :3, 2]
    return way


def places_of(pose: np.ndarray) -> np.ndarray:
    """Where the pixels of a picture are (rows, columns, 3)."""
    row, column = np.indices((ROWS, COLUMNS))
    pixels = np.stack([column, row, 0 * row, 1 + 0 * row], axis=-1)
    return (pixels @ (pose @ ON_PROBE).T)[..., :3]


def near(places: np.ndarray, middle: np.ndarray, radius: float) -> np.ndarray:
    return np.linalg.norm(places - middle, axis=-1) < radius


def marks_at(places: np.ndarray) -> np.ndarray:
    """What is in truth where pixels were at rest."""
    marks = near(places, CENTRE, RADIUS).astype(np.uint8)
    marks[near(places, TUMOUR, TUMOUR_RADIUS)] = PixelLabel.TUMOUR
    for bead, middle in enumerate(BEADS):
        marks[near(places, middle, BEAD_RADIUS)] += PixelLabel.BEAD * (bead + 1)
    return marks


def swept(images: np.ndarray, lost: tuple[int, ...] = ()) -> Sweep:
    seen = [None if k in lost else pose for k, pose in enumerate(poses())]
    return sweep_of(images, seen, np.arange(len(images)) / 30, ON_PROBE)


@pytest.fixture(scope="module")
def marked() -> Sweep:
    return swept(np.stack([marks_at(places_of(pose)) for pose in poses()]))


def check_balls(rebuilt: SweepVolumes, off_mm: float) -> None:
    """An outline that is off by a quarter of a voxel on average takes 3 / 8 of one over the radius off
    Dice.
    """
    at = rebuilt.box.places()
    for name, middle, radius in (("organ", CENTRE, RADIUS), ("tumour", TUMOUR, TUMOUR_RADIUS)):
        figures = segmentation_metrics(
            rebuilt.regions[name], near(at, middle, radius), rebuilt.box.spacing_mm
        )
        assert figures.dice > 1 - 3 / 8 / radius and figures.centroid_mm < off_mm


@pytest.mark.parametrize(("method", "off_mm"), [("smooth", 0.1), ("nearest", 0.5)])
def test_balls_are_reconstructed_at_their_positions(marked, method, off_mm):
    # Nearest voxels are off by up to half of one, all to one side where pictures lie as evenly as the voxels.
    shown: dict[str, int] = {}

    def counted(things, title):
        shown[title] = len(things)
        return things

    rebuilt = reconstruct_volumes(
        marked,
        image_poses_of(marked, "Reference"),
        ALL,
        1.0,
        method,
        2.0,
        marked,
        with_grey=False,
        progress=counted,
    )
    assert shown == {"images": len(marked), "fill holes": 2}
    check_balls(rebuilt, off_mm)
    assert sorted(rebuilt.beads) == [0, 1]
    # Some hundred pixels in a ball of 2 mm, of 0.5 x 0.8 x 0.8 mm: the mean of their middles is off by less
    # than a tenth of one.
    for bead, middle in rebuilt.beads.items():
        assert middle == pytest.approx(BEADS[bead], abs=0.08)


def test_the_compression_correction_restores_the_resting_shape(device, marked):
    now_from_rest = np.array([[1.0, 0.15, 0.0], [0.0, 0.8, 0.0], [0.05, 0.0, 1.1]])
    way = poses()

    def at_rest(frame: int) -> np.ndarray:
        return CENTRE + (places_of(way[frame]) - CENTRE) @ np.linalg.inv(now_from_rest).T

    squeezed = swept(np.stack([marks_at(at_rest(frame)) for frame in range(len(way))]))
    path = image_poses_of(squeezed, "Reference")
    seen, undone = (
        reconstruct_volumes(squeezed, path, ALL, 1.0, "smooth", 2.0, squeezed, places, with_grey=False)
        for places in (None, at_rest)
    )
    check_balls(undone, 0.1)
    ratio = seen.regions["organ"].sum() / undone.regions["organ"].sum()
    assert ratio == pytest.approx(np.linalg.det(now_from_rest), rel=0.02)
    assert undone.beads[0] == pytest.approx(BEADS[0], abs=0.1)
    assert seen.beads[0] == pytest.approx(CENTRE + now_from_rest @ (BEADS[0] - CENTRE), abs=0.1)


def test_frames_without_pose_or_image_are_left_out(marked):
    images = np.full((len(poses()), ROWS, COLUMNS), 90, np.uint8)
    images[[3, 20]] = 255
    sweep = swept(images, lost=(3, 11))
    sweep.frames[20]["ImageStatus"] = "INVALID"
    path = image_poses_of(sweep, "Reference")
    assert set(range(len(images))) - set(path.frames) == {3, 11, 20}
    assert path.matrices[3] == pytest.approx(poses()[4] @ ON_PROBE)
    # 0.8 mm each, and 1.6 over the three gaps.
    assert sorted(path.steps_mm.round(6))[-4:] == [0.8, 1.6, 1.6, 1.6]
    rebuilt = reconstruct_volumes(sweep, path, ALL, 1.0, "smooth", 2.0)
    # The box holds every pixel, and no voxel more.
    places = np.concatenate([places_of(poses()[frame]).reshape(-1, 3) for frame in path.frames])
    last = rebuilt.box.origin_mm + np.array(rebuilt.box.shape) - 1
    assert rebuilt.box.origin_mm == pytest.approx(places.min(axis=0))
    assert ((last >= places.max(axis=0)) & (last < places.max(axis=0) + 1)).all()
    np.testing.assert_allclose(rebuilt.grey[rebuilt.known], 90, rtol=1e-6)
    assert not rebuilt.regions and not rebuilt.beads


def test_only_the_field_of_view_counts():
    images = np.where(SECTOR, np.uint8(120), np.uint8(0)) * np.ones((len(poses()), 1, 1), np.uint8)
    sweep = swept(images)
    mask = lit_pixels(np.concatenate([0 * images[:1], images]))
    assert np.array_equal(mask, SECTOR)
    rebuilt = reconstruct_volumes(sweep, image_poses_of(sweep, "Reference"), mask, 1.0, "smooth", 2.0)
    np.testing.assert_allclose(rebuilt.grey[rebuilt.known], 120, rtol=1e-6)
    # Voxels on the border count as soon as a pixel is in them: half a voxel farther out on average, and gaps
    # are closed.
    volume, sides = SECTOR.sum() * 0.4 * 0.8 * len(images), 2 * (46 + 48) * 46 + 2 * 46 * 48
    assert volume < rebuilt.known.sum() < volume + 0.6 * sides
    small = replace(sweep, images=sweep.images[:, :20])
    tight = reconstruct_volumes(small, image_poses_of(small, "Reference"), SECTOR[:20], 1.0, "smooth", 2.0)
    assert np.prod(tight.box.shape) < 0.6 * np.prod(rebuilt.box.shape)


def test_sweeps_that_make_no_volume_are_refused_in_words(marked):
    path = image_poses_of(marked, "Reference")
    with pytest.raises(SweepError, match="valid pose in Reference, of 58 frames"):
        image_poses_of(swept(marked.images, lost=tuple(range(58))), "Reference")
    with pytest.raises(SweepError, match="black"):
        reconstruct_volumes(marked, path, ~ALL, 1.0, "smooth", 2.0)
    with pytest.raises(SweepError, match=r"labels of \(58, 60, 91\): expected \(58, 60, 92\)"):
        reconstruct_volumes(
            marked, path, ALL, 1.0, "smooth", 2.0, replace(marked, images=marked.images[..., 1:])
        )
    with pytest.raises(ValueError, match="take larger voxels"):
        reconstruct_volumes(marked, path, ALL, 0.01, "smooth", 2.0)


@pytest.mark.parametrize("count", [1, 2, 5])
@pytest.mark.parametrize("turn", [0.0, 35.0])
def test_images_in_one_plane_are_no_volume(marked, count, turn):
    plane = np.eye(4)
    plane[:3, :3] = rotation_about([1, 2, 3], turn)
    along = [plane.copy() for _ in range(count)]
    for k, pose in enumerate(along):
        pose[:3, 3] = 3.0 * k * plane[:3, 0]
    sweep = sweep_of(marked.images[:count], along, np.arange(count) / 30, ON_PROBE)
    with pytest.raises(SweepError, match=r"0\.00 mm thick, .* voxel of 1 mm; expected two images or more at"):
        reconstruct_volumes(sweep, image_poses_of(sweep, "Reference"), ALL, 1.0, "smooth", 2.0, sweep)


def test_images_of_one_lit_column_are_no_volume(marked):
    column = np.arange(COLUMNS) == 40
    with pytest.raises(SweepError, match="are in one plane"):
        reconstruct_volumes(marked, image_poses_of(marked, "Reference"), ALL & column, 1.0, "smooth", 2.0)


def a_box() -> VoxelBox:
    return VoxelBox(np.array([-9.5, 4.5, 40.5]), 1.0, (20, 24, 30))


def test_voxels_inside_a_block_are_those_whose_centres_are():
    box = a_box()
    # Two sides of it stick out of the box.
    for size, middle in (((10.4, 6.4, 14.4), (-8.2, 16.1, 66.3)), ((9.0, 5.2, 3.4), (0.3, 15.2, 50.1))):
        block = trimesh.creation.box(size).apply_translation(middle)
        expected = (np.abs(box.places() - middle) < np.array(size) / 2).all(axis=-1)
        assert expected.any() and np.array_equal(voxels_inside(block, box), expected)
    assert not voxels_inside(trimesh.creation.box([2.0] * 3), box).any()


def test_a_wider_box_moves_nothing():
    box = a_box()
    region = near(box.places(), [-2.0, 12.0, 60.0], 5.0)
    rebuilt = SweepVolumes(box, region * np.float32(7), region, {"organ": region})
    around = trimesh.creation.box([50.0, 60.0, 72.0]).apply_translation([3.0, 11.0, 52.0])
    grown = enclosing(rebuilt, around)
    at, before = grown.box.places(), box.places()[region]
    for volume in (grown.regions["organ"], grown.known, grown.grey == 7):
        assert at[volume] == pytest.approx(before, abs=1e-9)
    low, high = at.reshape(-1, 3).min(axis=0), at.reshape(-1, 3).max(axis=0)
    assert (low < around.bounds[0]).all() and (high > around.bounds[1]).all()
    # None of the block's faces goes through a voxel's centre.
    assert voxels_inside(around, grown.box).sum() == 50 * 60 * 72
    within = enclosing(rebuilt, trimesh.creation.box([2.0] * 3).apply_translation([0.0, 16.0, 55.0]))
    assert within.box.shape == box.shape


def test_a_ball_of_which_half_was_scanned():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=9.0).apply_translation([0.0, 16.0, 55.0])
    box = a_box()
    truth, known = voxels_inside(ball, box), box.places()[..., 0] > 0
    beads = {1: np.array([1.0, 2.0, 5.0]), 0: np.array([0.0, 0.0, 1.0])}
    rebuilt = SweepVolumes(box, truth * np.float32(1), known, {"organ": truth & known}, beads)
    found = compare_with_surfaces(
        rebuilt, {"organ": ball, "tumour": ball}, np.array([[0, 0, 0], [1, 2, 2], [9, 9, 9.0]])
    )
    assert set(found) == {"organ", "landmarks"}
    # Voxels are cut in halves by the plane x = 0, on which none has its centre.
    assert found["organ"]["scanned"] == 0.5
    assert found["organ"]["whole"]["dice"] == pytest.approx(2 / 3, abs=1e-4)
    assert found["organ"]["whole"]["volume_percent"] == -50
    # The centroid of half a ball, and the farthest places of the other half.
    assert found["organ"]["whole"]["centroid_mm"] == pytest.approx(3 / 8 * 9, abs=0.05)
    assert found["organ"]["scanned_part"] == dict(dice=1, hd95_mm=0, volume_percent=0, centroid_mm=0)
    assert found["landmarks"] == dict(count=2, of=3, mean_mm=2.0, max_mm=3.0)
    nothing = compare_with_surfaces(
        replace(rebuilt, known=~known & ~truth, beads={}), {"organ": ball}, np.zeros((1, 3))
    )
    assert nothing["organ"]["scanned"] == 0 and nothing["organ"]["scanned_part"] is None
    assert nothing["landmarks"] == dict(count=0, of=1, mean_mm=None, max_mm=None)


def test_what_was_not_found_or_has_no_voxel_has_no_figures():
    ball = trimesh.creation.icosphere(subdivisions=2, radius=9.0).apply_translation([0.0, 16.0, 55.0])
    speck = trimesh.creation.icosphere(subdivisions=1, radius=0.3).apply_translation([0.0, 16.0, 55.0])
    empty, known = np.zeros(a_box().shape, bool), np.ones(a_box().shape, bool)
    rebuilt = SweepVolumes(a_box(), empty * np.float32(1), known, {"organ": empty, "tumour": empty})
    found = compare_with_surfaces(rebuilt, {"organ": ball, "tumour": speck})
    assert set(found) == {"organ"}
    assert found["organ"]["whole"] == dict(dice=0, hd95_mm=None, volume_percent=-100, centroid_mm=None)


def test_files_have_each_voxel_at_its_place(tmp_path):
    box = VoxelBox(np.array([-30.0, 12.0, 500.0]), 0.75, (5, 7, 9))
    organ, tumour = np.zeros((2, *box.shape), bool)
    organ[1:4, 2:6, 3:8], tumour[2, 3, 6] = True, True
    grey = np.arange(organ.size, dtype=np.float32).reshape(box.shape) - 20.4
    rebuilt = SweepVolumes(box, grey, organ | True, {"organ": organ, "tumour": tumour})
    save_volumes(rebuilt, tmp_path)
    volume, labels = (sitk.ReadImage(str(tmp_path / f"{name}.nrrd")) for name in ("volume", "labels"))
    for index in ((0, 0, 0), (2, 3, 6), (4, 1, 2), (1, 5, 7)):
        assert volume.TransformIndexToPhysicalPoint(index) == pytest.approx(box.places()[index])
        assert volume[index] == np.clip(round(float(grey[index])), 0, 255)
        assert labels[index] == (PixelLabel.TUMOUR if tumour[index] else int(organ[index]))
    save_volumes(replace(rebuilt, regions={}), tmp_path / "..")
    assert not (tmp_path / ".." / "labels.nrrd").exists()


def test_the_figure_shows_the_cuts_through_the_tumour(tmp_path, marked):
    path = image_poses_of(marked, "Reference")
    rebuilt = reconstruct_volumes(
        replace(marked, images=marked.images * 60), path, ALL, 1.0, "smooth", 2.0, marked
    )
    save_slices_figure(rebuilt, tmp_path / "with.png")
    save_slices_figure(replace(rebuilt, regions={}), tmp_path / "without.png")
    shown, bare = (
        np.asarray(Image.open(tmp_path / f"{name}.png").convert("RGB")) for name in ("with", "without")
    )
    yellow = [
        (abs(each.astype(int) - [255, 225, 77]).sum(axis=-1) < 40).sum(axis=0) for each in (shown, bare)
    ]
    # The tumour's outline in each of three cuts, side by side.
    assert all(part.sum() > 20 for part in np.array_split(yellow[0], 3)) and yellow[1].sum() == 0


MIDDLE = np.array([-40.0, 25.0, 310.0])


def block_patient() -> LoadedAnatomy:
    """A soft block of 36 x 28 x 52 mm on a plane, a ball of 8 mm in it beside its middle."""
    organ = trimesh.creation.box([36.0, 28.0, 52.0]).subdivide().subdivide().apply_translation(MIDDLE)
    tumour = trimesh.creation.icosphere(subdivisions=2, radius=8.0).apply_translation(MIDDLE + [2, -4, 3])
    index_from_mm = np.diag([1 / 4, 1 / 4, 1 / 4, 1.0])
    index_from_mm[:3, 3] = (40 - MIDDLE) / 4
    ct = Grid(np.full((20, 20, 20), 40, np.float32), index_from_mm)
    support = PlaneShape(kind="plane", normal=(0.0, -1.0, 0.0), offset_mm=-39.0)
    return LoadedAnatomy(organ, tumour, ct, (support,))


@pytest.fixture(scope="module")
def runs() -> list[dict]:
    """Figures of the block with and without the tumour, as ``study freehand`` makes them."""
    held = {"attachment.at_mm": tuple(MIDDLE + [0, 14, 0]), "attachment.radius_mm": 20.0}
    down = {"press.warm_up_steps": 40, "gravity.direction": (0.0, 1.0, 0.0)}
    scene = with_options(Scene(anatomy=dict(phantom=True)), held | down)
    setup = PRESETS["neo-hookean"]["balanced"].but(cell_mm=7.0)
    block, made = block_patient(), []
    few = dict(PROBE="linear", PIXELS=64, EVERY=2, DEPTHS_MM=(9, 0.0, 9, 4.0, 9))
    with pytest.MonkeyPatch.context() as patch:
        for module, values in (
            (freehand_accuracy, few),
            (freehand_sweeps, dict(SPEED_MM_S=30.0)),
            (compression_correction, dict(APPROACH_MM=6.0, APPROACH_S=0.2, SETTLE_S=0.3)),
        ):
            for name, value in values.items():
                patch.setattr(module, name, value)
        for patient, tumour, swept_over in (
            ("with", block.tumour, {"calibration_mm": (1.0, 2.0, 3.0), "lost": (0.1, 0.2, 0.3)}),
            ("without", None, {"lost": (0.1, 0.2, 0.3)}),
        ):
            patch.setattr(freehand_accuracy, "VARIED", swept_over)
            anatomy, done = replace(block, tumour=tumour), []
            figures = freehand_accuracy.measure(scene, anatomy, setup, "cpu", True, partial(done.append, 1))
            assert len(done) == freehand_accuracy.count_of(anatomy, True)
            made.append(dict(patient=patient) | figures)
    return made


def test_at_rest_the_accuracy_is_met(runs):
    for run in runs:
        assert [row["method"] for row in run["resting"]] == ["nearest", "smooth"]
        assert run["apart_mm"] == pytest.approx(1.0) and run["frames"] == 60
        for row in run["resting"]:
            assert row["organ"]["scanned"] == 1.0 and row["organ"]["whole"]["dice"] >= 0.95
            assert row["landmarks"]["count"] == row["landmarks"]["of"] > 20
    tumour = runs[0]["resting"][1]["tumour"]["whole"]
    assert tumour["dice"] >= 0.95 and tumour["centroid_mm"] <= 0.5
    assert all("tumour" not in row for row in runs[1]["resting"]) and runs[1]["compression"] == []


def test_an_error_of_the_calibration_shifts_everything_equally(runs):
    # The quick run takes the third of the sizes.
    none, calibration, lost = runs[0]["noise"]
    assert (calibration["calibration_mm"], lost["lost"]) == (3.0, 0.3)
    assert none["landmarks"]["mean_mm"] < 0.5
    assert calibration["landmarks"]["mean_mm"] == pytest.approx(3.0, abs=0.1)
    # Gaps of pictures lost, 2 mm apart, are wider than what is closed.
    assert lost["organ"]["scanned"] < none["organ"]["scanned"] == 1.0
    assert [row["lost"] for row in runs[1]["noise"]] == [0.0, 0.3]


def test_the_compression_correction_reduces_the_error(runs):
    still, still_undone, seen, undone = runs[0]["compression"]
    assert [row["depth_mm"] for row in (still, still_undone, seen, undone)] == [0, 0, 4, 4]
    assert (seen["undone"], undone["undone"]) == (False, True) and seen["compression_mm"] > 1.0
    assert undone["landmarks"]["mean_mm"] < 0.4 * seen["landmarks"]["mean_mm"]
    assert (
        undone["tumour"]["scanned_part"]["centroid_mm"]
        < 0.2
        < 1.0
        < seen["tumour"]["scanned_part"]["centroid_mm"]
    )
    for row in (still, still_undone):
        assert row["tumour"]["scanned_part"]["centroid_mm"] < 0.5
    assert abs(still["landmarks"]["mean_mm"] - still_undone["landmarks"]["mean_mm"]) < 0.5


def test_the_study_prints_and_draws_both(runs, tmp_path):
    lines = [line for run in runs for line in table(run).splitlines()]
    row = runs[0]["compression"][3]["tumour"]["scanned_part"]
    printed = next(
        line for line in lines if line.startswith("pressed 4 mm") and "corrected" in line and "tumour" in line
    )
    assert f"{row['dice']:.3f}" in printed and f"{row['centroid_mm']:.2f}" in printed
    # Two lines of head, then two methods, three of the noise or two, and two by two of the press; of two
    # regions, or of one.
    assert len(lines) == 2 + 2 * (2 + 3 + 4) + 2 + (2 + 2)
    assert sum(line.startswith("every third image, no error") for line in lines) == 3
    write_csv([row for run in runs for row in rows_of(run)], tmp_path / "a.csv")
    with (tmp_path / "a.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(lines) - 4 and {row["patient"] for row in rows} == {"with", "without"}
    assert float(rows[-1]["lost"]) == 0.3 and rows[-1]["depth_mm"] == ""
    # A press that took the tumour out of the pictures, and one under which nothing was found.
    gone, lost = dict(runs[0]["compression"][2]), dict(runs[0]["compression"][3])
    del gone["tumour"]
    nothing = dict(dice=0.0, hd95_mm=None, volume_percent=-100.0, centroid_mm=None)
    lost["tumour"] = dict(scanned=0.1, whole=nothing, scanned_part=nothing)
    out = runs[0] | dict(compression=[gone, lost])
    assert sum("-100.0" in line for line in table(out).splitlines()) == 1
    figure_of([*runs, out]).savefig(tmp_path / "all.png")
    drawn = np.asarray(Image.open(tmp_path / "all.png").convert("RGB")).astype(int)
    # The colours of the three: curves, and marks of the press.
    for colour in ([31, 119, 180], [255, 127, 14], [44, 160, 44]):
        assert (np.abs(drawn - colour).sum(axis=-1) < 9).sum() > 100
