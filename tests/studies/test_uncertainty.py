"""The study of uncertainty: what is varied, its bands and indices against a known function, and the
panel's bands.
"""

import re

import numpy as np
import pytest
import trimesh
from small_bead_case import briefly, small_anatomy
from study_runs import refusal, written

import app
from rehearsal.input_files import InputFiles, check_anatomy
from rehearsal.measurements.live_measurements import LiveMeasurements
from rehearsal.measurements.tumour_measurements import Measurement
from rehearsal.measurements.uncertainty_bands import UncertaintyBands, UncertaintyError, read_bands
from rehearsal.worker_processes import Workers
from scenes.anatomy import LoadedAnatomy
from scenes.mechanical_tissues import mechanical_properties
from scenes.scene import Attachment, Scene, with_options
from sim.fields import array_of
from studies.harness import rehearsal_of
from studies.uncertainty import uncertainty_command
from studies.uncertainty.uncertainty_command import POSITION, bands_of, indices_of, samples_of
from studies.uncertainty.unknowns import (
    QUANTITIES,
    PressProblem,
    Unknown,
    press_outcome,
    set_values,
    unknowns_of,
    with_all_parts,
)


def patient() -> LoadedAnatomy:
    """A ball in a bowl, with a tumour on its back and a cyst."""
    ball = small_anatomy()
    tumour = trimesh.creation.icosphere(subdivisions=2, radius=4.0).apply_translation([0.0, 5.0, 0.0])
    cyst = trimesh.creation.icosphere(subdivisions=2, radius=2.0).apply_translation([6.0, -3.0, 0.0])
    return LoadedAnatomy(ball.organ, tumour, None, ball.shapes, parts={"cyst": cyst})


def scene() -> Scene:
    held = Attachment(at_mm=(-12.0, 0.0, 0.0), radius_mm=5.0, stiffness_n_mm=1.0, fat_kpa_mm=0.2)
    tissue = briefly(20).tissue.model_copy(update=dict(cell_mm=4.0, capsule_n_mm=0.3))
    press = briefly(20).press.model_copy(update=dict(indentations_mm=(1.0, 2.0), stage_steps=15))
    asked = briefly(20).model_copy(update=dict(attachment=held, tissue=tissue, press=press))
    return with_all_parts(asked, patient())


@pytest.fixture(scope="module")
def problem() -> PressProblem:
    return PressProblem(scene(), patient(), "one")


def test_what_is_declared_or_has_a_surface_is_varied_over_the_tables_range():
    found = {each.name: each for each in unknowns_of(scene(), patient())}
    # The cyst is fluid: it has no stiffness to vary.
    assert list(found) == [
        "kidney modulus",
        "kidney Poisson's ratio",
        "tumour modulus",
        "capsule",
        "pedicle",
        "fat",
        "friction",
    ]
    table = mechanical_properties()
    tumour = found["tumour modulus"]
    assert (tumour.low, tumour.typical, tumour.high) == table.parts["tumour"].young_kpa
    assert tumour.value(0.5) == pytest.approx((tumour.low * tumour.high) ** 0.5)
    poisson = found["kidney Poisson's ratio"]
    assert poisson.value(0.5) == pytest.approx((poisson.low + poisson.high) / 2)
    plain = briefly(20).model_copy(update=dict(attachment=Attachment()))
    assert [each.name for each in unknowns_of(plain, small_anatomy())] == [
        "kidney modulus",
        "kidney Poisson's ratio",
        "friction",
    ]


def test_values_reach_the_solver(device, problem):
    at_once = problem.scene.press.model_copy(update=dict(warm_up_steps=0))
    rehearsal = rehearsal_of(problem.scene.model_copy(update=dict(press=at_once)), problem.anatomy)
    model = rehearsal.organ.model
    tether, weight = array_of(model.tether), array_of(model.capsule.weight)
    values = {
        "kidney modulus": 7.0,
        "kidney Poisson's ratio": 0.4,
        "tumour modulus": 20.0,
        "capsule": 0.6,
        "friction": 0.2,
    }
    set_values(rehearsal, values | {"pedicle": 2.0, "fat": 0.4})
    assert (model.material.young_kpa, model.material.poisson) == (7.0, 0.4)
    assert [part.young_kpa for part in model.parts] == [0.3, 20.0]
    assert array_of(model.capsule.weight) == pytest.approx(2 * weight) and array_of(
        model.tether
    ) == pytest.approx(2 * tether)
    assert rehearsal.organ.contacts.coefficient == pytest.approx(0.2)


@pytest.mark.usefixtures("nothing_built")
def test_an_outcome_depends_on_its_values_alone_here_and_on_a_cluster(problem, cluster):
    usual, stiff = {"kidney modulus": 10.0}, {"kidney modulus": 20.0}
    first = press_outcome(problem, usual)
    other = press_outcome(problem, stiff)
    with Workers(dask=cluster) as workers:
        sent = workers.share(problem)
        found = list(workers.map(press_outcome, [(sent, stiff), (sent, usual)]))
    assert np.array_equal(found, [other, first])
    force = QUANTITIES.index("force_n")
    assert first.shape == (2, len(QUANTITIES) + 3) and first[1, force] > first[0, force] > 0
    assert 1.4 < other[1, force] / first[1, force] < 2.1


def test_bands_and_indices_are_those_of_a_known_function():
    """y = a + 4 b + 0 c over uniform parameters where the press is deepest, and 2 a + 0 b + c before:
    additive variances.
    """
    unknowns = [Unknown(name, "", 0.0, 0.5, 1.0, is_ratio=False) for name in "abc"]
    values = samples_of(unknowns, 256)
    assert len(values) == 256 * 5
    outcomes = np.full((len(values), 2, len(QUANTITIES) + 3), np.nan)
    outcomes[:, 0, 3] = [2 * each["a"] + each["c"] for each in values]
    outcomes[:, 1, 3] = [each["a"] + 4 * each["b"] for each in values]
    # Variances of 4 / 12, and of 12^2 / 12^2 together: their first-order indices would be 0.
    outcomes[:, :, 4] = [[2 * each["a"] + 12 * (each["b"] - 0.5) * (each["c"] - 0.5)] * 2 for each in values]
    total = indices_of(unknowns, outcomes)
    assert list(total) == [QUANTITIES[3], QUANTITIES[4]]
    for quantity, indices in ((3, [1 / 17, 16 / 17, 0.0]), (4, [0.25, 0.75, 0.75])):
        for name, index in zip("abc", indices, strict=True):
            found = total[QUANTITIES[quantity]][name]
            assert found["total"] == pytest.approx(index, abs=found["confidence"] + 1e-3)
            assert found["confidence"] < 0.2
    shallow, deep = (row[QUANTITIES[3]] for row in bands_of(outcomes))
    # b's own percentiles 5, 50 and 95, to what a varies.
    assert (deep["low"], deep["median"], deep["high"]) == pytest.approx((0.7, 2.5, 4.3), abs=0.1)
    # A trapezium over 0 to 3: its first and last twentieths are triangles of the height x / 2.
    assert (shallow["low"], shallow["median"], shallow["high"]) == pytest.approx(
        (0.2**0.5, 1.5, 3 - 0.2**0.5), abs=0.05
    )
    assert POSITION not in bands_of(outcomes)[0]


def test_the_band_of_the_position_is_the_distance_from_the_median_place():
    """Places u^2 along a line of 10 mm, u evenly in 0 to 1: their median is at a quarter, their mean at a
    third.
    """
    u, along = np.linspace(0, 1, 20_001), 10 * np.array([2.0, -1.0, 2.0]) / 3
    outcomes = np.zeros((len(u), 1, len(QUANTITIES) + 3))
    outcomes[:, 0, len(QUANTITIES) :] = (u**2)[:, None] * along + [3.0, 40.0, -7.0]
    # |u^2 - 1/4| < d: sqrt(1/4 + d) - sqrt(1/4 - d) of all, and beyond a quarter, sqrt(1/4 + d).
    expected = dict(low=np.sqrt(1 / 16 - 0.24875**2), median=np.sqrt(1 / 16 - 0.125**2), high=0.95**2 - 0.25)
    found = bands_of(outcomes)[0][POSITION]
    assert found == pytest.approx({name: 10 * d for name, d in expected.items()}, abs=2e-3)


def test_the_command_reports_writes_and_is_read_again(tmp_path, monkeypatch, capsys):
    def known(problem: PressProblem, values: dict[str, float]) -> np.ndarray:
        row = np.array([1.0, 2.0, 3.0, 4.0, values["tumour modulus"] / 10, 6.0, 7.0, 8.0, 9.0])
        return np.stack([row / 2, row, row * 2])

    class Here:
        def __enter__(self):
            return self

        def share(self, value):
            return value

        def map(self, function, tasks):
            return (known(*task) for task in tasks)

        def __exit__(self, *_):
            return None

    monkeypatch.setattr("rehearsal.worker_processes.Workers", lambda jobs, dask: Here())
    out = tmp_path / "out"
    assert app.main(["study", "uncertainty", "--samples", "8", "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "tumour modulus" in printed and "At 6 mm, over 80 presses:" in printed
    report, rows = written(out, "uncertainty")
    total = report["sobol_total"]["force_n"]
    assert max(total, key=lambda name: total[name]["total"]) == "tumour modulus"
    assert len(rows) == 80
    deepest = dict(
        tumour_shift_mm=2.0, to_tumour_mm=4.0, tumour_depth_mm=6.0, margin_mm=8.0, compression_mm=12.0
    )
    deepest |= dict(
        force_n=float(rows[0]["tumour modulus"]) / 5, tumour_x_mm=14.0, tumour_y_mm=16.0, tumour_z_mm=18.0
    )
    found = {name: float(rows[0][f"{name} (deepest)"]) for name in deepest}
    assert found == pytest.approx(deepest)
    bands = read_bands(out / "uncertainty.json")
    assert bands.indentations_mm == [2.0, 4.0, 6.0]
    line = refusal(capsys, "study", "uncertainty", "--samples", 12, "--out", out)
    assert "expected a power of two" in line


def test_the_table_is_of_the_deepest_press_and_ranks_what_it_depends_on():
    def band(low: float) -> dict[str, float]:
        return dict(low=low, median=low + 1, high=low + 3)

    def index(total: float) -> dict[str, float]:
        return dict(total=total, confidence=0.01)

    report = dict(
        indentations_mm=[2.0, 6.0],
        samples=72,
        parameters=[dict(name="fat", unit="kPa/mm", low=0.1, typical=0.2, high=0.4)],
        bands=[{"force_n": band(1.0)}, {"force_n": band(2.0), "margin_mm": band(-4.0)}],
        sobol_total={"force_n": {"fat": index(0.12), "capsule": index(0.8), "friction": index(0.3)}},
    )
    lines = [re.split("  +", line.strip()) for line in uncertainty_command.table(report).splitlines()]
    assert lines[0] == ["At 6 mm, over 72 presses:"]
    assert lines[2:4] == [
        ["force on the probe, N", "2.00", "3.00", "5.00", "capsule", "0.80", "friction", "0.30"],
        ["margin in the image, mm", "-4.00", "-3.00", "-1.00"],
    ]
    assert lines[-1] == ["fat", "0.1 to 0.4 kPa/mm"]


def bands(**changes) -> UncertaintyBands:
    band = dict(low=1.0, median=2.0, high=4.0)
    rows = [dict(force_n=band, to_tumour_mm=band), dict(force_n=band, margin_mm=band)]
    return UncertaintyBands.model_validate(
        dict(nephron_uncertainty=1, anatomy="a", indentations_mm=[2.0, 4.0], bands=rows) | changes
    )


def test_a_band_is_around_the_value_and_grows_with_the_depth():
    assert bands().around("force_n", 10.0, 2.0) == (9.0, 12.0)
    assert bands().around("force_n", 10.0, 1.0) == (9.5, 11.0)
    assert bands().around("force_n", 10.0, 9.0) == (9.0, 12.0)
    # Not at all depths.
    assert bands().around("margin_mm", 10.0, 4.0) is None and bands().around("contact_mm2", 1.0, 1.0) is None


def test_the_panel_shows_the_band_beside_the_measurement(device):
    rehearsal = rehearsal_of(with_options(briefly(0), {"tissue.cell_mm": 4.0}), small_anatomy())
    rehearsal.organ.pose = rehearsal.pose_at_depth(2.0)
    rehearsal.show()
    measurements = LiveMeasurements(rehearsal.anatomy, rehearsal.manipulator, bands=bands())
    measurements.latest = Measurement(1.0, 20.0, force_n=0.5)
    found = measurements.findings()
    # Nothing pulls: a force below zero is none.
    assert found["force"] == "0.50 (0.00 to 2.50) N" and found["compression"] == "1.0 mm"
    measurements.bands = None
    assert measurements.findings()["force"] == "0.50 N"


@pytest.mark.parametrize(
    "text, words",
    [
        (None, "no such file, which the scene names as uncertainty"),
        ("{", "cannot be read as JSON"),
        ("{}", "nephron_uncertainty: missing"),
        (bands().model_copy(update=dict(bands=[])).model_dump_json(), "0 bands for 2 depths"),
    ],
)
def test_a_file_of_bands_that_cannot_be_used_is_refused(tmp_path, text, words):
    file = tmp_path / "uncertainty.json"
    if text is not None:
        file.write_text(text)
    with pytest.raises(UncertaintyError, match=words) as error:
        read_bands(file)
    assert "app.py study uncertainty" in str(error.value) and "\n" not in str(error.value)


def test_bands_of_another_patient_are_refused():
    files = InputFiles(None, briefly(1), None, None, bands=bands())
    with pytest.raises(UncertaintyError, match="is of other anatomy than this scene"):
        check_anatomy(files, None, small_anatomy())
