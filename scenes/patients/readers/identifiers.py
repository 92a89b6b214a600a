"""Collect the identifiers (PHI) of a DICOM file, so that written files can be searched for them."""

from collections.abc import Iterator

from pydicom.dataelem import DataElement
from pydicom.dataset import Dataset

from scenes.patients.readers.dicom_files import SourceFile
from scenes.patients.readers.segment_names import is_anatomy

# Value representations that identify persons, dates and objects; UI also has standard UIDs, which identify nobody.
NAMING = ("PN", "DA", "DT", "UI")
FREE_TEXT = ("LO", "SH", "ST", "LT", "UT", "UC", "UN", "AE")
STANDARD_UID = "1.2.840.10008."
# Coordinates, which identify nobody, and of which a structure set has a million.
CONTOUR_DATA = 0x30060050
# Public elements of free text that may identify a person; the others describe the scanner.
PERSONAL_KEYWORDS = (
    "Patient", "Physician", "Operator", "Institution", "Accession", "StudyID", "StudyDescription", "SeriesDescription",
    "Station", "SerialNumber", "Address", "Telephone", "Comments", "History", "Occupation", "Department", "Protocol",
    "Requested", "Performed", "AdmissionID", "Issuer", "Reason", "Name", "SegmentLabel",
)  # fmt: skip
# Names of labels.
STRUCTURES = ("ROIName", "SegmentLabel")


def identifiers_of(item: SourceFile) -> dict[str, str]:
    """Names, IDs, dates, institutions, UIDs and private texts of one DICOM file, and the element of each, in words.

    Elements that cannot be parsed are taken as raw text.
    """
    return {text: place for text, place in _texts(item.header(None)) if text}


def _texts(data: Dataset) -> Iterator[tuple[str, str]]:
    for tag in sorted(data.keys() - {CONTOUR_DATA}):
        place = f"the DICOM element {tag}"
        try:
            element = data[tag]
            nested = list(element.value) if element.VR == "SQ" else []
        except Exception:  # a parser raises many kinds of error
            yield from ((text, place) for text in _plain(getattr(data.get_item(tag), "value", None)))
            continue
        if element.VR == "SQ":
            for one in nested:
                yield from _texts(one)
            continue
        personal = element.tag.is_private or any(word in element.keyword for word in PERSONAL_KEYWORDS)
        if element.VR in NAMING or (element.VR in FREE_TEXT and personal):
            place = f"{place} {element.keyword or '(private)'}"
            is_structure = element.keyword in STRUCTURES and is_anatomy(str(element.value))
            yield from ((text, place) for text in _words(element) if not is_structure)


def _words(element: DataElement) -> Iterator[str]:
    for value in element.value if element.VM > 1 else [element.value]:
        for text in _plain(value):
            yield text
            if element.VR == "PN":
                yield from (part for part in text.replace("=", "^").split("^") if part)


def _plain(value: object) -> Iterator[str]:
    """A value as text, if it is printable and not a standard UID."""
    text = (value.decode("latin-1") if isinstance(value, bytes) else str(value)).strip("\0 ")
    if text.isprintable() and not text.startswith(STANDARD_UID):
        yield text
