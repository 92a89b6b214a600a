"""Load the files of a scene: surfaces, CT and labels of a patient's folder, or of the embedded patient."""

import hashlib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import trimesh

from scenes.perirenal_fat import fat_thickness
from scenes.phantom.embedded_patient import phantom_folder
from scenes.scene import (
    AnatomyFiles,
    DistanceShape,
    MeshShape,
    PlaneShape,
    Press,
    Scene,
    SceneError,
    load_scene,
    scene_file,
)
from scenes.surfaces import load_surface
from scenes.terminal import ReportProgress, no_progress
from scenes.volumes.volume_files import file_volume


@dataclass(frozen=True)
class Grid:
    """Voxels (nx, ny, nz) float32, and the affine transform (4, 4) from LPS [mm] to voxel indices."""

    voxels: np.ndarray
    index_from_mm: np.ndarray


@dataclass(frozen=True)
class LoadedAnatomy:
    """The surfaces and volumes of one patient in LPS [mm]."""

    organ: trimesh.Trimesh
    tumour: trimesh.Trimesh | None
    ct: Grid | None
    shapes: tuple[PlaneShape | trimesh.Trimesh | Grid, ...]
    labels: Grid | None = None
    tissues: dict[int, str] = field(default_factory=dict)
    """The tissue of each label value."""
    parts: dict[str, trimesh.Trimesh] = field(default_factory=dict)
    """Surfaces of cysts, vessels and collecting system, by tissue."""
    corrections: Grid | None = None
    corrected_tissues: dict[int, str] = field(default_factory=dict)
    """The tissue of each value of the corrections."""
    fat_mm: np.ndarray | None = None
    """Thickness (faces,) [mm] of the fat before each face of the organ (``fat_thickness``), where a CT shows
    it and the scene needs it.
    """


def load_anatomy(scene: Scene, folder: Path, progress: ReportProgress = no_progress) -> LoadedAnatomy:
    """Read the files of a scene, relative to ``folder``. Raises SceneError, PatientError."""
    folder, anatomy = files_of(scene, folder, progress)
    ct = _grid(folder, anatomy.ct) if anatomy.ct else None
    organ = load_surface(folder / anatomy.organ)
    has_fat = scene.attachment.fat_young_kpa > 0
    return LoadedAnatomy(
        organ=organ,
        tumour=load_surface(folder / anatomy.tumour) if anatomy.tumour else None,
        ct=ct,
        shapes=tuple(_shape(folder, shape) for shape in scene.shape),
        labels=_labels(folder, anatomy, ct),
        tissues={int(label): tissue for label, tissue in anatomy.tissues.items()},
        parts={tissue: load_surface(folder / file) for tissue, file in anatomy.parts.items()},
        corrections=_grid(folder, anatomy.corrections) if anatomy.corrections else None,
        corrected_tissues={int(value): tissue for value, tissue in anatomy.corrected_tissues.items()},
        fat_mm=fat_thickness(organ, ct.voxels, ct.index_from_mm) if ct and has_fat else None,
    )


def files_of(scene: Scene, folder: Path, progress: ReportProgress = no_progress) -> tuple[Path, AnatomyFiles]:
    """The files of a scene and their folder: its own, or the embedded patient's. Raises SceneError."""
    if not scene.anatomy.phantom:
        return folder, scene.anatomy
    embedded = phantom_folder(progress)
    return embedded, load_scene(scene_file(embedded)).anatomy


def fingerprint(anatomy: LoadedAnatomy) -> str:
    """A hash of all surfaces and voxels."""
    digest = hashlib.sha256()
    parts = [anatomy.parts[name] for name in sorted(anatomy.parts)]
    arrays: tuple[np.ndarray, ...]
    volumes = anatomy.ct, anatomy.labels, *([anatomy.corrections] if anatomy.corrections else [])
    for geometry in (anatomy.organ, anatomy.tumour, *parts, *volumes, *anatomy.shapes):
        if isinstance(geometry, trimesh.Trimesh):
            arrays = geometry.vertices, geometry.faces
        elif isinstance(geometry, Grid):
            arrays = geometry.voxels, geometry.index_from_mm
        else:
            digest.update(repr(geometry).encode())
            continue
        for array in arrays:
            digest.update(np.ascontiguousarray(array).data.cast("B"))
    return digest.hexdigest()[:16]


def press_on(press: Press, anatomy: LoadedAnatomy, gravity: np.ndarray) -> Press:
    """The press with defaults for what the scene leaves out.

    The direction is gravity's, through the centre of mass of the tumour, or else of the organ; the image
    plane contains the organ's long axis.
    """
    direction = np.array(press.direction or gravity, float)
    middle = (anatomy.tumour or anatomy.organ).center_mass
    long_axis = np.linalg.svd(
        anatomy.organ.vertices - anatomy.organ.vertices.mean(axis=0), full_matrices=False
    )[2][0]
    # The sign of a principal axis is arbitrary: its largest component is made positive.
    long_axis *= np.sign(long_axis[np.argmax(np.abs(long_axis))])
    return press.model_copy(
        update={
            "target_mm": press.target_mm or tuple(float(v) for v in middle),
            "direction": tuple(float(v) for v in direction / np.linalg.norm(direction)),
            "lateral": press.lateral or tuple(float(v) for v in long_axis),
        }
    )


def _grid(folder: Path, name: str) -> Grid:
    path = folder / name
    if not path.is_file():
        raise SceneError(f"{path}: no such file; check the scene")
    volume = file_volume(path)
    return Grid(np.ascontiguousarray(volume.read().transpose(2, 1, 0), np.float32), volume.grid.index_from_mm)


def _labels(folder: Path, anatomy: AnatomyFiles, ct: Grid | None) -> Grid | None:
    """The label map. Raises SceneError where it is on another grid than the CT."""
    if anatomy.labels is None or ct is None:
        return None
    labels = _grid(folder, anatomy.labels)
    if labels.voxels.shape != ct.voxels.shape or not np.allclose(
        labels.index_from_mm, ct.index_from_mm, atol=1e-3
    ):
        raise SceneError(
            f"{folder / anatomy.labels}: is on another voxel grid than {anatomy.ct}; expected the same grid"
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
            f"{folder / shape.file}: its axes are not the patient's; expected the identity as direction"
        )
    return grid
