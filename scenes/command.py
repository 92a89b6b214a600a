"""The command ``import``: a patient's folder, with a scene, out of a CT and its labels."""

from pathlib import Path

import click

from scenes.anatomy import patient_scene
from scenes.labels import Side
from scenes.patient import describe, import_patient, save_patient
from scenes.reading import PatientError, read_volume
from scenes.scene import scene_text


@click.command("import")
@click.argument("ct", type=click.Path(path_type=Path))
@click.argument("labels", type=click.Path(path_type=Path))
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    required=True,
    help="Folder to write the patient to; new or empty.",
)
@click.option("--organ", help="Label values of the organ, such as 1 or 1,2 [all but the tumour's].")
@click.option("--tumour", help="Label values of the tumour [none].")
@click.option(
    "--side", type=click.Choice(["left", "right"]), help="Which kidney, where the labels hold both."
)
def import_patient_command(
    ct: Path, labels: Path, out: Path, organ: str | None, tumour: str | None, side: Side | None
) -> None:
    """Make a patient's folder, with a scene, out of a CT (DICOM folder, NIfTI, NRRD, MHA) and its LABELS."""
    patient = import_patient(
        read_volume(ct),
        read_volume(labels),
        label_values(organ, "--organ"),
        label_values(tumour, "--tumour"),
        side,
    )
    save_patient(patient, out, {"scene.toml": scene_text(patient_scene(patient))})
    click.echo(describe(patient))
    click.echo(f"Written to {out}. Rehearse with: python app.py rehearse {out}")


def label_values(text: str | None, option: str) -> list[int] | None:
    """Label values of an option's text, such as "1,2"."""
    if text is None:
        return None
    try:
        return [int(value) for value in text.split(",")]
    except ValueError:
        raise PatientError(f"{option} is {text!r}: expected whole numbers such as 1 or 1,2") from None
