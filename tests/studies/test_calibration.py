"""Calibration: fitted and held-out data, searches with a known result, and workers that agree."""

import csv
import json
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from small_bead_case import beads, write_case
from study_runs import refusal

import studies.accuracy.accuracy_commands as accuracy_commands
import studies.accuracy.case_workers as case_workers
from app import main
from rehearsal.configuration import Setup, setup_of
from rehearsal.worker_processes import Workers
from sim.sampling import SamplingError
from studies.accuracy.bead_case import BeadCase, load_case
from studies.accuracy.bead_errors import null_errors
from studies.accuracy.calibration import (
    MODEL,
    Calibration,
    CalibrationError,
    CalibrationTrial,
    exhaustive_count,
    finer_grid,
    quartic,
    search_count,
    split_of,
    stiffness_grid,
)
from studies.accuracy.calibration_results import best_so_far
from studies.accuracy.case_workers import Measured, evaluate

BEST = {3.0: 0.62, 4.0: 0.33}


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> list[Path]:
    """Two experiments that differ in what was measured."""
    place, scales = tmp_path_factory.mktemp("cases"), {"a": 1.0, "b": [1, 1, 0.9]}
    return [write_case(place / name, places=beads() * scale) for name, scale in scales.items()]


@pytest.fixture(scope="module")
def cases(folders) -> list[BeadCase]:
    return [load_case(folder) for folder in folders]


def pretended(case: BeadCase, setup: Setup) -> Measured:
    """Errors as if each radius had a best stiffness; the last stage has another, which must not be seen in
    a fit.
    """
    off = np.array(
        [setup.tissue.stiffness - BEST[setup.tissue.radius_mm]] * 2 + [setup.tissue.stiffness - 0.9]
    )
    errors = 0.2 + off[:, None] ** 2 + np.linspace(0, 0.1, case.measured.shape[1])
    errors += 0.05 * (setup.relaxation_factor - 1) + 0.001 * (setup.iterations - 9) ** 2
    return Measured(errors, [1.0, 2.0, 6.0], round(1000 / setup.tissue.radius_mm), 7)


def pretending(pairs):
    return (pretended(*pair) for pair in pairs)


def test_a_split_holds_out_what_is_named(cases):
    stages, thirds, whole = (split_of(cases, what) for what in ("stages", "beads", "cases"))
    assert all(mask[:-1].all() and not mask[-1].any() for mask in stages.fitted)
    assert all((mask == (np.arange(12) % 3 != 2)).all() for mask in thirds.fitted)
    assert whole.fitted[0].all() and not whole.fitted[1].any() and whole.held_out_name == "ball"
    errors = [np.arange(36.0).reshape(3, 12), 100 + np.arange(36.0).reshape(3, 12)]
    assert (whole.fit_mm(errors), whole.held_out_mm(errors)) == (17.5, 117.5)
    assert (stages.fit_mm(errors), stages.held_out_mm(errors)) == (11.5 + 50, 29.5 + 50)
    # Bead numbers 0 and 1, 3 and 4, ... have a mean of 5; 2, 5, ... of 6.5; each stage adds 12.
    assert (thirds.fit_mm(errors), thirds.held_out_mm(errors)) == (5 + 12 + 50, 6.5 + 12 + 50)


def test_a_split_that_holds_out_nothing_is_refused(cases):
    with pytest.raises(CalibrationError, match="there is one case"):
        split_of(cases[:1], "cases")
    with pytest.raises(CalibrationError, match="named twice"):
        split_of([cases[0], cases[0]], "cases")
    few = replace(cases[0], measured=cases[0].measured[:, :2], beads=cases[0].beads[:2])
    with pytest.raises(CalibrationError, match="less than 3 beads"):
        split_of([few], "beads")


def test_grids():
    assert stiffness_grid(0.25) == [0.25, 0.5, 0.75, 1.0]
    assert len(stiffness_grid(0.05)) == 20 and stiffness_grid(0.05)[0] == 0.05
    assert finer_grid(0.5, 0.05) == pytest.approx([0.46, 0.47, 0.48, 0.49, 0.51, 0.52, 0.53, 0.54])
    assert finer_grid(1.0, 0.05) == pytest.approx([0.96, 0.97, 0.98, 0.99])


def test_the_exhaustive_search_finds_the_best_fit_and_judges_it_on_held_out_data(cases):
    done = []
    found = Calibration(cases, split_of(cases, "stages"), pretending, done.append)
    found.exhaustive([3.0, 4.0], 0.1)
    assert sum(done) == exhaustive_count(2, 2, 0.1) == 2 * 2 * 18
    for radius, best in BEST.items():
        trial = found.best(radius)
        assert trial.setup.tissue.stiffness == pytest.approx(best, abs=0.011)
        assert trial.fit_mm == pytest.approx(0.25, abs=2e-4)
        assert trial.held_out_mm == pytest.approx(0.25 + (trial.setup.tissue.stiffness - 0.9) ** 2)
    null = np.mean([null_errors(case)[-1].mean() for case in cases])
    assert found.null_mm() == pytest.approx(null)


def trial(stiffness: float, fit_mm: float) -> CalibrationTrial:
    return CalibrationTrial(setup_of(MODEL, stiffness=stiffness), (), fit_mm, 0.0)


def test_a_quartic_and_its_minimum_are_found():
    x = np.linspace(0.1, 1, 19)
    y = 1 + 2 * (x - 0.4) ** 2 + 3 * (x - 0.4) ** 4
    fallen = [trial(0.02, 900.0), trial(0.05, np.inf)]
    curve, best = quartic([*fallen, *(trial(*pair) for pair in zip(x, y, strict=True))])
    assert best == pytest.approx(0.4, abs=1e-3) and curve(best) == pytest.approx(1.0, abs=1e-6)
    assert curve(x) == pytest.approx(y) and curve.domain.tolist() == [0.1, 1.0]
    assert quartic([trial(a, 1 + a) for a in (0.1, 0.2, 0.3, 0.4)]) is None


def test_a_search_of_several_settings_is_reproducible(cases):
    done = []
    split = split_of(cases, "stages")
    first, again = (Calibration(cases, split, pretending, done.append) for _ in range(2))
    for one in (first, again):
        one.search([3.0], 12)
    best = first.best(3.0).setup
    assert best.iterations in (8, 9, 10) and best.tissue.stiffness == pytest.approx(0.62, abs=0.1)
    assert [t.setup for t in first.trials[3.0]] == [t.setup for t in again.trials[3.0]]
    assert sum(done) == 2 * search_count(2, 1, 12) and len(first.trials[3.0]) == 15 * 13
    course = [t.fit_mm for t in best_so_far(first.trials[3.0])]
    assert course == sorted(course, reverse=True) and course[-1] == first.best(3.0).fit_mm


@contextmanager
def pretended_workers(jobs=None, dask=None):
    def mapped(function, tasks):
        assert function is evaluate
        return pretending(tasks)

    yield SimpleNamespace(map=mapped)


@pytest.mark.parametrize("searched", [False, True])
def test_calibrate_writes_tables_figures_and_json(monkeypatch, folders, cases, tmp_path, capsys, searched):
    monkeypatch.setattr(accuracy_commands, "Workers", pretended_workers)
    out = tmp_path / "out"
    more = ["--search", "2"] if searched else ["--grid", "0.1"]
    assert main(["calibrate", *map(str, folders), "--radii", "4,3", "--out", str(out), *more]) == 0
    printed = capsys.readouterr().out
    assert "Fitted on all stages but the deepest; held out: the deepest stage." in printed
    assert "no measure of accuracy" in printed
    found = json.loads((out / "calibration.json").read_text())
    assert [radius["radius_mm"] for radius in found["radii"]] == [3.0, 4.0] and found["cases"] == [
        "ball",
        "ball",
    ]
    best = found["radii"][0]["best"]
    setup = setup_of(
        MODEL,
        radius_mm=3.0,
        **{name: best[name] for name in ("stiffness", "relaxation_factor", "iterations")},
    )
    errors = pretended(cases[0], setup).errors
    with (out / "table2.csv").open() as file:
        head, *rows = csv.reader(file)
    assert head == [
        *("case", "stage", "part", "3 mm", "4 mm"),
        *("3 mm, % of travel", "4 mm, % of travel"),
    ]
    by_name = {tuple(row[:3]): row[3:] for row in rows}
    assert float(by_name["", "", "stiffness"][0]) == best["stiffness"]
    assert float(by_name["ball", "1 (2.00 mm)", "fit"][0]) == pytest.approx(errors[1].mean(), abs=1e-6)
    last = by_name["ball", "2 (4.00 mm)", "held out"]
    assert float(last[0]) == pytest.approx(errors[2].mean(), abs=1e-6)
    assert float(last[2]) == pytest.approx(100 * errors[2].mean() / 4, abs=1e-4)
    assert float(by_name["all", "mean", "held out"][0]) == pytest.approx(best["held_out_mm"])
    with (out / "table4.csv").open() as file:
        assert float(list(csv.reader(file))[2][3]) == pytest.approx(errors[0].max(), abs=1e-6)
    with (out / "table5.csv").open() as file:
        assert [float(row[1]) for row in list(csv.reader(file))[1:]] == pytest.approx(
            [3, (14 / 3) ** 0.5, 1, 6], abs=1e-3
        )
    figures = {path.name for path in out.glob("*.png")}
    other = "search.png" if searched else "figure4.png"
    assert figures == {"figure5.png", other, *(f"table{n}.png" for n in (2, 3, 4, 5))}
    for name in figures:
        assert np.asarray(Image.open(out / name).convert("L")).std() > 5


def test_calibrate_reports_mistakes_in_one_line(folders, tmp_path, capsys):
    refused = partial(refusal, capsys, "calibrate")
    a, out = folders[0], ("--out", tmp_path / "out")
    assert "--out" in refused(a)
    assert "CASE" in refused(*out)
    assert "holds no case.toml" in refused(tmp_path, *out)
    for name in ("Thumbs.db", "._case"):  # the shell's * gives these too
        assert f"{tmp_path}: holds no case.toml" in refused(tmp_path / name, tmp_path, *out)
        assert f"{name}: holds no case.toml" in refused(tmp_path / name, *out)
    assert "--radii is '2.7,x'" in refused(a, *out, "--radii", "2.7,x")
    assert "--radii is '0.1'" in refused(a, *out, "--radii", "0.1")
    assert "--hold-out" in refused(a, *out, "--hold-out", "nothing")
    assert "there is one case" in refused(a, *out, "--hold-out", "cases")


@pytest.mark.usefixtures("nothing_built")
def test_this_process_and_a_cluster_find_the_same(cases, cluster):
    setup = setup_of(MODEL, radius_mm=5.0, warm_up_steps=6, stage_steps=3)
    pairs = [(cases[0], setup.but(stiffness=a)) for a in (0.9, 0.5)]
    too_large = [(cases[0], setup_of(MODEL, radius_mm=20.0))]
    here = [evaluate(*pair) for pair in pairs]
    with Workers(dask=cluster) as workers:
        there = list(workers.map(evaluate, pairs))
        with pytest.raises(SamplingError, match="choose a smaller radius"):
            list(workers.map(evaluate, too_large))
    assert all(np.array_equal(a.errors, b.errors) for a, b in zip(here, there, strict=True))
    assert here[0].errors.mean() != here[1].errors.mean() and np.isfinite(here[0].errors).all()


@pytest.mark.usefixtures("nothing_built")
def test_a_case_is_filled_once_for_each_radius(monkeypatch, cases):
    monkeypatch.setattr(case_workers, "_filled", {})
    filled, built = [], []

    class Experiment:
        model = SimpleNamespace(counts=lambda: dict(particles=1, clusters=1))

        def __init__(self, case, setup, rest) -> None:
            built.append(rest)

        def run(self, setup) -> SimpleNamespace:
            return SimpleNamespace(finite=False, step_ms=[])

    monkeypatch.setattr(case_workers, "rest_body", lambda case, setup: filled.append(case.digest))
    monkeypatch.setattr(case_workers, "BeadExperiment", Experiment)
    for radius in (2.0, 3.0, 4.0, 5.0, 6.0, 2.0, 6.0):
        assert np.isinf(evaluate(cases[0], setup_of(MODEL, radius_mm=radius)).errors).all()
    # The fifth is one too many for Taichi: all are built anew.
    assert len(filled) == 5 and len(built) == 6
