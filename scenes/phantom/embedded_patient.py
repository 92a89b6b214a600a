"""The embedded patient: drawn and imported when it is first needed, then kept as a patient's folder in a
cache.

The generator and the importer are imported only to make it.
"""

import contextlib
import hashlib
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from errors import PatientError
from scenes.scene import SceneError, scene_text
from scenes.terminal import ReportProgress, no_progress

if TYPE_CHECKING:
    from scenes.patients.patient_import import Patient

SCENES = Path(__file__).parents[1]
CACHE = SCENES.parent / ".cache"
# When one of these changes, the embedded patient is made again.
SOURCES = ("phantom/*", "patients/*.py", "patients/readers/label_maps.py")


def phantom_folder(progress: ReportProgress = no_progress) -> Path:
    """The embedded patient's folder, from the cache where it is there.

    Raises SceneError where it cannot be written.
    """
    files = sorted(path for pattern in SOURCES for path in SCENES.glob(pattern) if path.is_file())
    sources = b"".join(path.read_bytes() for path in files)
    name = f"phantom-{hashlib.sha256(sources).hexdigest()[:12]}"
    places = [root / name for root in (CACHE, Path(tempfile.gettempdir()) / "nephron")]
    if cached := next((folder for folder in places if folder.is_dir()), None):
        return cached
    from scenes.patients.patient_folder import save_patient
    from scenes.patients.patient_scene import patient_scene

    patient = make_embedded_patient(progress)
    for folder in places:
        with contextlib.suppress(PatientError):
            save_patient(patient, folder, {"scene.toml": scene_text(patient_scene(patient))})
        if folder.is_dir():  # also where another process was first
            return folder
    roots = " and ".join(str(folder.parent) for folder in places)
    raise SceneError(
        f"{roots}: the embedded patient's files can be written to neither; free 20 MB in one of them"
    )


def make_embedded_patient(progress: ReportProgress = no_progress) -> "Patient":
    """Draw CT and labels, and import them. All labels but the tumour are the organ."""
    from scenes.patients.patient_import import import_patient
    from scenes.patients.readers.label_maps import LabelMap
    from scenes.phantom.kidney import Label, make_phantom
    from scenes.volumes.lazy_volume import LazyVolume

    progress("Making the embedded patient, only once: its CT")
    ct, image = make_phantom()
    progress("Making the embedded patient, only once: its surfaces")
    labels = LabelMap.of(image)
    segments = {v: replace(segment, tissue=Label(v).name.lower()) for v, segment in labels.segments.items()}
    organ = [value for value in segments if value != Label.TUMOUR]
    return import_patient(
        LazyVolume.of(ct), replace(labels, segments=segments), organ, side="left", position="supine"
    )
