"""Read DICOM headers: the series, their slices and positions, segmentations and structure sets."""

import re
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydicom.dataset import Dataset

from errors import PatientError, parsing
from scenes.patients.readers.dicom_files import DAMAGED, SourceFile
from scenes.volumes.dicom_references import DicomReferences

CT_CLASSES = {
    "1.2.840.10008.5.1.4.1.1.2",
    "1.2.840.10008.5.1.4.1.1.2.1",  # enhanced
    "1.2.840.10008.5.1.4.1.1.2.2",  # legacy converted enhanced
}
LABEL_CLASSES = {
    "1.2.840.10008.5.1.4.1.1.66.4": "SEG",
    "1.2.840.10008.5.1.4.1.1.66.7": "SEG",  # label map
    "1.2.840.10008.5.1.4.1.1.481.3": "RTSTRUCT",
}
MEDIA_DIRECTORY = "1.2.840.10008.1.3.10"
MOST_PIXELS = 8192 * 8192
# No position [mm] and no rescale of a CT has larger numbers.
MOST = 1e6
TAGS = [
    "SOPClassUID", "SOPInstanceUID", "Modality", "SeriesInstanceUID", "SeriesNumber", "InstanceNumber",
    "ImageType", "FrameOfReferenceUID", "ImagePositionPatient", "ImageOrientationPatient", "PixelSpacing",
    "Rows", "Columns", "NumberOfFrames", "RescaleSlope", "RescaleIntercept", "RescaleType",
    "PixelPaddingValue", "PixelPaddingRangeLimit", "BurnedInAnnotation", "SamplesPerPixel",
    "PatientPosition", "SharedFunctionalGroupsSequence", "PerFrameFunctionalGroupsSequence", "PatientID",
    "StudyInstanceUID",
]  # fmt: skip
IDENTIFYING = (
    "SOPClassUID", "Modality", "SeriesInstanceUID", "SeriesNumber", "FrameOfReferenceUID", "PatientID",
    "StudyInstanceUID",
)  # fmt: skip
MODALITY = re.compile("[A-Z]{2,8}")
# Values of ImageType of screen saves and dose reports, which may be in the series of their CT.
PAGES = {"SCREEN SAVE", "DOSE_INFO"}
# Words in values of ImageType of images that were computed from the slices of a CT, such as CT_SOM5 MIP or
# CURVED MPR.
COMPUTED = frozenset({
    "MIP", "MINIP", "MAXIP", "IP", "AVERAGE", "AVG", "PROJECTION", "REFORMATTED", "MPR", "CPR", "CURVED",
    "VRT", "VR", "SSD", "RENDER",
    "RENDERED", "RENDERING",
})  # fmt: skip
LOCALIZERS = {"LOCALIZER", "SCOUT", "TOPOGRAM"}
# Values of ImageType whose pixels are not HU.
NOT_HU = {
    "PERFUSION", "RCBF", "RCBV", "MTT", "TTP", "ANGIO", "DENSITY_MAP", "MAT_FRACTION", "MAT_SPECIFIC",
    "EFF_ATOMIC_NUM",
}  # fmt: skip


@dataclass(frozen=True)
class DicomSlice:
    """One slice of a CT: a file, or one of its frames."""

    item: SourceFile
    frame: int | None  # None in a single-frame file
    number: int | None  # InstanceNumber, or the frame's number from 1
    sop: str
    position: np.ndarray  # (3,) centre of the first pixel, LPS [mm]
    row: np.ndarray  # (3,) along which the column index grows
    column: np.ndarray  # (3,) along which the row index grows
    spacing: tuple[float, float]  # along row and column [mm]
    columns: int
    rows: int
    slope: float
    intercept: float
    is_rescaled: bool  # whether the header has a rescale
    padding: tuple[int, int] | None  # range of raw values outside the field of view
    patient_position: str = ""  # DICOM's term, such as HFS
    computed: frozenset[str] = frozenset()  # words of its ImageType that are in COMPUTED

    @property
    def normal(self) -> np.ndarray:
        """(3,) across the slice, LPS."""
        return np.cross(self.row, self.column)

    @property
    def along_mm(self) -> float:
        """The position along the normal."""
        return float(self.position @ self.normal)

    @property
    def heights_mm(self) -> np.ndarray:
        """(4,) LPS z of its corners: how far it reaches along the body."""
        across, down = (
            n * step for n, step in zip((self.columns - 1, self.rows - 1), self.spacing, strict=True)
        )
        return (
            self.position[2]
            + np.array([0, across, 0, across]) * self.row[2]
            + np.array([0, 0, down, down]) * self.column[2]
        )

    @property
    def label(self) -> str:
        """Its name in errors."""
        return f"slice {'without a number' if self.number is None else self.number} ({self.item.name})"


@dataclass(eq=False)
class Series:
    """The slices of one SeriesInstanceUID, or of several that were joined, in file order.

    The UIDs and the ID are the patient's (PHI), and are never shown.
    """

    uid: str
    number: str
    patient: str = ""  # PatientID
    study: str = ""
    frame_of_reference: str = ""
    slices: list[DicomSlice] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)  # a line for each slice that cannot be used
    localizers: int = 0
    pages: dict[str, str] = field(default_factory=dict)  # files that are no slices, and why
    projections: list[str] = field(
        default_factory=list
    )  # labels of images that were computed from its slices
    other_uids: frozenset[str] = frozenset()  # of series that were joined to it
    notes: list[str] = field(default_factory=list)  # for the user

    @property
    def uids(self) -> frozenset[str]:
        """All its SeriesInstanceUIDs."""
        return self.other_uids | {self.uid}

    @property
    def references(self) -> DicomReferences:
        """The objects that it consists of."""
        frames, series = ({self.frame_of_reference} - {""}, self.uids - {""})
        slices = {one.sop for one in self.slices} - {""}
        return DicomReferences(frozenset(frames), frozenset(series), frozenset(slices), self.patient)


@dataclass
class DicomContents:
    """The contents of DICOM files."""

    series: dict[str, Series] = field(default_factory=dict)
    labels: list[tuple[str, SourceFile]] = field(default_factory=list)  # SEG or RTSTRUCT, and the file
    others: Counter[str] = field(default_factory=Counter)  # of each modality, other files
    unreadable: list[str] = field(default_factory=list)  # subfolders that cannot be listed

    @property
    def candidates(self) -> list[Series]:
        """All series with CT slices, also damaged ones."""
        return [series for series in self.series.values() if series.slices or series.faults or series.pages]


def read_headers(
    items: list[SourceFile], progress: Callable[[Iterable[SourceFile]], Iterable[SourceFile]] = iter
) -> DicomContents:
    """Read all headers and sort them by kind. Raises PatientError where a file is damaged."""
    contents = DicomContents()
    for item in progress(items):
        header = item.header(TAGS)
        with parsing(f"{item.name}: a damaged DICOM file", DAMAGED):
            sop_class, modality, uid, number, frame, patient, study = (
                str(header.get(name) or "").strip() for name in IDENTIFYING
            )
            is_directory = header.file_meta.get("MediaStorageSOPClassUID", "") == MEDIA_DIRECTORY
        if sop_class in LABEL_CLASSES:
            contents.labels.append((LABEL_CLASSES[sop_class], item))
        elif sop_class in CT_CLASSES:
            named = number if number.isdecimal() else "without a number"
            series = contents.series.setdefault(uid, Series(uid, named, patient, study))
            series.frame_of_reference = frame
            try:
                if patient != series.patient:
                    raise PatientError(f"{item.name}: is of another patient than the files before it")
                slices = slices_of(item, header)
                series.slices += [one for one in slices if one is not None]
                series.localizers += slices.count(None)
            except PatientError as error:
                if patient == series.patient and _is_page(header):
                    series.pages[item.name] = str(error)
                else:
                    series.faults.append(str(error))
        elif sop_class:
            # Free text may name the patient.
            contents.others[modality if MODALITY.fullmatch(modality) else "files of unknown kind"] += 1
        elif not is_directory and header.preamble is not None:
            raise PatientError(f"{item.name}: a damaged DICOM file (no SOPClassUID); {DAMAGED}")
        elif not is_directory:
            contents.others["files of unknown kind"] += 1
    for series in contents.series.values():
        _leave_out_projections(series)
    return contents


def _leave_out_projections(series: Series) -> None:
    """Take images that were computed from the slices, such as MIP slabs, out of them; a series of one kind
    stays as it is.
    """
    slices = [one for one in series.slices if not one.computed]
    computed = [one for one in series.slices if one.computed]
    if not slices or not computed:
        return
    if len(slices) > len(computed):
        series.slices, series.projections = slices, [one.label for one in computed]
        return
    words = ", ".join(sorted(frozenset().union(*(one.computed for one in computed))))
    series.faults.append(
        f"{len(slices)} slices and {len(computed)} images computed from slices ({words}) are in one "
        "series; expected one kind"
    )


def _is_page(header: Dataset) -> bool:
    """Whether an image is no slice: a screen save, a dose report, in colours, with burned-in text, or
    without a place in the patient.
    """
    places = "ImagePositionPatient", "ImageOrientationPatient", "NumberOfFrames"
    try:
        if PAGES.intersection(map(str, header.get("ImageType") or [])):
            return True
        if (header.get("SamplesPerPixel") or 1) != 1 or _is_burned(header):
            return True
        # A header that ends early has lost its Rows too.
        return "Rows" in header and not any(header.get(name) for name in places)
    except Exception:  # a damaged value, of any kind
        return False


def slices_of(item: SourceFile, header: Dataset) -> list[DicomSlice | None]:
    """The slices of one file; None for a localizer. Raises PatientError."""
    with parsing(f"{item.name}: its header cannot be read", "expected a CT's"):
        if _is_burned(header):
            raise PatientError(f"{item.name}: has text burned into its pixels, which may name the patient")
        if int(header.get("SamplesPerPixel", 1)) != 1:
            raise PatientError(f"{item.name}: has colours; expected HU")
        frames, count = (
            header.get("PerFrameFunctionalGroupsSequence"),
            _whole(item, header, "NumberOfFrames") or 1,
        )
        if frames is None:
            if count > 1:
                raise PatientError(f"{item.name}: has {count} frames without positions")
            return [_slice(item, None, _whole(item, header, "InstanceNumber"), [header], header)]
        if len(frames) != count:
            raise PatientError(f"{item.name}: has {count} frames and positions of {len(frames)}")
        shared = _groups((header.get("SharedFunctionalGroupsSequence") or [Dataset()])[0])
        return [
            _slice(item, n, n + 1, [*_groups(frame), *shared, header], header)
            for n, frame in enumerate(frames)
        ]


def _is_burned(header: Dataset) -> bool:
    """Whether there is text in the pixels."""
    return str(header.get("BurnedInAnnotation", "NO")).upper() == "YES"


def _groups(functional: Dataset) -> list[Dataset]:
    """The items of the functional group macros."""
    return [element.value[0] for element in functional if element.VR == "SQ" and element.value]


def _slice(
    item: SourceFile, frame: int | None, number: int | None, groups: list[Dataset], header: Dataset
) -> DicomSlice | None:
    def value(name: str, usual: Any = None) -> Any:
        values = (_read(item, group, name) for group in groups)
        return next((one for one in values if one not in (None, "")), usual)

    kind = {str(word).upper() for word in [*(value("ImageType") or []), *(value("FrameType") or [])]}
    if kind & LOCALIZERS:
        return None
    if kind & PAGES:
        raise PatientError(f"{item.name}: is a screen save or a report; expected a slice")
    if kind & NOT_HU:
        raise PatientError(
            f"{item.name}: its pixels are {', '.join(sorted(kind & NOT_HU))}; expected HU; give the CT that "
            "it was made from"
        )
    row, column = _orientation(item, value("ImageOrientationPatient"))
    vertical, horizontal = _numbers(item, "PixelSpacing", value("PixelSpacing"), 2)
    rows, columns = _whole(item, header, "Rows") or 0, _whole(item, header, "Columns") or 0
    if min(vertical, horizontal) <= 0 or not 2 <= rows * columns <= MOST_PIXELS:
        raise PatientError(
            f"{item.name}: Columns, Rows and PixelSpacing are those of {columns} x {rows} pixels of "
            f"{horizontal:g} x {vertical:g} mm; "
            "expected more than 0 of each"
        )
    slope, intercept = (
        float(_numbers(item, name, value(name, usual), 1)[0])
        for name, usual in (("RescaleSlope", 1), ("RescaleIntercept", 0))
    )
    if slope == 0:
        raise PatientError(
            f"{item.name}: RescaleSlope is 0; expected the HU of one step of the pixels' values"
        )
    return DicomSlice(
        item=item,
        frame=frame,
        number=number,
        sop=str(header.get("SOPInstanceUID", "")),
        position=_numbers(item, "ImagePositionPatient", value("ImagePositionPatient"), 3),
        row=row,
        column=column,
        spacing=(horizontal, vertical),
        columns=columns,
        rows=rows,
        slope=slope,
        intercept=intercept,
        is_rescaled=value("RescaleIntercept") is not None,
        padding=_padding(header),
        patient_position=str(value("PatientPosition", "")).strip().upper(),
        computed=COMPUTED.intersection(word for text in kind for word in re.split(r"[\W_]+", text)),
    )


def _read(item: SourceFile, group: Dataset, name: str) -> Any:
    """An element's value, or None. Raises PatientError, without the text, which may name the patient."""
    with parsing(f"{item.name}: {name} cannot be read", "expected a CT's header"):
        return group.get(name)


def _whole(item: SourceFile, header: Dataset, name: str) -> int | None:
    """A whole number, or None. Raises PatientError."""
    with parsing(f"{item.name}: {name} cannot be read", "expected a whole number"):
        value = header.get(name)
        return None if value in (None, "") else int(value)


def _numbers(item: SourceFile, name: str, value: Any, count: int) -> np.ndarray:
    if value is None:
        raise PatientError(f"{item.name}: has no {name}")
    expected = f"{count} number{'s' * (count > 1)}, none beyond {MOST:.0f}"
    several = isinstance(value, Iterable) and not isinstance(value, str)
    with parsing(f"{item.name}: {name} cannot be read", f"expected {expected}"):
        numbers = np.array([float(n) for n in (value if several else [value])])
    if numbers.shape != (count,) or not (np.abs(numbers) <= MOST).all():
        raise PatientError(
            f"{item.name}: {name} is {', '.join(f'{n:g}' for n in numbers[: count + 1])}; expected {expected}"
        )
    return numbers


def _orientation(item: SourceFile, value: Any) -> tuple[np.ndarray, np.ndarray]:
    """Orthonormal vectors along a slice's rows and columns."""
    both = _numbers(item, "ImageOrientationPatient", value, 6).reshape(2, 3)
    lengths = np.linalg.norm(both, axis=1)
    if np.abs(lengths - 1).max() > 0.01 or abs(both[0] @ both[1]) > 0.01:
        raise PatientError(
            f"{item.name}: ImageOrientationPatient is {', '.join(f'{n:g}' for n in both.ravel())}; expected "
            "two orthogonal unit vectors"
        )
    row = both[0] / lengths[0]
    column = both[1] - (both[1] @ row) * row
    return row, column / np.linalg.norm(column)


def _padding(header: Dataset) -> tuple[int, int] | None:
    if header.get("PixelPaddingValue") in (None, ""):
        return None
    one = int(header.PixelPaddingValue)
    limit = header.get("PixelPaddingRangeLimit")
    other = one if limit in (None, "") else int(limit)
    return min(one, other), max(one, other)
