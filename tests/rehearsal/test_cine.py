"""The last seconds of a frozen scanner, and its caliper."""

import numpy as np
import pytest

from rehearsal.caliper import Caliper
from rehearsal.cine import KEPT_S, Cine, CineFrame
from render.viewer import View

HERE = np.eye(4)


def frame_at(time_s: float, rest: np.ndarray | None = None) -> CineFrame:
    grey = np.full((8, 8), round(time_s) % 256, np.uint8)
    return CineFrame(time_s, View(np.eye(4), {"B-mode": grey}, 16.0, 44.0, above_mm=4.0), rest)


def test_the_last_ten_seconds_are_kept_and_no_more():
    cine = Cine()
    for k in range(400):
        cine.keep(frame_at(k / 25))
    times = [frame.time_s for frame in cine.frames]
    assert times[-1] == 399 / 25 and times[-1] - times[0] == pytest.approx(KEPT_S, abs=1 / 25)


def test_of_a_fast_machine_thirty_frames_a_second_are_kept():
    cine = Cine()
    for k in range(1200):
        cine.keep(frame_at(k / 120))
    assert 280 <= len(cine.frames) <= 301


def test_going_back_and_on_ends_at_the_ends_and_a_new_frame_is_the_newest():
    cine = Cine()
    for k in range(5):
        cine.keep(frame_at(float(k)))
    cine.go(-2)
    assert (cine.shown.time_s, cine.age_s) == (2.0, -2.0)
    cine.go(-10)
    assert cine.shown.time_s == 0.0
    cine.go(10)
    assert cine.shown.time_s == 4.0
    cine.go(-3)
    cine.keep(frame_at(5.0))
    assert cine.shown.time_s == 5.0


def test_an_empty_cine_goes_nowhere():
    cine = Cine()
    cine.go(-1)
    assert cine.back == 0


def test_the_caliper_measures_the_tissue_as_it_lies_and_at_rest():
    stretch = np.array([[1.25, 0.1], [0.0, 0.8], [0.2, -0.3]])
    u, v = np.meshgrid(np.linspace(-8.0, 8.0, 33), np.linspace(-4.0, 40.0, 33))
    frame = frame_at(0.0, np.stack([u, v], axis=-1) @ stretch.T)
    caliper = Caliper()
    assert caliper.figure(frame) == ""
    caliper.point((-3.0, 5.0), HERE)
    caliper.point(None, HERE)
    caliper.point((4.0, 29.0), HERE)
    at_rest = np.linalg.norm(stretch @ [7.0, 24.0])
    # A linear map is exact between the places that are kept.
    assert caliper.figure(frame) == f"25.0 mm\nat rest {at_rest:.1f} mm"
    caliper.point((0.0, 0.0), HERE)
    assert caliper.points == () and caliper.figure(frame) == ""


def test_without_tissue_the_caliper_still_measures_the_picture():
    caliper = Caliper(((0.0, 0.0), (3.0, 4.0)))
    assert caliper.figure(frame_at(0.0)) == "5.0 mm"


def test_the_caliper_goes_when_the_probe_moves():
    caliper, moved = Caliper(), HERE.copy()
    moved[0, 3] = 0.5
    for count in (1, 2):
        caliper.point((float(count), 0.0), HERE)
        caliper.go_with(HERE + 1e-6)
        assert len(caliper.points) == count
    caliper.go_with(moved)
    assert caliper.points == ()
    caliper.point((1.0, 0.0), moved)
    caliper.go_with(moved)
    assert caliper.points == ((1.0, 0.0),)
