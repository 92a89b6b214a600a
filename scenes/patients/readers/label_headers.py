"""Read the headers of DICOM labels: the names of their segments, and the CT that they refer to."""

from collections.abc import Iterator
from dataclasses import dataclass

from pydicom.dataset import Dataset

from errors import parsing
from scenes.patients.readers.dicom_files import SourceFile
from scenes.volumes.dicom_references import DicomReferences

# Sequences of slices.
IMAGES = ("ContourImageSequence", "ReferencedInstanceSequence", "SourceImageSequence")
# Sequences of a structure set and of a segmentation that lead to what they refer to.
LEADING = (
    "ReferencedFrameOfReferenceSequence", "RTReferencedStudySequence", "RTReferencedSeriesSequence",
    "ReferencedSeriesSequence", "StudiesContainingOtherReferencedInstancesSequence", *IMAGES,
)  # fmt: skip
# Where only the contours or frames name the slices.
OF_EACH = (
    "ROIContourSequence", "ContourSequence", "PerFrameFunctionalGroupsSequence",
    "SharedFunctionalGroupsSequence",
    "DerivationImageSequence", *IMAGES,
)  # fmt: skip
LABEL_TAGS = [
    "PatientID", "StudyInstanceUID", "FrameOfReferenceUID", "SegmentSequence", "StructureSetROISequence",
    *LEADING,
]  # fmt: skip


@dataclass(frozen=True)
class LabelHeader:
    """The header of a segmentation or structure set."""

    kind: str  # SEG or RTSTRUCT
    item: SourceFile
    names: tuple[str, ...]  # of its segments
    references: DicomReferences
    study: str  # StudyInstanceUID


def label_header(kind: str, item: SourceFile) -> LabelHeader:
    """The header of a DICOM-SEG or RTSTRUCT. Raises PatientError where it is damaged."""
    data = item.header(LABEL_TAGS)
    with parsing(f"{item.name}: cannot be read as a {kind}", "export it again"):
        segments = [str(one.get("SegmentLabel") or "") for one in data.get("SegmentSequence") or []]
        regions = [str(one.get("ROIName") or "") for one in data.get("StructureSetROISequence") or []]
    return LabelHeader(
        kind, item, (*segments, *regions), references_of(data), _text(data, "StudyInstanceUID")
    )


def references_of(data: Dataset) -> DicomReferences:
    """What labels refer to.

    Of a structure set the frames are those of its regions; what cannot be read counts as absent.
    """
    uids = set(_uids(data, LEADING))
    if not any(kind == "instances" and uid for kind, uid in uids):
        uids |= {(kind, uid) for kind, uid in _uids(data, OF_EACH) if kind == "instances"}
    frames = {
        _text(region, "ReferencedFrameOfReferenceUID") for region in _items(data, "StructureSetROISequence")
    }
    frames = frames - {""} or {uid for kind, uid in uids if kind == "frames"}

    def of(kind: str) -> frozenset[str]:
        return frozenset(uid for one, uid in uids if one == kind and uid)

    return DicomReferences(frozenset(frames - {""}), of("series"), of("instances"), _text(data, "PatientID"))


def _uids(data: Dataset, sequences: tuple[str, ...], within: str = "") -> Iterator[tuple[str, str]]:
    """Kind and UID of all objects that a data set refers to, by way of the given sequences."""
    yield "frames", _text(data, "FrameOfReferenceUID")
    if within:  # at the top it is the labels' own series
        yield "series", _text(data, "SeriesInstanceUID")
    if within in IMAGES:  # elsewhere it is a study
        yield "instances", _text(data, "ReferencedSOPInstanceUID")
    for name in sequences:
        for one in _items(data, name):
            yield from _uids(one, sequences, name)


def _items(data: Dataset, name: str) -> list[Dataset]:
    try:
        return list(data.get(name) or [])
    except Exception:  # a parser raises many kinds of error
        return []


def _text(data: Dataset, name: str) -> str:
    try:
        return str(data.get(name) or "").strip()
    except Exception:
        return ""
