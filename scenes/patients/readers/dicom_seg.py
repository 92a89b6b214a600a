"""Read DICOM segmentation objects (binary, fractional, label map) with highdicom."""

import logging
from collections.abc import Collection
from dataclasses import replace
from typing import cast

import highdicom as hd
import numpy as np
from pydicom.dataset import Dataset
from pydicom.pixels import pixel_array
from pydicom.pixels.utils import pack_bits
from pydicom.uid import ExplicitVRLittleEndian, generate_uid

from errors import PatientError, parsing
from scenes.patients.readers.dicom_files import MOST_INFLATED, SourceFile
from scenes.patients.readers.dicom_headers import TAGS, slices_of
from scenes.patients.readers.label_headers import references_of
from scenes.patients.readers.label_maps import LabelMap, Segment, Segmentation, is_left_out, note_of_left_out
from scenes.patients.readers.segment_codes import dicom_meaning
from scenes.patients.readers.slice_stack import stack_slices
from scenes.terminal import Progress, silent
from scenes.volumes.voxel_grid import VoxelGrid

# Threshold of fractional segments.
HALF = 0.5
# The value for "inside" where tilted frames are resampled as if they were HU.
FULL_HU = 1000.0
UNCOMPRESSED = "export it again, uncompressed, or as a label map, for example NRRD"


def read_segmentation(
    item: SourceFile, wanted: Collection[str] = (), progress: Progress = silent
) -> Segmentation:
    """One label map per segment, without those that are needless and not wanted.

    Args:
        item: the file.
        wanted: names or numbers of segments of the user.
        progress: shows the progress of the segments.

    Raises:
        PatientError: damaged, not in the patient's coordinates, or of a transfer syntax that nothing here decodes.
    """
    logging.getLogger("highdicom").setLevel(logging.ERROR)
    data = item.parsed()
    references = references_of(data)
    _decode(item, data)
    with parsing(
        f"{item.name}: cannot be read as a DICOM segmentation",
        "expected evenly spaced frames in the patient's coordinates; export it as a label map, for example NRRD",
    ):
        _complete(item, data)
        segmentation = hd.seg.Segmentation.from_dataset(data, copy=False)
        segments = _segments(item, segmentation)
        left_out = [one for one in segments if is_left_out(one, wanted)]
        kept = [one for one in segments if one not in left_out]
        maps, grid = _maps(item, segmentation, kept, progress)
    if not maps:
        raise PatientError(
            f"{item.name}: is empty, no voxel is labelled; expected an organ; choose another file"
        )
    fractional = segmentation.segmentation_type == hd.seg.SegmentationTypeValues.FRACTIONAL
    notes = [f"fractional segments were cut at {HALF:.0%}"] * fractional
    return Segmentation(
        lambda _: maps,
        notes=(*notes, *note_of_left_out(left_out)),
        references=references,
        grid=grid,
        empty=tuple(one for one in kept if all(one not in each.segments.values() for each in maps)),
    )


def _decode(item: SourceFile, data: Dataset) -> None:
    """Replace frames that highdicom cannot read: big endian ones, and single bits that are compressed as bytes."""
    syntax = data.file_meta.TransferSyntaxUID
    if not syntax.is_transfer_syntax:
        raise PatientError(f"{_undecoded(item, data)}: an unknown transfer syntax; {UNCOMPRESSED}")
    with parsing(_undecoded(item, data), UNCOMPRESSED):
        if not syntax.is_little_endian:
            if data["PixelData"].VR == "OW":
                data.PixelData = np.frombuffer(data.PixelData, np.uint16).byteswap().tobytes()
        elif syntax.is_encapsulated and data.BitsAllocated == 1 and not _decodes(data):
            data.PixelData = pack_bits(_frames_of_bytes(item, data) > 0)
        else:
            return
    data.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian


def _frames_of_bytes(item: SourceFile, data: Dataset) -> np.ndarray:
    """The frames (n, rows, columns) of a binary segmentation that is compressed with one byte a pixel."""
    size = [int(data.get(name) or 1) for name in ("NumberOfFrames", "Rows", "Columns")]
    if float(np.prod(np.array(size, float))) > MOST_INFLATED:
        raise PatientError(f"{item.name}: has more than 2 GiB of frames; {UNCOMPRESSED}")
    data.BitsAllocated, data.BitsStored, data.HighBit = 8, 8, 7
    frames = pixel_array(data)
    data.BitsAllocated, data.BitsStored, data.HighBit = 1, 1, 0
    return frames


def _decodes(data: Dataset) -> bool:
    try:
        pixel_array(data, index=0)
    except Exception:  # decoders raise many kinds of error
        return False
    return True


def _undecoded(item: SourceFile, data: Dataset) -> str:
    return f"{item.name}: its frames cannot be decoded ({data.file_meta.TransferSyntaxUID.name})"


def _complete(item: SourceFile, data: Dataset) -> None:
    """Give frames in the patient's coordinates a frame of reference where an anonymiser took it. Raises PatientError for others."""
    groups = [*data.SharedFunctionalGroupsSequence, *data.PerFrameFunctionalGroupsSequence[:1]]
    planes = [group.PlaneOrientationSequence[0] for group in groups if group.get("PlaneOrientationSequence")]
    if not any("ImageOrientationPatient" in plane for plane in planes):
        raise PatientError(
            f"{item.name}: has no ImageOrientationPatient, so it belongs to no volume; expected labels of a CT; choose another file"
        )
    if not data.get("FrameOfReferenceUID"):
        data.FrameOfReferenceUID = generate_uid()


def _segments(item: SourceFile, segmentation: hd.seg.Segmentation) -> list[Segment]:
    """All segments, without the background, with the tissue of the coded property where the label names none."""
    found = []
    for number in segmentation.segment_numbers:
        if number == 0:  # background
            continue
        described = segmentation.get_segment_description(number)
        meaning = dicom_meaning(described)
        found.append(Segment.coded(item.name, described.segment_label, meaning, int(number)))
    return found


def _maps(
    item: SourceFile, segmentation: hd.seg.Segmentation, segments: list[Segment], progress: Progress
) -> tuple[list[LabelMap], VoxelGrid | None]:
    """The maps of the segments that are not empty, and the grid of all frames."""
    is_upright = segmentation.get_volume_geometry(allow_missing_positions=True) is not None
    read = _upright if is_upright else _tilted
    maps, whole = [], None
    for segment in progress(segments, "segments"):
        with parsing(_undecoded(item, segmentation), UNCOMPRESSED):
            whole, inside = read(item, segmentation, cast(int, segment.value))
        if inside.any():
            maps.append(LabelMap.single(whole, inside, segment))
    return maps, whole


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
