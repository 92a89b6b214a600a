"""The last seconds of a frozen scanner, and its calliper."""

import numpy as np
import pytest

from rehearsal.cine import KEPT_S, Calliper, Cine, Frame
from render.viewer import View

HERE = np.eye(4)


def frame_at(time_s: float, rest: np.ndarray | None = None) -> Frame:
    grey = np.full((8, 8), round(time_s) % 256, np.uint8)
    return Frame(time_s, View(np.eye(4), {"B-mode": grey}, 16.0, 44.0, above_mm=4.0), rest)


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


def test_the_calliper_measures_the_tissue_as_it_lies_and_at_rest():
    stretch = np.array([[1.25, 0.1], [0.0, 0.8], [0.2, -0.3]])
    u, v = np.meshgrid(np.linspace(-8.0, 8.0, 33), np.linspace(-4.0, 40.0, 33))
    frame = frame_at(0.0, np.stack([u, v], axis=-1) @ stretch.T)
    calliper = Calliper()
    assert calliper.figure(frame) == ""
    calliper.point((-3.0, 5.0), HERE)
    calliper.point(None, HERE)
    calliper.point((4.0, 29.0), HERE)
    at_rest = np.linalg.norm(stretch @ [7.0, 24.0])
    # A linear map is exact between the places that are kept.
    assert calliper.figure(frame) == f"25.0 mm\nat rest {at_rest:.1f} mm"
    calliper.point((0.0, 0.0), HERE)
    assert calliper.points == () and calliper.figure(frame) == ""


def test_without_tissue_the_calliper_still_measures_the_picture():
    calliper = Calliper(((0.0, 0.0), (3.0, 4.0)))
    assert calliper.figure(frame_at(0.0)) == "5.0 mm"


def test_the_calliper_goes_when_the_probe_moves():
    calliper, moved = Calliper(), HERE.copy()
    moved[0, 3] = 0.5
    for count in (1, 2):
        calliper.point((float(count), 0.0), HERE)
        calliper.go_with(HERE + 1e-6)
        assert len(calliper.points) == count
    calliper.go_with(moved)
    assert calliper.points == ()
    calliper.point((1.0, 0.0), moved)
    calliper.go_with(moved)
    assert calliper.points == ((1.0, 0.0),)
