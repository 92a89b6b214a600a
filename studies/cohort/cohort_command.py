"""The command ``study cohort``: many patients, each settled, pressed and planned for, in one table."""

import hashlib
import json
import re
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import click

from errors import UserError
from rehearsal.commands.command_line import load_patient
from rehearsal.configuration import probe_of
from rehearsal.planning.plan_file import write_plan
from rehearsal.planning.sweep_trial import PlanningProblem
from rehearsal.result_files import rounded, write_csv, write_json
from rehearsal.worker_processes import Workers, error_of, has_ended
from scenes.folder_files import without_system_files
from scenes.surfaces import volume_mm3
from scenes.tissue import QUALITIES
from studies.cohort.cohort_table import CohortFile, PatientRow, read_rows, text_of, write_rows
from studies.cohort.patient_run import MEASURED, PatientResult, run_patient
from studies.planning.plan_comparison import trials_option
from studies.study import Study, paths_argument, study_command
from ultrasound.target import Target
from version import VERSION

MARGIN_MM = 5.0
ENDED_MESSAGE = (
    "its worker process was ended, perhaps for lack of memory; give fewer --jobs, or a coarser --quality"
)


@dataclass(frozen=True)
class CohortPatient:
    """A patient who was read: the row so far, and the problem for a worker, without images."""

    row: PatientRow
    problem: PlanningProblem
    folder: Path


@study_command(
    "cohort",
    paths_argument("folders", "FOLDER...", required=True),
    click.option(
        "--quality", type=click.Choice(QUALITIES), help="A preset of the tissue model [each scene's]."
    ),
    trials_option,
    has_workers=True,
)
def cohort(study: Study, folders: tuple[Path, ...], quality: str | None, trials: int) -> None:
    """Settle, press and plan for each patient, in one table.

    FOLDER... are patients' folders or scene files. Started again with the same --out, it goes on where it was
    interrupted.
    """
    folders = without_system_files(folders)
    earlier = read_rows(study.out)
    with study.progress(len(folders), "patient") as bar:
        patients = CohortStudy(study.out, trials, earlier, bar.update)
        patients.run(folders, quality, study.jobs, study.dask)
    write_csv([row.model_dump() for row in patients.rows()], study.out / "cohort.csv")
    written = f"Wrote cohort.json, cohort.csv, and report and plan of each to {study.out}"
    click.echo(f"\n{text_of(patients.rows())}\n\n{written}")


class CohortStudy:
    """The rows of a cohort, each written as soon as its patient has ended; ``done`` is then called."""

    def __init__(self, out: Path, trials: int, earlier: list[PatientRow], done: Callable[[], object]) -> None:
        self.out, self.trials, self._done = out, trials, done
        self._finished = {row.key: row for row in earlier if row.state != "failed"}
        self._rows: list[PatientRow] = []

    def rows(self) -> list[PatientRow]:
        """In the order of the command line."""
        return sorted(self._rows, key=lambda row: row.patient or 0)

    def run(self, folders: tuple[Path, ...], quality: str | None, jobs: int | None, dask: str | None) -> None:
        """Read, compute and write. Raises CohortError, WorkerError, OSError."""
        read = (self._read(number, folder, quality) for number, folder in enumerate(folders, 1))
        to_do = (patient for patient in read if patient is not None)
        for patient, future in in_workers(to_do, self.trials, jobs, dask):
            self._take(patient, future)

    def _read(self, number: int, folder: Path, quality: str | None) -> CohortPatient | None:
        """The patient, who is to be computed; None where that was done before, or is not possible."""
        row = PatientRow(patient=number, trials=self.trials)
        try:
            scene, anatomy = load_patient(folder, quality=quality)
            target: Target = "organ" if anatomy.tumour is None else "margin"
            problem = PlanningProblem(
                scene, anatomy, probe_of(scene), target, MARGIN_MM, scene.trocar
            ).without_images
            row = _described(row, problem)
        except Exception as error:  # whatever is wrong with one patient, the others are computed
            self._write(row.model_copy(update=dict(message=_message_of(error, folder))))
            return None
        finished = self._finished.get(row.key)
        if finished is not None and self._has_files(finished):
            self._write(finished.model_copy(update=dict(patient=number)))
            return None
        return CohortPatient(row, problem, folder)

    def _has_files(self, row: PatientRow) -> bool:
        """Whether report and plan of a row are there still."""
        names = ["report.json", *(["plan.json"] if row.state == "done" else [])]
        return all((self.out / row.key / name).is_file() for name in names)

    def _take(self, patient: CohortPatient, future: Future) -> None:
        """The result of a patient, or why there is none."""
        error = error_of(future)
        if error is None:
            self._write(self._written(patient.row, future.result()))
            return
        message = ENDED_MESSAGE if has_ended(error) else _message_of(error, patient.folder)
        self._write(patient.row.model_copy(update=dict(message=message)))

    def _written(self, row: PatientRow, result: PatientResult) -> PatientRow:
        """Write report and plan of a patient; the row of the table."""
        folder = self.out / row.key
        folder.mkdir(exist_ok=True)
        write_json(result.report, folder / "report.json")
        if result.plan is not None:
            write_plan(result.plan, folder / "plan.json")
        return row.model_copy(update=_figures(result))

    def _write(self, row: PatientRow) -> None:
        """Write the table with one row more; rows of patients that are not reached yet, or of another
        command line, stay.
        """
        self._rows.append(row)
        reached = {row.key for row in self._rows}
        others = [
            earlier.model_copy(update=dict(patient=None))
            for earlier in read_rows(self.out)
            if earlier.state != "failed" and earlier.key not in reached
        ]
        write_rows(CohortFile(version=VERSION, patients=[*self.rows(), *others]), self.out)
        self._done()


def in_workers(
    patients: Iterator[CohortPatient], trials: int, jobs: int | None, dask: str | None
) -> Iterator[tuple[CohortPatient, Future]]:
    """Each patient and the future of the result, as soon as it has ended.

    Where a process is ended, those that were in work are computed again, each alone: one who takes too much
    memory does not cost the others their results. Raises WorkerError.
    """
    left = iter(patients)
    while True:
        sent: dict[int, CohortPatient] = {}
        lost: dict[int, CohortPatient] = {}

        def tasks(
            left: Iterator[CohortPatient] = left, sent: dict = sent, lost: dict = lost
        ) -> Iterator[tuple]:
            for number, patient in enumerate(left):
                sent[number] = patient
                yield patient.row.key, patient.problem, trials
                if lost:
                    return

        with Workers(jobs, dask) as workers:
            for number, future in workers.completed(run_patient, tasks()):
                patient = sent.pop(number)
                if has_ended(error_of(future)):
                    lost[number] = patient
                else:
                    yield patient, future
        if not lost:
            return
        in_order = [lost[number] for number in sorted(lost)]
        # The others had not begun.
        left = chain(in_order[workers.count :], left)
        for patient in in_order[: workers.count]:
            with Workers(1, dask) as alone:
                for _, future in alone.completed(run_patient, [(patient.row.key, patient.problem, trials)]):
                    yield patient, future


def _described(row: PatientRow, problem: PlanningProblem) -> PatientRow:
    """What is known of a patient before anything is computed."""
    # The probe itself, and not the path of its file.
    values = problem.scene.model_dump(
        mode="json", exclude={"title": True, "uncertainty": True, "transducer": {"probe"}}
    )
    probe = problem.probe.model_dump_json()
    settings = (json.dumps(values), probe, problem.fingerprint, str(row.trials), VERSION)
    kidney_ml, tumour_ml = (
        None if surface is None else rounded(volume_mm3(surface.vertices, surface.faces) / 1000)
        for surface in (problem.anatomy.organ, problem.anatomy.tumour)
    )
    return row.model_copy(
        update=dict(
            title=_printable(problem.scene.title),
            key=hashlib.sha256("\n".join(settings).encode()).hexdigest()[:12],
            kidney_ml=kidney_ml,
            tumour_ml=tumour_ml,
        )
    )


def _figures(result: PatientResult) -> dict[str, object]:
    """The columns of a patient whose computation has ended."""
    report, deepest = result.report, (result.report["stages"] or [{}])[-1]
    figures: dict[str, object] = {name: deepest.get(name) for name in ("indentation_mm", *MEASURED)}
    figures |= dict(
        state="failed" if not report["finite"] else "no plan" if result.plan is None else "done",
        message=result.message,
        settled_shift_mm=report["settled_shift_mm"],
        volume_ratio_min=report["volume_ratio_min"],
        states_restored=len(report["fallbacks"]),
        seconds=result.seconds,
    )
    if result.plan is not None:
        best = result.plan.sweeps[0]
        figures |= dict(
            sweep=best.name,
            score=best.score,
            covered=best.parts["seen"],
            sweep_compression_mm=best.parts["compression_mean_mm"],
            sweep_path_mm=best.parts["path_mm"],
        )
    return figures


def _message_of(error: BaseException, folder: Path) -> str:
    """What is wrong with a patient, in one line without paths: the table may be read by others, and a path
    may name the patient.
    """
    text = str(error) if isinstance(error, UserError) else f"{type(error).__name__}: {error}"
    places = [folder.absolute(), folder.resolve(), folder]
    if folder.suffix == ".toml":
        places += [folder.absolute().parent, folder.resolve().parent]
    names = {name for place in places for name in (str(place), _printable(str(place)))} - {".", "/"}
    # The longest first: a folder is the beginning of its file.
    for name in sorted(names, key=len, reverse=True):
        text = re.sub(rf"(?<![\w./\\-]){re.escape(name)}(?=[/\\:'\"]|$)", "FOLDER", text)
    # Any other absolute path, up to what ends it.
    text = re.sub(r"(?<![\w./\\-])(?:[A-Za-z]:[/\\]|/)[^:'\"]*", "FILE", text)
    return " ".join(_printable(text).split())


def _printable(text: str) -> str:
    """Letters that do not print, which could control a terminal, become question marks."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)
