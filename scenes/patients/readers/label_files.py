"""Read labels: label maps, folders with one file per organ, 3D Slicer's .seg.nrrd, DICOM-SEG, RTSTRUCT,
surfaces.
"""

import re
from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path

import numpy as np

from errors import PatientError
from scenes.folder_files import entries_of
from scenes.patient_space import Space
from scenes.patients.readers.ct_series import read_dicom_headers
from scenes.patients.readers.dicom_files import SourceFile, find_dicom_files
from scenes.patients.readers.dicom_headers import DicomContents
from scenes.patients.readers.label_headers import label_header
from scenes.patients.readers.label_maps import (
    NEAR_MM,
    LabelMap,
    Segment,
    Segmentation,
    present_values,
    whole_numbers,
)
from scenes.patients.readers.rtstruct import read_structures
from scenes.patients.readers.segment_codes import slicer_meaning
from scenes.patients.readers.segment_names import (
    is_far,
    is_needless,
    side_of,
    tissue_of,
)
from scenes.patients.readers.surface_labels import read_surfaces
from scenes.surfaces import ENDINGS as SURFACE_ENDINGS
from scenes.surfaces import OTHER_ENDINGS, is_surface_file
from scenes.terminal import Progress, silent
from scenes.tissue_classes.class_image import TAG
from scenes.volumes.dicom_references import DicomReferences
from scenes.volumes.lazy_volume import LazyVolume
from scenes.volumes.volume_files import ENDINGS, file_volume, is_volume_file

SLICER_KEY = re.compile(r"Segment(\d+)_Name$")


# Whether labels that refer to these objects can belong to the CT.
Belongs = Callable[[DicomReferences], bool]


def open_labels(
    path: Path,
    wanted: Collection[str] = (),
    progress: Progress = silent,
    belongs: Belongs = lambda references: True,
    space: Space | None = None,
) -> Segmentation:
    """Read the labels of a path: a label map or .seg.nrrd file, a surface, a folder with one file per organ,
    a DICOM-SEG or RTSTRUCT, or a folder or archive with one of these.

    ``wanted`` are names or values of segments, or files of a folder, to read, whatever their names.
    ``belongs`` selects one of several DICOM labels; ``space`` is that of the axes of files that do not name
    it. ``progress`` shows the progress of headers, files and contours. Raises PatientError where the path
    cannot be read, or has no labels, or all are empty.
    """
    if not path.exists():
        raise PatientError(f"{path}: no such file or folder; check the path")
    if path.is_file() and is_volume_file(path):
        return _label_map_file(path, space)
    if path.is_file() and is_surface_file(path):
        return read_surfaces([path], NEAR_MM, progress, space)
    if path.suffix.lower() in OTHER_ENDINGS:
        raise PatientError(f"{path}: is a surface that cannot be read here; export it as STL, PLY or OBJ")
    if of_files := _files_of_folder(path, wanted, progress, space):
        return of_files
    if not find_dicom_files(path):
        raise PatientError(
            f"{path}: has no labels; expected a label map, one file for each organ, a DICOM segmentation or "
            "structure set, or surfaces; "
            "choose another"
        )
    contents = read_dicom_headers(path, progress)
    segmentation = segmentation_of(contents, wanted, progress, belongs)
    if segmentation is None:
        slices = sum(len(series.slices) for series in contents.candidates)
        a_ct = f", but {slices} CT slices" if slices else ""
        order = "give the CT first, then the labels" if slices else "choose another"
        raise PatientError(
            f"{path}: has no labels{a_ct}; expected a DICOM segmentation or structure set, or label maps; "
            f"{order}"
        )
    return segmentation


def _files_of_folder(
    folder: Path, wanted: Collection[str], progress: Progress, space: Space | None
) -> Segmentation | None:
    """The label maps of a folder, or its surfaces, one per organ; None without either.

    Raises PatientError.
    """
    entries = entries_of(folder) if folder.is_dir() else []
    surfaces = [file for file in entries if is_surface_file(file)]
    if organ_files := [file for file in entries if is_volume_file(file)]:
        of_maps = (
            _label_map_file(organ_files[0], space)
            if len(organ_files) == 1
            else _file_per_organ(folder, organ_files, wanted, progress, space)
        )
        note = f"label maps were read, and not the surfaces beside them: {len(surfaces)}"
        return replace(of_maps, notes=(*of_maps.notes, note)) if surfaces else of_maps
    if not surfaces:
        return None
    near = _near(surfaces, wanted)
    if not near:
        raise PatientError(
            f"{folder}: has surfaces far from the kidneys alone; expected a kidney's; choose other labels"
        )
    return read_surfaces(near, NEAR_MM, progress, space)


def segmentation_of(
    contents: DicomContents,
    wanted: Collection[str] = (),
    progress: Progress = silent,
    belongs: Belongs = lambda references: True,
) -> Segmentation | None:
    """The segmentation among DICOM files that belongs to the CT, or None where there is none at all.

    Raises PatientError.
    """
    if len(contents.labels) < 2:
        return next((_read_dicom(kind, item, wanted, progress) for kind, item in contents.labels), None)
    headers = [label_header(kind, item) for kind, item in contents.labels]
    own = [header for header in headers if belongs(header.references)]
    if len(own) == 1:
        segmentation = _read_dicom(own[0].kind, own[0].item, wanted, progress)
        return replace(
            segmentation, notes=(*segmentation.notes, f"left out, labels of another CT: {len(headers) - 1}")
        )
    patients = len({header.references.patient or header.study for header in own})
    of_patients = f" of {patients} patients" if patients > 1 else ", none of this CT," if not own else ""
    names = ", ".join(header.item.name for header in (own or headers)[:6])
    choice = "choose the patient's CT with --series, or " if patients > 1 else ""
    raise PatientError(
        f"{len(own or headers)} segmentations and structure sets{of_patients} were found: {names}; "
        f"expected one; {choice}give its file "
        "as LABELS"
    )


def _read_dicom(kind: str, item: SourceFile, wanted: Collection[str], progress: Progress) -> Segmentation:
    """A DICOM-SEG or RTSTRUCT. Raises PatientError."""
    if kind == "RTSTRUCT":
        return read_structures(item, wanted, progress)
    # highdicom takes a second to import.
    from scenes.patients.readers.dicom_seg import read_segmentation

    return read_segmentation(item, wanted, progress)


def _label_map_file(path: Path, space: Space | None) -> Segmentation:
    """A label map, or the layers of 3D Slicer's .seg.nrrd; a single label without a name gets the file's."""
    volume = file_volume(path, vectors=True, space=space)
    voxels = volume.read()
    layers = [voxels] if voxels.ndim == 3 else np.moveaxis(voxels, -1, 0)
    names = _names(volume)
    unused = dict(names)
    maps = []
    for layer, one in enumerate(layers):
        if one.any() or len(layers) == 1:
            values = whole_numbers(one, str(path))
            segments = {v: unused.pop((layer, v), Segment.named("", v)) for v in present_values(values)}
            maps.append(LabelMap(volume.grid, values, segments))
    if not maps:
        raise PatientError(f"{path}: is empty, no voxel is labelled; expected an organ; choose another file")
    stem = _stem(path)
    if not names and len(maps[0].segments) == len(maps) == 1 and (tissue_of(stem) or side_of(stem)):
        (value,) = maps[0].segments
        segment = Segment.named(stem, value)
        # A name with a side alone says no more than none: the kidney.
        is_kidney = not segment.is_understood and not is_needless(stem)
        maps = [
            replace(maps[0], segments={value: replace(segment, tissue="kidney") if is_kidney else segment})
        ]
    return Segmentation(
        lambda _: maps,
        grid=volume.grid,
        empty=tuple(unused.values()),
        space=volume.space,
        is_class_image=any(TAG in text for key, text in volume.metadata.items() if key.endswith("_Tags")),
    )


def _names(volume: LazyVolume) -> dict[tuple[int, int], Segment]:
    """Segments by layer and value, in the header of 3D Slicer or of a NIfTI file."""
    segments = {}
    for key, name in volume.metadata.items():
        if key.isdecimal():
            segments[0, int(key)] = Segment.named(name, int(key))
        if number := SLICER_KEY.match(key):
            start = f"Segment{number[1]}_"
            rgb = [float(c) for c in re.findall(r"\d+\.?\d*", volume.metadata.get(f"{start}Color", ""))[:3]]
            layer, label = (
                volume.metadata.get(start + what, usual)
                for what, usual in (("Layer", "0"), ("LabelValue", "1"))
            )
            if not (layer.isdecimal() and label.isdecimal()):
                raise PatientError(
                    f"{volume.name}: {key} has no whole LabelValue and Layer; export it again from 3D Slicer"
                )
            colour = (rgb[0], rgb[1], rgb[2]) if len(rgb) == 3 else None
            codes = slicer_meaning(volume.metadata.get(f"{start}Tags", ""))
            segments[int(layer), int(label)] = Segment.coded(volume.name, name, codes, int(label), colour)
    return segments


def _file_per_organ(
    folder: Path, files: list[Path], wanted: Collection[str], progress: Progress, space: Space | None
) -> Segmentation:
    """One mask per organ, as TotalSegmentator writes: the files name the organs, and may be empty."""
    near = _near(files, wanted)
    # Kidneys first: of the others only the part near them is read.
    near.sort(key=lambda file: tissue_of(_stem(file)) != "kidney")
    maps: list[LabelMap] = []
    empty: list[Segment] = []
    around: np.ndarray | None = None
    assumed: Space | None = None
    for file in progress(near, "labels"):
        volume = file_volume(file, space=space)
        assumed = volume.space or assumed
        is_kidney = tissue_of(_stem(file)) == "kidney"
        box = volume.grid.full_box()
        if around is not None and not is_kidney:
            box = volume.grid.box_around(around[0], around[1])
        if all(a.start < a.stop for a in box):
            voxels = volume.read(box)
            if voxels.any():
                # Fractions, or an image among the labels, are refused.
                inside = whole_numbers(voxels, str(file)) > 0
                maps.append(LabelMap.single(volume.grid.part(box), inside, Segment.named(_stem(file))))
            else:
                empty.append(Segment.named(_stem(file)))
        if is_kidney and maps:
            places = np.concatenate([m.grid.corners() for m in maps])
            around = np.array([places.min(axis=0) - NEAR_MM, places.max(axis=0) + NEAR_MM])
    if not maps:
        raise PatientError(
            f"{folder}: all {len(near)} label files are empty; expected an organ; choose other labels"
        )
    return Segmentation(lambda _: maps, grid=volume.grid, empty=tuple(empty), space=assumed)


def _near(files: list[Path], wanted: Collection[str]) -> list[Path]:
    """The files whose names are wanted, or not those of structures far from the kidneys."""
    names = {word.casefold() for word in wanted}
    return [file for file in files if _stem(file).casefold() in names or not is_far(_stem(file))]


def _stem(path: Path) -> str:
    """A file's name without its extension."""
    name = path.name
    for ending in (".seg.nrrd", ".nii.gz", *ENDINGS, *SURFACE_ENDINGS):
        if name.lower().endswith(ending):
            return name[: -len(ending)]
    return name
