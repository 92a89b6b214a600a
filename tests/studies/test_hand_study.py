"""A hand that moves fast and at random over a small organ, and one that only looks."""

import csv
import json

import numpy as np
import pytest
from small_bead_case import briefly, small_anatomy

import app
from rehearsal.case import case_of
from rehearsal.rehearsal import Rehearsal
from studies import study
from studies.robustness import hand_study
from ultrasound.probe_manipulator import advanced


@pytest.mark.usefixtures("arrays_stored")
def test_a_random_hand_is_measured_and_leaves_the_organ_where_it_was(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(study, "load_patient", lambda _: (briefly(40), small_anatomy()))
    monkeypatch.setattr(hand_study, "LOOKS", 4)
    assert app.main(["study", "hand", "--quick", "--arch", "cpu", "--out", str(tmp_path)]) == 0
    (run,) = json.loads((tmp_path / "hand.json").read_text())["runs"]
    with (tmp_path / "hand.csv").open(newline="", encoding="utf-8") as file:
        assert len(list(csv.DictReader(file))) == 1
    assert run["steps"] == 120 and run["finite"] and run["coupled_apart"] == 0
    assert 0 < run["penetration_mm"] < 10 and run["force_n"] > 0.5 and run["lag_mm"] > 5
    assert run["look_force_n"] <= 0.2 and run["look_shift_mm"] <= 0.3
    assert "fast" in capsys.readouterr().out


def test_the_hand_is_the_same_each_time_and_does_all_that_hands_do(one_device, monkeypatch):
    anatomy = small_anatomy()
    rehearsal = Rehearsal(case_of(briefly(5), anatomy), anatomy)
    monkeypatch.setattr(hand_study, "LONGEST_S", 0.2)
    first, again = [], []
    for hands in (first, again):
        rehearsal.reset()
        rehearsal.manipulator.state = type(rehearsal.manipulator.state)()
        hands += hand_study.random_hand(rehearsal, 4.0)
    assert all((a == b).all() and p == q for (a, p), (b, q) in zip(first, again, strict=True))
    poses = np.array([pose for pose, _ in first])
    jumps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert jumps.max() > 10 and jumps.max() <= 2 * hand_study.AROUND_MM
    assert {presses for _, presses in first} == {True, False}


def test_an_array_that_is_coupled_from_afar_is_counted(one_device, monkeypatch):
    anatomy = small_anatomy()
    rehearsal = Rehearsal(case_of(briefly(5), anatomy), anatomy)
    coupling = hand_study.ArrayCoupling(rehearsal)
    rehearsal.organ.place(advanced(rehearsal.organ.pose, -30.0))
    rehearsal.show()
    assert not coupling.is_apart()
    every = np.ones(rehearsal.case.probe.number_of_scanlines, bool)
    monkeypatch.setattr(coupling.coverage, "add", lambda *_: every)
    assert coupling.is_apart() == (rehearsal.anatomy.scanner is not None)
