"""The command ``import``: a patient's folder, with a scene, out of a CT and its labels."""

from collections.abc import Sequence
from pathlib import Path

import click

from scenes.anatomy import patient_scene
from scenes.check_picture import draw_check
from scenes.facts import facts, told
from scenes.patient import Patient, import_patient
from scenes.patient_folder import save_patient
from scenes.reading.ct import dicom_or_words, open_ct
from scenes.reading.drawn import Drawing, drawing_of, open_labels
from scenes.reading.error import PatientError
from scenes.reading.labels import merged, with_tissues
from scenes.reading.names import Side
from scenes.reading.progress import bar
from scenes.scene import scene_text

# Options that say which labels are of a tissue.
TISSUE_OPTIONS = {"tumour": "tumour", "cyst": "cyst", "vessels": "vessel", "collecting": "urine"}
LABEL = "Names or values of the labels, such as 3 or kidney_cyst_left,7"


@click.command("import")
@click.argument("ct", type=click.Path(path_type=Path))
@click.argument("labels", type=click.Path(path_type=Path), nargs=-1)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    required=True,
    help="Folder to write the patient to; new or empty.",
)
@click.option("--organ", help=f"{LABEL} that are the organ [those named as a kidney; without names, all].")
@click.option("--tumour", help=f"{LABEL} of the tumour [by name].")
@click.option("--cyst", help=f"{LABEL} of cysts [by name].")
@click.option("--vessels", help=f"{LABEL} of blood vessels [by name].")
@click.option("--collecting", help=f"{LABEL} of the collecting system [by name].")
@click.option(
    "--side", type=click.Choice(["left", "right"]), help="Which kidney, where the labels hold both."
)
@click.option(
    "--series",
    help="Number of the CT series, or the end of its uid, where there are several [the best guess].",
)
def import_patient_command(
    ct: Path, labels: tuple[Path, ...], out: Path, side: Side | None, series: str | None, **words: str | None
) -> None:
    """Make a patient's folder, with a scene, out of a CT and its LABELS.

    CT: a folder with DICOM, a DICOMDIR or zip archive, a NIfTI, NRRD or MHA file. LABELS: label maps, a folder with a file
    an organ, DICOM-SEG, RTSTRUCT; without them those that lie with the CT.
    """
    chosen = {option: label_words(text, option) for option, text in words.items() if text is not None}
    patient, private = _imported(ct, labels, chosen, side, series)
    rows = facts(patient)
    texts = {"scene.toml": scene_text(patient_scene(patient))}
    searched = save_patient(patient, out, texts, lambda folder: draw_check(patient, rows, folder), private)
    click.echo(told(rows))
    click.echo(
        told(
            [
                (
                    "private",
                    f"{searched} names, ids, dates, uids and paths of the source are in none of the files",
                )
            ]
        )
    )
    click.echo(
        f"Written to {out}. Look at {out / 'check.png'}, then rehearse with: python app.py rehearse {out}"
    )


def _imported(
    ct: Path, labels: Sequence[Path], chosen: dict[str, list[str]], side: Side | None, series: str | None
) -> tuple[Patient, set[str]]:
    """The patient, and what none of its files may hold."""
    organ = chosen.pop("organ", [])
    words = [*organ, *(word for several in chosen.values() for word in several)]
    drawings = [open_labels(path, words, bar) for path in labels] or [_with_ct(ct)]
    referenced = next((drawing.referenced for drawing in drawings if drawing.referenced), "")
    volume = open_ct(ct, series, referenced, bar)
    maps = [one for drawing in drawings for one in drawing.maps(volume.grid)]
    tissues = {TISSUE_OPTIONS[option]: words for option, words in chosen.items()}
    label_map = merged(with_tissues(maps, organ, tissues))
    patient = import_patient(volume, label_map, label_map.called(organ) if organ else None, side)
    private = set(volume.secrets).union(*(drawing.secrets for drawing in drawings))
    for path in (ct, *labels):
        private |= {str(path.resolve()), *([str(path)] if len(path.parts) > 1 else [])}
    return patient, private


def _with_ct(ct: Path) -> Drawing:
    """The labels that lie with a CT."""
    found = drawing_of(dicom_or_words(ct, bar)) if ct.is_dir() else None
    if found is None:
        raise PatientError(f"{ct}: no labels lie with this CT; give a file or folder with LABELS")
    return found


def label_words(text: str, option: str) -> list[str]:
    """Names or values of an option's text, such as "1,2"."""
    words = [word.strip() for word in text.split(",")]
    if not all(words):
        raise PatientError(f"--{option} is {text!r}: expected names or values of labels, such as 1 or 1,2")
    return words
