"""Pictures without a body: poses that are read or refused, and what the command leaves."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from coarse_patient import thinned
from conftest import rotation_about
from PIL import Image
from pydicom import dcmread

import app
from rehearsal.commands import scan_command
from rehearsal.commands.scan_command import load_patient, warn_of_deep_poses
from rehearsal.pose_scans import PoseScans
from rehearsal.tracking.pose_file import PoseError, TimedPoses, load_poses, load_timed_poses
from scenes.anatomy import LoadedAnatomy, load_anatomy
from scenes.phantom.embedded_patient import phantom_folder
from scenes.scene import EMBEDDED, Scene, load_scene
from scenes.scene import Image as ImageSettings
from scenes.surfaces import load_surface
from ultrasound.probe import load_probe
from version import VERSION

pytestmark = pytest.mark.usefixtures("arrays_stored")


def pose_on_tumour() -> np.ndarray:
    """On the embedded kidney's tumour: y into it, x to the head."""
    folder = phantom_folder()
    organ, tumour = load_surface(folder / "organ.stl"), load_surface(folder / "tumour.stl")
    inward = organ.center_mass - tumour.center_mass
    inward /= np.linalg.norm(inward)
    face = organ.vertices[
        np.argmin(organ.vertices @ inward + 0.3 * np.linalg.norm(organ.vertices - tumour.center_mass, axis=1))
    ]
    x = np.cross(inward, [1.0, 0.0, 0.0])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.column_stack([x, inward, np.cross(x, inward)]), face
    return pose


def refused(tmp_path, text: str, name: str = "poses.json") -> str:
    (tmp_path / name).write_text(text)
    with pytest.raises(PoseError) as error:
        load_poses(tmp_path / name)
    assert "\n" not in str(error.value) and name in str(error.value)
    return str(error.value)


def test_poses_of_both_formats_are_the_same(tmp_path):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_about([1, 2, 3], 40), [1.0, -2.0, 3.0]
    (tmp_path / "a.json").write_text(
        json.dumps([dict(name="first", probe_to_patient=pose.tolist()), dict(probe_to_patient=pose.tolist())])
    )
    (tmp_path / "a.csv").write_text("# row by row\n" + ",".join(map(str, pose.ravel())) + "\n")
    named, numbered = load_poses(tmp_path / "a.json"), load_poses(tmp_path / "a.csv")
    assert list(named) == ["first", "0002"] and list(numbered) == ["0001"]
    assert np.array_equal(named["first"], pose) and np.array_equal(numbered["0001"], pose)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "; expected poses as JSON or CSV"),
        (" ", "is empty"),
        ("[]", "holds no poses"),
        ('[{"probe_to_patient": [[1, 0, 0, 0]]}]', "pose 1, probe_to_patient"),
        ('[{"matrix": []}]', "pose 1"),
        (
            json.dumps([dict(probe_to_patient=np.diag([1.0, 1, 2, 1]).tolist())]),
            "[0.0, 0.0, 0.0, 1.0]]: not rigid",
        ),
        (json.dumps([dict(probe_to_patient=np.diag([1.0, 1, -1, 1]).tolist())]), "determinant -1"),
        (json.dumps([dict(name="a", probe_to_patient=np.eye(4).tolist())] * 2), "'a' occurs twice"),
        (json.dumps([dict(probe_to_patient=[["1", 0, 0, 0], *np.eye(4)[1:].tolist()])]), "valid number"),
        (json.dumps([dict(name="../a", probe_to_patient=np.eye(4).tolist())]), "pose 1, name"),
    ],
)
def test_poses_that_cannot_be_used_are_refused_in_one_line(tmp_path, text, words):
    assert words in refused(tmp_path, text)


def test_a_table_with_another_number_of_columns_is_refused(tmp_path):
    assert "pose 1: 3 numbers" in refused(tmp_path, "1,2,3", "poses.csv")
    letter = refused(tmp_path, ",".join(["1", "a", *"0" * 14]), "poses.csv")
    assert "pose 1, probe_to_patient.0.1 = 'a': input should be a valid number" in letter
    (tmp_path / "a.png").write_bytes(b"\x89PNG")
    with pytest.raises(PoseError, match="not text in UTF-8.; expected poses as JSON or CSV"):
        load_poses(tmp_path / "a.png")
    with pytest.raises(PoseError, match="cannot be read as poses"):
        load_poses(tmp_path)
    with pytest.raises(PoseError, match="no such pose file"):
        load_poses(tmp_path / "none.json")


def test_poses_with_times_of_both_formats_are_the_same(tmp_path):
    poses = np.stack([np.eye(4)] * 3)
    poses[:, 0, 3] = [1.0, 2.0, 4.0]
    times = [10.0, 10.5, 12.0]
    rows = [
        dict(time_s=time, probe_to_patient=pose.tolist()) for time, pose in zip(times, poses, strict=True)
    ]
    (tmp_path / "a.json").write_text(json.dumps(rows))
    lines = [",".join(map(str, [time, *pose.ravel()])) for time, pose in zip(times, poses, strict=True)]
    (tmp_path / "a.csv").write_text("\n".join(lines))
    for name in ("a.json", "a.csv"):
        timed = load_timed_poses(tmp_path / name)
        assert np.array_equal(timed.times_s, times) and np.array_equal(timed.poses, poses)
        assert timed.length_s == 2.0
        assert np.array_equal(list(load_poses(tmp_path / name).values()), poses)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.csv", "1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1", "pose 1 has no time"),
        ("a.json", json.dumps([dict(probe_to_patient=np.eye(4).tolist())]), "pose 1 has no time"),
        ("a.json", json.dumps([dict(time_s="soon", probe_to_patient=np.eye(4).tolist())]), "pose 1, time_s"),
        (
            "a.csv",
            "nan,1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1",
            "pose 1, time_s = 'nan': input should be a finite number",
        ),
        ("a.csv", "0,1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1\n1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1", "pose 2: 16 numbers"),
        ("a.csv", "5,1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1\n" * 2, "pose 2 at 5 s is not later"),
    ],
)
def test_times_that_cannot_be_used_are_refused_in_one_line(tmp_path, name, text, words):
    (tmp_path / name).write_text(text)
    with pytest.raises(PoseError, match=words) as error:
        load_timed_poses(tmp_path / name)
    assert "\n" not in str(error.value) and name in str(error.value)


def test_times_that_do_not_increase_are_refused():
    with pytest.raises(PoseError, match="pose 3 at 1 s is not later than the one before, at 2 s"):
        TimedPoses(np.array([0.0, 2.0, 1.0]), [None] * 3)


def test_a_pixel_is_where_its_matrix_says():
    probe = load_probe("curvilinear")
    width, depth, above = probe.extent_mm
    matrix = probe.image_to_probe(300, 400)
    # The middle of the last row is the deepest place of the middle line; the first pixel's corner lies behind
    # the face.
    assert matrix @ [199.5, 299.5, 0, 1] == pytest.approx([0.0, depth - above, 0, 1])
    assert matrix @ [-0.5, -0.5, 0, 1] == pytest.approx([-width / 2, -above, 0, 1])


def thinned_patient(*given) -> tuple[Scene, LoadedAnatomy]:
    """Every fourth voxel each way."""
    scene, whole = load_patient(*given)
    return scene, replace(whole, ct=thinned(thinned(whole.ct)), labels=thinned(thinned(whole.labels)))


def test_scan_leaves_a_picture_of_each_pose_and_mode(tmp_path, capsys, monkeypatch):
    # Blood flow of every voxel takes seconds.
    monkeypatch.setattr(scan_command, "load_patient", thinned_patient)
    away, beyond = pose_on_tumour(), pose_on_tumour()
    away[:3, 3] -= 30 * away[:3, 1]
    beyond[:3, 3] -= 50 * beyond[:3, 1]
    poses = [
        dict(name="on", probe_to_patient=pose_on_tumour().tolist()),
        dict(name="off", probe_to_patient=away.tolist()),
        dict(name="past", probe_to_patient=beyond.tolist()),
    ]
    (tmp_path / "poses.json").write_text(json.dumps(poses))
    out = tmp_path / "out"
    command = [
        "scan",
        str(EMBEDDED),
        "--pose",
        tmp_path / "poses.json",
        "--out",
        out,
        "--contact",
        "organ",
        "--dicom",
        "--doppler",
        "power",
        "--iq",
        "npz",
    ]
    assert app.main([str(part) for part in [*command, "--arch", "cpu"]]) == 0
    report = json.loads((out / "scan.json").read_text())
    assert [row["file"] for row in report["pictures"]] == [
        f"{name}-{kind}.png" for name in ("on", "off", "past") for kind in ("b-mode", "ct", "doppler")
    ]
    assert "1 of 3 poses show nothing of the organ; they may be of another" in capsys.readouterr().out
    assert report["probe"]["FrequencyMhz"] == 9.0 and report["version"] == VERSION
    shown = {path.stem: np.asarray(Image.open(path)).astype(int) for path in out.glob("*.png")}
    row = report["pictures"][0]
    rows, columns = shown["on-b-mode"].shape
    assert (rows * row["row_mm"], columns * row["column_mm"]) == pytest.approx((50.0, 36.0))
    image_to_probe = np.array(row["image_to_probe"])
    corners = image_to_probe @ np.array([[-0.5, -0.5, 0, 1], [columns - 0.5, rows - 0.5, 0, 1]]).T
    assert pytest.approx(np.array([[-18.0, 0.0], [18.0, 50.0]])) == corners[:2].T
    assert np.array(row["probe_to_patient"]) == pytest.approx(pose_on_tumour())
    # Without contact there is electronic noise, and the vibration of the array near its face.
    assert (
        shown["on-b-mode"].mean() > 10 and shown["off-b-mode"][100:].mean() < 3 and shown["off-ct"].max() > 0
    )
    assert (out / "on-b-mode.dcm").is_file() and not (out / "on-ct.dcm").exists()
    # Where Doppler shows nothing, it is the B-mode image.
    doppler = shown["on-doppler"]
    grey = (doppler == shown["on-b-mode"][..., None]).all(axis=-1)
    assert 0 < (~grey).mean() < 0.5 and (doppler[~grey][:, 0] > doppler[~grey][:, 2]).mean() > 0.9
    assert dcmread(out / "on-doppler.dcm").PhotometricInterpretation == "RGB"
    signals = {name: np.load(out / f"{name}-iq.npz") for name in ("on", "off")}
    assert signals["on"]["iq"].shape == (800, 192) and (signals["on"]["motion_mm"] == 0).all()
    # The probe moved away by 30 mm: the tissue is that much deeper.
    assert signals["off"]["motion_mm"][..., 1] == pytest.approx(30.0, abs=1e-3)


def scan_of_one_pose(folder: Path, pose: np.ndarray, *options: str) -> int:
    """Exit code of ``scan`` of the embedded patient, into a folder."""
    poses = folder / "poses.json"
    poses.write_text(json.dumps([dict(probe_to_patient=pose.tolist())]))
    return app.main(["scan", str(EMBEDDED), "--pose", str(poses), "--out", str(folder), *options])


@pytest.mark.parametrize(
    "options, meant",
    [
        (["--picture", "ct", "--doppler", "colour"], "made from a B-mode image"),
        (["--picture", "ct", "--iq", "mat"], "made from a B-mode image"),
        (["--clamped"], "changes only Doppler"),
        (["--detail-level", "reflection", "--iq", "npz"], "choose speckle or elevation"),
    ],
)
def test_what_needs_a_b_mode_image_is_refused_without_one(tmp_path, capsys, options, meant):
    assert scan_of_one_pose(tmp_path, pose_on_tumour(), *options) == 2
    message = capsys.readouterr().err
    assert meant in message and len(message.strip().splitlines()) == 1


def test_poses_deep_inside_the_organ_are_counted(capsys):
    poses = np.stack([np.eye(4)] * 4)
    # Of a ball of 30 mm, whose facets lie up to 0.2 mm inside it; outside is not deep.
    poses[:, 0, 3] = [0.0, 9.5, 10.1, 55.0]
    organ = trimesh.creation.icosphere(subdivisions=4, radius=30.0)
    warn_of_deep_poses(poses, organ)
    assert (
        "2 of 4 poses are more than 20 mm inside the organ; they may be of another" in capsys.readouterr().out
    )
    warn_of_deep_poses(poses[2:], organ)
    assert capsys.readouterr().out == ""


def test_an_unknown_probe_is_named_with_those_that_are_known_and_poses_that_are_too_deep(tmp_path, capsys):
    deep = np.eye(4)
    deep[:3, 3] = [69.7, 26.8, -341.1]
    assert scan_of_one_pose(tmp_path, deep, "--probe", "x.toml") == 2
    told = capsys.readouterr()
    assert (
        "known by name are curvilinear, drop-in, linear, micro, phased" in told.err
        and "1 of 1 poses" in told.out
    )


def test_a_label_of_no_known_tissue_is_refused_in_one_line(tmp_path, capsys):
    folder = tmp_path / "patient"
    shutil.copytree(phantom_folder(), folder)
    (folder / "scene.toml").write_text(
        '[anatomy]\nct = "ct.nrrd"\nlabels = "labels.nrrd"\ntissues = {1 = "kidny"}\n'
    )
    (tmp_path / "poses.json").write_text(json.dumps([dict(probe_to_patient=np.eye(4).tolist())]))
    command = [
        "scan",
        str(folder),
        "--pose",
        str(tmp_path / "poses.json"),
        "--out",
        str(tmp_path),
        "--arch",
        "cpu",
    ]
    assert app.main(command) == 2
    told = capsys.readouterr().err
    assert "label 1 is 'kidny'" in told and "cortex" in told and len(told.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("contact", "outside", "has_fluid", "gap_mm"),
    [
        ("organ", "fluid", True, 8.0),
        ("tissue", "fluid", False, 1.5),
        ("organ", "background", False, 1.5),
    ],
)
def test_through_the_organ_alone_it_scans_through_the_fluid_of_a_rehearsal(
    one_device, tmp_path, contact, outside, has_fluid, gap_mm
):
    anatomy = load_anatomy(load_scene(EMBEDDED), EMBEDDED.parent)
    ct = thinned(anatomy.ct)
    settings = ImageSettings(outside=outside, pixels=32)
    scans = PoseScans(
        replace(anatomy, labels=None, ct=ct), ct, load_probe("drop-in"), settings, contact, tmp_path
    )
    assert (scans.scanner.has_fluid, scans.scanner.contact_gap_mm) == (has_fluid, gap_mm)
