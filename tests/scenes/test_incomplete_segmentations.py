"""DICOM-SEG as writers in the field make it: numbered from 0, or without what a reader of voxels does not
need.
"""

import numpy as np
import pydicom
import pytest
from dicom_series import Series, edited, refusal, save, write_segmentation
from test_readers_labels import by_name, ct_grid

from scenes.patients.readers.label_files import open_labels

NOT_NEEDED = [
    "StudyInstanceUID", "FrameOfReferenceUID", "ContentLabel", "DimensionOrganizationSequence",
    "DimensionIndexSequence",
    "ReferencedSeriesSequence", "ReferencedSeriesSequence.SeriesInstanceUID",
    "ReferencedSeriesSequence.ReferencedInstanceSequence.ReferencedSOPInstanceUID",
    "SegmentSequence.SegmentAlgorithmType", "SegmentSequence.SegmentAlgorithmName",
    "SegmentSequence.SegmentedPropertyCategoryCodeSequence",
    "SegmentSequence.SegmentedPropertyTypeCodeSequence",
    "SegmentSequence.SegmentedPropertyTypeCodeSequence.CodeMeaning",
    "SharedFunctionalGroupsSequence.PixelMeasuresSequence.SliceThickness",
    "SharedFunctionalGroupsSequence.PixelMeasuresSequence.SpacingBetweenSlices",
    "PerFrameFunctionalGroupsSequence.FrameContentSequence",
    "PerFrameFunctionalGroupsSequence.DerivationImageSequence",
    "PerFrameFunctionalGroupsSequence.FrameContentSequence.DimensionIndexValues",
    "PerFrameFunctionalGroupsSequence.DerivationImageSequence.SourceImageSequence.ReferencedSOPInstanceUID",
    "SamplesPerPixel", "PhotometricInterpretation", "PixelRepresentation", "BitsStored", "NumberOfFrames",
]  # fmt: skip


@pytest.fixture
def series(tmp_path):
    return Series(tmp_path / "ct")


@pytest.fixture
def masks(series):
    kidney, mass = np.zeros(series.size[::-1]), np.zeros(series.size[::-1])
    kidney[1:5, 2:7, 3:9], mass[2:4, 3:6, 8:11] = 1, 1
    return {"Kidney": kidney - kidney * mass, "renal mass": mass}


def without(items, path):
    """Data sets without an element, which is named by the sequences that lead to it."""
    first, *rest = path
    for one in items:
        if rest:
            without(one.get(first) or [], rest)
        elif first in one:
            delattr(one, first)


def renumber(data, by):
    for segment in data.SegmentSequence:
        segment.SegmentNumber += by
    for frame in data.PerFrameFunctionalGroupsSequence:
        for identified in frame.get("SegmentIdentificationSequence") or []:
            identified.ReferencedSegmentNumber += by


def values_of(path):
    return {s.name: s.value for one in open_labels(path).maps(None) for s in one.segments.values()}


@pytest.mark.parametrize("kind", ["BINARY", "FRACTIONAL", "LABELMAP"])
def test_without_what_is_not_needed(series, masks, tmp_path, kind):
    """Each alone, of one kind, and all together."""
    path = write_segmentation(tmp_path / "seg.dcm", series, masks, kind)
    alone = NOT_NEEDED if kind == "BINARY" else []
    for names in [[name] for name in alone] + [NOT_NEEDED]:
        data = pydicom.dcmread(path)
        for name in names:
            without([data], name.split("."))
        save(data, tmp_path / "less.dcm")
        labelled = by_name(open_labels(tmp_path / "less.dcm").maps(None), ct_grid(series))
        assert all(np.array_equal(labelled[name], mask > 0) for name, mask in masks.items()), names


@pytest.mark.parametrize("name", ["Rows", "SegmentationType", "SegmentSequence.SegmentNumber"])
def test_without_what_is_needed(series, masks, tmp_path, name):
    path = write_segmentation(tmp_path / "seg.dcm", series, masks)
    edited(path, lambda data: without([data], name.split(".")))
    refusal(path, read=lambda path: open_labels(path).maps(None))


@pytest.mark.parametrize("kind", ["BINARY", "FRACTIONAL"])
@pytest.mark.parametrize("by", [-1, 3])
def test_any_numbers(series, masks, tmp_path, kind, by):
    """Segment 0 is a segment as the others are, under its own number."""
    path = write_segmentation(tmp_path / "seg.dcm", series, masks, kind)
    edited(path, lambda data: renumber(data, by))
    labelled = by_name(open_labels(path).maps(None), ct_grid(series))
    assert all(np.array_equal(labelled[name], mask > 0) for name, mask in masks.items())
    assert values_of(path) == {"Kidney": 1 + by, "renal mass": 2 + by}


@pytest.mark.parametrize("kind", ["BINARY", "FRACTIONAL"])
def test_one_segment_that_no_frame_names(series, masks, tmp_path, kind):
    path = write_segmentation(tmp_path / "seg.dcm", series, {"Kidney": masks["Kidney"]}, kind)
    for sequence in ("SharedFunctionalGroupsSequence", "PerFrameFunctionalGroupsSequence"):
        edited(path, lambda data, at=sequence: without([data], [at, "SegmentIdentificationSequence"]))
    labelled = by_name(open_labels(path).maps(None), ct_grid(series))
    assert np.array_equal(labelled["Kidney"], masks["Kidney"] > 0)


def with_background(path, label, padding):
    """A label map whose segment 0 has a label, without a value of padding but where it is wanted."""

    def edit(data):
        (background,) = [one for one in data.SegmentSequence if one.SegmentNumber == 0]
        background.SegmentLabel = label
        if not padding:
            without([data], ["PixelPaddingValue"])

    return edited(path, edit)


@pytest.mark.parametrize("label", ["Background", "Hintergrund", ""])
@pytest.mark.parametrize("padding", [True, False])
def test_the_background_of_label_maps(series, masks, tmp_path, label, padding):
    path = write_segmentation(tmp_path / "seg.dcm", series, masks, "LABELMAP")
    assert values_of(with_background(path, label, padding)) == {"Kidney": 1, "renal mass": 2}


@pytest.mark.parametrize("label", ["Kidney", "renal mass"])
def test_a_structure_as_background(series, masks, tmp_path, label):
    path = write_segmentation(tmp_path / "seg.dcm", series, masks, "LABELMAP")
    message = refusal(with_background(path, label, padding=False), read=open_labels)
    assert f"segment 0 “{label}” is 0, which is the background" in message and "from 1" in message
