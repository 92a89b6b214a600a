"""Segments whose names say nothing, such as Segment_1: tissue and side by the codes of 3D Slicer and of
DICOM.
"""

import re

import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
from dicom_series import Series, refusal, write_segmentation
from pydicom.dataset import Dataset
from raw_nrrd import with_segments
from synthetic_body import LEFT, TUMOUR, body

from scenes.patients.import_warnings import _place, label_warnings
from scenes.patients.organ_selection import find_organs
from scenes.patients.readers.label_files import open_labels
from scenes.patients.readers.label_maps import LabelMap
from scenes.patients.readers.segment_codes import dicom_meaning, slicer_meaning
from scenes.volumes.voxel_grid import VoxelGrid

TISSUE, STRUCTURE = "SCT^85756007^Tissue", "SCT^123037004^Anatomical Structure"
ALTERED = "SCT^49755003^Morphologically Altered Structure"
KIDNEY, MASS, CYST = "SCT^64033007^Kidney", "SCT^4147007^Mass", "SCT^367643001^Cyst"
LEFT_CODE, RIGHT_CODE, BOTH = "SCT^7771000^Left", "SCT^24028007^Right", "SCT^51440002^Right and left"
NONE = "^^"
# Category, type and its modifier, region and its modifier; tissue, sides.
CODES = {
    "kidney, right": (STRUCTURE, KIDNEY, RIGHT_CODE, NONE, NONE, "kidney", {"right"}),
    "as 3D Slicer begins": (TISSUE, TISSUE, NONE, NONE, NONE, None, set()),
    "tissue of the left kidney": (TISSUE, TISSUE, NONE, KIDNEY, LEFT_CODE, "kidney", {"left"}),
    "right kidney in one code": (STRUCTURE, "SCT^9846003^", NONE, NONE, NONE, "kidney", {"right"}),
    "left kidney as the region": (TISSUE, TISSUE, NONE, "SCT^18639004^", NONE, "kidney", {"left"}),
    "mass of the right kidney": (ALTERED, MASS, NONE, KIDNEY, RIGHT_CODE, "tumour", {"right"}),
    "mass of no region": (ALTERED, MASS, NONE, NONE, NONE, "tumour", set()),
    "mass of the liver": (ALTERED, MASS, NONE, "SCT^10200004^Liver", NONE, None, set()),
    "cyst of the adrenal gland": (ALTERED, CYST, NONE, "SCT^23451007^Adrenal gland", LEFT_CODE, None,
    {"left"}),
    "cyst of the kidney": (ALTERED, CYST, LEFT_CODE, KIDNEY, LEFT_CODE, "cyst", {"left"}),
    "renal artery": (STRUCTURE, "SCT^2841007^Renal artery", RIGHT_CODE, NONE, NONE, "artery", {"right"}),
    "artery of the kidney": (STRUCTURE, "SCT^51114001^Artery", NONE, KIDNEY, NONE, "artery", set()),
    "renal pelvis": (STRUCTURE, "SCT^25990002^Renal pelvis", NONE, NONE, NONE, "urine", set()),
    "spleen": (STRUCTURE, "SCT^78961009^Spleen", NONE, NONE, NONE, "spleen", set()),
    "both kidneys": (STRUCTURE, KIDNEY, BOTH, NONE, NONE, "kidney", set()),
    "in German": (STRUCTURE, "SCT^64033007^Organ der Harnbildung", "SCT^7771000^li.", NONE, NONE, "kidney",
    {"left"}),
    "unknown code, known words": (STRUCTURE, "FMA^7205^Left kidney", NONE, NONE, NONE, "kidney", {"left"}),
    "another scheme's number": (STRUCTURE, "FMA^64033007^Femur", NONE, NONE, NONE, "bone", set()),
    "SNOMED RT": ("SRT^T-D0050^Tissue", "SRT^T-71000^", "SRT^G-A100^", NONE, NONE, "kidney", {"right"}),
    "SNM3": ("SNM3^T-D0050^", "SNM3^M-3340A^", NONE, "SNM3^T-71000^", "SNM3^G-A101^", "cyst", {"left"}),
    "SNOMED RT, neoplasm": ("SRT^M-01000^", "SRT^M-8FFFF^", NONE, "SRT^T-71000^", NONE, "tumour", set()),
    "SNOMED RT, vein": ("SRT^T-D000A^", "SRT^T-48740^", "SRT^G-A101^", NONE, NONE, "vein", {"left"}),
    "contradictory": (TISSUE, KIDNEY, LEFT_CODE, KIDNEY, RIGHT_CODE, "kidney", {"left", "right"}),
}  # fmt: skip


def tags(category, kind, modifier, region, region_modifier):
    """A segment's tags as 3D Slicer writes them."""
    contexts = (
        "Segmentation category and type - 3D Slicer General Anatomy list",
        "Anatomic codes - DICOM master list",
    )
    entry = "~".join([contexts[0], category, kind, modifier, contexts[1], region, region_modifier])
    return f"Segmentation.Status:inprogress|TerminologyEntry:{entry}|"


def coded(code):
    """The item of a code."""
    item = Dataset()
    item.CodingSchemeDesignator, item.CodeValue, item.CodeMeaning = code.split("^")
    return item


def described(category, kind, modifier, region, region_modifier):
    """The codes of a segment in DICOM."""
    segment = Dataset()
    segment.SegmentedPropertyCategoryCodeSequence = [coded(category)]
    segment.SegmentedPropertyTypeCodeSequence = [coded(kind)]
    if modifier != NONE:
        segment.SegmentedPropertyTypeCodeSequence[0].SegmentedPropertyTypeModifierCodeSequence = [
            coded(modifier)
        ]
    if region != NONE:
        segment.AnatomicRegionSequence = [coded(region)]
        if region_modifier != NONE:
            segment.AnatomicRegionSequence[0].AnatomicRegionModifierSequence = [coded(region_modifier)]
    return segment


@pytest.mark.parametrize(
    "meaning", [lambda *c: slicer_meaning(tags(*c)), lambda *c: dicom_meaning(described(*c))]
)
@pytest.mark.parametrize(("case"), CODES.values(), ids=CODES)
def test_tissue_and_side(case, meaning):
    *codes, tissue, sides = case
    found = meaning(*codes)
    assert (found.tissue, found.sides) == (tissue, sides)


@pytest.mark.parametrize(
    "text", ["", "x", "TerminologyEntry:", "TerminologyEntry:a~b", "TerminologyEntry:~~~~~~^~"]
)
def test_damaged_tags_mean_nothing(text):
    found = slicer_meaning(text)
    assert (found.tissue, found.sides, str(found)) == (None, set(), "")


def slicer_file(path, *segments):
    """A .seg.nrrd of segments (name, codes) that are rows of voxels, each 3 x 4 of them."""
    voxels = np.zeros((3, 4, len(segments) + 2), np.uint8)
    image = sitk.GetImageFromArray(voxels + np.arange(len(segments) + 2, dtype=np.uint8))
    fields = [dict(Name=name, LabelValue=n, Tags=tags(*codes)) for n, (name, codes) in enumerate(segments, 1)]
    sitk.WriteImage(with_segments(image, fields), str(path))
    return path


def found_in(path):
    return [
        (s.name, s.tissue, s.side)
        for one in open_labels(path).maps(None)
        for s in one.segments.values()
        if s.name
    ]


def codes_of(case):
    return CODES[case][:5]


NAMED = [
    ("Segment_1", "kidney, right", "kidney", "right"),
    ("Segment_2", "mass of the right kidney", "tumour", "right"),
    ("Segment_3", "as 3D Slicer begins", None, None),
    # A name that is understood comes before the codes, and its side is added to theirs.
    ("GTV", "tissue of the left kidney", "tumour", "left"),
    ("kidney left", "as 3D Slicer begins", "kidney", "left"),
    ("spleen", "as 3D Slicer begins", "spleen", None),
    # Letters of a name that is not understood are no side where the codes have one.
    ("L 4711 R2", "kidney, right", "kidney", "right"),
]  # fmt: skip


def test_slicer_segments(tmp_path):
    path = slicer_file(tmp_path / "a.seg.nrrd", *((name, codes_of(case)) for name, case, *_ in NAMED))
    assert found_in(path) == [(name, tissue, side) for name, _, tissue, side in NAMED]


def dicom_file(tmp_path, *segments):
    """A DICOM-SEG of segments (name, codes), one plane each; a further one has no voxel."""
    series = Series(tmp_path / "ct", size=(12, 10, len(segments) + 1))
    masks = {}
    for n, (name, _) in enumerate([*segments, ("nothing", None)]):
        masks[name] = np.zeros(series.size[::-1])
        masks[name][n] = n < len(segments)
    path = write_segmentation(tmp_path / "seg.dcm", series, masks)
    data = pydicom.dcmread(path)
    for segment, (_, codes) in zip(data.SegmentSequence, segments, strict=False):
        segment.update(described(*codes))
    data.save_as(path)
    return path


def test_dicom_segments(tmp_path):
    path = dicom_file(tmp_path, *((name, codes_of(case)) for name, case, *_ in NAMED))
    assert found_in(path) == [(name, tissue, side) for name, _, tissue, side in NAMED]
    assert [s.name for s in open_labels(path).empty] == ["nothing"]


@pytest.mark.parametrize("write", [lambda at, s: slicer_file(at / "seg.seg.nrrd", s), dicom_file])
@pytest.mark.parametrize(("name", "case"), [("Kidney L", "kidney, right"), ("Segment_1", "contradictory")])
def test_sides_that_differ_are_refused(tmp_path, write, name, case):
    path = write(tmp_path, (name, codes_of(case)))
    words = refusal(path, read=open_labels)
    assert name in words and "right" in words and "another side" in words and "correct" in words


def test_coded_segments_beside_the_organ_are_known(tmp_path):
    """A spleen by its codes is no label without a meaning, but it cannot be in a kidney; what has none is
    named with it.
    """
    _, labels = body(spacing=(6.0, 5.0, 8.0))
    plain = LabelMap.of(labels, {1: "kidney_right", 2: "kidney_left"})
    beside = plain.segments[3]
    (path,) = [slicer_file(tmp_path / "a.seg.nrrd", ("Segment_1", codes_of("spleen")))]
    (segment,) = [s for one in open_labels(path).maps(None) for s in one.segments.values() if s.name]
    assert str(segment) == "1 “Segment_1” (“spleen”)"
    for known, words in ((segment, "is of no tissue of a kidney"), (beside, "has no known tissue")):
        one = LabelMap(plain.grid, plain.values, {**plain.segments, 3: known})
        piece = find_organs(one, [2])[0]
        assert piece.centre_x_mm == pytest.approx(LEFT[0][0], abs=3)
        (warning,) = label_warnings(one, piece, True, [one])
        assert words in warning
    volume, *place = re.search(
        r"\(([\d.]+) ml\).* in the middle third, at (\d+), (\d+), (\d+) mm", warning
    ).groups()
    # The tumour that is not known, to a part of a voxel of 6 x 5 x 8 mm.
    assert np.array(place, float) == pytest.approx(TUMOUR[0], abs=2.0)
    assert float(volume) == pytest.approx((plain.values == 3).sum() * 0.24, abs=0.05)
    # From -33 to 57 mm.
    for z, third in ((42.0, "upper"), (-18.0, "lower")):
        assert (
            _place(piece, np.array([[70.0, 35.0, z]])) == f"in the {third} third, at 70, 35, {z:.0f} mm (LPS)"
        )


@pytest.mark.parametrize(("voxels", "is_named"), [(500, True), (499, False)])
def test_what_touches_the_organ_and_has_no_known_tissue_is_named_from_half_a_ml_on(voxels, is_named):
    """A rod of voxels of 1 mm that stands out of a block."""
    values = np.zeros((60, 60, 60), np.uint8)
    values[5:55, 5:35, 5:45] = 2
    at = np.argwhere(np.ones((5, 20, 5)))[:voxels] + [25, 35, 20]
    values[tuple(at.T)] = 3
    grid = VoxelGrid((60, 60, 60), np.ones(3), np.zeros(3), np.eye(3))
    labels = LabelMap.valued(grid, values, {2: "kidney_left", 3: "Segment_9"})
    found = label_warnings(labels, find_organs(labels, [2])[0], True, [labels])
    assert len(found) == is_named and all("(0.5 ml) touches the organ" in line for line in found)
