"""``study timing`` measures the step itself, and its references compute the same."""

from functools import partial

import numpy as np
import pytest
import taichi as ti
import trimesh
from lattice_tissue import tissue_of as lattice_tissue
from particle_tissue import tissue_of as particle_tissue
from small_bead_case import briefly, small_anatomy
from study_runs import written

import app
from rehearsal.configuration import setup_of
from sim.body import BodyState
from sim.fields import array_of
from sim.kernels import kernel
from sim.neo_hookean import LATTICE_SETTINGS
from sim.self_contact import SelfContacts
from sim.shapes import ConvexTool, Plane
from sim.solver import Solver, StepSettings
from studies import study
from studies.harness import memory_mb
from studies.performance import lower_bound, step_timing
from studies.performance.step_phases import Phases, without_calls


def solver_of(model: str, mesh: trimesh.Trimesh) -> Solver:
    shapes = [Plane(np.array([0.0, 0.0, 1.0]), -12.0), ConvexTool.cuboid(np.array([10.0, 6.0, 10.0]))]
    if model == "neo-hookean":
        return lattice_tissue(mesh, 4.0, shapes, friction=0.35)
    tissue = particle_tissue(mesh, shapes=shapes)
    return Solver(tissue, tool=shapes[1])


@pytest.mark.parametrize("model", ["neo-hookean", "shape-matching"])
def test_a_step_in_pieces_is_the_step(device, ball, model):
    solver = solver_of(model, ball)
    settings = StepSettings() if model == "shape-matching" else LATTICE_SETTINGS
    phases = Phases(solver, settings)
    ends = []
    for step in (partial(solver.step, settings), phases.step):
        solver.body.restore(solver.body.rest_state())
        solver.contacts.reset()
        solver.model.update_frames()
        poses = np.tile(np.eye(4), (settings.substeps + 1, 1, 1))
        for n in range(10):
            poses[:, 2, 3] = 17.5 - 0.3 * (n + np.linspace(0, 1, settings.substeps + 1))
            step(poses)
        ends.append(array_of(solver.body.position).astype(float))
    assert np.abs(ends[0] - solver.body.rest_points).max() > 1.0
    # Compiled otherwise, sums round otherwise: 1e-6 mm a pass at 12 mm, in a hundred passes that do not
    # forget it.
    assert np.abs(ends[1] - ends[0]).max() < 1e-3
    assert tuple(phases.ms) == phases.names()
    assert min(phases.ms.values()) > 0
    assert phases.calls["predict"] == settings.substeps and phases.calls["frames"] == 1


def test_pieces_sum_to_the_step_they_are_of():
    ms, calls = dict(fit=5.0, push=3.0, end=0.5), dict(fit=4, push=4, end=1)
    # 8.5 ms for 9 calls, 4 ms in one piece: half a millisecond a call.
    assert without_calls(ms, calls, 4.0) == pytest.approx(dict(fit=3.0, push=1.0, end=0.0))
    assert sum(without_calls(ms, calls, 9.0).values()) == pytest.approx(9.0)


def test_the_bound_in_c_computes_what_shape_matching_does(device, block):
    model = particle_tissue(block)
    try:
        plain = lower_bound.Bound(model)
    except lower_bound.NoBound as reason:
        pytest.skip(str(reason))
    x = plain.x.copy()
    model.body.restore(BodyState(x, np.zeros_like(x)))

    @kernel
    def match(model: ti.template(), iterations: int):
        ti.loop_config(serialize=True)
        for _once in range(1):
            model.gather()
            for _ in range(iterations):
                model.project(lower_bound.STIFFNESS, 1.0, 0.0)
            model.scatter()

    match(model, 3)
    plain.run(3, 2)
    assert np.abs(plain.x - x).max() > 1e-3
    # Both round at 15 mm, 1e-6 mm, in each of the operations of three passes.
    assert np.abs(array_of(model.body.predicted) - plain.x).max() < 3e-5


def test_memory_is_that_of_the_fields(device, block):
    tissue = particle_tissue(block)
    solver = Solver(tissue)
    n = tissue.body.count
    body = (4 * 3 + 1) * 4 * n
    self_contacts = SelfContacts(tissue, 0.25)
    grown = Solver(tissue, self_contacts=self_contacts)
    own = 4 * (2**15 + 1 + 2**15 + 3 * n + 24 * n + 3 * n + 1)
    assert 1e6 * (memory_mb(grown) - memory_mb(solver)) == pytest.approx(own)
    # What a body of particles takes, and its model not less.
    assert 1e6 * memory_mb(solver) > 2 * body


def test_the_command_writes_table_figure_and_json(tmp_path, monkeypatch, capsys):
    small = setup_of("shape-matching", radius_mm=4.0)
    monkeypatch.setattr(study, "load_patient", lambda _: (briefly(20), small_anatomy()))
    monkeypatch.setattr(step_timing, "PAPERS", small)
    monkeypatch.setattr(step_timing, "_setups", lambda quick: [small])
    monkeypatch.setattr(step_timing, "QUICK_COUNTS", [64])
    monkeypatch.setattr(step_timing, "QUICK_SHARE", 0.02)
    monkeypatch.setattr(lower_bound, "ROUNDS", 2)
    assert app.main(["study", "timing", "--quick", "--out", str(tmp_path)]) == 0
    report, rows = written(tmp_path, "timing")
    assert [case["model"] for case in report["cases"]] == ["shape-matching"]
    assert [size["model"] for size in report["sizes"]] == ["neo-hookean", "shape-matching"]
    for case in report["cases"] + report["sizes"]:
        ms = case["ms"]
        assert 0 < ms["min"] <= ms["median"] <= ms["max"] and ms["sd"] >= 0
        assert case["memory_mb"] > 0 and case["arch"] == report["arch"]
    matched = report["cases"][0]
    assert matched["radius_mm"] == 4.0 and matched["memberships"] > matched["particles"] > 100
    assert matched["bound_ms"] == report["bound_ms"]
    assert set(matched["phases_ms"]) >= {"find contacts", "fit clusters", "average goals", "keep out"}
    assert [size["particles"] for size in report["sizes"]] == [64, 64]
    assert len(rows) == 3 and float(rows[0]["median_ms"]) == matched["ms"]["median"]
    printed = capsys.readouterr().out
    assert f"{matched['ms']['median']:.2f}" in printed and "Table 5" in printed
