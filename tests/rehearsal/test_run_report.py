"""The report of a run: of tissue that was lost it has no figures, and says so."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from rehearsal.build_solver import step_settings
from rehearsal.configuration import probe_of
from rehearsal.measurements.run_report import Tally, summary
from scenes.scene import EMBEDDED, load_scene
from sim.fields import field_of, fill
from sim.material import Material, Part

SCENE = load_scene(EMBEDDED)


def rehearsed() -> SimpleNamespace:
    """What a tally asks of a rehearsal."""
    return SimpleNamespace(
        scene=SCENE,
        settings=step_settings(SCENE.tissue, SCENE.solver),
        probe=probe_of(SCENE),
        model=SimpleNamespace(counts=lambda: dict(particles=4, nodes=4, cells=1)),
        embedding=SimpleNamespace(count=6),
        body=SimpleNamespace(position=field_of(np.zeros((4, 3)), 1)),
        contacts=SimpleNamespace(measure_penetration=lambda: 0.25),
        volume_ratio=lambda: 0.97,
        indentation_mm=lambda: 3.5,
        wrench=lambda: np.array([0.0, 0.3, -0.4, 1.0, 2.0, 3.0]),
        parts_of_tissue=[Part("tumour", None, Material(60.0, 0.4))],
        notice="",
        steps=2,
    )


@pytest.mark.parametrize("lost", [None, np.nan, np.inf])
def test_figures_are_those_of_tissue_that_is_there(one_device, lost):
    rehearsal, tally = rehearsed(), Tally(1.0)
    tally.watch(rehearsal)
    # Later it is pressed less.
    rehearsal.volume_ratio, rehearsal.indentation_mm = (lambda: 0.99), (lambda: 1.5)
    rehearsal.contacts.measure_penetration = lambda: 0.1
    rehearsal.wrench = lambda: np.array([0.0, 0.15, -0.2, 1.0, 2.0, 3.0])
    tally.watch(rehearsal)
    if lost is not None:
        places = np.zeros((4, 3))
        places[3, 1] = lost
        fill((rehearsal.body.position, places))
        rehearsal.volume_ratio = rehearsal.indentation_mm = lambda: lost
        tally.watch(rehearsal)
    report = tally.report(rehearsal, "cpu")
    json.dumps(report, allow_nan=False)
    names = "volume_ratio_min", "max_penetration_mm", "indentation_max_mm"
    assert [report[name] for name in names] == ([0.97, 0.25, 3.5] if lost is None else [None] * 3)
    assert report["force_max_n"] == (0.5 if lost is None else None)
    assert report["probe_force_n"] == ([0.0, 0.15, -0.2] if lost is None else None)
    assert report["probe_torque_n_mm"] == ([1.0, 2.0, 3.0] if lost is None else None)
    # The first of each compiles kernels.
    tally.step_ms, tally.slice_ms = [900.0, 4.0, 5.5, 70.0], [800.0, 7.25]
    speed = "5.5 ms per step, 7.2 ms per image (medians of 2) on cpu; built in 1.0 s"
    assert f"speed     {speed}" in summary(tally.report(rehearsal, "cpu"))
    assert "parts     tumour 60 kPa (nu 0.4)" in summary(report)
    (press,) = (line for line in summary(report).splitlines() if line.startswith("press"))
    figures = "indentation 3.50 mm at most, force 0.50 N at most; least volume 97.0 %; penetration at most 0.250 mm; all finite"
    gone = "NOT FINITE: the tissue diverged, and there are no figures of it"
    assert press.removeprefix("press").strip() == (figures if lost is None else gone)
