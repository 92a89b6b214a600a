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
from pydicom.tag import Tag
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
# What all segmentations have, where the writer left it out.
ALWAYS = {"SamplesPerPixel": 1, "PhotometricInterpretation": "MONOCHROME2", "PixelRepresentation": 0}


def read_segmentation(
    item: SourceFile, wanted: Collection[str] = (), progress: Progress = silent
) -> Segmentation:
    """The segments of a DICOM segmentation, one label map each, without those that are needless and not
    wanted.

    ``wanted`` are names or numbers of segments of the user; ``progress`` shows the progress of the segments.
    Raises PatientError where the file is damaged, not in the patient's coordinates, or of a transfer syntax
    that nothing here decodes.
    """
    logging.getLogger("highdicom").setLevel(logging.ERROR)
    data = item.parsed()
    references = references_of(data)
    with parsing(f"{item.name}: cannot be read as a DICOM segmentation", "export it again"):
        segments = _segments(item, data)
    _decode(item, data)
    with parsing(
        f"{item.name}: cannot be read as a DICOM segmentation",
        "expected evenly spaced frames in the patient's coordinates; export it as a label map, for "
        "example NRRD",
    ):
        _complete(item, data)
        shift = _reduce(data)
        segmentation = hd.seg.Segmentation.from_dataset(data, copy=False)
        left_out = [one for one in segments if is_left_out(one, wanted)]
        kept = [one for one in segments if one not in left_out]
        maps, grid = _maps(item, segmentation, kept, shift, progress)
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
        empty=tuple(one for one in kept if all(one not in label_map.segments.values() for label_map in maps)),
    )


def _decode(item: SourceFile, data: Dataset) -> None:
    """Complete the description of pixels, and replace frames that highdicom cannot read: big endian ones,
    and single bits that are compressed as bytes.
    """
    for name, value in ALWAYS.items():
        if data.get(name) is None:
            setattr(data, name, value)
    if data.get("BitsStored") is None and data.get("BitsAllocated"):
        data.BitsStored = data.BitsAllocated
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
    except MemoryError:
        raise
    except Exception:  # decoders raise many kinds of error
        return False
    return True


def _undecoded(item: SourceFile, data: Dataset) -> str:
    return f"{item.name}: its frames cannot be decoded ({data.file_meta.TransferSyntaxUID.name})"


def _complete(item: SourceFile, data: Dataset) -> None:
    """Give frames in the patient's coordinates what highdicom requires, and writers or anonymisers leave out.

    Raises PatientError for others.
    """
    frames = data.PerFrameFunctionalGroupsSequence
    if not data.get("NumberOfFrames"):
        data.NumberOfFrames = len(frames)
    if not data.get("SharedFunctionalGroupsSequence"):
        data.SharedFunctionalGroupsSequence = [Dataset()]
    groups = [*data.SharedFunctionalGroupsSequence, *frames[:1]]
    planes = [group.PlaneOrientationSequence[0] for group in groups if group.get("PlaneOrientationSequence")]
    if not any("ImageOrientationPatient" in plane for plane in planes):
        raise PatientError(
            f"{item.name}: has no ImageOrientationPatient, so it belongs to no volume; expected labels of a "
            "CT; choose another file"
        )
    for name in ("FrameOfReferenceUID", "StudyInstanceUID"):
        if not data.get(name):
            setattr(data, name, generate_uid())
    for group in (*data.SharedFunctionalGroupsSequence, *frames):
        for measures in group.get("PixelMeasuresSequence") or []:
            if not measures.get("SliceThickness"):  # positions alone give the distance of frames
                measures.SliceThickness = measures.get("SpacingBetweenSlices") or 1


def _reduce(data: Dataset) -> int:
    """Leave only what voxels and their places need, so that nothing else has to be there; return what was
    added to the numbers of segments, as highdicom's are from 1. Segments are described by plain codes.
    """
    is_map = data.SegmentationType == "LABELMAP"
    numbers = [int(one.SegmentNumber) for one in data.SegmentSequence]
    shift = int(0 in numbers and not is_map)
    code = hd.sr.CodedConcept("85756007", "SCT", "Tissue")
    manual = hd.seg.SegmentAlgorithmTypeValues.MANUAL
    described = [hd.seg.SegmentDescription(1, "segment", code, code, manual) for _ in numbers]
    for one, number in zip(described, numbers, strict=True):
        one.SegmentNumber = number + shift
    data.SegmentSequence = described
    for name in ("ReferencedSeriesSequence", "SourceImageSequence", "DimensionIndexSequence"):
        data.pop(name, None)
    groups = data.PerFrameFunctionalGroupsSequence
    for group in groups:
        group.pop("DerivationImageSequence", None)
    if is_map:
        return shift
    index = Dataset()
    index.DimensionIndexPointer = Tag("ReferencedSegmentNumber")
    index.FunctionalGroupPointer = Tag("SegmentIdentificationSequence")
    data.DimensionIndexSequence = [index]
    shared = data.SharedFunctionalGroupsSequence[0].get("SegmentIdentificationSequence")
    data.SharedFunctionalGroupsSequence[0].pop("SegmentIdentificationSequence", None)
    for group in groups:
        own = group.get("SegmentIdentificationSequence") or shared
        if not own and len(numbers) > 1:
            raise ValueError
        number = int(own[0].ReferencedSegmentNumber) if own else numbers[0]
        identified, content = Dataset(), Dataset()
        identified.ReferencedSegmentNumber = content.DimensionIndexValues = number + shift
        group.SegmentIdentificationSequence, group.FrameContentSequence = [identified], [content]
    return shift


def _segments(item: SourceFile, data: Dataset) -> list[Segment]:
    """All segments, without the background, with the tissue of the coded property where the label names none.

    Raises PatientError where a label map's background is described as a structure.
    """
    described = [
        Segment.coded(
            item.name, str(one.get("SegmentLabel") or ""), dicom_meaning(one), int(one.SegmentNumber)
        )
        for one in data.SegmentSequence
    ]
    if data.get("SegmentationType") != "LABELMAP":
        return described
    for segment in described:
        if segment.value == 0 and segment.is_understood and data.get("PixelPaddingValue") != 0:
            raise PatientError(
                f"{item.name}: SegmentNumber of segment {segment} is 0, which is the background of a label "
                "map; expected numbers from 1; "
                "number the segments and their voxels from 1, or export it as a binary segmentation"
            )
    return [segment for segment in described if segment.value != 0]


def _maps(
    item: SourceFile,
    segmentation: hd.seg.Segmentation,
    segments: list[Segment],
    shift: int,
    progress: Progress,
) -> tuple[list[LabelMap], VoxelGrid | None]:
    """The maps of the segments that are not empty, and the grid of all frames; ``shift`` is as ``_reduce``
    returns it.
    """
    is_upright = segmentation.get_volume_geometry(allow_missing_positions=True) is not None
    read = _upright if is_upright else _tilted
    maps, whole = [], None
    for segment in progress(segments, "segments"):
        with parsing(_undecoded(item, segmentation), UNCOMPRESSED):
            whole, inside = read(item, segmentation, cast(int, segment.value) + shift)
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
    groups = segmentation.PerFrameFunctionalGroupsSequence
    identified = [frame.SegmentIdentificationSequence[0] for frame in groups]
    own = [
        replace(one, slope=FULL_HU / most, intercept=0.0)
        for one, frame in zip(slices_of(item, item.header(TAGS)), identified, strict=True)
        if one is not None and frame.ReferencedSegmentNumber == number
    ]
    stack = stack_slices(item.name, own)
    return stack.grid, stack.read() >= HALF * FULL_HU
