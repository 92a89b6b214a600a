"""The table of a cohort: a row for each patient, kept in a file from which an interrupted study goes on."""

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from errors import UserError, explained
from rehearsal.result_files import write_json
from studies.tables_and_panels import table_of
from text_files import TextError, read_text

FILE = "cohort.json"


class CohortError(UserError):
    """A folder that holds something else than a cohort's results."""


class PatientRow(BaseModel):
    """One patient: lengths in mm, volumes in ml, force in N, times in s; None for what there is not.

    ``key`` tells patient, scene, program and settings apart, and names the folder of report and plan. Of the
    press, figures are at its greatest depth; of the plan, of its first sweep.
    """

    model_config = ConfigDict(extra="forbid")

    patient: int | None
    """Place in the command line, from 1; None for a patient of an earlier one."""
    title: str = ""
    key: str = ""
    trials: int
    state: Literal["done", "no plan", "failed"] = "failed"
    message: str = ""
    kidney_ml: float | None = None
    tumour_ml: float | None = None
    settled_shift_mm: float | None = None
    """Greatest shift of the surface from the CT by gravity and support."""
    indentation_mm: float | None = None
    compression_mm: float | None = None
    tumour_shift_mm: float | None = None
    to_tumour_mm: float | None = None
    tumour_depth_mm: float | None = None
    margin_mm: float | None = None
    force_n: float | None = None
    volume_ratio_min: float | None = None
    states_restored: int | None = None
    sweep: str | None = None
    score: float | None = None
    covered: float | None = None
    """Share of the target, 0 to 1."""
    sweep_compression_mm: float | None = None
    """Mean over its poses."""
    sweep_path_mm: float | None = None
    seconds: float | None = None


class CohortFile(BaseModel):
    """cohort.json."""

    model_config = ConfigDict(extra="forbid")

    nephron_cohort: Literal[1] = 1
    version: str
    patients: list[PatientRow] = []


COLUMNS = {
    "": "{patient}",
    "title": "{title}",
    "kidney, ml": "{kidney_ml:.0f}",
    "tumour, ml": "{tumour_ml:.1f}",
    "settled by, mm": "{settled_shift_mm:.1f}",
    "pressed, mm": "{indentation_mm:.1f}",
    "force, N": "{force_n:.2f}",
    "tumour shift, mm": "{tumour_shift_mm:.1f}",
    "restored": "{states_restored:d}",
    "score": "{score:.1f}",
    "covered": "{covered:.0%}",
    "s": "{seconds:.0f}",
    "state": "{state}",
}


def read_rows(folder: Path) -> list[PatientRow]:
    """The rows that an earlier study left in a folder; none where it has no table. Raises CohortError."""
    path = folder / FILE
    try:
        return CohortFile.model_validate_json(read_text(path)).patients
    except FileNotFoundError:
        return []
    except (NotADirectoryError, TextError) as error:
        raise CohortError(f"{path}: cannot be read ({error}); choose another --out") from None
    except ValidationError as error:
        raise CohortError(
            f"{path}: is no table of a cohort of this version ({explained(error)}); choose another --out"
        ) from None


def write_rows(table: CohortFile, folder: Path) -> None:
    """Write cohort.json anew, whole or not at all. Raises OSError."""
    write_json(table.model_dump(), folder / FILE)


def text_of(rows: list[PatientRow]) -> str:
    """The table, and the message of each patient who has one."""
    table = table_of(COLUMNS, [row.model_dump() for row in rows])
    messages = [f"patient {row.patient}: {row.message}" for row in rows if row.message]
    done = sum(row.state == "done" for row in rows)
    return "\n".join([table, "", f"{done} of {len(rows)} patients are done.", *messages])
