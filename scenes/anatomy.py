"""Load what a scene names: surfaces, CT and labels of a patient's folder, or of the embedded patient."""

import contextlib
import hashlib
import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
import SimpleITK as sitk
import trimesh

from scenes.patients.hilum import hilum
from scenes.patients.import_error import PatientError
from scenes.patients.organ_selection import GROWN, PARENCHYMA
from scenes.patients.part_surfaces import PARTS
from scenes.patients.patient_folder import save_patient
from scenes.patients.patient_import import Patient, import_patient, tissue_codes
from scenes.patients.readers.label_maps import LabelMap
from scenes.patients.readers.lazy_volume import LazyVolume
from scenes.patients.readers.volume_readers import file_volume
from scenes.phantom.kidney import Label, make_phantom
from scenes.progress import ReportProgress, no_progress
from scenes.scene import (
    AnatomyFiles,
    Attachment,
    DistanceShape,
    Image,
    MeshShape,
    PlaneShape,
    Press,
    Scene,
    SceneError,
)
from scenes.surface_files import load_surface

HERE = Path(__file__).parent
CACHE = HERE.parent / ".cache"
# What the embedded patient is made by: when one of these changes, it is made anew.
PHANTOM_SOURCES = (
    *("anatomy", "phantom/kidney", "phantom/abdomen", "patients/organ_selection", "patients/patient_import"),
    *(
        "patients/part_surfaces",
        "patients/label_surfaces",
        "patients/moulded_support",
        "patients/readers/label_maps",
    ),
)
FAT_HU = -110.0
LEAST_WINDOW_HU = 310.0  # to 200 HU, or an unenhanced kidney is white
# What the parts of the embedded kidney are for sound.
TISSUE_OF_PART: dict[int, str] = {
    Label.CORTEX: "cortex",
    Label.MEDULLA: "medulla",
    Label.SINUS_FAT: "sinus",
    Label.COLLECTING_SYSTEM: "urine",
    Label.VESSEL: "vessel",
    Label.TUMOUR: "tumour",
}
PHANTOM_PARTS: tuple[Literal["urine", "vessel"], ...] = ("urine", "vessel")
PHANTOM_TISSUES = {str(code): tissue for tissue, code in tissue_codes(list(TISSUE_OF_PART.values())).items()}


@dataclass(frozen=True)
class Grid:
    """Voxels (nx, ny, nz) float32 and the affine map (4, 4) from patient coordinates [mm] to voxel indices."""

    voxels: np.ndarray
    index_from_mm: np.ndarray


@dataclass(frozen=True)
class LoadedAnatomy:
    """Everything of one patient that a rehearsal needs; LPS [mm]."""

    organ: trimesh.Trimesh
    tumour: trimesh.Trimesh | None
    ct: Grid | None
    shapes: tuple[PlaneShape | trimesh.Trimesh | Grid, ...]
    labels: Grid | None = None
    tissues: dict[int, str] = field(default_factory=dict)
    """Which tissue each label is."""
    parts: dict[str, trimesh.Trimesh] = field(default_factory=dict)
    """Surfaces of cysts, vessels and collecting system, by tissue."""


def load_anatomy(scene: Scene, folder: Path, progress: ReportProgress = no_progress) -> LoadedAnatomy:
    """Read the files that a scene names, relative to ``folder``. Raises SceneError, PatientError."""
    folder, anatomy = files_of(scene, folder, progress)
    return LoadedAnatomy(
        organ=load_surface(folder / anatomy.organ),
        tumour=load_surface(folder / anatomy.tumour) if anatomy.tumour else None,
        ct=_grid(folder, anatomy.ct) if anatomy.ct else None,
        shapes=tuple(_shape(folder, shape) for shape in scene.shape),
        labels=_labels(folder, anatomy),
        tissues={int(label): tissue for label, tissue in anatomy.tissues.items()},
        parts={tissue: load_surface(folder / file) for tissue, file in anatomy.parts.items()},
    )


def files_of(scene: Scene, folder: Path, progress: ReportProgress = no_progress) -> tuple[Path, AnatomyFiles]:
    """A scene's files and the folder that they are in: its own, or the embedded patient's. Raises SceneError."""
    if not scene.anatomy.phantom:
        return folder, scene.anatomy
    parts = {tissue: f"{PARTS[tissue]}.stl" for tissue in PHANTOM_PARTS}
    return phantom_folder(progress), AnatomyFiles(
        tumour="tumour.stl", parts=parts, ct="ct.nrrd", labels="labels.nrrd", tissues=PHANTOM_TISSUES
    )


def fingerprint(anatomy: LoadedAnatomy) -> str:
    """A short name of what a rehearsal's body and pictures are made of: other surfaces or voxels, another name."""
    digest = hashlib.sha256()
    parts = [anatomy.parts[name] for name in sorted(anatomy.parts)]
    for each in (anatomy.organ, anatomy.tumour, *parts, anatomy.ct, anatomy.labels, *anatomy.shapes):
        if isinstance(each, trimesh.Trimesh):
            digest.update(np.ascontiguousarray(each.vertices).tobytes() + each.faces.tobytes())
        elif isinstance(each, Grid):
            digest.update(np.ascontiguousarray(each.voxels).tobytes() + each.index_from_mm.tobytes())
        else:
            digest.update(repr(each).encode())
    return digest.hexdigest()[:16]


def press_on(press: Press, anatomy: LoadedAnatomy, gravity: np.ndarray) -> Press:
    """A press with what it leaves open filled in.

    The axis follows gravity through the middle of the tumour, or of the organ where there is none; the image is
    taken along the organ's long axis.
    """
    direction = np.array(press.direction or gravity, float)
    middle = (anatomy.tumour or anatomy.organ).center_mass
    long_axis = np.linalg.svd(
        anatomy.organ.vertices - anatomy.organ.vertices.mean(axis=0), full_matrices=False
    )[2][0]
    # The sign of a principal axis is arbitrary; the head, or the patient's left, is to the marked side.
    long_axis *= np.sign(long_axis[np.argmax(np.abs(long_axis))])
    return press.model_copy(
        update={
            "target_mm": press.target_mm or tuple(float(v) for v in middle),
            "direction": tuple(float(v) for v in direction / np.linalg.norm(direction)),
            "lateral": press.lateral or tuple(float(v) for v in long_axis),
        }
    )


def patient_scene(patient: Patient) -> Scene:
    """The scene that an import writes beside the patient's files: on the back, on the moulded support."""
    tumour = None if patient.tumour is None else "tumour.stl"
    own = [code for code, tissue in patient.tissues.items() if tissue in (*PARENCHYMA, *GROWN)]
    hu = sitk.GetArrayViewFromImage(patient.ct)[np.isin(sitk.GetArrayViewFromImage(patient.labels), own)]
    # From fat to the brightest of the organ, whatever contrast agent it holds.
    darkest = FAT_HU
    brightest = max(round(float(np.percentile(hu, 99)), -1), darkest + LEAST_WINDOW_HU)
    return Scene(
        image=Image(window_hu=brightest - darkest, level_hu=(brightest + darkest) / 2),
        title=f"{patient.side.capitalize()} kidney{' (draft)' if patient.draft else ''}",
        anatomy=AnatomyFiles.model_validate(
            dict(
                tumour=tumour,
                parts={tissue: f"{PARTS[tissue]}.stl" for tissue in patient.parts if tissue != "tumour"},
                ct="ct.nrrd",
                labels="labels.nrrd",
                tissues={str(code): tissue for code, tissue in patient.tissues.items()},
            )
        ),
        attachment=Attachment(at_mm=hilum(patient.organ, patient.side)),
        shape=(MeshShape(kind="mesh", file="support.stl"),),
    )


def phantom_folder(progress: ReportProgress = no_progress) -> Path:
    """Folder of the embedded patient, imported like any other on first use and whenever its sources changed."""
    sources = [HERE / f"{name}.py" for name in PHANTOM_SOURCES]
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:12]
    places = [root / f"phantom-{digest}" for root in (CACHE, Path(tempfile.gettempdir()) / "nephron")]
    there = next((folder for folder in places if folder.is_dir()), None)
    return there or _saved_in_one_of(places, _phantom_patient(progress))


def _saved_in_one_of(places: list[Path], patient: Patient) -> Path:
    """The first folder that a patient could be saved in. Raises SceneError."""
    for folder in places:
        with contextlib.suppress(PatientError):
            save_patient(patient, folder)
        if folder.is_dir():  # also where another process was first
            return folder
    roots = " and ".join(str(folder.parent) for folder in places)
    raise SceneError(
        f"{roots}: the embedded patient's files can be written to neither; free 20 MB in one of them"
    )


def _phantom_patient(progress: ReportProgress) -> Patient:
    """The embedded patient: its organ is all that it has labelled."""
    progress("Making the embedded patient, this once: its CT")
    ct, image = make_phantom()
    progress("Making the embedded patient, this once: its surfaces")
    labels = LabelMap.of(image)
    named = {
        value: replace(segment, tissue=TISSUE_OF_PART[value]) for value, segment in labels.segments.items()
    }
    own = [value for value in named if value != Label.TUMOUR]
    return import_patient(LazyVolume.of(ct), replace(labels, segments=named), own, side="left")


def _grid(folder: Path, name: str) -> Grid:
    path = folder / name
    if not path.is_file():
        raise SceneError(f"{path}: no such file; check the scene")
    volume = file_volume(path)
    mm_from_index = np.eye(4)
    mm_from_index[:3, :3] = volume.grid.direction * volume.grid.spacing
    mm_from_index[:3, 3] = volume.grid.origin
    return Grid(
        np.ascontiguousarray(volume.read().transpose(2, 1, 0), np.float32), np.linalg.inv(mm_from_index)
    )


def _labels(folder: Path, anatomy: AnatomyFiles) -> Grid | None:
    """The label map, on the CT's grid."""
    if anatomy.labels is None or anatomy.ct is None:
        return None
    labels, ct = _grid(folder, anatomy.labels), _grid(folder, anatomy.ct)
    if labels.voxels.shape != ct.voxels.shape or not np.allclose(
        labels.index_from_mm, ct.index_from_mm, atol=1e-3
    ):
        raise SceneError(
            f"{folder / anatomy.labels}: is on another grid than {anatomy.ct}; expected the same"
        )
    return labels


def _shape(
    folder: Path, shape: PlaneShape | MeshShape | DistanceShape
) -> PlaneShape | trimesh.Trimesh | Grid:
    if isinstance(shape, PlaneShape):
        return shape
    if isinstance(shape, MeshShape):
        return load_surface(folder / shape.file)
    grid = _grid(folder, shape.file)
    axes = grid.index_from_mm[:3, :3]
    if not np.allclose(axes, np.diag(np.diag(axes))) or (np.diag(axes) <= 0).any():
        raise SceneError(
            f"{folder / shape.file}: its axes are not the patient's; expected the identity direction"
        )
    return grid
