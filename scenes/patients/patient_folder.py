"""Write a patient's folder, and search its files for identifiers of the patient (PHI)."""

import json
import re
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

import SimpleITK as sitk

from errors import PatientError
from scenes.atomic_files import new_folder
from scenes.patients.part_surfaces import PARTS
from scenes.patients.patient_import import Patient
from scenes.patients.readers.label_maps import MERGE_ORDER
from scenes.scene import AnatomyFiles, Scene, scene_text
from scenes.surfaces import STL_HEADER_BYTES, save_surface
from scenes.volumes.volume_files import save_image

# Shorter texts, such as the ID 7, and numbers under six digits identify nobody.
LEAST_LETTERS, LEAST_DIGITS = 3, 6
MEASURE = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)")
REDACTED = "[removed]"
# Texts of this length do not occur in voxels or triangles by chance.
SURE_BYTES = 7
ENCODINGS = ("utf-8", "utf-16-le", "latin-1")
# Labels may name the UIDs of a thousand slices: so many are searched for in the digits of a file alone.
UID, MANY = re.compile(r"[0-9.]+"), 200
NUMBERS = re.compile(rb"(?:[0-9.]\0?){4,}")
GZIP = 31  # zlib's wbits for gzip
# Of NRRD and STL headers, and of import.json; those of scene.toml are added below.
COMMON = (
    "left right kidney cyst vessels collecting system STL LPS ITK NRRD complete type int short unsigned char gzip space mm ml HU CT "
    "file format specification at http teem sourceforge net html dimension posterior superior sizes directions kinds domain endian little "
    "encoding origin version side draft supine prone decubitus position extent surfaces faces volume label labels support series source "
    "length size spacing direction tissues warnings notes text acknowledged true false null none complexity tumours diameter exophytic share "
    "contact distance touches main vessel renal padua estimated not known needed least most suffix low moderate high to components points "
    "measure unit location rim sinus artery and vein cm mesh kind target fluid drop linear curvilinear phased "
)


def save_patient(
    patient: Patient,
    folder: Path,
    texts: dict[str, str] | None = None,
    draw: Callable[[Path], None] | None = None,
    identifiers: Mapping[str, str] = MappingProxyType({}),
) -> int:
    """Write ct.nrrd, labels.nrrd, organ.stl, support.stl and a surface for each part: all or nothing.

    Args:
        patient: only its voxels and geometry are written.
        folder: new or empty.
        texts: further text files (the scene), name -> content.
        draw: writes further files into a folder (the check image).
        identifiers: names, IDs, dates, paths that no file may contain, and where each stands in the source.

    Returns:
        The number of identifiers that were searched for and not found.

    Raises:
        PatientError: the folder exists and is not empty, cannot be written, or would have contained an identifier.
    """
    with new_folder(folder) as partial:
        _write(patient, partial, texts or {})
        if draw is not None:
            draw(partial)
        return _search(partial, identifiers)


def _write(patient: Patient, folder: Path, texts: dict[str, str]) -> None:
    for name, image in (("ct", patient.ct), ("labels", patient.labels)):
        bare = sitk.GetImageFromArray(sitk.GetArrayViewFromImage(image))  # without metadata
        bare.CopyInformation(image)
        save_image(bare, folder / f"{name}.nrrd")
    save_surface(patient.organ, folder / "organ.stl")
    save_surface(patient.support, folder / "support.stl")
    for tissue, surface in patient.parts.items():
        save_surface(surface, folder / f"{PARTS[tissue]}.stl")
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")


def _search(folder: Path, identifiers: Mapping[str, str]) -> int:
    """Search all files of a folder, return the number of identifiers searched. Raises PatientError where one is found."""
    wanted = {text: place for text, place in identifiers.items() if is_identifying(text)}
    for file in sorted(folder.iterdir()):
        words, everything = _contents(file)
        numbers = b"\n".join(NUMBERS.findall(everything)) if len(wanted) > MANY else everything
        for text, place in wanted.items():
            if _holds(words, numbers if UID.fullmatch(text) else everything, text):
                raise PatientError(
                    f"{file.name} would have contained the text of {place}; expected no text of the source, which may identify the "
                    "patient; nothing was written; if that text identifies nobody, remove it from a copy of the source and import that; "
                    "else report this as a fault of the program"
                )
    return len(wanted)


def without_identifiers(patient: Patient, identifiers: Collection[str]) -> Patient:
    """The patient with notes and warnings that name nobody."""
    return replace(
        patient,
        notes=tuple(redacted(note, identifiers) for note in patient.notes),
        warnings=tuple(redacted(warning, identifiers) for warning in patient.warnings),
    )


def redacted(text: str, identifiers: Collection[str]) -> str:
    """A text without the identifiers: in notes and warnings, which may quote names of files and labels."""
    # Labels name the UIDs of a thousand slices: few are in the text, and to compile a pattern for each takes seconds.
    plain = text.casefold()
    found = [each for each in identifiers if each.casefold() in plain and is_identifying(each)]
    # The longest first: one may begin with another.
    for identifier in sorted(found, key=len, reverse=True):
        is_sure = len(identifier) >= SURE_BYTES and not identifier.isdigit()
        pattern = re.escape(identifier) if is_sure else _as_word(re.escape(identifier))
        text = re.sub(pattern, REDACTED, text, flags=re.IGNORECASE)
    return text


def _as_word(pattern: str) -> str:
    """A pattern that matches whole words and numbers only; an underscore separates words."""
    return rf"(?<![^\W_])(?<!\d\.){pattern}(?![^\W_])(?!\.\d)"


def is_identifying(text: str) -> bool:
    """Whether a text can identify somebody: long enough, no mere numbers, and not only words that are in every patient's files."""
    if not any(letter.isalpha() for letter in text):
        numbers = [part for part in re.split(r"[\\,;\s]+", text) if part]
        is_long = sum(map(str.isdigit, text)) >= LEAST_DIGITS
        return is_long and not all(map(_is_measure, numbers))
    if len(text) < LEAST_LETTERS:
        return False
    words = re.findall(r"[^\W_]+", text.lower())
    return any(
        word not in _common_words() and not (word.isdigit() and len(word) < LEAST_DIGITS) for word in words
    )


def _is_measure(number: str) -> bool:
    """Whether a number is a measured value or a count, not an ID or a date of LEAST_DIGITS digits or more."""
    return bool(MEASURE.fullmatch(number)) and not (number.isdigit() and len(number) >= LEAST_DIGITS)


@cache
def _common_words() -> frozenset[str]:
    written = (
        scene_text(Scene(anatomy=AnatomyFiles(phantom=True))) + COMMON + " ".join(filter(None, MERGE_ORDER))
    )
    return frozenset(re.findall(r"[^\W\d]+", written.lower().replace("_", " ")))


def _contents(file: Path) -> tuple[bytes, bytes]:
    """The text of a file (header), and all its bytes, decompressed."""
    content = file.read_bytes()
    if file.suffix == ".nrrd":
        header, _, packed = content.partition(b"\n\n")
        return header, header + zlib.decompress(packed, wbits=GZIP)
    if file.suffix == ".json":
        # Not the keys, which are the program's words; and texts as they are, without JSON's escapes.
        content = "\n".join(_texts_in(json.loads(content))).encode()
    return (content if file.suffix in (".toml", ".json") else content[:STL_HEADER_BYTES]), content


def _texts_in(value: Any) -> Iterator[str]:
    """All texts in a value of JSON, without the keys."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, list | dict):
        for each in value.values() if isinstance(value, dict) else value:
            yield from _texts_in(each)


def _holds(words: bytes, everything: bytes, text: str) -> bool:
    """Whether a file contains a text: anywhere if it is long, else as a whole word of its text."""
    for encoding in ENCODINGS:
        wanted = text.encode(encoding, "ignore")
        if len(wanted) >= SURE_BYTES and not text.isdigit():
            if wanted in everything:
                return True
        elif wanted and re.search(_as_word(re.escape(text)), words.decode(encoding, "replace")):
            return True
    return False
