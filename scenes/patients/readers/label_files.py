"""Read labels: label maps, folders with one file per organ, 3D Slicer's .seg.nrrd, DICOM-SEG, RTSTRUCT."""

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

# An import keeps 60 mm around its organ.
NEAR_MM = 80.0
SLICER_KEY = re.compile(r"Segment(\d+)_Name$")


@dataclass(frozen=True)
class Segmentation:
    """Labels of one source; contours are filled once the CT's grid is known."""

    maps: Callable[[VoxelGrid], list[LabelMap]]  # on the CT's grid
    referenced: str = ""  # UID of the referenced series
    notes: tuple[str, ...] = ()
    identifiers: frozenset[str] = frozenset()
    frame_of_reference: str = ""  # DICOM's UID


def open_labels(path: Path, wanted: Collection[str] = (), progress: Progress = silent) -> Segmentation:
    """Read labels.

    Args:
        path: a label map or .seg.nrrd file, a folder with one file per organ, a DICOM-SEG or RTSTRUCT, or a folder or
            archive with one of these.
        wanted: files of a folder to read, whatever their names.

    Raises:
        PatientError: not readable, no labels, or all empty.
    """
    if not path.exists():
        raise PatientError(f"{path}: no such file or folder; check the path")
    if path.is_file() and is_volume_file(path):
        return _file(path)
    organ_files = sorted(file for file in path.iterdir() if is_volume_file(file)) if path.is_dir() else []
    if organ_files:
        return _file_per_organ(path, organ_files, wanted, progress)
    found = segmentation_of(read_dicom_headers(path, progress))
    if found is None:
        raise PatientError(
            f"{path}: has no labels; expected a DICOM segmentation or structure set, or label maps; choose another"
        )
    return found


def segmentation_of(contents: DicomContents) -> Segmentation | None:
    """The segmentation among DICOM files, or None. Raises PatientError where there are several."""
    objects = [*contents.segmentations, *contents.structure_sets]
    if len(objects) > 1:
        names = ", ".join(item.name for item in objects[:6])
        raise PatientError(
            f"{len(objects)} segmentations and structure sets were found: {names}; expected one; give its file as LABELS"
        )
    if contents.segmentations:
        maps, notes, referenced = read_segmentation(objects[0])
        frame = str(read_header(objects[0]).get("FrameOfReferenceUID") or "")
        return Segmentation(lambda _: maps, referenced, tuple(notes), identifiers_of(objects[0]), frame)
    if contents.structure_sets:
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
    """A label map; a single label without a name gets the file's name where that names a tissue or side."""
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
    """Segments in the header of 3D Slicer, by layer and value."""
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
        raise PatientError(f"{path}: is empty, no voxel is labelled; expected an organ; choose another file")
    return maps


def _file_per_organ(
    folder: Path, files: list[Path], wanted: Collection[str], progress: Progress
) -> Segmentation:
    """One mask per organ, as TotalSegmentator writes: the files name the organs, and may be empty."""
    asked = {word.casefold() for word in wanted}
    near = [f for f in files if _stem(f).casefold() in asked or not is_far(_stem(f))]
    # Kidneys first: of the others only the part near them is read.
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
    """Corners (2, 3) of the LPS box [mm] within NEAR_MM of some places."""
    return np.array([places.min(axis=0) - NEAR_MM, places.max(axis=0) + NEAR_MM])


def _organ(file: Path, volume: LazyVolume, box: Box) -> LabelMap | None:
    """The label of one file within a box, or None."""
    if any(a.start == a.stop for a in box):
        return None
    voxels = volume.read(box)
    labelled = box_of(voxels)
    if labelled is None:
        return None
    # Fractions, or an image among the labels, are refused.
    values = whole_numbers(voxels[labelled[::-1]], str(file))
    grid = volume.grid.part(box).part(labelled)
    return LabelMap.single(grid, values > 0, Segment.named(_stem(file)))


def _stem(path: Path) -> str:
    """A file's name without its extension."""
    name = path.name
    for ending in (".seg.nrrd", ".nii.gz", *ENDINGS):
        if name.lower().endswith(ending):
            return name[: -len(ending)]
    return name
