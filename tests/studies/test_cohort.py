"""A cohort: its table, what is read of an earlier one, and patients whose computation fails or ends its
process.
"""

import csv
import json
import os
import re
import shutil
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace

import pytest
from ball_patient import folder_of_ball
from study_runs import refusal

import app
from errors import UserError
from rehearsal.planning import plan_search
from rehearsal.planning.plan_file import MOST_SWEEPS, Plan, PlanError, read_plan
from rehearsal.worker_processes import error_of, has_ended
from scenes.anatomy import fingerprint, load_anatomy
from scenes.scene import load_scene
from studies.cohort import cohort_command, cohort_table, patient_run
from studies.cohort.cohort_table import PatientRow
from studies.cohort.patient_run import PatientResult
from ultrasound.probe import PROBES
from version import VERSION

TRIALS = ["--trials", str(MOST_SWEEPS)]
PRESS = "indentations_mm = [1.0, 2.0]\nstage_steps = 20\nwarm_up_steps = 90"


@pytest.fixture
def patients(tmp_path) -> list[Path]:
    """A ball, a softer one, and a folder whose scene is not valid."""
    folders = [tmp_path / name for name in ("Jane_Doe", "John_Doe", "Max_Doe")]
    for folder in folders:
        folder.mkdir()
        scene = folder_of_ball(folder) / "scene.toml"
        scene.write_text(scene.read_text().replace("warm_up_steps = 90", PRESS))
    soft = folders[1] / "scene.toml"
    soft.write_text(soft.read_text().replace("cell_mm = 8.0", "cell_mm = 8.0\nyoung_kpa = 8.0"))
    (folders[2] / "scene.toml").write_text("[tissue]\ncell_mm = -1\n")
    return folders


def table_in(folder: Path) -> list[dict]:
    return json.loads((folder / "cohort.json").read_text())["patients"]


def run(folders: list[Path], out: Path, *options: str) -> int:
    return app.main(["study", "cohort", *map(str, folders), "--out", str(out), *TRIALS, *options])


@pytest.mark.usefixtures("nothing_built")
def test_patients_are_settled_pressed_and_planned_for_on_a_cluster(
    patients, tmp_path, cluster, monkeypatch, capsys
):
    for name, few in dict(BEGINNING=24, ROUNDS=1, VARIATIONS=4).items():
        monkeypatch.setattr(plan_search, name, few)
    monkeypatch.setattr(patient_run, "SPEED_MM_S", 60.0)
    out = tmp_path / "out"
    assert run(patients, out, "--dask", cluster) == 0
    printed = capsys.readouterr().out
    ball, soft, broken = table_in(out)
    assert [row["state"] for row in (ball, soft, broken)] == ["done", "done", "failed"]
    assert (
        "FOLDER/scene.toml: anatomy: missing" in broken["message"] and "2 of 3 patients are done" in printed
    )
    # A quarter of 4/3 pi, by facets, 25 and 7 mm.
    assert ball["kidney_ml"] == pytest.approx(65.4, rel=0.02) and ball["tumour_ml"] == pytest.approx(
        1.44, rel=0.02
    )
    assert ball["indentation_mm"] == 2.0 and 0 < soft["force_n"] < 0.8 * ball["force_n"]
    assert soft["settled_shift_mm"] > ball["settled_shift_mm"] > 0
    for folder, row in zip(patients, (ball, soft), strict=False):
        report = json.loads((out / row["key"] / "report.json").read_text())
        assert [stage["indentation_mm"] for stage in report["stages"]] == [1.0, 2.0]
        assert report["stages"][1]["force_n"] == row["force_n"] > report["stages"][0]["force_n"]
        assert report["finite"] and report["steps"] == 40
        plan = read_plan(out / row["key"] / "plan.json")
        assert plan.anatomy == fingerprint(load_anatomy(load_scene(folder / "scene.toml"), folder))
        assert plan.sweeps[0].score == row["score"] and sum(one.trials for one in plan.sweeps) == MOST_SWEEPS
    with (out / "cohort.csv").open(newline="") as file:
        assert [row["key"] for row in csv.DictReader(file)] == [ball["key"], soft["key"], ""]
    # Nothing says whose they are.
    written = printed + "".join(path.read_text() for path in out.rglob("*") if path.is_file())
    assert "Doe" not in written.replace(str(tmp_path), "") and str(tmp_path) not in written.replace(
        str(out), ""
    )


def result(message: str = "", finite: bool = True, plan: Plan | None = None) -> PatientResult:
    stages = [dict(indentation_mm=2.0) | dict.fromkeys(patient_run.MEASURED)]
    report = dict(finite=finite, stages=stages, settled_shift_mm=1.0, volume_ratio_min=0.99, fallbacks=[])
    return PatientResult(report, plan, message, 2.0)


def without_plan(key: str, problem, trials: int) -> PatientResult:
    """Stands for ``run_patient``; the soft ball is what goes wrong."""
    if problem.scene.tissue.young_kpa == 8.0:
        raise KeyError("young")
    return result("no sweep was found")


def ending(key: str, problem, trials: int) -> PatientResult:
    if problem.scene.tissue.young_kpa == 8.0:
        os._exit(1)
    return result("no sweep was found")


@pytest.mark.parametrize(
    ("stand_in", "words"),
    [(without_plan, "KeyError: 'young'"), (ending, "was ended, perhaps for lack of memory")],
)
def test_a_patient_who_fails_costs_no_other_and_is_tried_again(
    patients, tmp_path, monkeypatch, stand_in, words
):
    """Also one who ends the process, and all that wait with it."""
    out, folders = tmp_path / "out", [patients[0], patients[1], patients[2], *[patients[0]] * 4]
    monkeypatch.setattr(cohort_command, "run_patient", stand_in)
    assert run(folders, out, "--jobs", "1") == 0
    rows = table_in(out)
    assert [row["patient"] for row in rows] == [1, 2, 3, 4, 5, 6, 7]
    assert [row["state"] for row in rows] == ["no plan", "failed", "failed", *["no plan"] * 4]
    assert words in rows[1]["message"] and rows[0]["message"] == "no sweep was found"
    assert "FOLDER" in rows[2]["message"] and "Doe" not in json.dumps(rows)

    tried = []

    def once_more(key: str, problem, trials: int) -> PatientResult:
        tried.append(problem.scene.tissue.young_kpa)
        return result("no sweep was found")

    with monkeypatch.context() as patch:
        patch.setattr(cohort_command, "Workers", Here)
        patch.setattr(cohort_command, "run_patient", once_more)
        assert run(folders, out) == 0
        assert tried == [8.0] and [row["state"] for row in table_in(out)].count("failed") == 1
        # Other settings are another computation.
        assert run(folders[:2], out, "--quality", "fast") == 0
        assert len(tried) == 3
        # A row whose files somebody removed is computed again.
        shutil.rmtree(out / rows[0]["key"])
        assert run(folders[:1], out) == 0
        assert len(tried) == 4


class Here:
    """Instead of workers: each task as it comes."""

    count = 1

    def __init__(self, *_: object) -> None: ...

    def __enter__(self) -> "Here":
        return self

    def __exit__(self, *_: object) -> None: ...

    def completed(self, function, tasks):
        for number, task in enumerate(tasks):
            future: Future = Future()
            try:
                future.set_result(function(*task))
            except Exception as error:
                future.set_exception(error)
            yield number, future


@pytest.mark.parametrize("names", [["Thumbs.db"], ["desktop.ini", "._a"]])
def test_files_of_an_operating_system_are_no_patients(tmp_path, capsys, names):
    for name in names:
        (tmp_path / name).touch()
    files = [str(tmp_path / name) for name in names]
    assert app.main(["study", "cohort", *files, "--jobs", "1", "--out", str(tmp_path / "out")]) == 0
    assert "0 of 0 patients" in capsys.readouterr().out


def test_an_interrupted_cohort_goes_on_where_it_was(patients, tmp_path, monkeypatch):
    """Interrupted in the second patient: the first is in the table already, and is not computed again."""
    out, tried = tmp_path / "out", []
    monkeypatch.setattr(cohort_command, "Workers", Here)

    def interrupted(key: str, problem, trials: int) -> PatientResult:
        tried.append(key)
        if len(tried) == 2:
            raise KeyboardInterrupt
        return result("no sweep was found")

    monkeypatch.setattr(cohort_command, "run_patient", interrupted)
    assert run(patients, out) == 130
    (row,) = table_in(out)
    assert (row["key"], row["state"]) == (tried[0], "no plan")
    # Those that are not reached yet stay in the file, though a second interruption comes before them.
    tried[:] = ["another"]
    assert run(patients[1:] + patients[:1], out) == 130
    assert [each["key"] for each in table_in(out)] == [row["key"]]
    assert run(patients, out) == 0
    assert len(tried) == 3 and tried[2] != row["key"]
    assert [each["state"] for each in table_in(out)] == ["no plan", "no plan", "failed"]


def message(text: str, folder: Path) -> str:
    return cohort_command._message_of(UserError(text), folder)


@pytest.mark.parametrize(
    ("text", "folder", "words"),
    [
        ("/data/Jane Doe/scene.toml: bad", "/data/Jane Doe", "FOLDER/scene.toml: bad"),
        ("/data/Jane Doe/organ.stl: bad", "/data/Jane Doe/scene.toml", "FOLDER/organ.stl: bad"),
        ("/data/Jane?Doe/organ.stl: bad", "/data/Jane\u00a0Doe", "FOLDER/organ.stl: bad"),
        ("/else/Jane Doe/organ.stl: bad", "/data/x", "FILE: bad"),
        ("no (Not a directory: '/else/Doe/x')", "/data/x", "no (Not a directory: 'FILE')"),
        ("C:\\Doe\\organ.stl: bad", "/data/x", "FILE: bad"),
        ("a/organ.stl: give a surface", "a", "FOLDER/organ.stl: give a surface"),
        ("a: give a surface and/or a line", "a", "FOLDER: give a surface and/or a line"),
        ("organ.stl: bad\x1b[31m\nline", ".", "organ.stl: bad?[31m?line"),
    ],
)
def test_messages_have_no_paths_and_nothing_that_controls_a_terminal(text, folder, words):
    assert message(text, Path(folder)) == words


def test_what_is_wrong_with_one_patient_does_not_stop_the_others(patients, tmp_path, monkeypatch):
    """Whatever it is, also what no message was written for."""
    out, load = tmp_path / "out", cohort_command.load_patient

    def failing(folder: Path, **options):
        if folder == patients[1]:
            raise PermissionError(13, "Permission denied", str(folder / "scene.toml"))
        return load(folder, **options)

    monkeypatch.setattr(cohort_command, "load_patient", failing)
    monkeypatch.setattr(cohort_command, "Workers", Here)
    monkeypatch.setattr(cohort_command, "run_patient", lambda *_: result("no sweep was found"))
    assert run([patients[1], patients[0]], out) == 0
    refused, computed = table_in(out)
    assert refused["message"] == "PermissionError: [Errno 13] Permission denied: 'FOLDER/scene.toml'"
    assert computed["state"] == "no plan"
    # Another study with the same folder meanwhile: the rows of both stay.
    assert run([patients[2]], out) == 0
    assert [row["patient"] for row in table_in(out)] == [1, None]


def test_a_key_depends_on_the_probe_and_not_on_where_its_file_is(patients, tmp_path, monkeypatch):
    out = tmp_path / "out"
    monkeypatch.setattr(cohort_command, "Workers", Here)
    monkeypatch.setattr(cohort_command, "run_patient", lambda *_: result("no sweep was found"))
    probe = (PROBES / "drop-in.toml").read_text()
    folder = patients[0]
    scene = folder / "scene.toml"
    scene.write_text(scene.read_text().replace('"drop-in"', '"mine.toml"'))
    keys = []
    for depth in ("50.0", "33.0"):
        (folder / "mine.toml").write_text(probe.replace("DepthMm = 50.0", f"DepthMm = {depth}"))
        assert run([folder], out) == 0
        keys.append(table_in(out)[0]["key"])
    folder = folder.rename(tmp_path / "elsewhere")
    assert run([folder], out) == 0
    assert keys[0] != keys[1] == table_in(out)[0]["key"]


class KilledWorker(Exception):
    """As Dask's."""


def test_who_was_in_work_beside_one_that_killed_its_worker_is_computed_again(monkeypatch):
    """Alone, and only those: the others go on in parallel."""
    begun: list[tuple[int, str]] = []

    class Cluster(Here):
        count = 2

        def __init__(self, jobs: int | None, dask: str | None) -> None:
            self.jobs = jobs

        def completed(self, function, tasks):
            killed = 0
            for number, task in enumerate(tasks):
                begun.append((self.jobs, task[0]))
                future: Future = Future()
                if task[0] == "poison" or (self.jobs is None and killed in (1, 2)):
                    killed += 1
                    future.set_exception(KilledWorker("tcp://10.0.0.1"))
                else:
                    future.set_result(task[0])
                yield number, future

    monkeypatch.setattr(cohort_command, "Workers", Cluster)
    patients = [
        SimpleNamespace(row=SimpleNamespace(key=key), problem=None) for key in ("a", "poison", "b", "c")
    ]
    ended = {
        patient.row.key: error_of(future)
        for patient, future in cohort_command.in_workers(iter(patients), 4, None, "tcp://x")
    }
    assert list(ended) == ["a", "poison", "b", "c"] and has_ended(ended.pop("poison"))
    assert list(ended.values()) == [None] * 3
    assert (1, "poison") in begun and (None, "c") in begun


def test_no_plan_is_searched_for_tissue_that_diverged(monkeypatch):
    monkeypatch.setattr(patient_run, "built_once", lambda key, build: type("Trial", (), dict(rehearsal=None)))
    monkeypatch.setattr(patient_run, "press", lambda *_: dict(finite=False, stages=[]))
    found = patient_run.run_patient("key", None, 8)
    assert found.plan is None and "diverged in the press" in found.message

    def unreachable(*_: object) -> None:
        raise PlanError("no sweep was found")

    monkeypatch.setattr(patient_run, "press", lambda *_: dict(finite=True, stages=[]))
    monkeypatch.setattr(patient_run, "make_plan", unreachable)
    assert patient_run.run_patient("key", None, 8).message == "no sweep was found"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "is no table of a cohort of this version"),
        ("[]", "is no table of a cohort of this version"),
        (json.dumps(dict(nephron_cohort=2, version=VERSION)), "nephron_cohort = 2"),
        (
            json.dumps(dict(nephron_cohort=1, version=VERSION, patients=[dict(patient="x")])),
            "patient",
        ),
        ("\xff".encode("latin-1"), "cannot be read"),
    ],
)
def test_a_folder_with_something_else_is_refused(tmp_path, capsys, text, words):
    file = tmp_path / "cohort.json"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    before = file.read_bytes()
    line = refusal(capsys, "study", "cohort", tmp_path, "--out", tmp_path)
    assert words in line and "choose another --out" in line
    assert file.read_bytes() == before


def test_a_row_has_the_figures_of_the_deepest_press_and_of_the_first_sweep():
    """Each another number, so that no column can have that of another."""
    stages = [
        dict(indentation_mm=5.0 * k) | {name: k + n / 8 for n, name in enumerate(patient_run.MEASURED)}
        for k in (1, 2)
    ]
    report = dict(
        finite=True, stages=stages, settled_shift_mm=3.4, volume_ratio_min=0.97, fallbacks=["a", "b"]
    )
    sweeps = [
        SimpleNamespace(
            name=name, score=score, parts=dict(seen=seen, compression_mean_mm=score / 40, path_mm=score * 3)
        )
        for name, score, seen in (("one pass", 80.0, 0.86), ("two passes", 60.0, 0.9))
    ]
    found = cohort_command._figures(PatientResult(report, SimpleNamespace(sweeps=sweeps), "", 41.6))
    press = dict(
        compression_mm=2.0,
        tumour_shift_mm=2.125,
        to_tumour_mm=2.25,
        tumour_depth_mm=2.375,
        margin_mm=2.5,
        force_n=2.625,
    )
    settled = dict(indentation_mm=10.0, settled_shift_mm=3.4, volume_ratio_min=0.97, states_restored=2)
    sweep = dict(sweep="one pass", score=80.0, covered=0.86, sweep_compression_mm=2.0, sweep_path_mm=240.0)
    assert found == press | settled | sweep | dict(state="done", message="", seconds=41.6)
    row = PatientRow(patient=3, title="A kidney", trials=8, kidney_ml=151.6, tumour_ml=8.24, **found)
    heads, figures = (re.split("  +", line.strip()) for line in cohort_table.text_of([row]).splitlines()[:2])
    assert dict(zip(heads, figures[1:], strict=True)) == {
        "title": "A kidney",
        "kidney, ml": "152",
        "tumour, ml": "8.2",
        "settled by, mm": "3.4",
        "pressed, mm": "10.0",
        "force, N": "2.62",
        "tumour shift, mm": "2.1",
        "restored": "2",
        "score": "80.0",
        "covered": "86%",
        "s": "42",
        "state": "done",
    }
