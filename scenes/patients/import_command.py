"""The command ``import``: makes a patient's folder with a scene from a CT and its labels."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import numpy as np

from errors import PatientError, UserError
from scenes.atomic_files import check_folder
from scenes.patient_space import SPACES, Space
from scenes.patients.patient_folder import public
from scenes.patients.patient_position import POSITIONS, Position
from scenes.patients.readers.segment_names import Side
from scenes.terminal import bar, shell_command
from text_files import read_text

# Options that assign labels to a tissue.
TISSUE_OPTIONS = {
    "tumour": "tumour",
    "cyst": "cyst",
    "vessels": "vessel",
    "arteries": "artery",
    "veins": "vein",
    "collecting": "urine",
    "stones": "stone",
}
LABEL = "Names or values of the labels"
# The file of a probe of the user's own, in the patient's folder.
PROBE_FILE = "probe.toml"


@click.command("import")
@click.argument("ct", type=click.Path(path_type=Path))
@click.argument("labels", type=click.Path(path_type=Path), nargs=-1)
@click.option("--out", type=click.Path(path_type=Path), help="Folder to write to; new or empty.")
@click.option("--list", "lists", is_flag=True, help="List series and labels, and make nothing.")
@click.option(
    "--organ", help=f"{LABEL} that are the organ, such as 1,2 [named as a kidney; without names, all]."
)
@click.option("--tumour", help=f"{LABEL} of the tumour [by name].")
@click.option("--cyst", help=f"{LABEL} of cysts [by name].")
@click.option("--vessels", help=f"{LABEL} of blood vessels of either kind [by name].")
@click.option("--arteries", help=f"{LABEL} of arteries [by name].")
@click.option("--veins", help=f"{LABEL} of veins [by name].")
@click.option("--collecting", help=f"{LABEL} of the collecting system [by name].")
@click.option("--stones", help=f"{LABEL} of stones [by name].")
@click.option("--side", type=click.Choice(["left", "right"]), help="Which kidney, where there are both.")
@click.option("--series", help="Number of the CT series, or the end of its uid [the best guess].")
@click.option(
    "--seed", help="X,Y,Z in mm, LPS: without labels, a draft of the kidney by region growing from there."
)
@click.option(
    "--support",
    default="mould",
    show_default=True,
    help="What the organ rests on: a mould of its underside, a bed made from the labels around it "
    "(labels), or a surface in a "
    "file (LPS, mm).",
)
@click.option(
    "--position",
    type=click.Choice(POSITIONS),
    help="How the patient lay in the CT [the CT's header, else supine]; left-decubitus is on the left side.",
)
@click.option(
    "--space",
    type=click.Choice(SPACES, case_sensitive=False),
    help="Where +x, +y and +z point in files that do not name it, such as RAS: to the patient's right, "
    "front (anterior) and head "
    "(superior).",
)
@click.option(
    "--probe",
    metavar="NAME|FILE",
    default="drop-in",
    show_default=True,
    help="The probe, by name (drop-in, micro, linear, curvilinear, phased) or in a file, which is copied.",
)
@click.option(
    "--uniform",
    is_flag=True,
    help="One stiffness for all tissue [tumour, cysts, sinus and collecting system have their own].",
)
@click.pass_obj
def import_patient_command(
    read_probe: Callable[[str], Any],
    ct: Path,
    labels: tuple[Path, ...],
    out: Path | None,
    lists: bool,
    organ: str | None,
    side: Side | None,
    series: str | None,
    seed: str | None,
    support: str,
    position: Position | None,
    space: Space | None,
    probe: str,
    uniform: bool,
    **words: str | None,
) -> None:
    """Make a patient's folder from a CT and its LABELS.

    The folder contains the scene to rehearse.

    CT: a folder with DICOM, a DICOMDIR or zip archive, a NIfTI, NRRD or MHA file. LABELS: label maps,
    surfaces (STL, PLY, OBJ), a folder with one file per organ, DICOM-SEG, RTSTRUCT; by default the
    segmentation in the CT's folder.
    """
    if lists:
        from scenes.patients.import_listing import listing_text

        click.echo(listing_text(ct, labels, bar, space))
        return
    if out is None:
        raise click.UsageError("--out: expected a folder to write to, or --list to see what there is")
    check_folder(out)
    try:
        housing_mm, texts = read_probe(probe).housing_mm, dict[str, str]()
    except UserError as error:
        raise UserError(str(error).replace("transducer.probe", "--probe")) from None
    # The program's own probes have names without a suffix.
    if Path(probe).suffix:
        probe, texts = PROBE_FILE, {PROBE_FILE: read_text(Path(probe))}
    # Matplotlib and highdicom take 0.5 s to import.
    from scenes.patients.check_picture import as_table
    from scenes.patients.import_folder import save_import
    from scenes.patients.import_request import import_request

    tissues = {TISSUE_OPTIONS[o]: label_words(text, o) for o, text in words.items() if text is not None}
    own = [] if organ is None else label_words(organ, "organ")
    seed_place = None if seed is None else position_mm(seed)
    patient = import_request(
        ct, labels, own, tissues, side, series, seed_place, support, position, bar, space
    )
    click.echo(as_table(save_import(patient, out, probe, housing_mm, uniform, texts)))
    written = public(patient)
    if (written.notes, written.warnings) != (patient.notes, patient.warnings):
        click.echo("Names of labels that may be a person's are shown here, and are not in the files.")
    click.echo(
        f"The probe is {probe}, on the organ over the "
        f"{'middle' if patient.tumour is None else 'tumour'}; --probe gives another.\n"
        f"Written to {out}. Check {out / 'check.png'}, then: {shell_command('rehearse', out)}"
    )


def label_words(text: str, option: str) -> list[str]:
    """Names or values of labels in an option's text, such as "1,2"."""
    words = [word.strip() for word in text.split(",")]
    if not all(words):
        raise PatientError(f"--{option} is {text!r}: expected names or values of labels, such as 1 or 1,2")
    return words


def position_mm(text: str) -> np.ndarray:
    """A position in LPS [mm] in an option's text."""
    try:
        position = np.array([float(number) for number in text.split(",")])
    except ValueError:
        position = np.array([])
    if position.shape != (3,) or not np.isfinite(position).all():
        raise PatientError(
            f"--seed is {text!r}: expected three numbers X,Y,Z in mm, LPS, such as -60,25,-310"
        )
    return position
