"""The tables of a run against values computed by hand, and the run itself."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from click.testing import CliRunner
from conftest import rotation_about
from small_bead_case import DEPTHS, beads, values, write_case
from study_runs import refusal

from app import cli
from rehearsal.build_solver import step_settings
from rehearsal.configuration import PRESETS, SetupError, choose_setup, setup_of
from scenes.scene import SolverSection
from scenes.tissue import QUALITIES, TISSUES
from sim.fields import array_of
from studies.accuracy.bead_case import BeadCase, load_case
from studies.accuracy.bead_errors import (
    SLIP,
    bead_errors,
    correlation,
    force_figures,
    force_table,
    null_errors,
    probe_distances,
    report,
    stage_figures,
    summary,
    table,
)
from studies.accuracy.bead_experiment import BeadExperiment, BeadRun

KEYS = {
    "case",
    "model",
    "radius_mm",
    "particles",
    "substeps",
    "iterations",
    "time_step_s",
    "parts",
    "stages",
    "overall_mean_mm",
    "ms_per_step",
    "distance_correlation",
    "finite",
}
COARSE = setup_of("shape-matching", radius_mm=3.0)
BRIEF = setup_of("shape-matching", radius_mm=3.0, warm_up_steps=12, stage_steps=9)


@pytest.fixture(scope="module")
def case(tmp_path_factory) -> BeadCase:
    return load_case(write_case(tmp_path_factory.mktemp("ball") / "ball"))


def test_figures_of_a_stage_by_hand():
    errors = np.array([[1.0, 1.0, 1.0, 1.0], [1.0, 2.0, 3.0, 6.0]])
    null = np.array([[0.0, 0.0, 0.0, 0.0], [2.0, 2.0, 4.0, 4.0]])
    first, second = stage_figures(np.array([0.0, 10.0]), errors, null)
    assert first == dict(
        indentation_mm=0, mean_mm=1, sd_mm=0, max_mm=1, percent_of_travel=None, null_mean_mm=0
    )
    # Mean 3, deviations -2, -1, 0 and 3.
    assert second.pop("sd_mm") == pytest.approx((14 / 4) ** 0.5, abs=1e-6)
    assert second == dict(indentation_mm=10, mean_mm=3, max_mm=6, percent_of_travel=30, null_mean_mm=3)


def test_errors_are_distances_and_the_null_model_stays_at_stage_0(case):
    shifted = case.measured + [3.0, 0.0, -4.0]
    assert bead_errors(case, shifted) == pytest.approx(np.full((3, 12), 5.0))
    rest = beads()[0]
    way = np.sqrt((rest[:, 0] / 6) ** 2 + (rest[:, 1] / 6) ** 2 + (1 + rest[:, 2] / 6) ** 2)
    assert null_errors(case) == pytest.approx(np.outer(DEPTHS, way) / 12)
    assert bead_errors(case, np.broadcast_to(case.measured[0], case.measured.shape)) == pytest.approx(
        null_errors(case)
    )


def test_correlation_is_pearsons_and_none_of_what_does_not_vary():
    random = np.random.default_rng(5)
    a = random.normal(size=(3, 20))
    b = a + random.normal(size=(3, 20))
    assert correlation(a, b) == pytest.approx(np.corrcoef(a.ravel(), b.ravel())[0, 1], abs=1e-6)
    assert correlation(a, 1 - 2 * a) == -1
    assert correlation(a, np.ones_like(a)) is None


def test_distance_from_the_probe_is_that_of_the_rounded_cuboid_at_its_pose(case):
    turn = rotation_about([0, 0, 1], 90)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, [1.0, 2.0, 3.0]
    local = np.array([[10.0, 0, 0], [0, -7.0, 0], [0, 0, 0], [8.0, 4.0, 5.0]])
    placed = replace(case, poses=pose[None], measured=(local @ turn.T + pose[:3, 3])[None])
    # Half sizes 8, 4 and 5, edges of 1: beyond a face, beyond a face, inside, at a corner that is rounded
    # off.
    assert probe_distances(placed)[0] == pytest.approx([2, 3, -4, 3**0.5 - 1])


@pytest.fixture(scope="module")
def experiment(one_device, case) -> BeadExperiment:
    """Each run begins at rest."""
    return BeadExperiment(case, COARSE)


def test_report_and_table_show_these_figures(experiment, case):
    off = np.linspace(0, 1, 12)[:, None] * np.array([0.0, 0.0, 1.0])
    unknown = np.full((3, 3), np.nan)
    run = BeadRun(
        case.measured + off,
        step_ms=[1.0, 2.0, 6.0],
        force_n=unknown,
        sliding_share=unknown[0],
        friction_ratio=unknown[0],
        parts_mm=np.zeros((3, 0, 3)),
    )
    figures = report(experiment, COARSE, run)
    assert set(figures) == KEYS | {"clusters", "memberships"} and figures["case"] == "ball"
    assert figures["overall_mean_mm"] == pytest.approx(0.5)
    assert figures["ms_per_step"]["median"] == 2 and figures["ms_per_step"]["mean"] == 3
    assert "speed  2.0 ms a step (median), 6.0 at most" in summary(figures, "m")
    distances = probe_distances(case)[1:].ravel()
    expected = np.corrcoef(distances, np.tile(np.linspace(0, 1, 12), 2))[0, 1]
    assert figures["distance_correlation"] == pytest.approx(expected, abs=1e-6)
    rows = table(case, run.beads).splitlines()
    null = null_errors(case).mean(axis=1)
    assert rows[2].split() == [
        *["1", "2.00", "0.50", "25", "0.31", "1.00", f"{null[1]:.2f}", f"{0.5 / null[1]:.2f}"],
        f"{np.corrcoef(probe_distances(case)[1], off[:, 2])[0, 1]:.2f}",
    ]
    assert rows[4].split() == ["all", "0.50", "1.00", f"{null.mean():.2f}", f"{0.5 / null.mean():.2f}"]
    assert sum(int(row.split("(")[1].split()[0]) for row in rows if "bead positions" in row) == 24
    # A result that is not finite is reported, in valid JSON.
    lost = replace(run, beads=np.full_like(case.measured, np.nan), step_ms=[1.0], finite=False)
    figures = report(experiment, COARSE, lost)
    assert figures["finite"] is False and figures["overall_mean_mm"] is None
    json.dumps(figures, allow_nan=False)
    assert "NOT FINITE" in summary(figures, experiment.describe(COARSE)) and "nan" in table(case, lost.beads)


def test_the_probe_waits_above_then_goes_to_each_stage_and_rests_there_wherever_the_case_is(one_device, case):
    far = np.array([100.0, -200.0, 1000.0])
    organ, support = (mesh.copy().apply_translation(far) for mesh in (case.organ, case.support))
    poses = case.poses + np.pad(far[:, None], ((0, 1), (3, 0)))
    moved = replace(case, organ=organ, support=support, beads=case.beads + far, poses=poses)
    experiment = BeadExperiment(moved, COARSE)
    seen = []
    experiment.solver.step = lambda settings, poses: seen.append(poses)
    run = experiment.run(COARSE)
    assert np.abs(array_of(experiment.body.position)).max() < 12.0
    assert run.beads[0] == pytest.approx(moved.beads, abs=1e-4)
    ends = np.array([poses[-1] for poses in seen])
    assert len(ends) == 120 + 3 * 90 == 120 + len(run.step_ms)
    assert np.array_equal(np.concatenate([seen[0][:1], ends[:-1]]), [poses[0] for poses in seen])
    lowest = ends[:, 2, 3] - case.size_mm[2] / 2
    assert (lowest[:120] > 40).all()
    moved = np.diff(lowest[119:])
    assert moved[:60] == pytest.approx(moved[0]) and moved[90:150] == pytest.approx(-2.0 / 60)
    for stage, depth in enumerate(DEPTHS):
        assert lowest[120 + stage * 90 + 59 : 120 + (stage + 1) * 90] == pytest.approx(12.0 - depth)


def test_a_pressed_ball_sinks_the_same_every_time_whatever_ran_between(experiment, case):
    first = experiment.run(BRIEF)
    other = experiment.run(BRIEF.but(stiffness=0.4, iterations=5))
    again = experiment.run(BRIEF)
    assert np.array_equal(first.beads, again.beads) and not np.array_equal(first.beads, other.beads)
    sunk = (first.beads - case.beads)[:, :, 2].mean(axis=1)
    # It falls by the 0.2 mm of play at least, and by less than 1 mm; pressed 4 mm, beads sink by some of
    # that.
    assert first.finite and -1.0 < sunk[0] < -0.15 and -3.0 < sunk[2] - sunk[0] < -0.3


def test_presets_differ_in_radius_alone_and_options_change_them():
    radii = [PRESETS["shape-matching"][quality].size_mm for quality in QUALITIES]
    assert radii == [3.3, 2.7, 2.2]
    assert choose_setup("shape-matching", "fast") == setup_of("shape-matching", radius_mm=3.3)
    assert choose_setup("shape-matching", "fast", stiffness=0.5, radius_mm=None) == setup_of(
        "shape-matching", radius_mm=3.3, stiffness=0.5
    )
    with pytest.raises(SetupError, match="--young-kpa: shape-matching has no such setting"):
        choose_setup("shape-matching", "fast", young_kpa=15.0)


@pytest.mark.parametrize("model", PRESETS)
def test_a_scene_is_rehearsed_as_balanced_is_validated(model):
    balanced = choose_setup(model, "balanced")
    tissue = TISSUES[model].model_validate({"model": model})
    stepped = step_settings(tissue, SolverSection())
    for name in ("time_step_s", "substeps", "iterations", "relaxation_factor"):
        assert getattr(balanced.solver, name) == getattr(stepped, name)
    assert balanced.tissue == tissue


def test_validate_twice_prints_and_writes_the_same_but_for_times(monkeypatch, tmp_path):
    brief = partial(choose_setup, warm_up_steps=12, stage_steps=9)
    monkeypatch.setattr("studies.accuracy.accuracy_commands.choose_setup", brief)
    folder = write_case(tmp_path / "ball")
    reports = []
    for name in ("a.json", "new/b.json"):
        arguments = ["validate", folder, "--cell", 5, "--arch", "cpu", "--json", tmp_path / name]
        done = CliRunner().invoke(cli, [str(argument) for argument in arguments])
        assert done.exit_code == 0 and "1/60 s in 1 substep of 4 iterations" in done.output
        reports.append(json.loads((tmp_path / name).read_text()))
    times = [figures.pop("ms_per_step") for figures in reports]
    assert times[0].keys() == {"mean", "sd", "min", "max", "median"}
    assert reports[0] == reports[1] and reports[0]["finite"] and reports[0]["cell_mm"] == 5


def test_validate_reports_mistakes_in_one_line(tmp_path, capsys):
    refused = partial(refusal, capsys, "validate")
    folder = write_case(tmp_path / "ball")
    assert "holds no case.toml" in refused(tmp_path)
    assert "--model" in refused(folder, "--model", "clay")
    assert "--quality" in refused(folder, "--quality", "best")
    assert "--poisson" in refused(folder, "--poisson", 0.5)
    assert "has no such setting" in refused(folder, "--radius", 3, "--cell", 4)
    shape_matching = [folder, "--model", "shape-matching"]
    assert "has no such setting" in refused(*shape_matching, "--young-kpa", 15)
    assert "choose a smaller radius" in refused(*shape_matching, "--radius", 20, "--arch", "cpu")
    assert "is a folder" in refused(folder, "--json", tmp_path)
    assert "choose another --json" in refused(folder, "--json", folder / "case.toml" / "a.json")
    write_case(tmp_path / "ball", values() | {"stage": []})
    assert "stage" in refused(folder)


def test_a_real_case_is_pressed(one_device, data):
    case = load_case(data / "truth" / "bean")
    assert case.measured.shape == (4, 45, 3) and case.young_kpa == 15.0
    # The README of the truth names these displacements.
    assert null_errors(case).mean(axis=1) == pytest.approx([0, 0.86, 1.45, 1.96], abs=0.006)
    setup = BRIEF.but(radius_mm=6.0)
    run = BeadExperiment(case, setup).run(setup)
    assert run.finite and 0.3 < bead_errors(case, run.beads).mean() < 2.0


def test_forces_are_compared_as_vectors_and_what_is_unknown_is_none(case):
    known = replace(case, probe_force_n=np.array([[0.0, 0, 0], [0, 0, 2.0], [np.nan] * 3]))
    found = np.array([[0.0, 0, 0.01], [0.3, 0, 2.4], [0, 0, 4.0]])
    slides, ratio = np.array([0.0, 0.4, 0.75]), np.array([0.0, 0.25, 0.35])
    run = BeadRun(
        case.measured, force_n=found, sliding_share=slides, friction_ratio=ratio, parts_mm=np.zeros((3, 0, 3))
    )
    figures = force_figures(known, run)
    assert figures[1]["probe_force_N"] == [0.3, 0, 2.4] and figures[1]["measured_probe_force_N"] == [0, 0, 2]
    assert figures[2]["measured_probe_force_N"] is None
    assert [(row["sliding_share"], row["friction_ratio"]) for row in figures] == [
        (0, 0),
        (0.4, 0.25),
        (0.75, 0.35),
    ]
    rows = force_table(known, run).splitlines()[1:]
    # 0.5 N of 2 N; of no force there is no share.
    assert rows[1].split()[-4:] == ["0.500", "25.0", "40", "0.25"] and rows[0].split()[-3:] == [
        "0.010",
        "0",
        "0.00",
    ]
    assert "not known" in rows[2]
    assert rows[3] == SLIP.format("2")
    assert len(force_table(known, replace(run, sliding_share=slides / 2)).splitlines()) == 4
