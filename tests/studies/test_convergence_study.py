"""The convergence study, by hand and on the command line."""

import json
from functools import partial

import pytest
from click.testing import CliRunner
from small_bead_case import write_case
from study_runs import refusal

from app import cli
from rehearsal.configuration import PRESETS, Setup, choose_setup, setup_of
from studies.accuracy.bead_case import BeadCase, load_case
from studies.accuracy.bead_experiment import BeadRun
from studies.accuracy.convergence_study import changes_of, moved


def values_of(setup: Setup) -> dict[str, object]:
    return (
        vars(setup) | setup.tissue.model_dump() | setup.solver.model_dump() | dict(tissue=None, solver=None)
    )


@pytest.mark.parametrize("model", PRESETS)
def test_each_change_is_of_one_setting(model):
    setup = choose_setup(model, "balanced")
    different = {
        name: {key for key, value in values_of(changed).items() if values_of(setup)[key] != value}
        for name, changed in changes_of(setup).items()
    }
    size = setup.tissue.size_key
    assert list(different.values()) == [
        {"time_step_s", "warm_up_steps", "stage_steps"},
        {"iterations"},
        {size},
        {size},
    ]
    halved = changes_of(setup)["half the time step"]
    assert halved.stage_steps * halved.solver.time_step_s == pytest.approx(
        setup.stage_steps * setup.solver.time_step_s
    )


class Drifting:
    """Stands for an Experiment: its beads drift along x by what the setup has of iterations, steps and
    cells.
    """

    def __init__(self, case: BeadCase, setup: Setup) -> None:
        self.case, self.cell_mm = case, setup.size_mm

    def run(self, setup: Setup) -> BeadRun:
        assert setup.size_mm == self.cell_mm
        beads = self.case.measured.copy()
        beads[..., 0] += setup.iterations + 100 * setup.stage_steps * setup.solver.time_step_s
        beads[-1, 0, 0] += setup.size_mm
        return BeadRun(beads)


def test_displacements_are_reported_stage_by_stage(tmp_path):
    case, setup = load_case(write_case(tmp_path / "ball")), setup_of("neo-hookean", cell_mm=6.0, iterations=8)
    experiment = Drifting(case, setup)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("studies.accuracy.convergence_study.BeadExperiment", Drifting)
        halved, doubled, larger, smaller = moved(experiment, setup, experiment.run(setup).beads)
    count = case.measured.shape[1]
    assert halved["moved_max_mm"] == pytest.approx(0.0, abs=1e-6)
    assert doubled["moved_mean_mm"] == pytest.approx([8.0] * len(case.measured))
    for row in (larger, smaller):
        assert row["moved_max_mm"] == pytest.approx(2.0)
        assert row["moved_mean_mm"][-1] == pytest.approx(2.0 / count, abs=1e-6)
        assert not any(row["moved_mean_mm"][:-1])


def test_validate_prints_and_writes_what_the_settings_change(monkeypatch, tmp_path):
    monkeypatch.setattr(
        "studies.accuracy.accuracy_commands.choose_setup",
        partial(choose_setup, warm_up_steps=12, stage_steps=9),
    )
    monkeypatch.setattr("studies.accuracy.convergence_study.BeadExperiment", Drifting)
    folder, file = write_case(tmp_path / "ball"), tmp_path / "a.json"
    arguments = ["validate", folder, "--cell", 6, "--check", "--arch", "cpu", "--json", file]
    done = CliRunner().invoke(cli, [str(argument) for argument in arguments])
    assert done.exit_code == 0, done.output
    rows = json.loads(file.read_text())["independence"]
    assert [row["change"] for row in rows] == list(changes_of(setup_of("neo-hookean")))
    assert all(f"  {row['change']}  " in done.output for row in rows)
    # Of what the real one computed: the ball's beads come to another place, but not far.
    assert all(0 < row["moved_max_mm"] < 1 for row in rows[:2])


def test_sizes_that_cannot_be_changed_are_refused(capsys, tmp_path):
    folder = write_case(tmp_path / "ball")
    line = refusal(capsys, "validate", folder, "--cell", 0.6, "--check", "--arch", "cpu")
    assert "--cell from 0.75 to 15" in line
