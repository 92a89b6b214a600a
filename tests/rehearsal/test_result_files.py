"""Figures as reports have them, surfaces, and shapes that are compared."""

import csv
import math

import numpy as np
import pytest
import trimesh
from conftest import rotation_about
from matplotlib.figure import Figure

from rehearsal.image_and_surface_files import IMAGE, SCREENSHOT, save_images
from rehearsal.result_files import next_number, rounded, save_figure, spread, write_csv, write_json
from scenes.surfaces import translated, volume_mm3
from studies.harness import distances_after_fit
from ultrasound.probe import load_probe
from ultrasound.scanner import B_MODE


def test_what_json_has_no_number_for_is_none():
    assert [rounded(value) for value in (None, math.nan, math.inf, 1 / 3)] == [None, None, None, 0.333333]


def test_a_spread_is_of_all_values_and_not_of_a_sample():
    assert spread([1.0, 2.0, 6.0]) == dict(
        mean=3.0, sd=round(math.sqrt(14 / 3), 4), min=1.0, max=6.0, median=2.0
    )


def test_no_file_holds_what_is_no_json(tmp_path):
    write_json({"mm": 1.5}, tmp_path / "a.json")
    assert (tmp_path / "a.json").read_text() == '{\n  "mm": 1.5\n}\n'
    with pytest.raises(ValueError, match="JSON compliant"):
        write_json({"mm": math.nan}, tmp_path / "b.json")


def test_a_row_may_lack_what_others_have(tmp_path):
    write_csv([dict(a=1, b=2), dict(c=3, a=4)], tmp_path / "a.csv")
    with (tmp_path / "a.csv").open(newline="") as file:
        assert list(csv.reader(file)) == [["a", "b", "c"], ["1", "2", ""], ["4", "", "3"]]


def test_a_full_disk_leaves_what_was_there(tmp_path, bytes_to_a_file):
    """Of figures, tables, pictures and DICOM, and nothing that is half written."""
    figure, probe = Figure(), load_probe("linear")
    figure.subplots().plot(np.arange(100))
    grey = {B_MODE: np.random.default_rng(4).integers(0, 255, (64, 64), np.uint8)}
    writers = {
        "a.json": lambda: write_json({"mm": [1.5] * 999}, tmp_path / "a.json"),
        "a.csv": lambda: write_csv([dict(mm=1.5)] * 999, tmp_path / "a.csv"),
        "a.png": lambda: save_figure(figure, tmp_path / "a.png"),
        "a-b-mode.png": lambda: save_images(grey, 40.0, 40.0, probe, tmp_path / "a"),
    }
    for name in writers:
        (tmp_path / name).write_text("before")
    with bytes_to_a_file(1000):
        for name, write in writers.items():
            with pytest.raises(OSError, match=name):
                write()
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == dict.fromkeys(writers, "before")
    with bytes_to_a_file(4800), pytest.raises(OSError, match="a-b-mode.dcm"):
        writers["a-b-mode.png"]()
    assert {path.name for path in tmp_path.iterdir()} == set(writers)


def test_a_surface_holds_the_same_volume_wherever_it_is():
    box = trimesh.creation.box((2.0, 3.0, 4.0))
    far = translated(box, [100.0, -50.0, 7.0])
    assert far.bounds.mean(axis=0) == pytest.approx([100.0, -50.0, 7.0])
    # 24 mm^3, less what is lost where the corners' products of 1e6 mm^3 cancel.
    assert volume_mm3(far.vertices, far.faces) == pytest.approx(24.0, abs=1e-8)
    assert volume_mm3(box.vertices, box.faces[:, ::-1]) == pytest.approx(-24.0)


def test_a_shape_is_compared_whatever_its_place_and_turn():
    wanted = np.random.default_rng(3).normal(size=(20, 3))
    moved = wanted @ rotation_about([1.0, 2.0, -1.0], 115.0).T + [30.0, -7.0, 1.0]
    assert distances_after_fit(moved, wanted) == pytest.approx(np.zeros(20), abs=1e-12)
    # Twice as large about its middle: each point is as far off as it was from there.
    assert distances_after_fit(2 * moved, wanted) == pytest.approx(
        np.linalg.norm(wanted - wanted.mean(axis=0), axis=1)
    )
    assert distances_after_fit(moved[:1], wanted[:1]) == pytest.approx([0.0])


def test_the_next_number_is_one_more_than_the_highest(tmp_path):
    assert next_number(tmp_path / "none", SCREENSHOT) == next_number(tmp_path, SCREENSHOT) == 1
    others = "screenshot-0x9.png", "my-screenshot-044.png", "screenshot-050.png.part"
    for name in ("screenshot-007.png", "screenshot-12.png", "013-ct.png", *others):
        (tmp_path / name).touch()
    assert next_number(tmp_path, SCREENSHOT) == 8 and next_number(tmp_path, IMAGE) == 14
    for name in ("screenshot-999.png", "screenshot-1000.png", "1000-no ct.png"):
        (tmp_path / name).touch()
    assert next_number(tmp_path, SCREENSHOT) == next_number(tmp_path, IMAGE) == 1001
