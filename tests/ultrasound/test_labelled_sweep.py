"""Sweeps with the truth beside them as they are recorded, and what ``reconstruct`` makes of sweeps."""

import io
import json
import re
import shutil
from contextlib import redirect_stderr
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import SimpleITK as sitk
from conftest import rotation_about
from plan_ball import case_of_ball

import app
from rehearsal.commands.reconstruct_command import _describe, in_words
from rehearsal.notices import Notices
from rehearsal.reconstruction import compression_correction
from rehearsal.reconstruction.compression_correction import CompressionCorrection
from rehearsal.reconstruction.sweep_volumes import ImagePoses, image_poses_of
from rehearsal.tracking.sweep_recording import SweepRecorder
from scenes.anatomy import phantom_folder
from scenes.scene import EMBEDDED
from scenes.surfaces import load_surface
from sim.embedding import Unmoved
from sim.signed_distance import signed_distance
from studies.freehand.freehand_sweeps import sweep_of
from ultrasound import reconstruction
from ultrasound.probe import load_probe
from ultrasound.probe_manipulator import pose_at
from ultrasound.sweep import PixelLabel, Sweep, SweepError
from ultrasound.sweep_file import (
    LABELS_SUFFIX,
    SUFFIX,
    LabelledSweep,
    read_ground_truth,
    read_sweep,
    write_sweep,
)
from version import VERSION

SPINE, NWIRE = "SpinePhantomFreehand", "NwirePhantomFreehand"
SPINE_XML = "us/PlusDeviceSet_SpinePhantomFreehandReconstructionOnly.xml"
NWIRE_XML = "us/PlusDeviceSet_NwirePhantomFreehand_vtkVolumeReconstructorTest2.xml"
FULL = "File too large"


def status_of(*arguments) -> int:
    """The exit status of a command."""
    return app.main([str(argument) for argument in arguments])


def refused(*arguments) -> str:
    """The one line with which a command is refused."""
    output = io.StringIO()
    with redirect_stderr(output):
        status = status_of(*arguments)
    lines = [line for line in output.getvalue().strip().splitlines() if "image/s" not in line]
    assert status == 2 and len(lines) == 1 and lines[0].startswith("nephron: "), output.getvalue()
    return lines[0]


ORIGIN = np.array([-61.0, 112.0, 1240.0])


def recording(pixels: int = 24) -> tuple[SimpleNamespace, SimpleNamespace]:
    """What recording asks of an anatomy and a view; their pictures change with the pose."""
    case = case_of_ball(probe=load_probe("curvilinear"), origin=ORIGIN)
    pose = pose_at(np.array([9.0, -4, 17]), np.array([0.3, -0.2, -1]), np.array([1, 0.5, 0.2]), 30.0)
    draw = np.random.default_rng(5)
    view = SimpleNamespace(images={"B-mode": draw.integers(0, 256, (pixels, pixels), np.uint8), "CT": None})
    marks = SimpleNamespace(render=lambda: view.images["B-mode"] % 3)
    anatomy = SimpleNamespace(case=case, pose=pose, scanner=SimpleNamespace(ground_truth=marks))
    anatomy.probe_in_patient = lambda: case.probe_in_patient(anatomy.pose)
    return anatomy, view


class Recording(SweepRecorder):
    """A recorder whose methods return what they tell the user."""

    def __init__(self, anatomy: SimpleNamespace) -> None:
        super().__init__(anatomy, Notices())

    def add(self, *frame) -> str:
        super().add(*frame)
        return "".join(self.notices.present())

    def toggle(self, out: Path) -> str:
        super().toggle(out)
        return "".join(self.notices.present())

    def stop(self) -> str:
        self.end()
        return "".join(self.notices.present())


def moved_on(anatomy: SimpleNamespace, by_mm: float) -> None:
    anatomy.pose = anatomy.pose.copy()
    anatomy.pose[:3, 3] += by_mm * anatomy.pose[:3, 1]


def test_a_recorded_sweep_gives_the_position_of_each_pixel(tmp_path):
    anatomy, view = recording()
    sweeping, places, pictures = Recording(anatomy), [], []
    assert sweeping.add(0.0, view, anatomy.case.probe) == "" and sweeping.stop() == ""
    assert sweeping.toggle(tmp_path) == "sweep-001: {sweep} ends it"
    for step in range(8):
        # A step of 1/60 s: every other is a frame, the first among them.
        assert sweeping.add(5.0 + step / 60, view, anatomy.case.probe) == ""
        if step % 2 == 0:
            plane = anatomy.case.image_plane(anatomy.pose)
            # The middle of the last row but one pixel: on the middle line, a pixel and a half from its end.
            deep = plane.depth_mm * (1 - 1.5 / 24) - plane.above_mm
            aside = plane.width_mm * 0.5 / 24
            places.append((plane.world_from_plane @ [aside, deep, 0, 1])[:3] + ORIGIN)
            pictures.append(view.images["B-mode"])
        moved_on(anatomy, 0.7)
        view.images["B-mode"] = np.roll(view.images["B-mode"], 1, axis=step % 2)
    assert sweeping.toggle(tmp_path) == "sweep-001.igs.mha: 4 images"
    sweep = read_sweep(tmp_path / "sweep-001.igs.mha")
    assert np.array_equal(sweep.images, pictures)
    assert sweep.times_s == pytest.approx(5 + np.arange(4) / 30)
    assert sweep.transform("Probe", "Reference", 0)[:3, 1] == pytest.approx(-anatomy.pose[:3, 2])
    for frame, place in enumerate(places):
        at = sweep.transform("Image", "Reference", frame) @ [12, 22, 0, 1]
        assert at[:3] == pytest.approx(place, abs=1e-6)
    marks = read_ground_truth(tmp_path / "sweep-001.igs.mha")
    assert np.array_equal(marks.images, sweep.images % 3)
    assert sweep.fields["NephronVersion"] == marks.fields["NephronVersion"] == VERSION
    assert [frame["ProbeToReferenceTransform"] for frame in marks.frames] == [
        frame["ProbeToReferenceTransform"] for frame in sweep.frames
    ]
    assert read_ground_truth(tmp_path / "sweep-001-marks.igs.mha") is None
    # Times of a sweep are those of the session, and a new one begins at once, whenever the last ended.
    assert sweeping.toggle(tmp_path) == "sweep-002: {sweep} ends it"
    sweeping.add(1.0, view, anatomy.case.probe)
    assert sweeping.stop() == "sweep-002.igs.mha: 1 images"
    assert read_sweep(tmp_path / "sweep-002.igs.mha").times_s == [1.0]


def test_the_length_of_a_sweep_is_shown_while_it_is_recorded(tmp_path):
    anatomy, view = recording()
    sweeping = Recording(anatomy)
    said = []
    for first in (100.0, 200.0):
        said.append(sweeping.status)
        sweeping.toggle(tmp_path)
        said.append(sweeping.status)
        for time_s in (first, first + 0.6, first + 11.8):
            sweeping.add(time_s, view, anatomy.case.probe)
            said.append(sweeping.status)
        sweeping.toggle(tmp_path)
    once = ["", *(f"Recording {seconds} s" for seconds in (0, 0, 1, 12))]
    assert [*said, sweeping.status] == [*once, *once, ""]


def test_sweeps_are_numbered_after_the_last(tmp_path):
    sweeping = Recording(recording()[0])
    for name in ("sweep-004.igs.mha", "sweep-009-marks.igs.mha", "sweep-x.igs.mha", "sweep-0.igs.mha"):
        (tmp_path / name).touch()
    assert sweeping.toggle(tmp_path).startswith("sweep-005:")
    sweeping.stop()
    for name in ("sweep-999", "sweep-1000"):
        (tmp_path / f"{name}.igs.mha").touch()
    assert sweeping.toggle(tmp_path).startswith("sweep-1001:")


def test_a_sweep_without_frames_or_ct_leaves_words_and_no_file(tmp_path):
    anatomy, _ = recording()
    sweeping = Recording(anatomy)
    sweeping.toggle(tmp_path)
    assert sweeping.stop() == "No sweep: a sweep without frames"
    assert "cannot be written: No such file" in sweeping.toggle(tmp_path / "none")
    anatomy.scanner = None
    assert sweeping.toggle(tmp_path) == "No sweep: the scene has no CT"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("marks_too", [False, True])
def test_a_full_disk_ends_a_sweep_in_words_and_leaves_nothing(tmp_path, marks_too, bytes_to_a_file):
    anatomy, view = recording(pixels=256)
    if marks_too:
        anatomy.scanner.ground_truth.render = lambda: view.images["B-mode"]
    sweeping = Recording(anatomy)
    sweeping.toggle(tmp_path)
    with bytes_to_a_file(150_000):
        # Noise: 65 kB each, of which two have room.
        said = [sweeping.add(k / 30, view, anatomy.case.probe) for k in range(5)]
    assert said == ["", "", f"No sweep: {FULL}", "", ""]
    assert list(tmp_path.iterdir()) == []
    sweeping.toggle(tmp_path)
    sweeping.add(0.0, view, anatomy.case.probe)
    assert sweeping.stop() == "sweep-001.igs.mha: 1 images"


def test_a_picture_of_another_size_ends_a_sweep_with_what_there_is(tmp_path):
    anatomy, view = recording()
    sweeping = Recording(anatomy)
    sweeping.toggle(tmp_path)
    sweeping.add(0.0, view, anatomy.case.probe)
    view.images["B-mode"] = np.zeros((8, 8), np.uint8)
    said = sweeping.add(1.0, view, anatomy.case.probe)
    assert said.startswith("sweep-001.igs.mha: 1 images: frame 1: image of uint8 (8, 8)")
    assert len(read_sweep(tmp_path / "sweep-001.igs.mha")) == len(
        read_sweep(tmp_path / "sweep-001-marks.igs.mha")
    )


def test_both_files_or_none(tmp_path):
    anatomy, view = recording()
    sweep = LabelledSweep(tmp_path, "s", anatomy.case.probe)
    picture = view.images["B-mode"]
    sweep.add(picture, picture % 3, anatomy.case.probe, anatomy.probe_in_patient(), 0.0)
    # The pictures find a folder where their file should be.
    (tmp_path / "s.igs.mha").mkdir()
    with pytest.raises(IsADirectoryError):
        sweep.close()
    assert [path.name for path in tmp_path.iterdir()] == ["s.igs.mha"]


def over_tumour() -> np.ndarray:
    """Poses over the embedded patient's tumour, 1.5 mm apart, seen from in front; x is not along an axis."""
    middle = load_surface(phantom_folder() / "tumour.stl").center_mass
    pose = np.eye(4)
    pose[:3, :3] = rotation_about([0, 1, 0], 20)
    way = np.tile(pose, (14, 1, 1))
    way[:, :3, 3] = middle + [0, -20, 0] + (np.arange(14) - 6.5)[:, None] * 1.5 * pose[:3, 2]
    return way


def places_of_pixels(count: int, matrix: np.ndarray) -> np.ndarray:
    """Where a matrix takes the pixels of a square image, (rows, columns, 3)."""
    row, column = np.indices((count, count))
    return (np.stack([column, row, 0 * row, 1 + 0 * row], axis=-1) @ matrix.T)[..., :3]


def test_the_matrices_of_a_frame_are_of_its_rows_and_columns(tmp_path):
    probe, pose = load_probe("curvilinear"), np.eye(4)
    pose[:3, 3] = 3.0, -2.0, 7.0
    sweep = LabelledSweep(tmp_path, "sweep", probe)
    sweep.add(*np.zeros((2, 50, 80), np.uint8), probe, pose, 0.0)
    sweep.close()
    for end in (SUFFIX, LABELS_SUFFIX):
        read = read_sweep(tmp_path / f"sweep{end}")
        assert read.images.shape == (1, 50, 80)
        assert np.array_equal(read.transform("Image", "Probe", 0), probe.image_to_probe(50, 80))
        assert np.array_equal(read.transform("Probe", "Reference", 0), pose)


def still_rehearsal() -> tuple[SimpleNamespace, list[np.ndarray]]:
    """What the correction asks of a rehearsal whose tissue never moves, and the poses of its probe."""
    probe = load_probe("curvilinear").model_copy(update=dict(housing_mm=(40.0, 10.0, 20.0)))
    organ = SimpleNamespace(pose=np.eye(4), settings=SimpleNamespace(time_step_s=1 / 60))
    organ.place = lambda pose: setattr(organ, "pose", pose)
    poses: list[np.ndarray] = []

    def advance(pose: np.ndarray) -> None:
        organ.pose = pose
        poses.append(pose)

    case, anatomy = case_of_ball(probe=probe, origin=ORIGIN), SimpleNamespace(embedding=Unmoved())
    still = SimpleNamespace(case=case, anatomy=anatomy, organ=organ, advance=advance, show=lambda: None)
    return still, poses


def test_compression_correction_follows_the_tracked_path_and_leaves_tissue_at_rest_in_place(device):
    probe = load_probe("curvilinear")
    on_probe, way = probe.image_to_probe(32, 32), over_tumour()[::5]
    sweep = sweep_of(np.zeros((len(way), 32, 32), np.uint8), way, np.array([0.0, 0.1, 9.0]), on_probe)
    still, at = still_rehearsal()
    places = CompressionCorrection(still, sweep, image_poses_of(sweep, "Reference"), "Reference")
    begun = len(at)
    assert begun == (compression_correction.APPROACH_S + compression_correction.SETTLE_S) * 60
    for frame, pose in enumerate(way):
        # Float32 of 1300 mm, less its origin.
        assert places(frame) == pytest.approx(places_of_pixels(32, pose @ on_probe), abs=1e-3)
        face = at[-1] @ [0, 0, -10.0, 1]
        assert face[:3] + ORIGIN == pytest.approx(pose[:3, 3])
    # 0.1 s, and a pause of 8.9 s cut to 2.
    assert len(at) - begun == 6 + 120
    assert np.linalg.norm(at[0][:3, 3] - at[begun - 1][:3, 3]) == pytest.approx(29.0)


def test_what_no_probe_can_press_again_is_refused(device):
    sweep = sweep_of(np.zeros((1, 32, 30), np.uint8), np.eye(4)[None], np.zeros(1), np.eye(4))
    with pytest.raises(SweepError, match="32 x 30 pixels: expected a sweep that Nephron recorded"):
        CompressionCorrection(still_rehearsal()[0], sweep, image_poses_of(sweep, "Reference"), "Reference")


@pytest.fixture(scope="module")
def swept(tmp_path_factory) -> Path:
    """A sweep over the embedded patient's tumour, with marks by its surfaces."""
    folder = tmp_path_factory.mktemp("swept")
    organ, tumour = (load_surface(phantom_folder() / f"{name}.stl") for name in ("organ", "tumour"))
    probe = load_probe("drop-in")
    sweep = LabelledSweep(folder, "over", probe)
    way = over_tumour()
    places = [places_of_pixels(64, pose @ probe.image_to_probe(64, 64)) for pose in way]
    places = np.reshape(places, (-1, 3))
    inside = [signed_distance(part.vertices, part.faces, places)[0] < 0 for part in (organ, tumour)]
    marks = np.where(inside[1], PixelLabel.TUMOUR, inside[0]).astype(np.uint8).reshape(-1, 64, 64)
    for k, (pose, labels) in enumerate(zip(way, marks, strict=True)):
        sweep.add(40 + 80 * labels, labels, probe, pose, k / 10)
    sweep.close()
    return folder / "over.igs.mha"


def test_a_sweep_is_described_by_its_steps_and_speeds():
    """Steps of 3, 12 and 5 mm in 0.5, 1 and 2 s; the third frame, on the way of 12 mm, was not tracked."""
    times = (7.0, 7.5, 8.0, 8.5, 10.5)
    frames = [dict(Timestamp=str(time)) for time in times]
    sweep = Sweep(np.zeros((5, 2, 2), np.uint8), frames, {})
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, :3, 3] = [[0, 0, 9], [1, -2, 11], [9, 6, 7], [9, 3, 3]]
    described = _describe(sweep, ImagePoses(np.array([0, 1, 3, 4]), poses))
    assert described == dict(
        frames=5,
        used=4,
        way_mm=20.0,
        between_median_mm=5.0,
        between_max_mm=12.0,
        speed_median_mm_s=6.0,
        speed_max_mm_s=12.0,
    )
    part = dict(dice=0.9123, hd95_mm=1.254, volume_percent=-3.46, centroid_mm=0.567)
    organ = dict(scanned=0.234, whole=None, scanned_part=part)
    tumour = dict(scanned=0.876, whole=None, scanned_part=dict.fromkeys(part))
    report = described | dict(
        shape=[30, 40, 50],
        spacing_mm=0.5,
        method="smooth",
        undo_compression=True,
        agreement=dict(organ=organ, tumour=tumour),
    )
    assert in_words(report).splitlines() == [
        "images    4 of 5 with a pose, 5.00 mm apart (median; at most 12.00), 6 mm/s",
        "volume    30 x 40 x 50 voxels of 0.5 mm, smooth, compression corrected",
        "organ     23 % scanned; only in this small part Dice 0.912, HD95 1.25 mm, volume -3.5 %, "
        "centroid 0.57 mm off",
        "tumour    88 % scanned; in this part nothing found",
    ]


def test_reconstruct_makes_a_volume_and_compares_it(swept, tmp_path, capsys):
    scene = "--scene", EMBEDDED
    assert status_of("reconstruct", swept, *scene, "--spacing-mm", "1.5", "--out", tmp_path / "out") == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text(), parse_constant=pytest.fail)
    assert (report["frames"], report["used"], report["method"]) == (14, 14, "smooth")
    assert report["version"] == VERSION
    assert report["way_mm"] == pytest.approx(13 * 1.5) and report["between_max_mm"] == pytest.approx(1.5)
    assert report["speed_median_mm_s"] == report["speed_max_mm_s"] == pytest.approx(15.0)
    # Two voxels, which is more than pictures are apart.
    assert report["reach_mm"] == 3.0 and report["undo_compression"] is False
    organ, tumour = report["agreement"]["organ"], report["agreement"]["tumour"]
    assert organ["scanned"] < 0.3 < 0.5 < tumour["scanned"] < 1
    # As balls of the same volume: an outline that is off by a quarter of a voxel on average.
    assert tumour["scanned_part"]["dice"] > 0.95 and tumour["scanned_part"]["centroid_mm"] < 0.2
    assert f"tumour    {100 * tumour['scanned']:.0f} % scanned; in this part Dice" in capsys.readouterr().out
    volume, labels = (sitk.ReadImage(str(tmp_path / "out" / f"{name}.nrrd")) for name in ("volume", "labels"))
    assert list(volume.GetSize()) == report["shape"] == list(labels.GetSize())
    middle = load_surface(phantom_folder() / "tumour.stl").center_mass
    at = volume.TransformPhysicalPointToIndex(middle.tolist())
    assert (volume[at], labels[at]) == (40 + 80 * PixelLabel.TUMOUR, PixelLabel.TUMOUR)
    assert (tmp_path / "out" / "volume.png").stat().st_size > 10_000


@pytest.mark.parametrize("away_mm", [-80, 4000])
def test_reconstruct_compares_no_sweep_with_an_organ_that_it_does_not_show(swept, tmp_path, capsys, away_mm):
    organ = load_surface(phantom_folder() / "organ.stl").apply_translation([0, 0, away_mm])
    organ.export(tmp_path / "organ.stl")
    (tmp_path / "scene.toml").write_text('[anatomy]\norgan = "organ.stl"\n')
    scene = "--scene", tmp_path
    assert status_of("reconstruct", swept, *scene, "--spacing-mm", "2", "--out", tmp_path) == 0
    report, output = json.loads((tmp_path / "report.json").read_text()), capsys.readouterr().out
    assert report["agreement"] == {} and "Dice" not in output
    assert re.search(r"the sweep covers 0\.[0-9] % of this organ", output)


def test_reconstruct_refuses_in_one_line(swept, tmp_path, monkeypatch):
    out = ("--out", tmp_path / "out")
    assert "none.igs.mha: No such file" in refused("reconstruct", tmp_path / "none.igs.mha", *out)
    assert "expected a tracked one" in refused("reconstruct", Path(__file__), *out)
    assert "name it with --scene" in refused("reconstruct", swept, *out, "--undo-compression")
    there = refused("reconstruct", swept, *out, "--reference", "Tracker")
    assert "no chain of transforms from Image to Tracker" in there and "ProbeToReference" in there
    (tmp_path / "none.xml").write_text("<PlusConfiguration/>")
    assert "none.xml: no CoordinateDefinitions" in refused(
        "reconstruct", swept, *out, "--config", tmp_path / "none.xml"
    )
    sweep = read_sweep(swept)
    del sweep.frames[5]["Timestamp"]
    write_sweep(tmp_path / "timeless.igs.mha", sweep)
    assert "frame 5: Timestamp" in refused("reconstruct", tmp_path / "timeless.igs.mha", *out)
    # Nothing of this is found out after a folder was made.
    assert not (tmp_path / "out").exists()
    monkeypatch.setattr(reconstruction, "MAX_VOXELS", 5000)
    large = refused("reconstruct", swept, *out)
    assert "over.igs.mha: " in large and "take larger voxels" in large
    monkeypatch.undo()
    shutil.copy(swept, tmp_path / "a.igs.mha")
    write_sweep(tmp_path / "a-marks.igs.mha", type(sweep)(sweep.images[:3], sweep.frames[:3], sweep.fields))
    assert "labels of (3, 64, 64)" in refused("reconstruct", tmp_path / "a.igs.mha", *out)
    write_sweep(tmp_path / "one.igs.mha", type(sweep)(sweep.images[:1], sweep.frames[:1], sweep.fields))
    assert "expected two images or more" in refused("reconstruct", tmp_path / "one.igs.mha", *out)
    assert not (tmp_path / "out").exists()
    sweep.images = sweep.images * np.uint8(0)
    sweep.frames[5]["Timestamp"] = "0.5"
    write_sweep(tmp_path / "black.igs.mha", sweep)
    assert "all images are black" in refused("reconstruct", tmp_path / "black.igs.mha", *out)


@pytest.mark.parametrize(("sample", "config", "used"), [(SPINE, SPINE_XML, 21), (NWIRE, NWIRE_XML, None)])
def test_reconstruct_takes_what_plus_wrote(data, tmp_path, capsys, sample, config, used):
    sweep = data / f"us/{sample}.igs.mha"
    assert "no chain of transforms from Image" in refused("reconstruct", sweep, "--out", tmp_path / "none")
    coarsely = "--spacing-mm", "2", "--out", tmp_path
    assert status_of("reconstruct", sweep, "--config", data / config, *coarsely) == 0
    report = json.loads((tmp_path / "report.json").read_text())
    assert (
        report["used"] == report["frames"] == (used or len(read_sweep(sweep))) and report["agreement"] == {}
    )
    voxels = sitk.GetArrayFromImage(sitk.ReadImage(str(tmp_path / "volume.nrrd")))
    assert list(voxels.shape[::-1]) == report["shape"] and (voxels > 0).mean() > 0.02
    # Voxels are means of pixels.
    assert voxels.max() <= read_sweep(sweep).images.max()
    assert not (tmp_path / "labels.nrrd").exists()
    assert f"images    {report['used']} of {report['used']} with a pose" in capsys.readouterr().out


def test_poses_alone_make_no_volume(data, tmp_path):
    sweep = data / "us/SlidingProbeTrackingData.igs.mha"
    assert "no image with a valid pose" in refused("reconstruct", sweep, "--out", tmp_path)


def test_scan_leaves_a_sweep_at_the_poses_of_its_file(tmp_path):
    way = over_tumour()[5:8]
    (tmp_path / "poses.json").write_text(json.dumps([dict(probe_to_patient=pose.tolist()) for pose in way]))
    options = "--out", tmp_path / "out", "--sweep", "--picture", "ct", "--arch", "cpu"
    assert status_of("scan", EMBEDDED, "--pose", tmp_path / "poses.json", *options) == 0
    sweep = read_sweep(tmp_path / "out/sweep.igs.mha")
    marks = read_ground_truth(tmp_path / "out/sweep.igs.mha")
    probe, rows = load_probe("drop-in"), sweep.images.shape[1]
    for frame, pose in enumerate(way):
        for file in (sweep, marks):
            assert file.transform("Probe", "Reference", frame) == pytest.approx(pose, abs=1e-9)
        at = sweep.transform("Image", "Reference", frame)
        assert at == pytest.approx(pose @ probe.image_to_probe(rows, rows), abs=1e-9)
    assert np.diff(sweep.times_s) == pytest.approx(1 / 30) and sweep.images.std() > 10
    # The tumour's middle, 20 mm before the face, lies half a step beside the two last pictures.
    middle = load_surface(phantom_folder() / "tumour.stl").center_mass
    column, row, aside, _ = np.linalg.inv(sweep.transform("Image", "Reference", 1)) @ [*middle, 1]
    assert (
        abs(aside) == pytest.approx(0.75) and marks.images[1, round(row), round(column)] == PixelLabel.TUMOUR
    )
    assert (
        np.argwhere(marks.images == PixelLabel.TUMOUR).size
        and (marks.images[1][0] == PixelLabel.OUTSIDE).any()
    )


def test_labels_of_another_file_are_not_used(tmp_path):
    (tmp_path / "a-marks.igs.mha").write_text("no sweep")
    assert read_ground_truth(tmp_path / "a.mha") is None and read_ground_truth(tmp_path / "b.igs.mha") is None
    with pytest.raises(SweepError, match="a-marks"):
        read_ground_truth(tmp_path / "a.igs.mha")
