"""Labels from DICOM: segmentation objects (binary, fractional, label map), by highdicom."""

from __future__ import annotations

import logging
import warnings

import highdicom as hd
import numpy as np

from scenes.reading.dicom_file import parsed
from scenes.reading.error import PatientError
from scenes.reading.grid import VoxelGrid
from scenes.reading.labels import LabelMap, Segment
from scenes.reading.source import Item

# A voxel of a fractional segment is in it from this share on.
HALF = 0.5


def read_segmentation(item: Item) -> tuple[list[LabelMap], list[str], str]:
    """The segments of a DICOM-SEG, a map each; notes; and the uid of the series that it was drawn on.

    Raises PatientError: damaged, or not in the patient's coordinates.
    """
    logging.getLogger("highdicom").setLevel(logging.ERROR)
    with item.open() as file:
        data = parsed(file, item.name)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            segmentation = hd.seg.Segmentation.from_dataset(data, copy=False)
            found = _maps(item.name, segmentation)
    except PatientError:
        raise
    except Exception as error:  # a parser's faults are many; all of them are the file's
        raise PatientError(
            f"{item.name}: cannot be read as a DICOM segmentation ({type(error).__name__}); expected evenly spaced frames in the "
            "patient's coordinates; export it as a label map, for example NRRD"
        ) from error
    if not found:
        raise PatientError(
            f"{item.name}: is empty, no voxel is marked; expected an organ; choose another file"
        )
    fractional = segmentation.segmentation_type == hd.seg.SegmentationTypeValues.FRACTIONAL
    notes = [f"fractional segments were cut at {HALF:.0%}"] if fractional else []
    referenced = data.get("ReferencedSeriesSequence") or []
    return found, notes, str(referenced[0].get("SeriesInstanceUID", "")) if referenced else ""


def _maps(name: str, segmentation: hd.seg.Segmentation) -> list[LabelMap]:
    if segmentation.get("FrameOfReferenceUID") is None:
        raise PatientError(
            f"{name}: has no frame of reference, so it was drawn on no volume; expected labels of a CT; choose another file"
        )
    maps = []
    for number in segmentation.segment_numbers:
        if number == 0:  # background of a label map
            continue
        segment = Segment.named(segmentation.get_segment_description(number).segment_label, int(number))
        if segment.tissue is None:
            meaning = segmentation.get_segment_description(number).segmented_property_type.meaning
            segment = Segment(segment.name, segment.value, Segment.named(meaning).tissue, segment.side)
        volume = segmentation.get_volume(segment_numbers=[number], allow_missing_positions=True)
        one = LabelMap.single(
            VoxelGrid(
                volume.spatial_shape,
                np.array(volume.spacing),
                np.array(volume.position),
                np.array(volume.direction),
            ).checked(name),
            np.asarray(volume.array[..., 0] >= HALF).T,
            segment,
        )
        if one is not None:
            maps.append(one)
    return maps
