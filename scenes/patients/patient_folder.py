"""A patient's folder: written whole or not at all, and searched for what would name the patient."""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable, Collection
from functools import cache
from pathlib import Path

import SimpleITK as sitk

from errors import PatientError
from scenes.atomic_files import new_folder
from scenes.patients.part_surfaces import PARTS
from scenes.patients.patient_import import Patient
from scenes.scene import AnatomyFiles, Scene, scene_text
from scenes.surfaces import STL_HEADER_BYTES, save_surface
from scenes.volumes.volume_files import save_image

# Shorter texts, such as the id 7, say nothing, and numbers under six digits are in every file.
LEAST_TEXT, LEAST_DIGITS = 3, 6
# Longer ones cannot be in voxels or triangles by chance.
SURE_BYTES = 7
ENCODINGS = ("utf-8", "utf-16-le", "latin-1")
GZIP = 31  # zlib's code
COMMON = "left right kidney cyst vessels collecting system STL LPS ITK NRRD complete type int short unsigned char gzip space"


def save_patient(
    patient: Patient,
    folder: Path,
    texts: dict[str, str] | None = None,
    draw: Callable[[Path], None] | None = None,
    private: Collection[str] = (),
) -> int:
    """Write ct.nrrd, labels.nrrd, organ.stl, support.stl and a surface for each part: all or nothing.

    Args:
        patient: what was imported; nothing of its source but voxels and geometry is written.
        folder: new or empty.
        texts: further files, name to content (the scene), that appear together with the rest.
        draw: draws further files into a folder (the checking picture).
        private: what none of the files may hold: names, ids, dates, paths.

    Returns:
        How many private texts were searched for, and not found.

    Raises:
        PatientError: the folder exists and is not empty, cannot be written, or would have held something private.
    """
    with new_folder(folder) as partial:
        _write(patient, partial, texts or {})
        if draw is not None:
            draw(partial)
        return _searched(partial, private)


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


def _searched(folder: Path, private: Collection[str]) -> int:
    """Search all files of a folder. Raises PatientError where something private is in one."""
    wanted = [text for text in private if is_identifying(text)]
    for file in sorted(folder.iterdir()):
        words, everything = _contents(file)
        if any(_holds(words, everything, text) for text in wanted):
            raise PatientError(
                f"{file.name} would have held something of the source that names the patient; nothing was written; this is a "
                "fault of the program: please report it"
            )
    return len(wanted)


def is_identifying(text: str) -> bool:
    """Whether a text is long enough to name somebody, and more than words that every patient's files hold."""
    if len(text) < (LEAST_DIGITS if text.isdigit() else LEAST_TEXT):
        return False
    return not set(re.findall(r"\w+", text.lower())) <= _common_words()


@cache
def _common_words() -> frozenset[str]:
    written = scene_text(Scene(anatomy=AnatomyFiles(phantom=True))) + COMMON
    return frozenset(re.findall(r"[^\W\d]+", written.lower().replace("_", " ")))


def _contents(file: Path) -> tuple[bytes, bytes]:
    """What of a file is words, and all of it, unpacked."""
    content = file.read_bytes()
    if file.suffix == ".nrrd":
        header, _, packed = content.partition(b"\n\n")
        return header, header + zlib.decompress(packed, wbits=GZIP)
    return (content if file.suffix == ".toml" else content[:STL_HEADER_BYTES]), content


def _holds(words: bytes, everything: bytes, text: str) -> bool:
    """Whether a text is in a file: anywhere where it is long, else as a word among words."""
    for encoding in ENCODINGS:
        wanted = text.encode(encoding, "ignore")
        if len(wanted) >= SURE_BYTES and not text.isdigit():
            if wanted in everything:
                return True
        elif wanted and re.search(rb"(?<![\w.])" + re.escape(wanted) + rb"(?![\w.])", words):
            return True
    return False
