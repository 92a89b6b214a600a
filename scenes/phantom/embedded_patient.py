"""The embedded patient: drawn and imported when it is first needed, then kept as a patient's folder in a cache.

The generator and the importer are imported only to make it.
"""

import contextlib
import hashlib
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from errors import PatientError
from scenes.scene import SceneError
from scenes.terminal import ReportProgress, no_progress

if TYPE_CHECKING:
    from scenes.patients.patient_import import Patient

SCENES = Path(__file__).parents[1]
CACHE = SCENES.parent / ".cache"
# When one of these changes, the embedded patient is made again.
PHANTOM_SOURCES = (
    "phantom/embedded_patient.py",
    "phantom/kidney.py",
    "phantom/abdomen.py",
    "patients/label_surfaces.py",
    "patients/organ_support.py",
    "patients/organ_selection.py",
    "patients/part_surfaces.py",
    "patients/patient_import.py",
    "patients/patient_scene.py",
    "patients/readers/label_maps.py",
)


def phantom_folder(progress: ReportProgress = no_progress) -> Path:
    """The embedded patient's folder, from the cache where it is there. Raises SceneError where it cannot be written."""
    sources = b"".join((SCENES / name).read_bytes() for name in PHANTOM_SOURCES)
    name = f"phantom-{hashlib.sha256(sources).hexdigest()[:12]}"
    places = [root / name for root in (CACHE, Path(tempfile.gettempdir()) / "nephron")]
    cached = next((folder for folder in places if folder.is_dir()), None)
    return cached or _save(make_embedded_patient(progress), places)


def make_embedded_patient(progress: ReportProgress = no_progress) -> "Patient":
    """Draw CT and labels, and import them. All labels but the tumour are the organ."""
    from scenes.patients.patient_import import import_patient
    from scenes.patients.readers.label_maps import LabelMap
    from scenes.phantom.kidney import TISSUE_OF_LABEL, Label, make_phantom
    from scenes.volumes.lazy_volume import LazyVolume

    progress("Making the embedded patient, only once: its CT")
    ct, image = make_phantom()
    progress("Making the embedded patient, only once: its surfaces")
    labels = LabelMap.of(image)
    segments = {v: replace(segment, tissue=TISSUE_OF_LABEL[v]) for v, segment in labels.segments.items()}
    organ = [value for value in segments if value != Label.TUMOUR]
    return import_patient(LazyVolume.of(ct), replace(labels, segments=segments), organ, side="left")


def _save(patient: "Patient", places: list[Path]) -> Path:
    """Save into the first folder that can be written. Raises SceneError."""
    from scenes.patients.patient_folder import save_patient
    from scenes.patients.patient_scene import patient_scene
    from scenes.scene import scene_text

    for folder in places:
        with contextlib.suppress(PatientError):
            save_patient(patient, folder, {"scene.toml": scene_text(patient_scene(patient))})
        if folder.is_dir():  # also where another process was first
            return folder
    roots = " and ".join(str(folder.parent) for folder in places)
    raise SceneError(
        f"{roots}: the embedded patient's files can be written to neither; free 20 MB in one of them"
    )
