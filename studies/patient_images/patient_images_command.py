"""The command ``study patient-images``: B-mode images of patients' kidneys beside their CT, and what can
be seen in them.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import numpy as np

from rehearsal.commands.command_line import CommandError, load_patient
from rehearsal.result_files import rounded
from scenes.anatomy import LoadedAnatomy
from scenes.scene import Scene
from studies.image_quality import NOISE_DEPTHS_MM, depth_of_noise_mm, snr_db
from studies.patient_images.image_figures import agent_figures, capsule_figures, picture_figures
from studies.patient_images.image_sheet import write_sheet
from studies.patient_images.patient_image_scans import ImagedPatient
from studies.study import Results, Study, paths_argument, study_command
from studies.tables_and_panels import table_of
from ultrasound.probe import Probe, load_probe

PROBES = "drop-in", "linear", "curvilinear"
# Figures of one patient and probe, pooled over the standard planes (``image_figures``); None where there is
# too little to judge.
COLUMNS = {
    "patient": "{patient}",
    "": "{title}",
    "probe": "{probe}",
    "fat brighter [AUC]": "{fat_auc:.2f}",
    "surroundings brighter [AUC]": "{surroundings_auc:.2f}",
    "grey, median": "{grey_median:.0f}",
    "90 %": "{grey_p90:.0f}",
    "capsule, 0-10 deg [dB]": "{capsule_db:.1f}",
    "15-20 deg": "{capsule_aslant_db:.1f}",
    "speckle's own": "{capsule_control_db:.1f}",
    "agent [dB]": "{agent_db:.1f}",
    "behind it": "{behind_agent_db:.1f}",
    "outlined": "{outlined:.2f}",
    "by place alone": "{outlined_by_place:.2f}",
}


NOISE_COLUMNS = {
    "speckle of cortex over noise [dB]": "{probe}",
    **{f"at {depth:g} mm": f"{{at_{depth:g}_mm_db:.1f}}" for depth in NOISE_DEPTHS_MM},
    "0 dB at [mm]": "{noise_depth_mm:.0f}",
}


@study_command(
    "patient-images",
    paths_argument("patients", "PATIENT...", required=True),
    click.option(
        "--probe",
        "names",
        metavar="NAME",
        multiple=True,
        default=PROBES,
        help="Probe, by name or file; may be given several times [drop-in, linear, curvilinear].",
    ),
    arch="cpu",
)
def patient_images(study: Study, patients: tuple[Path, ...], names: tuple[str, ...]) -> Results:
    """Show B-mode images of kidneys beside their CT, and measure what can be seen.

    PATIENT... are patients' folders or scene files with a CT and labels. One sheet for each patient and
    probe: CT, labels, classes and B-mode image of eight standard planes. Half a minute for each patient and
    probe.
    """
    probes = {Path(name).stem: load_probe(name) for name in names}
    # All before the first is imaged: a wrong path is refused before any work.
    loaded = [_loaded(path) for path in patients]
    sheets = study.progress(len(loaded) * len(probes), "sheet", _rows(loaded, probes, study.out))
    rows = list(sheets)
    noise = [_noise(name, probe) for name, probe in probes.items()]
    shares = {name: float(np.mean([row[name] for row in rows])) for name in ("outlined", "outlined_by_place")}
    outlined, by_place = (f"{100 * share:.0f} %" for share in shares.values())
    summary = f"Outlined on {outlined} of the planes, by place alone on {by_place}"
    text = "\n\n".join([table_of(COLUMNS, rows), summary, table_of(NOISE_COLUMNS, noise)])
    report = dict(backend=study.backend, rows=rows) | shares | dict(speckle_over_noise=noise)
    return Results(report, text, rows)


def _loaded(path: Path) -> tuple[Scene, LoadedAnatomy]:
    """A patient with CT and labels. Raises CommandError, SceneError, PatientError."""
    scene, anatomy = load_patient(path)
    if anatomy.ct is None or anatomy.labels is None:
        raise CommandError(f"{path}: has no CT or no labels; expected both (anatomy.ct, anatomy.labels)")
    return scene, anatomy


def _rows(
    patients: list[tuple[Scene, LoadedAnatomy]], probes: dict[str, Probe], out: Path
) -> Iterator[dict[str, Any]]:
    """Write the sheet of each patient and probe; its figures."""
    for number, (scene, anatomy) in enumerate(patients, 1):
        patient = ImagedPatient.of(scene, anatomy)
        for name, probe in probes.items():
            scans = list(patient.scans(probe))
            sheet = out / f"patient-{number}-{name}.png"
            write_sheet(patient, scans, f"{number}: {scene.title}, {name}", sheet)
            scanlines = [scan.scanlines for scan in scans]
            echoes = capsule_figures(scanlines) | agent_figures(scanlines, patient.truth)
            figures = {key: rounded(value) for key, value in (picture_figures(scans) | echoes).items()}
            yield dict(patient=number, title=scene.title, probe=name) | figures


def _noise(name: str, probe: Probe) -> dict[str, str | float | None]:
    """A row: speckle of cortex over noise [dB] by depth, and the depth at which it is 0 dB [mm]."""
    levels = {
        f"at_{depth:g}_mm_db": rounded(float(snr))
        for depth, snr in zip(NOISE_DEPTHS_MM, snr_db(probe, np.array(NOISE_DEPTHS_MM)), strict=True)
    }
    return {"probe": name, **levels, "noise_depth_mm": rounded(depth_of_noise_mm(probe))}
