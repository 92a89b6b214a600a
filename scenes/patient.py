"""Patient import: a CT and a label map become an organ's surface, its tumour, its support, its CT.

Everything stays in patient coordinates: LPS [mm], +x to the patient's left, +y posterior, +z to the head, as
DICOM has them and as SimpleITK reads every format. Voxels are cropped, never resampled.
"""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import SimpleITK as sitk
import trimesh
from scipy import ndimage

from scenes.labels import LabelledOrgan, Side, labelled_organ
from scenes.reading import PatientError, read_volume
from scenes.support import cradle
from scenes.surfaces import surface_from_mask

__all__ = ["Patient", "PatientError", "describe", "import_patient", "read_volume", "save_patient"]

ORGAN, TUMOUR, FIRST_PART = 1, 2, 3
SUPINE_GRAVITY = np.array([0.0, 1.0, 0.0])  # as the CT was taken: on the back, posterior is down
AIR_HU = -1000
PADDING_BELOW_HU = -1024
# Faces of a surface grow with its area, so that a tumour is meshed as finely as a kidney of this volume.
FACES, FACES_AT_ML = 5000, 150.0
LEAST_FACES = 500


@dataclass(frozen=True)
class Patient:
    """One organ with what surrounds it; meshes in LPS [mm], watertight, normals outward."""

    ct: sitk.Image  # int16 [HU], cropped around the organ, original voxels and direction
    labels: sitk.Image  # uint8 on the grid of `ct`: a tissue each
    tissues: dict[int, str]  # what the labels are: 1 = kidney, 2 = tumour, and more where the import was told
    organ: trimesh.Trimesh  # tumour included
    tumour: trimesh.Trimesh | None
    support: trimesh.Trimesh
    side: Side
    organ_volume_ml: float  # of the label, tumour included
    tumour_volume_ml: float  # of the label; 0 without a tumour
    extent_mm: tuple[float, float, float]  # of the organ along x, y, z
    spacing_mm: tuple[float, float, float]  # of the voxels along the image's own axes


def import_patient(
    ct: sitk.Image,
    labels: sitk.Image,
    organ: Sequence[int] | None = None,
    tumour: Sequence[int] | None = None,
    side: Side | None = None,
    margin_mm: float = 60.0,
    tissues: Mapping[int, str] | None = None,
) -> Patient:
    """Cut one organ out of a CT and its label map and build its surfaces and its support.

    Args:
        ct: scalar 3D image [HU].
        labels: label map, whole numbers, 0 = nothing; on another grid it is resampled by nearest neighbour.
        organ: label values that together are the organ; None: every value that is not the tumour's.
        tumour: label values of the tumour, which becomes part of the organ; None: no tumour.
        side: which kidney, where the label map holds both, and a check where it holds one; needed where the
            CT does not show the body's whole width.
        margin_mm: CT kept around the organ [mm].
        tissues: label values of parts of the organ, and the tissue that each is for sound (`ultrasound/tissues.toml`).

    Raises:
        PatientError: one line that says what was found, what was expected and what to do.
    """
    if not margin_mm >= 0:
        raise PatientError(f"the margin is {margin_mm} mm: expected 0 or more")
    piece, told_side = labelled_organ(ct, labels, organ, tumour, side)
    codes = {value: FIRST_PART + i for i, value in enumerate(sorted(tissues or {}))}
    cropped_ct, cropped_labels = _crop(ct, piece, margin_mm, codes)
    organ_surface = _surface(cropped_labels != 0, "organ", FACES)
    try:
        support = cradle(organ_surface, SUPINE_GRAVITY)
    except ValueError as error:
        raise PatientError(f"no support fits under the organ: {error}; check the organ's label") from error
    voxel_ml = float(np.prod(ct.GetSpacing())) / 1000.0
    return Patient(
        ct=cropped_ct,
        labels=cropped_labels,
        tissues={ORGAN: "kidney", TUMOUR: "tumour"} | {codes[v]: name for v, name in (tissues or {}).items()},
        organ=organ_surface,
        tumour=_tumour_surface(cropped_labels, voxel_ml) if piece.tumour.any() else None,
        support=support,
        side=told_side,
        organ_volume_ml=piece.volume_ml,
        tumour_volume_ml=float(piece.tumour.sum() * voxel_ml),
        extent_mm=tuple(organ_surface.extents.tolist()),
        spacing_mm=tuple(ct.GetSpacing()),
    )


def save_patient(patient: Patient, folder: Path, texts: Mapping[str, str] | None = None) -> None:
    """Write ct.nrrd, labels.nrrd, organ.stl, support.stl and, if there is one, tumour.stl: all or nothing.

    Nothing of the source but voxels and geometry is written. `texts` are further files, name to content (the
    scene), that appear together with the rest.

    Raises:
        PatientError: the folder exists and is not empty, or cannot be written.
    """
    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise PatientError(f"{folder}: exists and is not an empty folder; choose another folder or remove it")
    partial = folder.parent / f".{folder.name}.partial-{secrets.token_hex(4)}"
    try:
        partial.mkdir(parents=True)
        try:
            _write(patient, partial, texts or {})
            if folder.exists():
                folder.rmdir()
            os.replace(partial, folder)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or "the files could not be written"
        raise PatientError(f"{folder}: {reason}; choose a folder that can be written") from error


def describe(patient: Patient) -> str:
    """What was found, for the terminal: several lines without a name, date or path."""
    size = " x ".join(str(n) for n in patient.ct.GetSize())
    spacing = " x ".join(f"{s:.2f}" for s in patient.spacing_mm)
    extent = " x ".join(f"{e:.0f}" for e in patient.extent_mm)
    tumour = "none"
    if patient.tumour is not None:
        tumour = f"{patient.tumour_volume_ml:.1f} ml, {len(patient.tumour.faces)} faces"
    surface_ml = patient.organ.volume / 1000
    return "\n".join(
        [
            f"organ     {patient.side} kidney, {patient.organ_volume_ml:.1f} ml (surface {surface_ml:.1f})",
            f"extent    {extent} mm (right-left x front-back x foot-head)",
            f"surface   {len(patient.organ.faces)} faces, watertight",
            f"tumour    {tumour}",
            f"support   {len(patient.support.faces)} faces, under the organ of a patient lying supine",
            f"CT        {size} voxels of {spacing} mm",
        ]
    )


def _write(patient: Patient, folder: Path, texts: Mapping[str, str]) -> None:
    sitk.WriteImage(_bare(patient.ct), str(folder / "ct.nrrd"), useCompression=True)
    sitk.WriteImage(_bare(patient.labels), str(folder / "labels.nrrd"), useCompression=True)
    patient.organ.export(folder / "organ.stl")
    patient.support.export(folder / "support.stl")
    if patient.tumour is not None:
        patient.tumour.export(folder / "tumour.stl")
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")


def _bare(image: sitk.Image) -> sitk.Image:
    """Voxels and geometry without the metadata dictionary, which names patients and scanners."""
    return _image(sitk.GetArrayViewFromImage(image), like=image)


def _image(voxels: np.ndarray, like: sitk.Image) -> sitk.Image:
    image = sitk.GetImageFromArray(voxels)
    image.CopyInformation(like)
    return image


def _crop(
    ct: sitk.Image, piece: LabelledOrgan, margin_mm: float, codes: Mapping[int, int]
) -> tuple[sitk.Image, sitk.Image]:
    """CT and labels around the organ, on one grid, padding replaced by air; parts of the organ get their codes."""
    box = ndimage.find_objects(piece.mask.astype(np.uint8))[0][::-1]
    rim = [int(np.ceil(margin_mm / s)) for s in ct.GetSpacing()]
    window = tuple(
        slice(max(0, axis.start - r), min(n, axis.stop + r))
        for axis, r, n in zip(box, rim, ct.GetSize(), strict=True)
    )
    around = ct[window]
    hounsfield = np.clip(np.rint(sitk.GetArrayFromImage(around)), -32768, 32767).astype(np.int16)
    hounsfield[hounsfield < PADDING_BELOW_HU] = AIR_HU
    marked = piece.mask[window[::-1]].astype(np.uint8) * np.uint8(ORGAN)
    for value, code in codes.items():
        marked[piece.labels[window[::-1]] == value] = code
    marked[piece.tumour[window[::-1]]] = TUMOUR
    return _image(hounsfield, around), _image(marked, around)


def _surface(mask: sitk.Image, name: str, faces: int) -> trimesh.Trimesh:
    try:
        return surface_from_mask(mask, faces)
    except ValueError as error:
        raise PatientError(f"the {name} has no surface: {error}; check the {name}'s label") from error


def _tumour_surface(labels: sitk.Image, voxel_ml: float) -> trimesh.Trimesh:
    """Surface of the tumour; several tumours of one kidney are bodies of one mesh, specks are left out."""
    labelled, _ = ndimage.label(sitk.GetArrayViewFromImage(labels) == TUMOUR)
    sizes = np.bincount(labelled.ravel())[1:]
    surfaces = []
    for n in np.flatnonzero(sizes >= 0.1 * sizes.max()):
        faces = FACES * (sizes[n] * voxel_ml / FACES_AT_ML) ** (2 / 3)
        body = _image((labelled == n + 1).astype(np.uint8), labels)
        surfaces.append(_surface(body, "tumour", int(np.clip(faces, LEAST_FACES, FACES))))
    if len(surfaces) == 1:
        return surfaces[0]
    return cast(trimesh.Trimesh, trimesh.util.concatenate(surfaces))
