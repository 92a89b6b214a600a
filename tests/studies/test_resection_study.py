"""The study of the resection: its voxels against closed forms, what counts as a failure, and what the
command writes.
"""

import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from coarse_patient import coarse_patient
from cut_ball import R, ball, cap_mm3, cut_by, half_space
from small_bead_case import write_case
from study_runs import refusal

import app
from rehearsal.configuration import setup_of
from rehearsal.resection.cut import CutSettings
from sim.removed_tissue import RemovedTissue
from studies.accuracy.bead_case import load_case
from studies.harness import positions_of
from studies.resection import resection_command
from studies.resection.cut_balance import BalanceRow, CutBeadExperiment, CutCase
from studies.resection.planned_cuts import MarginRow, line_over, margin_rows
from studies.resection.random_cuts import (
    KINDS,
    RandomResult,
    ScoredPatient,
    random_results,
    random_score,
    summary,
    surface_faults,
)
from studies.resection.voxel_margins import (
    VOXEL_MM,
    CutFigures,
    RasterGrid,
    figures_by_voxels,
    signed_distance_map,
)

pytestmark = pytest.mark.usefixtures("arrays_stored")

ORGAN = ball(R)
FIGURES = CutFigures(3.0, 4.0, 100.0, 10.0, 0.0, 5.0)


@pytest.mark.parametrize("surface", [ball(9.0), trimesh.creation.box([10.0, 8.0, 6.0])])
def test_voxels_inside_a_surface_have_its_volume(surface):
    grid = RasterGrid.around([surface], VOXEL_MM, 1.0)
    inside = grid.inside(surface)
    # Each voxel at the surface is off by up to half, at random: the error of their sum grows as the root of
    # their number. Faces along the voxels are off together, by up to half a voxel on each side.
    along = np.asarray(surface.area) * VOXEL_MM / 2 if len(surface.faces) == 12 else 0.0
    at_random = 3 * VOXEL_MM**3 * np.sqrt(surface.area / VOXEL_MM**2) / 2
    assert inside.sum() * VOXEL_MM**3 == pytest.approx(surface.volume, abs=along + at_random)
    centres = grid.low_mm + VOXEL_MM * np.argwhere(inside)
    assert (centres >= surface.bounds[0]).all() and (centres <= surface.bounds[1]).all()


def test_the_distance_map_is_the_distance_from_a_ball():
    grid = RasterGrid.around([ball(9.0)], VOXEL_MM, 4.0)
    inside = grid.inside(ball(9.0))
    index = np.stack(np.indices(inside.shape), axis=-1)
    exact = np.linalg.norm(grid.low_mm + VOXEL_MM * index, axis=-1) - 9.0
    found = signed_distance_map(inside, VOXEL_MM)
    assert ((found < 0) == inside).all()
    # A voxel of the surface has a neighbour on its other side: it is within the diagonal of a voxel of it,
    # and half a voxel in the mean.
    error = np.abs(found - exact)
    assert error.max() < VOXEL_MM * np.sqrt(3) and error.mean() < VOXEL_MM / 2


def test_figures_by_voxels_of_concentric_balls_are_closed_forms():
    specimen, tumour = ball(14.0), ball(9.0)
    found = figures_by_voxels(cut_by(ORGAN, specimen), ORGAN, tumour, {})
    assert found.margin_mean_mm == pytest.approx(5.0, abs=VOXEL_MM / 2)
    assert found.margin_min_mm == pytest.approx(5.0, abs=VOXEL_MM)
    assert found.specimen_ml == pytest.approx(specimen.volume / 1000, rel=2e-3)
    assert found.parenchyma_ml == pytest.approx((specimen.volume - tumour.volume) / 1000, rel=2e-3)
    assert found.tumour_left_ml == 0 and found.below_5_mm2 < specimen.area
    all_below = figures_by_voxels(cut_by(ORGAN, specimen), ORGAN, ball(10.0), {})
    assert all_below.below_5_mm2 == pytest.approx(specimen.area, rel=0.01)


def test_figures_by_voxels_of_a_plane_through_the_tumour():
    tumour, urine = ball(9.0), ball(4.0, (0.0, 16.0, 12.0))
    found = figures_by_voxels(cut_by(ORGAN, half_space(3.0)), ORGAN, tumour, dict(urine=urine))
    assert found.margin_min_mm == 0.0
    # The plane is across the voxels: off by up to half of one together.
    assert found.tumour_left_ml == pytest.approx(cap_mm3(9.0, 12.0) / 1000, abs=np.pi * 72 * VOXEL_MM / 2000)
    removed = cap_mm3(R, R - 3.0) - cap_mm3(9.0, 6.0) - urine.volume
    assert found.parenchyma_ml == pytest.approx(removed / 1000, abs=np.pi * 891 * VOXEL_MM / 2000)


def row(**changed) -> MarginRow:
    ours = CutFigures(**(vars(FIGURES) | changed))
    return MarginRow("p", "around", CutSettings("wedge", 3.0), ours, FIGURES, tumour_ml=8.0)


@pytest.mark.parametrize(
    ("changed", "within"),
    [
        (dict(margin_min_mm=3.29), True),
        (dict(margin_min_mm=2.69), False),
        (dict(margin_mean_mm=4.31), False),
        (dict(specimen_ml=10.19), True),
        (dict(specimen_ml=9.79), False),
        (dict(tumour_left_ml=0.15), True),
        (dict(tumour_left_ml=0.17), False),
        (dict(parenchyma_ml=5.11), False),
    ],
)
def test_a_row_is_judged_by_its_bars(changed, within):
    assert row(**changed).is_within == within
    assert row(**changed).described()["within"] == ("yes" if within else "no")


def test_a_patient_without_a_tumour_has_no_margins():
    assert list(margin_rows("p", SimpleNamespace(organ=ORGAN, tumour=None, parts={}))) == []


def test_the_line_around_a_tumour_is_seen_along_its_own_direction():
    line = line_over(ORGAN, ball(7.0, (0.0, 12.0, 18.0)), 3.0)
    out = np.array([0.0, 12.0, 18.0]) / np.hypot(12, 18)
    assert line.direction @ out > 0.995


def test_surfaces_with_holes_or_in_pieces_are_faults():
    cut = cut_by(ORGAN, half_space(10.0))
    assert surface_faults(cut, ORGAN) == []
    open_one = trimesh.Trimesh(cut.specimen.vertices, cut.specimen.faces[1:], process=False)
    two = trimesh.util.concatenate([cut.remnant, ball(1.0, (0.0, 0.0, 60.0))])
    whole = SimpleNamespace(specimen=open_one, remnant=two)
    assert surface_faults(whole, ORGAN) == ["the specimen is not closed", "the remnant has 2 pieces"]
    lost = SimpleNamespace(specimen=ball(10.0), remnant=cut.remnant)
    (fault,) = surface_faults(lost, ORGAN)
    assert "of the organ's volume at rest" in fault


@pytest.mark.parametrize("kind", KINDS)
def test_random_scores_are_of_all_kinds_and_the_same_for_a_seed(kind):
    patient = ScoredPatient(ORGAN, ball(7.0, (0.0, 12.0, 18.0)), np.array([R, 0.0, 0.0]))
    score = next(s for s in (random_score(patient, seed) for seed in range(1, 400, 2)) if s.kind == kind)
    seed = next(seed for seed in range(1, 400, 2) if random_score(patient, seed).kind == kind)
    again = random_score(patient, seed)
    np.testing.assert_array_equal(again.marks, score.marks)
    assert again.settings == score.settings and (again.seen == score.seen).all()
    assert len(again.seen) == len(patient.tumour.vertices)


def test_a_patient_without_a_tumour_is_cut_to_a_depth():
    patient = ScoredPatient(ORGAN, None, np.array([R, 0.0, 0.0]))
    scores = [random_score(patient, seed) for seed in range(30)]
    assert all(score.settings.depth_mm is not None and score.seen.shape == (0,) for score in scores)
    assert "around" not in {score.kind for score in scores} and len({score.kind for score in scores}) > 2


def test_the_summary_counts_reasons_without_their_numbers_and_lists_failures():
    results = [
        RandomResult("p", 1, "tiny", refused="the cut removes only 0.02 ml"),
        RandomResult("p", 2, "tiny", refused="the cut removes only 0.01 ml"),
        RandomResult("p", 3, "around", specimen_ml=3.0, volume_change_percent=0.1),
        RandomResult("q", 4, "half", faults=("the remnant is not closed",)),
    ]
    lines = summary(results).splitlines()
    assert lines[0] == "4 random scores: 2 cut, 2 refused, 1 failed"
    assert lines[1].strip() == "2 refused: the cut removes only N ml"
    assert "q, seed 4 (half): the remnant is not closed" in lines[2] and len(lines) == 3


def test_random_cuts_of_a_patient_are_refused_or_without_fault(device, monkeypatch):
    rehearsal = coarse_patient()[0]
    seeds = [0, 1, 3]
    found = list(random_results("p", rehearsal, seeds))
    assert [each.seed for each in found] == seeds and not any(each.faults for each in found)
    assert {bool(each.refused) for each in found} == {True, False}
    made = next(each for each in found if not each.refused)
    assert made.specimen_ml > 0.1 and abs(made.volume_change_percent) < 0.5
    # What is wrong is seen, and an error of the program is one of its faults.
    monkeypatch.setattr("studies.resection.random_cuts.VOLUME_BAR", -1.0)
    (again,) = random_results("p", rehearsal, [made.seed])
    assert any("of the organ's volume" in fault for fault in again.faults)
    monkeypatch.setattr(rehearsal, "advance", lambda pose: 1 / 0)
    (broken,) = random_results("p", rehearsal, [made.seed])
    assert broken.faults == ("ZeroDivisionError: division by zero",)


def test_tissue_is_removed_before_or_after_the_organ_settles(device, tmp_path):
    case = load_case(write_case(tmp_path))
    cut = cut_by(case.organ, half_space(8.0))
    removed = CutCase(case, RemovedTissue(cut.specimen, cut.remnant, cut.on_remnant))
    setup = setup_of("neo-hookean", cell_mm=4.0, warm_up_steps=30, stage_steps=6)
    rests = []
    for settles_first in (False, True):
        experiment = CutBeadExperiment(removed, setup, settles_first)
        whole = experiment.model.lattice.tissue.sum()
        experiment.prepare(setup)
        left = experiment.model.lattice.tissue.sum()
        assert left / whole == pytest.approx(cut.remnant.volume / case.organ.volume, rel=0.02)
        rests.append(positions_of(experiment.solver)[:, 2].mean())
    # The same tissue at rest in the same bowl, but for friction: less than the sag of the whole.
    assert rests[0] == pytest.approx(rests[1], abs=0.3)


def test_balance_is_within_only_if_each_stage_is():
    case = SimpleNamespace(
        beads=np.zeros((2, 3)), indentation_mm=np.array([0.0, 6.0]), measured=np.zeros((2, 2, 3))
    )
    assert BalanceRow("whole", None, case, np.array([[0.1, 0.18], [0.1, 0.1]])).is_within
    assert not BalanceRow("whole", None, case, np.array([[0.1, 0.1], [0.1, 0.22]])).is_within


def test_the_command_writes_what_it_prints(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(resection_command, "margin_rows", lambda name, anatomy: [row(), row(specimen_ml=9.0)])
    assert app.main(["study", "resection", "--part", "margins", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert "1 of 2 within 0.3 mm and 2 %" in printed and "3.00 / 3.00" in printed
    report = json.loads((tmp_path / "resection.json").read_text())
    assert list(report) == ["margins"]
    assert [each["within"] for each in report["margins"]["rows"]] == ["yes", "no"]
    assert report["margins"]["rows"][1]["ours"]["specimen_ml"] == 9.0


def test_without_finite_elements_it_says_how_to_install_them(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "mmgpy", None)
    line = refusal(capsys, "study", "resection", "--part", "balance", "--out", tmp_path / "out")
    assert "mmgpy" in line and "requirements-dev.txt" in line
    assert not (tmp_path / "out").exists()
