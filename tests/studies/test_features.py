"""A scene pays only for what it declares: what is off is neither compiled nor allocated; and a soak ends
as it began.
"""

import functools

import pytest
import taichi as ti
from small_bead_case import briefly, small_anatomy
from study_runs import written

import app
from rehearsal.configuration import PRESETS, setup_of
from sim.capsule import Capsule
from sim.device import start
from sim.particle_contact import ShapeContacts
from sim.self_contact import SelfContacts
from sim.shape_matching import ShapeMatching
from sim.shapes import ConvexTool, SignedDistanceField
from sim.solver import Solver
from sim.surface_contact import SurfaceContacts
from sim.viscoelasticity import Relaxation
from studies import study
from studies.harness import memory_mb
from studies.performance import feature_costs
from studies.robustness import soak_study

SETUPS = {
    "neo-hookean": setup_of("neo-hookean", cell_mm=6.0),
    "shape-matching": setup_of("shape-matching", radius_mm=4.0),
}
# What only the feature has kernels use.
OWN = {
    "contact with the support": [(SignedDistanceField, "surface"), (SignedDistanceField, "clearance")],
    "the transducer": [(ConvexTool, "surface"), (ConvexTool, "motion")],
    "friction on shapes": [(SurfaceContacts, "tangential_slip"), (ShapeContacts, "friction_change")],
    "contacts of particles": [(SelfContacts, "find"), (SelfContacts, "project")],
    "capsule": [(Capsule, "begin"), (Capsule, "node_force"), (Capsule, "follow")],
    "relaxation, one term": [(Relaxation, "begin"), (Relaxation, "finish")],
    "scaled masses": [(ShapeMatching, "update_patch_masses"), (ShapeMatching, "update_cluster_masses")],
}
# Options, and the features that none of them has.
WITHOUT = (
    (
        feature_costs.Options(support=False, transducer=False),
        (
            "capsule",
            "relaxation, one term",
            "contact with the support",
            "the transducer",
            "friction on shapes",
        ),
    ),
    (
        feature_costs.Options(shape_friction=0.0),
        ("friction on shapes", "contacts of particles", "scaled masses"),
    ),
)


def body_of(model: str) -> feature_costs.FeatureBody:
    # Without a warm-up the rehearsal of which it is made compiles no step.
    return feature_costs.FeatureBody(briefly(0), small_anatomy(), SETUPS[model], "cpu")


@pytest.mark.parametrize("model", list(feature_costs.FEATURES))
@pytest.mark.filterwarnings("ignore:.*Calling non-taichi function:SyntaxWarning")
def test_what_is_off_is_not_compiled_and_not_allocated(monkeypatch, model):
    # What other tests have compiled would not be compiled again.
    ti.reset()
    start("cpu")
    body = body_of(model)

    # Where one solver serves two features, what the first needs is what it has not compiled yet.
    @functools.cache
    def solver_of(options: feature_costs.Options) -> Solver:
        with monkeypatch.context() as quick:
            # A kernel of its own in each solver, which no feature changes; the body is at rest.
            quick.setattr(ShapeMatching, "update_frames", lambda _: None)
            return body.solver(options)

    def compiled(*_):
        raise AssertionError("compiled")

    for feature, both in feature_costs.FEATURES[model].items():
        if feature in OWN:
            on, off = map(solver_of, both)
            assert memory_mb(off) < memory_mb(on), feature
            with monkeypatch.context() as forbidden:
                for owner, name in OWN[feature]:
                    forbidden.setattr(owner, name, compiled)
                with pytest.raises(ti.TaichiCompilationError, match="compiled"):
                    on.step(body.settings, body.poses(0))
    for options, names in WITHOUT:
        off = solver_of(options)
        with monkeypatch.context() as forbidden:
            for owner, method in [part for name in names for part in OWN[name]]:
                forbidden.setattr(owner, method, compiled)
            forbidden.setattr(ShapeMatching, "update_frames", lambda _: None)
            off.step(body.settings, body.poses(0))


def test_kernels_are_counted_where_a_step_is_parallel(device):
    body = body_of("shape-matching")
    base = feature_costs.kernels_of(body, feature_costs.BASE, "cpu")
    # Every iteration launches its own kernels.
    assert base["launches"] > body.settings.substeps * body.settings.iterations
    assert base["launches"] > base["kernels"] > 10


def test_the_command_writes_table_figure_and_json(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(study, "load_patient", lambda _: (briefly(0), small_anatomy()))
    monkeypatch.setattr(feature_costs, "SETTLE_STEPS", 3)
    monkeypatch.setattr(feature_costs, "PRESS_STEPS", 3)
    monkeypatch.setitem(
        feature_costs.FEATURES,
        "neo-hookean",
        {"friction on shapes": feature_costs.EVERYWHERE["friction on shapes"]},
    )
    assert app.main(["study", "features", "--quick", "--out", str(tmp_path)]) == 0
    report, rows = written(tmp_path, "features")
    names = ["friction on shapes", "divergence check", "organ's surface"]
    assert [row["feature"] for row in report["features"]] == [row["feature"] for row in rows] == names
    for row in report["features"]:
        assert row["mb_on"] > row["mb_off"] and row["ms_on"] > 0
    assert "what is off" not in capsys.readouterr().out


def test_a_soak_ends_where_it_began_and_replays(monkeypatch):
    setup = PRESETS["neo-hookean"]["fast"]
    monkeypatch.setattr(soak_study, "REST_S", 3.0)
    monkeypatch.setattr(soak_study, "REPLAYED_MINUTES", 1)
    done = []
    found = soak_study.run_soak(briefly(60), small_anatomy(), setup, 2, 5.0, "cpu", lambda: done.append(1))
    assert len(found["minutes"]) == 2 and len(done) == 3
    assert found["replay_equal"] and found["reset_equal"] and found["fallbacks"] == 0
    for row in found["minutes"]:
        assert row["finite"] and row["shape_mm"] < 1.0 and abs(row["volume_ratio"] - 1) < 0.1
    assert found["minutes"][0]["moved_mm"] != found["minutes"][1]["moved_mm"]
    ti.reset()
