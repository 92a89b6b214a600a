"""The beam: recordings read and measured, and the clamped model against beam theory and the recordings."""

import json
import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import trimesh
from conftest import rotation_about
from study_runs import refusal

from app import main
from sim.fields import fill
from studies.beam.beam_command import markers_on
from studies.beam.beam_comparison import mean_length, measured_oscillation, theory
from studies.beam.cantilever import BeamMaterial, Cantilever
from studies.beam.motion_capture import COLUMNS, BeamError, load_captures, oscillation, read_capture

FRAMES = 300


def swing(time_s: np.ndarray, hz: float, ratio: float, rest_mm: float) -> np.ndarray:
    """Height [mm] of what is let go at 0 and comes to rest at rest_mm, an oscillator's textbook solution."""
    decay = ratio / np.sqrt(1 - ratio**2) * 2 * np.pi * hz
    angle = 2 * np.pi * hz * time_s
    after = 1 - np.exp(-decay * time_s) * (np.cos(angle) + decay / (2 * np.pi * hz) * np.sin(angle))
    return rest_mm * np.where(time_s > 0, after, 0.0)


def recording(rest_mm: float = -7.0) -> np.ndarray:
    """Values of a recording at 100 Hz (FRAMES, 10): held for half a second, then swinging at 7 Hz."""
    values = np.zeros((FRAMES, len(COLUMNS)))
    values[:, 0] = 0.01 * np.arange(FRAMES)
    for marker in range(3):
        values[:, 1 + 3 * marker] = 1e-3 * swing(values[:, 0] - 0.5, 7.0, 0.05, rest_mm)
    return values


def save(path: Path, values: np.ndarray, columns: tuple[str, ...] = COLUMNS) -> Path:
    """Write a recording."""
    np.savetxt(path, values[:, : len(columns)], delimiter=",", header=",".join(columns), comments="")
    return path


def test_a_recording_is_read_in_mm_with_its_load(tmp_path):
    save(tmp_path / "beam_load52_a.csv", recording())
    save(tmp_path / "beam_gravity_a.csv", recording())
    light, heavy = load_captures(tmp_path)
    assert (light.load_g, heavy.load_g) == (0.0, 52.0)
    assert heavy.tips_mm.shape == (FRAMES, 3, 3)
    # After 2.5 s and 17 swings with a damping ratio of 0.05, exp(-5.5) of the motion is left.
    np.testing.assert_allclose(heavy.final_mm()[:, 0], -7.0, atol=0.1)
    # 0.5 mm is fallen within the two frames after the release.
    assert abs(heavy.release() - 50) <= 2


@pytest.mark.parametrize(
    ("name", "spoil", "words"),
    [
        ("beam_load52", lambda v: v[:, :-1], "tip3_z_m is missing"),
        ("beam_load52", lambda v: np.where(np.indices(v.shape)[0] == 7, np.nan, v), "line 9, t_s is .nan."),
        ("beam_load52", lambda v: v[:40], "40 frames are too few"),
        ("beam_load52", lambda v: v[::-1], "do not increase"),
        ("beam_load52", lambda v: np.where(np.arange(v.shape[1]) > 0, 0.0, v), "never falls"),
        ("beam_heavy", lambda v: v, "neither 'gravity' nor 'load'"),
    ],
)
def test_a_fault_of_a_recording_is_named(tmp_path, name, spoil, words):
    values = spoil(recording())
    path = save(tmp_path / f"{name}.csv", values, COLUMNS[: values.shape[1]])
    with pytest.raises(BeamError, match=words):
        read_capture(path)


def test_a_value_that_is_no_number_is_named(tmp_path):
    path = save(tmp_path / "beam_gravity.csv", recording())
    path.write_text(path.read_text().replace("1.000000000000000021e-02", "soon", 1))
    with pytest.raises(BeamError, match="line 3, t_s is .soon."):
        read_capture(path)


def test_frequency_and_damping_of_a_noisy_creeping_signal():
    time = 0.01 * np.arange(150)
    noise = np.random.default_rng(0).normal(scale=0.02, size=len(time))
    height = swing(time, 7.7, 0.05, -6.5) - 0.5 * (1 - np.exp(-3 * time)) + noise
    found = oscillation(time, height)
    # A sinusoid of amplitude A in noise s, N samples over T: the frequency's variance is 6 s^2 / (pi^2 A^2 N
    # T^2)
    # (Cramer and Rao), 0.02 Hz in the last window (A = 1.7 mm, N = 26, T = 0.26 s) and less in those before.
    assert abs(found.hz - 7.7) < 3 * 0.02
    assert found.error_hz < 3 * 0.02
    assert found.damping_ratio == pytest.approx(0.05, abs=0.006)


@pytest.mark.parametrize(
    "height", [np.linspace(0, -7, 200), -1 + np.cos(2 * np.pi * 7 * 0.01 * np.arange(40))]
)
def test_no_frequency_without_enough_swings(height):
    with pytest.raises(BeamError):
        oscillation(0.01 * np.arange(len(height)), height)


def test_theory_of_a_heavy_load_is_a_spring_that_carries_some_of_the_beam():
    # Rayleigh: 33/140 of the beam's mass swings with the load, to 1 in 1000 where the load is five times the
    # beam.
    material = BeamMaterial(263.8, 0.499, 1.07)
    _, hz = theory([30.0, 30.0, 100.0], material, 500.0)
    stiffness = 3 * 263.8e3 * 0.03**4 / 12 / 0.1**3
    assert hz == pytest.approx(np.sqrt(stiffness / (0.5 + 33 / 140 * 0.0963)) / (2 * np.pi), rel=1e-3)


@pytest.mark.parametrize("load_g", [0.0, 3.0])
def test_a_slender_beam_sags_and_swings_as_beam_theory_says(device, load_g):
    size, material = np.array([10.0, 10.0, 60.0]), BeamMaterial(2000.0, 0.0, 1.07)
    beam = Cantilever(size, material, 5.0, load_g)
    sag, hz = theory(size, material, load_g)
    rest_mm, left_mm = beam.rest()
    # Bending inside the cells is exact; shear is 2% of the sag. The sag is 4% of the length at most: theory's
    # small angles cost
    # 0.1%, and straight cells along the length 1/(4 x 12^2) = 0.2%.
    assert -rest_mm[0, 0] == pytest.approx(sag, rel=0.01)
    assert left_mm < 0.005
    frame = 0.04 / hz
    height = beam.swing(125, frame)[:, 0, 0]
    found = oscillation(frame * np.arange(len(height)), height)
    # Shear and the turning of the sections, which the frequency's theory leaves out, take up to 1.6% off,
    # masses lumped at the nodes up to 1%.
    assert found.hz == pytest.approx(hz, rel=0.03)
    # Implicit steps damp by half of their angle.
    step = frame / beam.substeps(frame)
    assert found.damping_ratio == pytest.approx(np.pi * hz * step, rel=0.2)


def test_a_frame_of_more_substeps_than_a_step_can_have_is_several_steps(device):
    # Nearly incompressible tissue has fast pressure waves.
    beam = Cantilever(np.array([10.0, 10.0, 40.0]), BeamMaterial(263.8, 0.499, 1.07), 5.0)
    assert beam.substeps(0.01) > 100
    assert np.isfinite(beam.swing(2, 0.01)).all()


def test_markers_stand_where_the_recordings_have_them():
    # By hand for the beam of 30 x 30 x 100 mm.
    markers = markers_on(np.array([30.0, 30.0, 100.0]))
    np.testing.assert_allclose(markers, [[36, 15, 100], [24, 36, 100], [6, -6, 100]])


def test_markers_turn_with_the_end_that_they_stand_on(device):
    size = np.array([30.0, 30.0, 100.0])
    beam = Cantilever(size, BeamMaterial(263.8, 0.45, 1.07), 10.0, 0.0, markers_on(size))
    turn = rotation_about([0.3, 1.0, 0.2], 25.0)
    fill((beam.body.position, (beam.body.rest_points @ turn.T)))
    # float32 keeps some 1e-5 of 100 mm.
    np.testing.assert_allclose(beam.displacement(), beam.markers @ turn.T - beam.markers, atol=1e-4)


def test_the_command_compares_draws_and_reports(tmp_path, capsys):
    trimesh.creation.box(bounds=[[0, 0, 0], [20, 20, 60]]).export(tmp_path / "beam.stl")
    save(tmp_path / "beam_gravity_a.csv", recording())
    out, report = tmp_path / "out", tmp_path / "beam.json"
    files = ["--json", str(report), "--out", str(out)]
    assert main(["beam", str(tmp_path), "--poisson", "0.3", "--check", *files]) == 0
    assert (out / "beam.png").stat().st_size > 10_000
    row = json.loads(report.read_text())["loads"][0]
    assert row["measured_hz"] == pytest.approx(7.0, abs=0.01)
    assert row["computed_hz"] == pytest.approx(row["theory_hz"], rel=0.1)
    printed = capsys.readouterr().out
    assert "first frequency" in printed
    as_above = re.search(r"as above +([\d.]+) mm +([\d.]+) Hz", printed)
    assert float(as_above[2]) == pytest.approx(row["computed_hz"], abs=1e-4)
    # Rests on cells twice as wide as the row's: stiffer in bending by the hourglass term, 5% with two cells
    # in the height.
    assert float(as_above[1]) == pytest.approx(row["computed_mm"], rel=0.1)
    assert all(f"  {name}  " in printed for name in ("half the time step", "twice the iterations"))


def test_cells_that_do_not_fill_the_beam_are_refused(device):
    with pytest.raises(BeamError, match="no whole number of 7 mm cells"):
        Cantilever(np.array([30.0, 30.0, 100.0]), BeamMaterial(263.8, 0.45, 1.07), 7.0)


def test_a_missing_file_is_one_line(tmp_path, capsys):
    refused = partial(refusal, capsys, "beam", tmp_path)
    assert refused() == f"nephron: {tmp_path}: holds no recordings (*.csv)"
    save(tmp_path / "beam_gravity_a.csv", recording())
    assert "beam.stl: cannot be read" in refused()


def test_the_silicone_beam_within_a_tenth(device, data):
    captures = load_captures(data / "deform" / "silicone_beam")
    assert [capture.load_g for capture in captures] == [0, 0, 52, 52, 101, 101]
    for capture, low, high in zip(captures[::2], (6.2, 16.7, 25.0), (6.9, 17.7, 28.0), strict=True):
        assert low < mean_length(capture.final_mm()) < high
    measured = measured_oscillation(captures[0])
    # Poisson's ratio is 0.499; 0.45 is 10 times quicker and moves the rest by 2%, the frequency by 1%. The
    # rest is for what 10 mm cells add to 4%, by which the finer ones of the command are off.
    size = np.array([30.0, 30.0, 100.0])
    beam = Cantilever(size, BeamMaterial(263.8, 0.45, 1.07), 10.0, 0.0, markers_on(size))
    assert mean_length(beam.rest()[0]) == pytest.approx(mean_length(captures[0].final_mm()), rel=0.1)
    height = beam.swing(65, 0.01)[:, :, 0].mean(axis=1)
    assert oscillation(0.01 * np.arange(66), height).hz == pytest.approx(measured.hz, rel=0.1)
