"""The stress test applies what a case names, measures recovery from the rest position, and gives a reason
where there is none.
"""

from types import SimpleNamespace

import numpy as np
import pytest
from conftest import rotation_about
from study_runs import written

import app
from studies.harness import distances_after_fit
from studies.robustness import stress_bodies, stress_study
from studies.robustness.stress_cases import MODELS, StressCase, Subject, cases_of, quick_cases_of
from studies.robustness.stress_motion import PROBES, STATES
from studies.robustness.stress_study import OUTCOMES, outcome_of
from ultrasound.probe_manipulator import advanced

ONE = Subject("one")


@pytest.mark.parametrize("model", MODELS)
def test_the_cases_are_many_and_each_is_another(model):
    cases = cases_of(model)
    assert len(cases) > 300
    assert len({case.name for case in cases}) == len(cases)
    assert {case.probe[0] for case in cases} == set(PROBES)
    assert {case.state[0] for case in cases} == set(STATES)
    steps = [case.settings.get("time_step_s", 1 / 60) for case in cases]
    assert (min(steps), max(steps)) == (1e-4, 1.0)
    assert {case.settings.get("iterations") for case in cases} >= {1, 100}
    assert {case.gravity for case in cases} >= {0.0, 1000.0}
    assert {case.subject.size_mm for case in cases} >= {1.0, 10.0}
    assert max(max(case.heaviest, case.subject.mass_ratio) for case in cases) == 1e6
    kinds = {case.kind for case in cases if case.subject.kind == "kidney"}
    assert {case.kind for case in quick_cases_of(model)} == kinds | {"one alone"}


def test_initial_states_and_motions_match_their_names():
    x = np.random.default_rng(0).normal(size=(50, 3))
    up, home = np.array([0.0, 0.0, 1.0]), np.eye(4)
    assert np.ptp(STATES["scaled"](x, up, 1.0, 1.0, 0.0)[0][:, 2]) == 0
    mirrored = STATES["scaled"](x, up, -1.0, 1.0, 1.0)[0]
    assert mirrored - x.mean(axis=0) == pytest.approx((x - x.mean(axis=0)) * [-1, 1, 1])
    turning = STATES["turning"](x, up, 2, 10.0)[1]
    assert turning == pytest.approx(np.cross([0, 0, 10.0], x - x.mean(axis=0)))
    two = np.concatenate([x - [9, 0, 0], x + [9, 0, 0]])
    wholly = STATES["overlapped"](two, up, 1.0)[0]
    assert wholly[50:].mean(axis=0) == pytest.approx(wholly[:50].mean(axis=0))
    body, dt = SimpleNamespace(home=home, thickness_mm=30.0), 1 / 60
    assert PROBES["press"](0.0, body, dt, 12.0) == pytest.approx(home)
    assert PROBES["press"](10.0, body, dt, 12.0) == pytest.approx(advanced(home, 12.0))
    assert PROBES["flat"](10.0, body, dt, -2.0) == pytest.approx(advanced(home, 32.0))
    first, last = (PROBES["sweep"](t, body, dt, 1000.0, 5.0) for t in (0.10, 0.11))
    assert np.linalg.norm(last[:3, 3] - first[:3, 3]) == pytest.approx(10.0)
    spun = PROBES["spin"](0.1, body, dt, 10.0, 2)
    assert spun[:3, :3] == pytest.approx(rotation_about([0, 0, 1], np.degrees(1.0)))


@pytest.mark.parametrize("model", MODELS)
def test_a_small_body_is_stressed_released_and_measured(device, model):
    cases = [
        StressCase("rest", "", ONE),
        StressCase("lost", "", ONE, state=("nothing",)),
        StressCase("gone", "", ONE, state=("lifted", 1e6)),
        StressCase("beside", "", ONE, state=("lifted", 100.0)),
    ]
    specimen = stress_bodies.prepared(model, ONE)
    rest, lost, gone, beside = (stress_study.run(specimen, model, case) for case in cases)
    assert rest["finite"] and rest["recovered"] and rest["fallback"] is None and rest["reason"] is None
    assert rest["rest_error_mm"] < 0.01
    assert rest["volume_ratio"] == pytest.approx(1.0, abs=0.01)
    for restored, why in ((lost, "not finite"), (gone, "left the scene")):
        assert why in restored["fallback"]
        assert restored["finite"] and restored["recovered"]
    # It falls 100 mm and comes to rest somewhere: where it was, or there is a reason.
    assert beside["fallback"] is None and beside["kinetic_peak_mj"] > rest["kinetic_peak_mj"]
    assert beside["recovered"] == (beside["rest_error_mm"] <= 0.1) == (beside["reason"] is None)


def test_two_bodies_are_fitted_apart(device):
    specimen = stress_bodies.prepared("shape-matching", Subject("two"))
    assert sorted(np.concatenate(specimen.parts)) == list(range(specimen.body.count))
    assert min(len(part) for part in specimen.parts) > 0.4 * specimen.body.count
    turned = specimen.body.rest_points.copy()
    turned[specimen.parts[1]] = turned[specimen.parts[1]] @ np.diag([-1.0, -1.0, 1.0]) + [5.0, 3.0, 1.0]
    assert distances_after_fit(turned, specimen.body.rest_points).mean() > 1.0
    state = specimen.solver.snapshot().body
    specimen.body.restore(type(state)(turned.astype(np.float32), state.velocity))
    assert stress_study._shape_error(specimen) < 1e-4


def test_reasons_distinguish_position_and_shape():
    assert stress_study._reason(0.05, None) is None
    assert "shape has recovered, 12 mm" in stress_study._reason(12.0, 0.01)
    assert "shape differs by 3 mm" in stress_study._reason(12.0, 3.0)


def test_the_command_writes_table_figure_and_json(tmp_path, monkeypatch, capsys):
    few = [StressCase("rest", "long", ONE), StressCase("lost", "wholly", ONE, state=("nothing",))]
    monkeypatch.setattr(stress_study, "quick_cases_of", lambda model: few)
    assert app.main(["study", "stability", "--quick", "--jobs", "1", "--out", str(tmp_path)]) == 0
    report, rows = written(tmp_path, "stability")
    cases = report["cases"]
    assert [(case["model"], case["name"]) for case in cases] == [
        (model, name) for model in MODELS for name in ("rest: long", "lost: wholly")
    ]
    for case in cases:
        assert {"finite", "recovered", "rest_error_mm", "volume_ratio", "fallback", "reason"} <= set(case)
        assert case["finite"]
    assert [row["fallback"] != "" for row in rows] == [False, True, False, True]
    printed = capsys.readouterr().out
    assert "2 cases, 2 finite; 2 recovered to within 0.1 mm; the state was restored in 1" in printed


@pytest.mark.parametrize("model", MODELS)
def test_a_state_along_an_axis_matches_its_name(model):
    states = {case.name: case.state for case in cases_of(model)}
    assert states["collapsed: to a plane, x"] == ("scaled", 0.0, 1.0, 1.0)
    assert states["collapsed: to a line, y"] == ("scaled", 0.0, 1.0, 0.0)
    assert states["mirrored: in z"] == ("scaled", 1.0, 1.0, -1.0)
    assert states["thrown: 10 m/s, -y"] == ("thrown", 0.0, -1e4, 0.0)


@pytest.mark.parametrize(
    "changes, outcome",
    [
        (dict(), "recovered its position"),
        (dict(fallback="torn"), "recovered its position after the state was restored"),
        (dict(recovered=False, shape_error_mm=0.1), "recovered its shape in another position"),
        (
            dict(recovered=False, shape_error_mm=0.1, fallback="torn"),
            "recovered its shape in another position after the state was restored",
        ),
        (dict(recovered=False, shape_error_mm=0.2, fallback="torn"), "shape changed"),
        (dict(recovered=False), "shape changed"),
        (dict(finite=False), "not finite"),
    ],
)
def test_the_outcome_of_a_case(changes, outcome):
    row = dict(finite=True, recovered=True, fallback=None, shape_error_mm=None)
    assert outcome_of(row | changes) == outcome and outcome in OUTCOMES
