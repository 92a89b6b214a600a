"""The report of a run: of tissue that was lost it has no figures, and says so."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from plan_ball import case_of_ball, frame_at

from rehearsal.build_solver import step_settings
from rehearsal.configuration import probe_of
from rehearsal.loop.command import Undo
from rehearsal.loop.frame import Applied, Event, Frame, Step
from rehearsal.measurements import run_report
from rehearsal.measurements.run_report import Tally, summary
from scenes.scene import EMBEDDED, load_scene
from sim.material import Material, Part

SCENE = load_scene(EMBEDDED)
WRENCH = np.array([0.0, 0.3, -0.4, 1.0, 2.0, 3.0])


def rehearsed(
    volume: float, penetration_mm: float, indentation_mm: float, share: float = 0.5
) -> SimpleNamespace:
    """What a tally asks of a rehearsal."""
    return SimpleNamespace(
        case=case_of_ball(scene=SCENE, probe=probe_of(SCENE)),
        organ=SimpleNamespace(
            settings=step_settings(SCENE.tissue, SCENE.solver),
            model=SimpleNamespace(counts=lambda: dict(particles=4, nodes=4, cells=1)),
            parts_of_tissue=[Part("tumour", None, Material(60.0, 0.4))],
            steps=2,
        ),
        anatomy=SimpleNamespace(
            embedding=SimpleNamespace(count=6), volume_ratio=lambda: volume, penetration_mm=penetration_mm
        ),
        indentation_mm=lambda: indentation_mm,
        frame=SimpleNamespace(wrench=WRENCH / 2, sliding_share=share, friction_ratio=0.25),
    )


def frame_of(wrench: np.ndarray, *events: Event, last_mm: float = 0.0) -> Frame:
    """The tissue is four points, the last of which may be lost."""
    positions = np.zeros((4, 3))
    positions[3, 1] = last_mm
    hand = np.eye(4)
    hand[0, 3] = 3.0
    return replace(frame_at(np.eye(4), 1, 0.0, *events), hand=hand, positions=positions, wrench=wrench)


STEP = Step(0, np.eye(4), np.eye(4), 0.01, 4, 1.0)


@pytest.mark.parametrize("lost", [None, np.nan, np.inf])
def test_figures_are_those_of_tissue_that_is_there(lost, monkeypatch):
    monkeypatch.setattr(run_report, "penetration_of", lambda anatomy: anatomy.penetration_mm)
    tally, later = Tally(1.0), rehearsed(0.99, 0.1, 1.5)
    tally.add(rehearsed(0.97, 0.25, 3.5), frame_of(WRENCH, STEP))
    tally.add(later, frame_of(WRENCH / 2, STEP))
    # What was restored is no press, and the divergence check's notice is kept.
    tally.add(rehearsed(0.5, 9.0, 9.0), frame_of(9 * WRENCH, STEP, Applied(1, Undo(), restored=0)))
    tally.add(rehearsed(0.5, 9.0, 9.0), frame_of(9 * WRENCH))
    tally.add(later, frame_of(WRENCH / 2, replace(STEP, notice="restored")))
    if lost is not None:
        tally.add(rehearsed(lost, 0.0, lost), frame_of(WRENCH, STEP, last_mm=lost))
    report = tally.report(later, "cpu")
    json.dumps(report, allow_nan=False)
    assert report["max_lag_mm"] == 3.0 and report["penetration_mm"] == (0.1 if lost is None else None)
    names = "volume_ratio_min", "max_penetration_mm", "indentation_max_mm"
    assert [report[name] for name in names] == ([0.97, 0.25, 3.5] if lost is None else [None] * 3)
    assert report["force_max_n"] == (0.5 if lost is None else None)
    assert report["probe_force_n"] == ([0.0, 0.15, -0.2] if lost is None else None)
    assert report["probe_torque_n_mm"] == ([0.5, 1.0, 1.5] if lost is None else None)
    assert report["friction_ratio"] == (0.25 if lost is None else None)
    assert report["fallbacks"] == ["restored"]
    # The first of each compiles kernels.
    tally.step_ms, tally.slice_ms = [900.0, 4.0, 5.5, 70.0], [800.0, 7.25]
    speed = "5.5 ms per step, 7.2 ms per image (medians of 2) on cpu; built in 1.0 s"
    assert f"speed     {speed}" in summary(tally.report(later, "cpu"))
    assert "parts     tumour 60 kPa (nu 0.4)" in summary(report)
    (press,) = (line for line in summary(report).splitlines() if line.startswith("press"))
    figures = (
        "indentation 3.50 mm at most, force 0.50 N at most; least volume 97.0 %; "
        "penetration at most 0.250 mm; all finite; the probe at most 3.0 mm behind the hand"
    )
    slipped = summary(tally.report(rehearsed(0.99, 0.1, 1.5, share=0.75), "cpu"))
    assert ("force 0.50 N at most, 75 % of the contact slides;" in slipped) == (lost is None)
    gone = "NOT FINITE: the tissue diverged, and there are no figures of it"
    assert press.removeprefix("press").strip() == (figures if lost is None else gone)
