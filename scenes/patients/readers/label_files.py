"""Labels from whatever draws them: label maps, one file an organ, 3D Slicer's .seg.nrrd, DICOM-SEG, RTSTRUCT."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import SimpleITK as sitk

from errors import PatientError
from scenes.patients.readers.dicom_headers import DicomContents, read_header
from scenes.patients.readers.dicom_seg import read_segmentation
from scenes.patients.readers.dicom_series import read_dicom_headers
from scenes.patients.readers.identifiers import identifiers_of
from scenes.patients.readers.label_maps import LabelMap, Segment, box_of, whole_numbers
from scenes.patients.readers.rtstruct import read_contours, referenced_series
from scenes.patients.readers.segment_names import is_far, side_of, tissue_of
from scenes.terminal import Progress, silent
from scenes.volumes.itk_files import itk_header, itk_layers, metadata
from scenes.volumes.lazy_volume import LazyVolume
from scenes.volumes.nifti_files import label_names
from scenes.volumes.volume_files import ENDINGS, NIFTI, file_volume, is_volume_file
from scenes.volumes.voxel_grid import Box, VoxelGrid

# An import keeps 60 mm around its organ, and a probe sees as far.
NEAR_MM = 80.0
SLICER_KEY = re.compile(r"Segment(\d+)_Name$")


@dataclass(frozen=True)
class Segmentation:
    """Labels that were found; contours are filled once the CT is known."""

    maps: Callable[[VoxelGrid], list[LabelMap]]
    referenced: str = ""  # uid of the series that they were drawn on, where they say
    notes: tuple[str, ...] = ()
    identifiers: frozenset[str] = frozenset()
    frame_of_reference: str = ""  # DICOM's uid, where they have one


def open_labels(path: Path, wanted: Collection[str] = (), progress: Progress = silent) -> Segmentation:
    """Read labels.

    Args:
        path: a label map or .seg.nrrd file, a folder with a file for each organ, a DICOM-SEG or RTSTRUCT, or a folder
            or archive that holds one.
        wanted: names of files of a folder that are read though their names say nothing.

    Raises:
        PatientError: nothing readable, no labels, none marked; a line for the user.
    """
    if not path.exists():
        raise PatientError(f"{path}: no such file or folder; check the path")
    if path.is_file() and is_volume_file(path):
        return _file(path)
    organs = sorted(file for file in path.iterdir() if is_volume_file(file)) if path.is_dir() else []
    if organs:
        return _one_an_organ(path, organs, wanted, progress)
    drawing = segmentation_of(read_dicom_headers(path, progress))
    if drawing is None:
        raise PatientError(
            f"{path}: holds no labels; expected a DICOM segmentation or structure set, or label maps; choose another"
        )
    return drawing


def segmentation_of(found: DicomContents) -> Segmentation | None:
    """The labels among DICOM files; None where there are none. Raises PatientError where there are several."""
    objects = [*found.segmentations, *found.structure_sets]
    if len(objects) > 1:
        names = ", ".join(item.name for item in objects[:6])
        raise PatientError(
            f"{len(objects)} segmentations and structure sets were found: {names}; expected one; give its file as LABELS"
        )
    if found.segmentations:
        maps, notes, referenced = read_segmentation(objects[0])
        frame = str(read_header(objects[0]).get("FrameOfReferenceUID") or "")
        return Segmentation(lambda _: maps, referenced, tuple(notes), identifiers_of(objects[0]), frame)
    if found.structure_sets:
        item = objects[0]
        referenced = referenced_series(read_header(item, tags=["ReferencedFrameOfReferenceSequence"]))
        return Segmentation(lambda ct: read_contours(item, ct), referenced, (), identifiers_of(item))
    return None


def _file(path: Path) -> Segmentation:
    if path.name.lower().endswith(NIFTI):
        volume = file_volume(path)
        maps = [_map(path, volume.grid, volume.read(), label_names(path))]
        return Segmentation(lambda _: maps, identifiers=volume.identifiers)
    header = itk_header(path)
    names = _slicer_names(header)
    kept = {n: text for n, text in metadata(header).items() if not n.startswith(("NRRD_", "ITK_", "Segment"))}
    identifiers = frozenset(text for text in kept.values() if text)
    if not names and header.GetNumberOfComponents() == 1:
        volume = file_volume(path)
        maps = [_map(path, volume.grid, volume.read())]
    else:
        maps = _slicer_maps(path, VoxelGrid.of(header), names)
    return Segmentation(lambda _: maps, identifiers=identifiers)


def _map(path: Path, grid: VoxelGrid, voxels: np.ndarray, names: Mapping[int, str] | None = None) -> LabelMap:
    """A label map; one of a single value is called as its file where that says what it is."""
    values = whole_numbers(voxels, str(path))
    one = LabelMap.valued(grid, values, names)
    if names:
        return one
    stem = _stem(path)
    if len(one.segments) == 1 and (tissue_of(stem) or side_of(stem)):
        (value,) = one.segments
        return LabelMap.valued(grid, values, {value: stem})
    return one


def _slicer_names(header: sitk.ImageFileReader) -> dict[tuple[int, int], Segment]:
    """Segments of 3D Slicer's header, by layer and value."""
    found = {}
    for key in metadata(header):
        number = SLICER_KEY.match(key)
        if number is None:
            continue

        def value(what: str, usual: str, start: str = f"Segment{number.group(1)}_") -> str:
            return header.GetMetaData(start + what) if header.HasMetaDataKey(start + what) else usual

        colour = tuple(float(c) for c in re.findall(r"\d+\.?\d*", value("Color", ""))[:3])
        layer, label = value("Layer", "0"), value("LabelValue", "1")
        if not (layer.isdecimal() and label.isdecimal()):
            raise PatientError(
                f"{header.GetFileName()}: {key} has no whole LabelValue and Layer; export it again from 3D Slicer"
            )
        rgb = (colour[0], colour[1], colour[2]) if len(colour) == 3 else None
        found[int(layer), int(label)] = Segment.named(header.GetMetaData(key), int(label), rgb)
    return found


def _slicer_maps(path: Path, grid: VoxelGrid, names: dict[tuple[int, int], Segment]) -> list[LabelMap]:
    maps = []
    for layer, voxels in enumerate(itk_layers(path)):
        if not voxels.any():
            continue
        one = LabelMap.valued(grid, whole_numbers(voxels, str(path)))
        known = {v: names.get((layer, v), s) for v, s in one.segments.items()}
        maps.append(LabelMap(one.grid, one.values, known))
    if not maps:
        raise PatientError(f"{path}: is empty, no voxel is marked; expected an organ; choose another file")
    return maps


def _one_an_organ(
    folder: Path, files: list[Path], wanted: Collection[str], progress: Progress
) -> Segmentation:
    """One file an organ, as TotalSegmentator leaves them: named by their files, and empty where an organ is not there."""
    asked = {word.casefold() for word in wanted}
    near = [f for f in files if _stem(f).casefold() in asked or not is_far(_stem(f))]
    # Kidneys first: of the rest, what is near them is read.
    near.sort(key=lambda file: tissue_of(_stem(file)) != "kidney")
    maps: list[LabelMap] = []
    identifiers: set[str] = set()
    around: np.ndarray | None = None
    for file in progress(near, "labels"):
        volume = file_volume(file)
        identifiers |= volume.identifiers
        is_kidney = tissue_of(_stem(file)) == "kidney"
        box = volume.grid.full_box()
        if around is not None and not is_kidney:
            box = volume.grid.box_around(around[0], around[1])
        one = _organ(file, volume, box)
        if one is not None:
            maps.append(one)
        if is_kidney:
            places = [m.grid.corners() for m in maps]
            around = _around(np.concatenate(places)) if places else None
    if not maps:
        raise PatientError(
            f"{folder}: all {len(near)} label files are empty; expected an organ; choose other labels"
        )
    return Segmentation(lambda _: maps, identifiers=frozenset(identifiers))


def _around(places: np.ndarray) -> np.ndarray:
    """Corners (2, 3) of the box of LPS [mm] that a picture of what is at places can show."""
    return np.array([places.min(axis=0) - NEAR_MM, places.max(axis=0) + NEAR_MM])


def _organ(file: Path, volume: LazyVolume, box: Box) -> LabelMap | None:
    """What one file marks in a box; None where that is nothing."""
    if any(a.start == a.stop for a in box):
        return None
    voxels = volume.read(box)
    marked = box_of(voxels)
    if marked is None:
        return None
    # Other numbers than whole ones are shares, or an image among the labels.
    values = whole_numbers(voxels[marked[::-1]], str(file))
    grid = volume.grid.part(box).part(marked)
    return LabelMap.single(grid, values > 0, Segment.named(_stem(file)))


def _stem(path: Path) -> str:
    """A file's name without the ending of its kind."""
    name = path.name
    for ending in (".seg.nrrd", ".nii.gz", *ENDINGS):
        if name.lower().endswith(ending):
            return name[: -len(ending)]
    return name
