"""The command ``study cohort``: many patients, each settled, pressed and planned for, in one table."""

import hashlib
from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path

import click
from tqdm import tqdm

from errors import UserError
from rehearsal.commands.command_line import load_patient, make_folder
from rehearsal.configuration import probe_of
from rehearsal.planning.plan_file import write_plan
from rehearsal.planning.sweep_trial import PlanningProblem
from rehearsal.result_files import rounded, write_csv, write_json
from rehearsal.worker_processes import ENDED, Workers
from scenes.surfaces import volume_mm3
from scenes.tissue import QUALITIES
from studies.cohort.cohort_table import CohortFile, PatientRow, read_rows, text_of, write_rows
from studies.cohort.patient_run import MEASURED, PatientResult, run_patient
from studies.study_options import dask_option, jobs_option, out_option, trials_option
from ultrasound.target import Target
from version import VERSION

MARGIN_MM = 5.0


@dataclass(frozen=True)
class CohortPatient:
    """A patient who was read: the row so far, and the problem for a worker, without images."""

    row: PatientRow
    problem: PlanningProblem


@click.command()
@click.argument("folders", metavar="FOLDER...", type=click.Path(path_type=Path), nargs=-1, required=True)
@out_option
@click.option("--quality", type=click.Choice(QUALITIES), help="A preset of the tissue model [each scene's].")
@trials_option
@jobs_option
@dask_option
def cohort(
    folders: tuple[Path, ...],
    out: Path,
    quality: str | None,
    trials: int,
    jobs: int | None,
    dask: str | None,
) -> None:
    """Settle, press and plan for each patient, in one table.

    FOLDER... are patients' folders or scene files. Started again with the same --out, it goes on where it was interrupted.
    """
    make_folder(out)
    study = CohortStudy(out, trials, read_rows(out))
    with tqdm(total=len(folders), desc="cohort", unit="patient") as bar:
        for _ in study.run(folders, quality, jobs, dask):
            bar.update()
    write_csv([row.model_dump() for row in study.rows()], out / "cohort.csv")
    click.echo(
        f"\n{text_of(study.rows())}\n\nWrote cohort.json, cohort.csv, and report and plan of each to {out}"
    )


class CohortStudy:
    """The rows of a cohort, each written as soon as its patient has ended."""

    def __init__(self, out: Path, trials: int, earlier: list[PatientRow]) -> None:
        self.out, self.trials = out, trials
        self._finished = {row.key: row for row in earlier if row.state != "failed"}
        self._rows: dict[int, PatientRow] = {}

    def rows(self) -> list[PatientRow]:
        """In the order of the command line."""
        return [self._rows[number] for number in sorted(self._rows)]

    def run(
        self, folders: tuple[Path, ...], quality: str | None, jobs: int | None, dask: str | None
    ) -> Iterator[None]:
        """Read, compute and write; one turn for each patient who has ended. Raises WorkerError, OSError."""
        numbered = enumerate(folders, 1)
        ended = 0

        def to_do() -> Iterator[CohortPatient]:
            nonlocal ended
            for number, folder in numbered:
                patient = self._read(number, folder, quality)
                if patient is None:
                    ended += 1
                else:
                    yield patient

        for patient, future in in_workers(to_do(), self.trials, jobs, dask):
            self._take(patient, future)
            yield from [None] * (ended + 1)
            ended = 0
        yield from [None] * ended

    def _read(self, number: int, folder: Path, quality: str | None) -> CohortPatient | None:
        """The patient, who is to be computed; None where that was done before, or is not possible."""
        row = PatientRow(patient=number)
        try:
            scene, anatomy = load_patient(folder, quality=quality)
            target: Target = "organ" if anatomy.tumour is None else "margin"
            problem = PlanningProblem(
                scene, anatomy, probe_of(scene), target, MARGIN_MM, scene.trocar
            ).without_images
            row = _described(row, problem, self.trials)
        except UserError as error:
            self._write(row.model_copy(update=dict(message=_without_paths(str(error), folder))))
            return None
        if row.key in self._finished and (self.out / row.key / "report.json").is_file():
            self._write(self._finished[row.key].model_copy(update=dict(patient=number)))
            return None
        return CohortPatient(row, problem)

    def _take(self, patient: CohortPatient, future: Future) -> None:
        """The result of a patient, or why there is none."""
        error = future.exception()
        if isinstance(error, ENDED):
            message = "its worker process was ended, perhaps for lack of memory; give fewer --jobs, or a coarser --quality"
        elif error is not None:
            message = str(error) if isinstance(error, UserError) else f"{type(error).__name__}: {error}"
        else:
            self._write(self._written(patient.row, future.result()))
            return
        self._write(patient.row.model_copy(update=dict(message=" ".join(message.split()))))

    def _written(self, row: PatientRow, result: PatientResult) -> PatientRow:
        """Write report and plan of a patient; the row of the table."""
        folder = self.out / row.key
        folder.mkdir(exist_ok=True)
        write_json(result.report, folder / "report.json")
        if result.plan is not None:
            write_plan(result.plan, folder / "plan.json")
        return row.model_copy(update=_figures(result))

    def _write(self, row: PatientRow) -> None:
        self._rows[row.patient] = row
        # Rows that are not reached yet stay in the file: the next interruption must not lose them.
        reached = {each.key for each in self._rows.values()}
        later = [each for key, each in self._finished.items() if key not in reached]
        write_rows(CohortFile(version=VERSION, trials=self.trials, patients=[*self.rows(), *later]), self.out)


def in_workers(
    patients: Iterator[CohortPatient], trials: int, jobs: int | None, dask: str | None
) -> Iterator[tuple[CohortPatient, Future]]:
    """Each patient and the future of the result, as soon as it has ended.

    Where a process is ended, all that were in work with it are computed again, each alone: one who takes too much memory does not
    cost the others their results. Raises WorkerError.
    """
    is_last = False
    while not is_last:
        sent: dict[int, CohortPatient] = {}
        lost: list[CohortPatient] = []

        def tasks() -> Iterator[tuple]:
            nonlocal is_last
            for number, patient in enumerate(patients):
                sent[number] = patient
                yield patient.row.key, patient.problem, trials
                if lost:
                    return
            is_last = True

        with Workers(jobs, dask) as workers:
            for number, future in workers.completed(run_patient, tasks()):
                if isinstance(future.exception(), ENDED):
                    lost.append(sent.pop(number))
                else:
                    yield sent.pop(number), future
        for patient in lost:
            with Workers(1, dask) as alone:
                task = patient.row.key, patient.problem, trials
                for _, future in alone.completed(run_patient, [task]):
                    yield patient, future


def _described(row: PatientRow, problem: PlanningProblem, trials: int) -> PatientRow:
    """What is known of a patient before anything is computed."""
    scene, organ, tumour = problem.scene, problem.anatomy.organ, problem.anatomy.tumour
    settings = scene.model_dump_json(), problem.fingerprint, str(trials), VERSION
    return row.model_copy(
        update=dict(
            title=scene.title,
            key=hashlib.sha256("\n".join(settings).encode()).hexdigest()[:12],
            kidney_ml=rounded(volume_mm3(organ.vertices, organ.faces) / 1000),
            tumour_ml=None if tumour is None else rounded(volume_mm3(tumour.vertices, tumour.faces) / 1000),
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


def _without_paths(message: str, folder: Path) -> str:
    """A message for a table that others may read: a patient's path may name the patient."""
    for path in (str(folder.resolve()), str(folder)):
        message = message.replace(path, "FOLDER")
    return message
