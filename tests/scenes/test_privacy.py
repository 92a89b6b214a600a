"""Nothing in a patient's folder names the patient: not by a search afterwards, but by what is copied."""

import json
import zlib
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from dicom_series import PERSON, Series, write_structures
from pydicom.dataset import Dataset
from raw_nrrd import with_segments
from synthetic_body import DIRECTIONS, LEFT, TUMOUR, body, coarsely, level, section

from app import main
from scenes.patients.readers.segment_names import public_text, quoted

# In every text that a source has, under names that are words of the program's own sentences, too.
TEXTS = (
    *("Long^Small", "Wolpertinger", "X-22-ID", "St Elsewhere", "calls himself Jim", "19600229", "Ünal"),
    *("Front^Back", "Bone^Rene", "29.02.60"),
)


@pytest.fixture(scope="module", autouse=True)
def coarse():
    with pytest.MonkeyPatch.context() as patch:
        coarsely(patch)
        yield


def contents(folder: Path) -> bytes:
    """All bytes of a folder's files, with voxels and pictures decompressed."""
    parts = []
    for file in sorted(folder.iterdir()):
        head, _, packed = file.read_bytes().partition(b"\n\n")
        parts.append(
            head + zlib.decompress(packed, wbits=31) if file.suffix == ".nrrd" else file.read_bytes()
        )
    return b"\n".join(parts)


def in_any_encoding(text: str) -> set[bytes]:
    return {text.encode(encoding) for encoding in ("utf-8", "utf-16-le", "latin-1")}


def from_dicom(folder: Path) -> list[Path]:
    """A series and a structure set whose elements, private ones, paths and names of regions all name the
    patient.
    """

    def hounsfield(places):
        values = np.where(level(places, (np.zeros(3), np.array([160.0, 110.0, 400.0]))) < 0, 40.0, -1000.0)
        values[level(places, LEFT) < 0] = 120
        return values

    def edit(data, _=None):
        inner = Dataset()
        inner.PatientName = "Wolpertinger^Long"
        data.PatientName, data.RequestAttributesSequence = "Long^Small", [inner]
        data.ImageComments, data.InstitutionName = "calls himself Jim", "St Elsewhere"
        data.OtherPatientIDs, data.SeriesDescription = ["X-1", "X-22-ID"], "Ünal"
        data.private_block(0x0099, "MAKER", create=True).add_new(1, "LO", "Wolpertinger")

    series = Series(
        folder / "Long_Small" / "ct",
        DIRECTIONS["identity"],
        size=(88, 61, 36),
        gap=3.5,
        origin=(-174.0, -120.0, -56.0),
        spacing=(4.0, 4.0),
        field=hounsfield,
    )
    series.write(edit=edit)

    def rings(solid):
        return [ring for k in range(36) if (ring := section(solid, series.positions(k))) is not None]

    regions = {
        "Kidney_L": rings(LEFT),
        "GTV Wolpertinger": rings(TUMOUR),
        "Ünal": rings((LEFT[0], np.array([9.0, 9.0, 12.0]))),
        "PRV Kidney_L Front^Back": rings(LEFT),
        "PRV Kidney_L Bone^Rene": rings(LEFT),
        "Befund 29.02.60": rings((LEFT[0] - [0, 0, 22], np.full(3, 9.0))),
    }
    return [series.folder, write_structures(folder / "rt.dcm", regions, series.uid, edit=edit)]


def from_slicer(folder: Path) -> list[Path]:
    """An NRRD and a segmentation of 3D Slicer, whose header's fields and names name the patient."""
    ct, labels = body(spacing=(4.0, 4.0, 4.0))
    folder = folder / "Wolpertinger"
    folder.mkdir()
    for image in (ct, labels):
        image.SetMetaData("descrip", "Long^Small, X-22-ID, St Elsewhere, calls himself Jim, 19600229")
    names = "kidney of Long Small", "kidney_left", "GTV Wolpertinger"
    labels = with_segments(
        labels, [dict(Name=name, LabelValue=n, Layer=0) for n, name in enumerate(names, 1)]
    )
    sitk.WriteImage(ct, str(folder / "Ünal.nrrd"))
    sitk.WriteImage(
        sitk.Cast(labels, sitk.sitkUInt8), str(folder / "Long^Small.seg.nrrd"), useCompression=True
    )
    return [folder / "Ünal.nrrd", folder / "Long^Small.seg.nrrd"]


@pytest.mark.parametrize(("source", "shown"), [(from_dicom, "“Ünal”"), (from_slicer, "")])
def test_no_file_names_the_patient_and_no_sentence_is_garbled(source, shown, tmp_path, capfd):
    """A name that may be a person's is shown in the terminal alone."""
    out = tmp_path / "out"
    assert main(["import", *map(str, source(tmp_path)), "--side", "left", "--out", str(out)]) == 0
    terminal = capfd.readouterr().out
    everything = contents(out)
    for text in (*TEXTS, *PERSON.values(), "Long", str(tmp_path)):
        if len(text) > 3:
            assert not any(encoded in everything for encoded in in_any_encoding(text)), text
    assert "mm long" in terminal or "length" in terminal
    assert "removed" not in terminal
    findings = json.loads((out / "import.json").read_text("utf-8"))
    sentences = [*findings["notes"], *(warning["text"] for warning in findings["warnings"])]
    assert shown in terminal and (not shown or any("“...”" in sentence for sentence in sentences))


@pytest.mark.parametrize(
    ("name", "is_written"),
    [
        ("kidney_left", True), ("Renal mass 2", True), ("BODY", True), ("vertebrae_L1", True),
        ("GTV_PRV5", True), ("Niere links", True), ("kidneyL", True), ("portal_vein_and_splenic_vein", True),
        ("", True), ("Mr L", False), ("Doe_left", False), ("GTV Doe", False), ("kidney 19600229", False),
        ("Carter kidney", False), ("Harnisch", False), ("kidney^left", False),
    ],
)  # fmt: skip
def test_names_of_structures_alone_are_written(name, is_written):
    sentence = f"the label {quoted(name)} has 3 ml"
    assert (public_text(sentence) == sentence) == is_written
    assert public_text(sentence).startswith("the label “") and public_text(sentence).endswith("” has 3 ml")


@pytest.mark.parametrize("name", ["Doe” and “kidney", "“Doe”", "Doe ”” kidney"])
def test_a_name_with_quotation_marks_cannot_leave_its_own(name):
    assert "Doe" not in public_text(f"label {quoted(name)}, 3 ml")
