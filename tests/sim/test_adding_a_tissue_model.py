"""The example of docs/adding-a-tissue-model.md, taken from the page, passes the tests of every tissue
model.
"""

import re
import sys
from collections.abc import Iterator
from importlib.util import module_from_spec, spec_from_file_location

import numpy as np
import pytest
import taichi as ti
import test_tissue_models as every
from conftest import ROOT

import scenes.tissue
from rehearsal.build_solver import TISSUE_MODELS
from rehearsal.configuration import setup_of
from scenes.scene import Scene, SceneError, load_scene
from sim.body import BodyState, ParticleBody
from sim.device import start
from sim.sampling import RestBody
from sim.solver import Solver, StepSettings

PAGE = (ROOT / "docs" / "adding-a-tissue-model.md").read_text("utf-8")
FILE, SECTION, TEST = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
MODEL = "mass-spring"


@pytest.fixture(scope="module")
def added(tmp_path_factory) -> Iterator[type]:
    """Both pieces where the page has them go; the model's class."""
    with pytest.MonkeyPatch.context() as patch:
        path = tmp_path_factory.mktemp("sim") / "mass_spring.py"
        path.write_text(FILE, "utf-8")
        spec = spec_from_file_location("sim.mass_spring", path)
        module = module_from_spec(spec)
        patch.setitem(sys.modules, spec.name, module)
        spec.loader.exec_module(module)
        names = dict(vars(scenes.tissue))
        exec(SECTION, names)
        patch.setitem(scenes.tissue.TISSUES, MODEL, names["MassSpringTissue"])
        patch.setitem(TISSUE_MODELS, MODEL, module.MassSpring)
        start("cpu")
        yield module.MassSpring
        ti.reset()


@pytest.fixture(scope="module")
def laid(added) -> every.Subject:
    return every.ball_of(MODEL, True)


def test_a_scene_can_use_it_and_wrong_values_are_named(added, tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(f"[anatomy]\n[tissue]\nmodel = '{MODEL}'\nstiffness = 0.5", "utf-8")
    scene = load_scene(path)
    assert scene.tissue.stiffness == 0.5 and Scene.model_validate(scene.model_dump()) == scene
    path.write_text(f"[anatomy]\n[tissue]\nmodel = '{MODEL}'\nradius_mm = 99", "utf-8")
    with pytest.raises(SceneError, match=r"tissue.radius_mm = 99: input should be less than or equal to 20"):
        load_scene(path)
    assert setup_of(MODEL, iterations=7).substeps == 12


def test_it_passes_the_tests_of_every_model(laid):
    free = every.ball_of(MODEL, False)
    for test in (every.test_it_reports_its_size, every.test_it_falls_freely):
        test(free)
        free.solver.restore(free.built)
    every.test_attached_points_move_with_the_body(free)
    every.test_pressed_it_deforms_and_recovers(laid)
    laid.solver.restore(laid.built)
    every.test_a_restored_state_continues_with_the_same_bits(laid)


def test_its_own_test_passes(added):
    names = dict(BodyState=BodyState, MassSpring=added, ParticleBody=ParticleBody, RestBody=RestBody)
    names |= dict(Solver=Solver, StepSettings=StepSettings, np=np, pytest=pytest)
    exec(TEST, names)
    (test,) = (function for name, function in names.items() if name.startswith("test_"))
    test()
