"""What a source says about a person, so that what an import wrote can be searched for it."""

from __future__ import annotations

from collections.abc import Iterator

from pydicom.dataset import Dataset

from scenes.reading.error import PatientError
from scenes.reading.headers import read_header
from scenes.reading.source import Item

# Of DICOM's kinds of text those that name persons, dates and things; UI also holds standard uids, which name nobody.
NAMING = ("PN", "DA", "DT", "UI")
FREE_TEXT = ("LO", "SH", "ST", "LT", "UT", "UC", "UN", "AE")
STANDARD_UID = "1.2.840.10008."
# Free text that is the scanner's, of public groups.
PERSONAL_KEYWORDS = (
    "Patient", "Physician", "Operator", "Institution", "Accession", "StudyID", "StudyDescription", "SeriesDescription",
    "Station", "SerialNumber", "Address", "Telephone", "Comments", "History", "Occupation", "Department", "Protocol",
    "Requested", "Performed", "AdmissionID", "Issuer", "Reason", "Name",
)  # fmt: skip


def secrets_of(item: Item) -> frozenset[str]:
    """Every name, id, date, institution, uid and private text of one DICOM file."""
    try:
        return frozenset(text for text in _texts(read_header(item, tags=None)) if text)
    except PatientError:
        raise
    except Exception as error:  # a value's faults are many; all of them are the file's
        raise PatientError(
            f"{item.name}: a damaged DICOM file ({type(error).__name__}); copy or export it again"
        ) from error


def _texts(data: Dataset) -> Iterator[str]:
    for element in data:
        if element.VR == "SQ":
            for nested in element.value:
                yield from _texts(nested)
            continue
        personal = element.tag.is_private or any(word in element.keyword for word in PERSONAL_KEYWORDS)
        if element.VR in NAMING or (element.VR in FREE_TEXT and personal):
            yield from _words(element)


def _words(element) -> Iterator[str]:
    several = element.value if element.VM > 1 else [element.value]
    for value in several:
        text = value.decode("latin-1") if isinstance(value, bytes) else str(value)
        text = text.strip("\0 ")
        if not text.isprintable() or text.startswith(STANDARD_UID):
            continue
        yield text
        if element.VR == "PN":
            yield from (part for part in text.replace("=", "^").split("^") if part)
