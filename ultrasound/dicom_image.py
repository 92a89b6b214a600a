"""Images as de-identified DICOM Ultrasound Images (PS3.3 A.6.4, with the US modules of C.8.5.5 and
C.8.5.6).
"""

import io
from pathlib import Path

import numpy as np
from pydicom import Dataset
from pydicom.dataset import FileMetaDataset
from pydicom.uid import ExplicitVRLittleEndian, UltrasoundImageStorage, generate_uid
from pydicom.valuerep import DS

from ultrasound.probe import Probe
from version import VERSION

# Attributes of type 2: required, empty where unknown.
EMPTY = (
    "PatientName",
    "PatientID",
    "PatientBirthDate",
    "PatientSex",
    "StudyDate",
    "StudyTime",
    "ReferringPhysicianName",
    "StudyID",
    "AccessionNumber",
    "SeriesNumber",
    "Laterality",
    "InstanceNumber",
    "PatientOrientation",
)
TRANSDUCER_TYPES = {"LINEAR": "LINEAR", "CURVILINEAR": "CURVED LINEAR", "PHASED": "SECTOR_PHASED"}
REGION_2D, REGION_TISSUE, REGION_COLOUR_FLOW, CENTIMETRES = 1, 1, 2, 3


def save_dicom(
    path: Path, image: np.ndarray, spacing_mm: tuple[float, float], probe: Probe | None = None
) -> None:
    """Write grey values (rows, columns) uint8, or colours (rows, columns, 3) of Doppler, with row and column
    spacing [mm].

    With a probe, whose ``extent_mm`` the image covers, the file also has transducer data and the centre of
    the array face. Raises OSError where the file cannot be written.
    """
    data = Dataset()
    for keyword in EMPTY:
        setattr(data, keyword, None)
    data.PatientIdentityRemoved = "YES"
    data.DeidentificationMethod = "Nothing of the patient is written"
    data.SOPClassUID = UltrasoundImageStorage
    # Without a prefix they are random UUIDs, which identify neither patient nor machine nor time.
    for keyword in ("SOPInstanceUID", "SeriesInstanceUID", "StudyInstanceUID"):
        setattr(data, keyword, generate_uid(prefix=None))
    data.Modality = "US"
    data.Manufacturer = "Nephron"
    data.SoftwareVersions = VERSION
    # Not acquired: derived from the pixels of another image.
    data.ImageType = ["DERIVED", "SECONDARY"]
    data.DerivationDescription = "Simulated, not for diagnosis"
    data.SyntheticData = "YES"
    data.BurnedInAnnotation = "NO"
    data.LossyImageCompression = "00"
    # Not part of this IOD, which has the region's deltas, but read by ITK.
    data.PixelSpacing = [DS(float(mm), auto_format=True) for mm in spacing_mm]
    data.SequenceOfUltrasoundRegions = [_region(image.shape, spacing_mm, probe)]
    if probe is not None:
        data.TransducerType = TRANSDUCER_TYPES[probe.transducer_geometry]
        data.DepthOfScanField = round(probe.depth_mm)

    data.file_meta = FileMetaDataset()
    data.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    data.set_pixel_data(
        image, "MONOCHROME2" if image.ndim == 2 else "RGB", bits_stored=8, generate_instance_uid=False
    )
    content = io.BytesIO()  # so that an error of the disk names the file
    data.save_as(content, enforce_file_format=True)
    path.write_bytes(content.getvalue())


def _region(shape: tuple[int, ...], spacing_mm: tuple[float, float], probe: Probe | None) -> Dataset:
    """The whole image as one region; its reference pixel contains the centre of the face, where (u, v) is 0
    [cm].
    """
    rows, columns = shape[:2]
    row_cm, column_cm = (float(mm) / 10 for mm in spacing_mm)
    region = Dataset()
    region.RegionSpatialFormat = REGION_2D
    region.RegionDataType = REGION_TISSUE if len(shape) == 2 else REGION_COLOUR_FLOW
    region.RegionFlags = 0
    region.RegionLocationMinX0, region.RegionLocationMinY0 = 0, 0
    region.RegionLocationMaxX1, region.RegionLocationMaxY1 = columns - 1, rows - 1
    region.PhysicalUnitsXDirection = region.PhysicalUnitsYDirection = CENTIMETRES
    region.PhysicalDeltaX, region.PhysicalDeltaY = column_cm, row_cm
    if probe is not None:
        region.TransducerFrequency = round(probe.frequency_mhz * 1000)
        above_cm = probe.extent_mm[2] / 10
        column, row = columns // 2, int(above_cm / row_cm)
        region.ReferencePixelX0, region.ReferencePixelY0 = column, row
        # The pixel's centre is off the face's centre by a part of a pixel.
        region.ReferencePixelPhysicalValueX = (column + 0.5 - columns / 2) * column_cm
        region.ReferencePixelPhysicalValueY = (row + 0.5) * row_cm - above_cm
    return region
