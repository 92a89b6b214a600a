"""Read DICOM segmentation objects (binary, fractional, label map) with highdicom."""

import logging
from dataclasses import replace

import highdicom as hd
import numpy as np
from pydicom.dataset import Dataset

from errors import PatientError, parsing
from scenes.patients.readers.dicom_files import SourceFile
from scenes.patients.readers.dicom_headers import TAGS, slices_of
from scenes.patients.readers.identifiers import identifiers_of
from scenes.patients.readers.label_maps import LabelMap, Segment, Segmentation
from scenes.patients.readers.segment_codes import dicom_meaning
from scenes.patients.readers.slice_stack import stack_slices
from scenes.volumes.voxel_grid import VoxelGrid

# Threshold of fractional segments.
HALF = 0.5
# The value for "inside" where tilted frames are resampled as if they were HU.
FULL_HU = 1000.0


def read_segmentation(item: SourceFile) -> Segmentation:
    """One label map per segment. Raises PatientError: damaged, or not in the patient's coordinates."""
    logging.getLogger("highdicom").setLevel(logging.ERROR)
    data = item.parsed()
    with parsing(
        f"{item.name}: cannot be read as a DICOM segmentation",
        "expected evenly spaced frames in the patient's coordinates; export it as a label map, for example NRRD",
    ):
        segmentation = hd.seg.Segmentation.from_dataset(data, copy=False)
        maps, empty = _maps(item, segmentation)
    if not maps:
        raise PatientError(
            f"{item.name}: is empty, no voxel is labelled; expected an organ; choose another file"
        )
    fractional = segmentation.segmentation_type == hd.seg.SegmentationTypeValues.FRACTIONAL
    series = data.get("ReferencedSeriesSequence") or [Dataset()]
    return Segmentation(
        lambda _: maps,
        referenced=str(series[0].get("SeriesInstanceUID", "")),
        notes=(f"fractional segments were cut at {HALF:.0%}",) * fractional,
        identifiers=identifiers_of(item),
        frame_of_reference=str(data.get("FrameOfReferenceUID") or ""),
        empty=tuple(empty),
    )


def _maps(item: SourceFile, segmentation: hd.seg.Segmentation) -> tuple[list[LabelMap], list[Segment]]:
    """The map of each segment that has voxels, and the other segments."""
    if segmentation.get("FrameOfReferenceUID") is None:
        raise PatientError(
            f"{item.name}: has no frame of reference, so it belongs to no volume; expected labels of a CT; choose another file"
        )
    is_upright = segmentation.get_volume_geometry(allow_missing_positions=True) is not None
    read = _upright if is_upright else _tilted
    maps, empty = [], []
    for number in segmentation.segment_numbers:
        if number == 0:  # background
            continue
        described = segmentation.get_segment_description(number)
        segment = Segment.coded(item.name, described.segment_label, dicom_meaning(described), int(number))
        grid, inside = read(item, segmentation, int(number))
        if inside.any():
            maps.append(LabelMap.single(grid, inside, segment))
        else:
            empty.append(segment)
    return maps, empty


def _upright(
    item: SourceFile, segmentation: hd.seg.Segmentation, number: int
) -> tuple[VoxelGrid, np.ndarray]:
    """A segment's grid and mask (z, y, x)."""
    volume = segmentation.get_volume(segment_numbers=[number], allow_missing_positions=True)
    place = np.array(volume.spacing), np.array(volume.position), np.array(volume.direction)
    grid = VoxelGrid(volume.spatial_shape, *place).checked(item.name)
    return grid, np.asarray(volume.array[..., 0] >= HALF).T


def _tilted(item: SourceFile, segmentation: hd.seg.Segmentation, number: int) -> tuple[VoxelGrid, np.ndarray]:
    """The same for frames of a tilted gantry: resampled as CT slices are, as if they were HU."""
    most = float(segmentation.get("MaximumFractionalValue") or 1)
    shared = segmentation.SharedFunctionalGroupsSequence[0].get("SegmentIdentificationSequence")
    groups = segmentation.PerFrameFunctionalGroupsSequence
    identified = [frame.get("SegmentIdentificationSequence", shared)[0] for frame in groups]
    own = [
        replace(one, slope=FULL_HU / most, intercept=0.0)
        for one, frame in zip(slices_of(item, item.header(TAGS)), identified, strict=True)
        if one is not None and frame.ReferencedSegmentNumber == number
    ]
    stack = stack_slices(item.name, own)
    return stack.grid, stack.read() >= HALF * FULL_HU
