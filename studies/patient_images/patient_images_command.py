"""The command ``study patient-images``: B-mode images of patients' kidneys beside their CT, and what can
be seen in them.
"""

from dataclasses import asdict, dataclass
from pathlib import Path

import click
import numpy as np
from tqdm import tqdm

from rehearsal.commands.command_line import CommandError, load_patient, make_folder, start_taichi
from rehearsal.result_files import rounded
from scenes.anatomy import LoadedAnatomy
from scenes.scene import Scene
from studies.image_quality import NOISE_DEPTHS_MM, depth_of_noise_mm, snr_db
from studies.patient_images.image_figures import agent_figures, capsule_figures, picture_figures
from studies.patient_images.image_sheet import write_sheet
from studies.patient_images.patient_image_scans import ImagedPatient
from studies.study_options import out_option
from studies.study_results import table_of, write_results
from ultrasound.probe import Probe, load_probe

PROBES = "drop-in", "linear", "curvilinear"
COLUMNS = (
    ("patient", "{patient}"),
    ("", "{title}"),
    ("probe", "{probe}"),
    ("fat brighter [AUC]", "{fat_auc:.2f}"),
    ("surroundings brighter [AUC]", "{surroundings_auc:.2f}"),
    ("grey, median", "{grey_median:.0f}"),
    ("90 %", "{grey_p90:.0f}"),
    ("capsule, 0-10 deg [dB]", "{capsule_db:.1f}"),
    ("15-20 deg", "{capsule_aslant_db:.1f}"),
    ("speckle's own", "{capsule_control_db:.1f}"),
    ("agent [dB]", "{agent_db:.1f}"),
    ("behind it", "{behind_agent_db:.1f}"),
    ("outlined", "{outlined:.2f}"),
    ("by place alone", "{outlined_by_place:.2f}"),
)


NOISE_COLUMNS = (
    ("speckle of cortex over noise [dB]", "{probe}"),
    *((f"at {depth:g} mm", f"{{at_{depth:g}_mm_db:.1f}}") for depth in NOISE_DEPTHS_MM),
    ("0 dB at [mm]", "{noise_depth_mm:.0f}"),
)


@dataclass(frozen=True)
class PatientImageRow:
    """Figures of one patient and probe, pooled over the standard planes (``picture_figures``,
    ``scanline_figures``); None where there is too little to judge.
    """

    patient: int
    title: str
    probe: str
    fat_auc: float | None
    surroundings_auc: float | None
    grey_median: float | None
    grey_p90: float | None
    capsule_db: float | None
    capsule_aslant_db: float | None
    capsule_control_db: float | None
    agent_db: float | None
    behind_agent_db: float | None
    outlined: float | None
    outlined_by_place: float | None


@click.command("patient-images")
@click.argument(
    "patients", metavar="PATIENT...", type=click.Path(path_type=Path, readable=False), nargs=-1, required=True
)
@click.option(
    "--probe",
    "names",
    metavar="NAME",
    multiple=True,
    default=PROBES,
    help="Probe, by name or file; may be given several times [drop-in, linear, curvilinear].",
)
@out_option
def patient_images(patients: tuple[Path, ...], names: tuple[str, ...], out: Path) -> None:
    """Show B-mode images of kidneys beside their CT, and measure what can be seen.

    PATIENT... are patients' folders or scene files with a CT and labels. One sheet for each patient and
    probe: CT, labels, classes and B-mode image of eight standard planes. Half a minute for each patient and
    probe.
    """
    make_folder(out)
    probes = {Path(name).stem: load_probe(name) for name in names}
    # All before the first is imaged: a wrong path is refused before any work.
    loaded = [_loaded(path) for path in patients]
    backend = start_taichi("cpu")
    rows: list[PatientImageRow] = []
    with tqdm(total=len(patients) * len(probes), desc="patient-images", unit="sheet") as bar:
        for number, (scene, anatomy) in enumerate(loaded, 1):
            patient = ImagedPatient.of(scene, anatomy)
            for name, probe in probes.items():
                rows.append(_row(patient, number, name, probe, out))
                bar.update()
    described = [asdict(row) for row in rows]
    noise = [_noise(name, probe) for name, probe in probes.items()]
    shares = np.array([(row.outlined, row.outlined_by_place) for row in rows], float)
    outlined, by_place = shares.mean(axis=0).tolist()
    text = (
        f"{table_of(COLUMNS, described)}\n\nOutlined on {100 * outlined:.0f} % of the planes, by place "
        f"alone on {100 * by_place:.0f} %\n\n"
        f"{table_of(NOISE_COLUMNS, noise)}"
    )
    report = dict(
        backend=backend,
        rows=described,
        outlined=outlined,
        outlined_by_place=by_place,
        speckle_over_noise=noise,
    )
    write_results(out, "patient-images", report, text, described)


def _loaded(path: Path) -> tuple[Scene, LoadedAnatomy]:
    """Return a patient with CT and labels. Raises CommandError, SceneError, PatientError."""
    scene, anatomy = load_patient(path)
    if anatomy.ct is None or anatomy.labels is None:
        raise CommandError(f"{path}: has no CT or no labels; expected both (anatomy.ct, anatomy.labels)")
    return scene, anatomy


def _row(patient: ImagedPatient, number: int, name: str, probe: Probe, out: Path) -> PatientImageRow:
    """Write the sheet of a patient and a probe; its figures."""
    scans = list(patient.scans(probe))
    title = patient.scene.title
    write_sheet(patient, scans, f"{number}: {title}, {name}", out / f"patient-{number}-{name}.png")
    scanlines = [scan.scanlines for scan in scans]
    figures = picture_figures(scans) | capsule_figures(scanlines) | agent_figures(scanlines, patient.truth)
    return PatientImageRow(number, title, name, **{key: rounded(value) for key, value in figures.items()})


def _noise(name: str, probe: Probe) -> dict[str, str | float | None]:
    """Return a row: speckle of cortex over noise [dB] by depth, and the depth at which it is 0 dB [mm]."""
    levels = {
        f"at_{depth:g}_mm_db": rounded(float(snr))
        for depth, snr in zip(NOISE_DEPTHS_MM, snr_db(probe, np.array(NOISE_DEPTHS_MM)), strict=True)
    }
    return {"probe": name, **levels, "noise_depth_mm": rounded(depth_of_noise_mm(probe))}
