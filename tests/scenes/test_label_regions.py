"""Regions of structure sets and segments of segmentations: which are read, how far, and from any transfer
syntax.
"""

import numpy as np
import pydicom
import pytest
from dicom_series import Series, refusal, save, write_segmentation, write_structures
from pydicom.encaps import encapsulate
from pydicom.pixels.encoders import RLELosslessEncoder
from pydicom.uid import (
    DeflatedExplicitVRLittleEndian,
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
    JPEG2000Lossless,
    JPEGLSLossless,
    RLELossless,
)
from skimage.draw import polygon
from synthetic_body import DIRECTIONS
from test_readers_labels import by_name, ct_grid, ring

from scenes.patients.readers import dicom_seg
from scenes.patients.readers.label_files import open_labels
from scenes.patients.readers.label_maps import NEAR_MM
from scenes.patients.readers.segment_names import is_needless

NEEDLESS = [
    "BODY", "Body", "External", "external_1", "Skin", "Patient", "Patient outline", "Outer Contour",
    "Body contour", "whole body",
    "CouchSurface", "CouchInterior", "Z_Couch", "Table", "table top", "Mattress", "heart", "lung_left",
    "femur_right",
]  # fmt: skip
NEEDED = [
    "kidney_left", "GTV", "vertebral body L1", "external oblique muscle", "body of pancreas", "spleen",
    "Segment_1", "skin metastasis",
    "stable lesion", "unknown", "aorta", "patient's cyst",
]  # fmt: skip


def test_needless_names():
    assert [name for name in NEEDLESS if not is_needless(name)] == []
    assert [name for name in NEEDED if is_needless(name)] == []


def points_between(start, end):
    """The points of whole coordinates on an edge between two of them."""
    count = max(1, int(np.gcd(*(end - start))))
    return start + np.outer(np.arange(count), (end - start) // count)


class TestStructures:
    @pytest.fixture
    def series(self, tmp_path):
        return Series(tmp_path / "ct", DIRECTIONS["oblique"])

    def circles(self, series, planes=(1, 2, 3)):
        return [ring(series.places(k)[5, 6], 2.6, series.direction) for k in planes]

    def read(self, series, path, **options):
        drawing = open_labels(path, **options)
        return drawing, by_name(drawing.maps(ct_grid(series)))

    def test_what_is_needless_is_not_filled(self, series, tmp_path):
        circles = self.circles(series)
        regions = dict.fromkeys(("Kidney", "BODY", "liver", "heart", "spleen", "x"), circles)
        path = write_structures(tmp_path / "rt.dcm", regions)
        drawing, labelled = self.read(series, path)
        assert set(labelled) == {"Kidney", "liver", "spleen", "x"}
        assert drawing.notes == (
            "not read, as they are far from the kidneys or no organ: 2 “BODY”, 4 “heart”",
        )

    @pytest.mark.parametrize("word", ["body", "2"])
    def test_what_the_user_names_is_filled(self, series, tmp_path, word):
        circles = self.circles(series)
        path = write_structures(tmp_path / "rt.dcm", {"Kidney": circles, "BODY": circles, "heart": circles})
        drawing, labelled = self.read(series, path, wanted=[word])
        assert set(labelled) == {"Kidney", "BODY"} and np.array_equal(labelled["BODY"], labelled["Kidney"])
        assert drawing.notes == ("not read, as they are far from the kidneys or no organ: 3 “heart”",)

    @pytest.mark.parametrize(
        ("kind", "filled"), [("EXTERNAL", False), ("SUPPORT", False), ("GTV", True), ("", True), (None, True)]
    )
    def test_interpreted_types(self, series, tmp_path, kind, filled):
        """In any language: the type of a region says what it is."""

        def edit(data):
            observed = pydicom.Dataset()
            observed.ReferencedROINumber, observed.RTROIInterpretedType = 2, kind
            data.RTROIObservationsSequence = [observed]

        circles = self.circles(series)
        path = write_structures(tmp_path / "rt.dcm", {"Kidney": circles, "Außenkontur": circles}, edit=edit)
        assert ("Außenkontur" in self.read(series, path)[1]) == filled

    def test_numbers_of_what_is_needless_are_not_parsed(self, series, tmp_path):
        def edit(data):
            contour = data.ROIContourSequence[1].ContourSequence[0]
            contour["ContourData"] = pydicom.DataElement(0x30060050, "DS", "1\\2\\3")
            contour["ContourData"]._value = "no\\number\\here"

        circles = self.circles(series)
        path = write_structures(tmp_path / "rt.dcm", {"Kidney": circles, "BODY": circles}, edit=edit)
        assert set(self.read(series, path)[1]) == {"Kidney"}
        refusal(path, read=lambda path: open_labels(path, wanted=["BODY"]))

    def test_nothing_else_is_there(self, series, tmp_path):
        path = write_structures(tmp_path / "rt.dcm", {"BODY": self.circles(series)})
        message = refusal(path, read=lambda path: open_labels(path).maps(ct_grid(series)))
        assert "no closed contour" in message and "1 “BODY”" in message

    def test_names_of_two_encodings(self, tmp_path, series):
        """Points are the same from both encodings of their length."""
        path = write_structures(tmp_path / "rt.dcm", {"Kidney": self.circles(series)})
        plain = self.read(series, path)[1]["Kidney"]
        data = pydicom.dcmread(path)
        data.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
        save(data, tmp_path / "explicit.dcm")
        assert np.array_equal(self.read(series, tmp_path / "explicit.dcm")[1]["Kidney"], plain)

    @pytest.mark.parametrize("direction", ["identity", "oblique", "slices first"])
    def test_others_are_filled_near_the_kidneys(self, tmp_path, direction):
        """A long, wide region beside a small kidney; the box of the kidney's points in the patient, and
        the voxels that cover it.
        """
        turned = DIRECTIONS[direction]
        origin = turned @ np.full(3, -147.5)
        series = Series(tmp_path, turned, size=(60, 60, 60), gap=5.0, origin=origin, spacing=(5.0, 5.0))
        middle = ct_grid(series).place([[29.5, 29.5, k] for k in range(60)])
        kidney = [ring(middle[k], 12.0, turned) for k in (29, 30)]
        shown = []

        def progress(things, title):
            shown.append((title, len(things)))
            return things

        regions = {"Kidney": kidney, "x": [ring(m, 140.0, turned) for m in middle]}
        path = write_structures(tmp_path / "rt.dcm", regions)
        maps = open_labels(path, progress=progress).maps(ct_grid(series))
        filled = {segment.name: one for one in maps for segment in one.segments.values()}
        points = np.concatenate(kidney)
        low, high = points.min(axis=0) - NEAR_MM, points.max(axis=0) + NEAR_MM
        box = ct_grid(series).box_around(low, high)
        labelled = by_name(maps, ct_grid(series))["x"]
        radius = np.stack([np.linalg.norm(series.places(k) - middle[k], axis=-1) for k in range(60)])
        near = np.zeros(labelled.shape, bool)
        near[box[::-1]] = True
        assert near.sum() < 0.8 * near.size
        # The circle's 360 corners cut off 5 um.
        assert labelled[near & (radius < 139.9)].all() and not labelled[near & (radius > 140.1)].any()
        assert not labelled[~near].any()
        assert filled["Kidney"].values.any(axis=(1, 2)).sum() == 2
        planes = near.any(axis=(1, 2)).sum()
        assert [("contours", 2), ("contours", planes)] == [one for one in shown if one[0] == "contours"]

    @pytest.mark.parametrize("corners", [3, 4, 60, 500])
    def test_any_polygon(self, tmp_path, corners):
        """As skimage fills it, also where it crosses itself and has corners and edges on pixels; of
        oblique ones skimage misses some.
        """
        series = Series(
            tmp_path, DIRECTIONS["identity"], size=(70, 60, 4), origin=(0, 0, 0), spacing=(1.0, 1.0)
        )
        drawn = np.random.default_rng(corners).integers(-8, 75, (3, corners, 2))
        contours = [np.column_stack([outline, np.full(corners, 2.5 * k)]) for k, outline in enumerate(drawn)]
        path = write_structures(tmp_path / "rt.dcm", {"Kidney": contours})
        (filled,) = open_labels(path).maps(ct_grid(series))
        expected = np.zeros((3, 200, 200), bool)
        for plane, outline in zip(expected, drawn, strict=True):
            plane[polygon(outline[:, 1] + 50, outline[:, 0] + 50, plane.shape)] = True
            on = np.concatenate(
                [points_between(*ends) for ends in zip(outline, np.roll(outline, -1, axis=0), strict=True)]
            )
            plane[on[:, 1] + 50, on[:, 0] + 50] = True
        labelled = np.zeros_like(expected)
        at = np.rint(filled.grid.place(np.argwhere(filled.values)[:, ::-1]) / (1, 1, 2.5)).astype(int)
        labelled[at[:, 2], at[:, 1] + 50, at[:, 0] + 50] = True
        assert np.array_equal(labelled, expected)

    def test_without_a_kidney_all_is_filled(self, series, tmp_path):
        path = write_structures(tmp_path / "rt.dcm", {"x": self.circles(series, range(6))})
        assert self.read(series, path)[1]["x"].any(axis=(1, 2)).sum() == 6


class TestSegments:
    def test_what_is_needless_is_not_read(self, tmp_path):
        series = Series(tmp_path / "ct")
        ones = np.ones(series.size[::-1])
        path = write_segmentation(tmp_path / "seg.dcm", series, {"Kidney": ones, "heart": ones, "body": ones})
        drawing = open_labels(path)
        assert set(by_name(drawing.maps(None))) == {"Kidney"} and drawing.empty == ()
        assert drawing.notes == (
            "not read, as they are far from the kidneys or no organ: 2 “heart”, 3 “body”",
        )
        assert set(by_name(open_labels(path, ["3"]).maps(None))) == {"Kidney", "body"}


class TestSyntaxes:
    """Segmentations as archives store them; JPEG 2000 takes no smaller frames."""

    SIZE = (48, 40, 6)

    @pytest.fixture
    def drawn(self, tmp_path):
        def draw(kind):
            series = Series(tmp_path / "ct", size=self.SIZE)
            # An odd number of frames, with marks that no exchange of bytes or bits leaves as they are.
            mask = np.zeros(self.SIZE[::-1])
            mask[1:4, 3:30, 5:18], mask[2, 7, 41] = 1, 1
            return series, mask, write_segmentation(tmp_path / "seg.dcm", series, {"Kidney": mask}, kind)

        return draw

    @pytest.mark.parametrize("kind", ["BINARY", "FRACTIONAL", "LABELMAP"])
    @pytest.mark.parametrize(
        "syntax",
        [
            ImplicitVRLittleEndian, ExplicitVRBigEndian, DeflatedExplicitVRLittleEndian, RLELossless,
            JPEG2000Lossless, JPEGLSLossless,
        ],
    )  # fmt: skip
    def test_are_decoded(self, drawn, kind, syntax):
        series, mask, path = drawn(kind)
        data = pydicom.dcmread(path)
        if syntax == ExplicitVRBigEndian:
            data.PixelData = np.frombuffer(data.PixelData, "<u2").astype(">u2").tobytes()
            data["PixelData"].VR = "OW"
        elif syntax.is_encapsulated and kind == "BINARY":
            data = as_bytes(data, syntax)
        elif syntax.is_encapsulated:
            data.compress(syntax)
        data.file_meta.TransferSyntaxUID = syntax
        save(data, path)
        assert np.array_equal(by_name(open_labels(path).maps(None), ct_grid(series))["Kidney"], mask > 0)

    @pytest.mark.parametrize("kind", ["BINARY", "FRACTIONAL"])
    def test_that_nothing_decodes_are_named(self, drawn, kind):
        _, _, path = drawn(kind)
        data = pydicom.dcmread(path)
        data.PixelData = encapsulate([b"no frame"] * int(data.NumberOfFrames))
        data["PixelData"].VR = "OB"
        for syntax, name in (
            (JPEG2000Lossless, "JPEG 2000"),
            ("1.2.840.10008.1.2.4.201", "1.2.4.201|JPEG|HT"),
        ):
            data.file_meta.TransferSyntaxUID = pydicom.uid.UID(syntax)
            save(data, path)
            message = refusal(path, read=open_labels)
            assert "cannot be decoded" in message and "uncompressed" in message
            assert any(part in message for part in name.split("|"))

    def test_a_frame_that_is_damaged(self, drawn):
        _, _, path = drawn("FRACTIONAL")
        data = pydicom.dcmread(path)
        data.compress(RLELossless)
        frames = [bytes(64)] * int(data.NumberOfFrames)
        frames[0] = next(pydicom.encaps.generate_frames(data.PixelData, number_of_frames=len(frames)))
        data.PixelData = encapsulate(frames)
        save(data, path)
        assert "frames cannot be decoded (RLE Lossless" in refusal(path, read=open_labels)

    def test_a_claim_of_size(self, drawn, monkeypatch):
        monkeypatch.setattr(dicom_seg, "MOST_INFLATED", 1000)
        _, _, path = drawn("BINARY")
        save(as_bytes(pydicom.dcmread(path), RLELossless), path)
        assert "more than 2 GiB of frames" in refusal(path, read=open_labels)


def as_bytes(data, syntax):
    """A binary segmentation whose frames are compressed as one byte a pixel."""
    import jpeg_ls
    from openjpeg.utils import encode_array

    packed = {
        RLELossless: lambda frame: RLELosslessEncoder.encode(
            frame, rows=frame.shape[0], columns=frame.shape[1], samples_per_pixel=1, bits_allocated=8,
            bits_stored=8,
            number_of_frames=1, photometric_interpretation="MONOCHROME2", pixel_representation=0,
        ),
        JPEG2000Lossless: lambda frame: encode_array(frame, bits_stored=8),
        JPEGLSLossless: lambda frame: bytes(jpeg_ls.encode_array(frame)),
    }[syntax]  # fmt: skip
    data.PixelData = encapsulate([packed(frame) for frame in data.pixel_array.astype(np.uint8)])
    data["PixelData"].VR = "OB"
    data.file_meta.TransferSyntaxUID = syntax
    return data
