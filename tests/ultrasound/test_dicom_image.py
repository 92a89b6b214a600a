"""Pictures as DICOM Ultrasound Images: what readers make of them, and what is not in them."""

import getpass
import re
import socket
import uuid
from datetime import date
from pathlib import Path

import numpy as np
import pydicom
import pytest
import SimpleITK as sitk

from ultrasound.dicom_image import save_dicom
from ultrasound.probe import Probe, load_probe
from version import VERSION

# Not square, an odd number of bytes, and spacings that no decimal string holds whole.
PICTURE = np.random.default_rng(3).integers(0, 256, (9, 7), np.uint8)
SPACING_MM = (62.4 / 529, 1 / 3)

# Types 1 and 2, and 1C and 2C where their condition holds, of the mandatory modules and of the calibration:
# PS3.3 (2024d).
REQUIRED = {
    "Patient, C.7.1.1": ("DeidentificationMethod", "PatientName PatientID PatientBirthDate PatientSex"),
    "General Study, C.7.2.1": (
        "StudyInstanceUID",
        "StudyDate StudyTime ReferringPhysicianName StudyID AccessionNumber",
    ),
    "General Series, C.7.3.1": ("Modality SeriesInstanceUID", "SeriesNumber Laterality"),
    "General Equipment, C.7.5.1": ("", "Manufacturer"),
    "General Image, C.7.6.1": ("", "InstanceNumber PatientOrientation"),
    "Image Pixel, C.7.6.3": (
        "SamplesPerPixel PhotometricInterpretation Rows Columns BitsAllocated BitsStored HighBit "
        "PixelRepresentation PixelData",
        "",
    ),
    "US Region Calibration, C.8.5.5": ("SequenceOfUltrasoundRegions", ""),
    "a region": (
        "RegionSpatialFormat RegionDataType RegionFlags RegionLocationMinX0 RegionLocationMinY0 "
        "RegionLocationMaxX1 RegionLocationMaxY1 PhysicalUnitsXDirection PhysicalUnitsYDirection "
        "PhysicalDeltaX PhysicalDeltaY",
        "",
    ),
    "US Image, C.8.5.6": ("", "ImageType"),
    "SOP Common, C.12.1": ("SOPClassUID SOPInstanceUID", ""),
}


@pytest.fixture
def file(tmp_path) -> Path:
    """A picture that a linear probe shows."""
    save_dicom(tmp_path / "picture.dcm", PICTURE, SPACING_MM, load_probe("linear"))
    return tmp_path / "picture.dcm"


def test_pixels_and_spacing_come_back(file):
    data, image = pydicom.dcmread(file), sitk.ReadImage(str(file))
    for pixels in (data.pixel_array, sitk.GetArrayViewFromImage(image)[0]):
        assert np.array_equal(pixels, PICTURE)
    assert data.PixelSpacing == pytest.approx(SPACING_MM) == image.GetSpacing()[1::-1]
    assert data.file_meta.TransferSyntaxUID == pydicom.uid.ExplicitVRLittleEndian
    assert data.SOPClassUID == data.file_meta.MediaStorageSOPClassUID == "1.2.840.10008.5.1.4.1.1.6.1"
    assert data.SOPInstanceUID == data.file_meta.MediaStorageSOPInstanceUID


def test_one_region_in_centimetres_covers_the_picture(file):
    (region,) = pydicom.dcmread(file).SequenceOfUltrasoundRegions
    assert (region.RegionLocationMinX0, region.RegionLocationMinY0) == (0, 0)
    assert (region.RegionLocationMaxX1, region.RegionLocationMaxY1) == (6, 8)
    assert (region.PhysicalUnitsXDirection, region.PhysicalUnitsYDirection) == (3, 3)
    assert (10 * region.PhysicalDeltaY, 10 * region.PhysicalDeltaX) == pytest.approx(SPACING_MM)
    assert (region.RegionSpatialFormat, region.RegionDataType, region.RegionFlags) == (1, 1, 0)


@pytest.mark.parametrize("module", REQUIRED)
def test_each_module_has_what_the_standard_requires(file, module):
    data = pydicom.dcmread(file)
    if module == "a region":
        (data,) = data.SequenceOfUltrasoundRegions
    type_1, type_2 = (keywords.split() for keywords in REQUIRED[module])
    assert [keyword for keyword in type_1 if keyword not in data or data[keyword].is_empty] == []
    assert [keyword for keyword in type_2 if keyword not in data] == []


@pytest.mark.parametrize(
    "geometry, kind",
    [("LINEAR", "LINEAR"), ("CURVILINEAR", "CURVED LINEAR"), ("PHASED", "SECTOR_PHASED")],
)
def test_a_probe_is_described_in_the_standards_terms_and_units(tmp_path, geometry, kind):
    sector = {"radius_start_mm": 35.0, "theta_start_deg": -30.0, "theta_stop_deg": 30.0}
    probe = Probe(
        transducer_name="any", transducer_geometry=geometry, frequency_mhz=3.5, depth_mm=129.6, **sector
    )
    save_dicom(tmp_path / "picture.dcm", PICTURE, SPACING_MM, probe)
    data = pydicom.dcmread(tmp_path / "picture.dcm")
    assert data.TransducerType == kind
    # In kHz, and in whole mm.
    assert data.SequenceOfUltrasoundRegions[0].TransducerFrequency == 3500
    assert data.DepthOfScanField == 130


@pytest.mark.parametrize("name", ["linear", "curvilinear"])
@pytest.mark.parametrize("shape", [(120, 90), (121, 91)])
def test_the_reference_pixel_leads_to_the_probes_coordinates(tmp_path, name, shape):
    probe = load_probe(name)
    width_mm, depth_mm, above_mm = probe.extent_mm
    spacing_mm = (depth_mm / shape[0], width_mm / shape[1])
    save_dicom(tmp_path / "picture.dcm", np.zeros(shape, np.uint8), spacing_mm, probe)
    (region,) = pydicom.dcmread(tmp_path / "picture.dcm").SequenceOfUltrasoundRegions
    u_cm, v_cm = region.ReferencePixelPhysicalValueX, region.ReferencePixelPhysicalValueY
    assert abs(u_cm) <= region.PhysicalDeltaX / 2 + 1e-9 and abs(v_cm) <= region.PhysicalDeltaY / 2 + 1e-9
    left_cm = u_cm - (region.ReferencePixelX0 + 0.5) * region.PhysicalDeltaX
    top_cm = v_cm - (region.ReferencePixelY0 + 0.5) * region.PhysicalDeltaY
    assert (left_cm, top_cm) == pytest.approx((-width_mm / 20, -above_mm / 10))


def test_without_a_probe_its_attributes_are_absent(tmp_path):
    save_dicom(tmp_path / "picture.dcm", PICTURE, SPACING_MM)
    keywords = {element.keyword for element in pydicom.dcmread(tmp_path / "picture.dcm").iterall()}
    assert {keyword for keyword in keywords if re.match("Transducer|Depth|Reference", keyword)} == set()


def test_it_says_that_it_is_simulated_and_names_nobody(file):
    data = pydicom.dcmread(file)
    not_text = ("DS", "FD", "IS", "OB", "SL", "SQ", "UI", "UL", "US")
    texts = {
        element.keyword: element.value
        for element in data.iterall()
        if element.VR not in not_text and not element.is_empty
    }
    assert texts == {
        "ImageType": ["DERIVED", "SECONDARY"],
        "SyntheticData": "YES",
        "DerivationDescription": "Simulated, not for diagnosis",
        "Modality": "US",
        "Manufacturer": "Nephron",
        "SoftwareVersions": VERSION,
        "PatientIdentityRemoved": "YES",
        "DeidentificationMethod": "Nothing of the patient is written",
        "TransducerType": "LINEAR",
        "PhotometricInterpretation": "MONOCHROME2",
        "BurnedInAnnotation": "NO",
        "LossyImageCompression": "00",
    }


def test_no_byte_tells_who_where_or_when(file):
    written = file.read_bytes().removesuffix(PICTURE.tobytes() + b"\0")
    assert len(written) < file.stat().st_size
    here = [getpass.getuser(), socket.gethostname(), str(file.parent), str(Path.cwd()), str(Path.home())]
    for word in [*here, date.today().isoformat(), date.today().strftime("%Y%m%d")]:
        assert not re.search(rb"(?<!\w)" + re.escape(word.encode()) + rb"(?!\w)", written), word


def test_uids_are_random_and_never_the_same(tmp_path):
    uids = set()
    for name in ("one.dcm", "other.dcm"):
        save_dicom(tmp_path / name, PICTURE, SPACING_MM)
        data = pydicom.dcmread(tmp_path / name)
        uids |= {data.SOPInstanceUID, data.SeriesInstanceUID, data.StudyInstanceUID}
    assert len(uids) == 6
    assert {uid[:5] for uid in uids} == {"2.25."}
    # Version 4 is of random bits; version 1 would hold the network card and the time.
    assert {uuid.UUID(int=int(uid[5:])).version for uid in uids} == {4}


def test_a_place_that_cannot_be_written_is_an_os_error_of_one_line(tmp_path):
    with pytest.raises(OSError, match=r"^[^\n]*missing[^\n]*$"):
        save_dicom(tmp_path / "missing" / "picture.dcm", PICTURE, SPACING_MM)
