"""CT series as DICOM: any order, orientation and container; missing, duplicate and tilted slices and other
images are reported.
"""

import shutil

import numpy as np
import pytest
from dicom_series import Series, edited, read_ct, refusal, save, write_dicomdir, zipped
from pydicom.datadict import dictionary_VR
from pydicom.dataelem import RawDataElement
from pydicom.tag import Tag
from pydicom.uid import (
    DeflatedExplicitVRLittleEndian,
    ExplicitVRBigEndian,
    ImplicitVRLittleEndian,
    generate_uid,
)
from scipy.spatial.transform import Rotation
from synthetic_body import DIRECTIONS

from scenes.patients.readers.ct_series import open_ct
from scenes.volumes.dicom_references import DicomReferences

SHUFFLED = (3, 0, 5, 1, 4, 2)
TILT = 18.0
SLOPE = np.array([3.0, -5.0, 8.0])  # HU/mm
AIR = -1000


def bump(places, centre=(-26.0, 24.0, -395.0), high=400.0, wide=6.0):
    """A plane and a ball, HU."""
    away = np.linalg.norm(places - np.array(centre), axis=-1)
    return 100 + (places - np.array(centre)) @ SLOPE + high * np.exp(-(away**2) / (2 * wide**2))


def voxel_places(grid):
    """LPS of all voxels (z, y, x, 3)."""
    k, j, i = np.meshgrid(*[np.arange(n) for n in grid.size[::-1]], indexing="ij")
    return grid.place(np.stack([i, j, k], axis=-1).reshape(-1, 3)).reshape(*grid.size[::-1], 3)


def assert_whole(series, path, /, **options):
    """All voxels, each in its place to what the file's six decimals leave."""
    volume, voxels = read_ct(path, **options)
    places = np.stack([series.places(k) for k in range(series.size[2])])
    at = np.rint(volume.grid.index(places.reshape(-1, 3))).astype(int)
    np.testing.assert_allclose(volume.grid.place(at), places.reshape(-1, 3), atol=1e-5)
    assert volume.grid.size == series.size
    assert np.array_equal(voxels[tuple(at.T[::-1])].reshape(places.shape[:3]), series.hounsfield)
    return volume


class TestSeries:
    @pytest.mark.parametrize("direction", DIRECTIONS)
    def test_any_orientation_and_order(self, tmp_path, direction):
        series = Series(tmp_path, DIRECTIONS[direction])
        series.write(SHUFFLED)
        (tmp_path / "notes.txt").write_text("no slice")
        assert assert_whole(series, tmp_path).notes == ()

    @pytest.mark.parametrize(
        "options",
        [
            dict(syntax=ImplicitVRLittleEndian),
            dict(syntax=ExplicitVRBigEndian),
            dict(syntax=DeflatedExplicitVRLittleEndian),
            dict(name="part{k}/IM{n}"),
            dict(preamble=False, name="IM{n}"),
        ],
        ids=["implicit", "big endian", "deflated", "subfolders", "no preamble"],
    )
    def test_any_form_of_files(self, tmp_path, options):
        series = Series(tmp_path)
        series.write(SHUFFLED, **options)
        assert_whole(series, tmp_path)

    def test_medium(self, tmp_path):
        series = Series(tmp_path)
        listed = write_dicomdir(tmp_path / "cd", [series.slice(k) for k in SHUFFLED])
        assert_whole(series, listed)
        assert assert_whole(series, tmp_path / "cd").notes == ()

    def test_archive(self, tmp_path):
        series = Series(tmp_path / "ct")
        series.write(SHUFFLED, name="a/b{k}/IM{n}")
        (tmp_path / "ct" / "readme.txt").write_text("no slice")
        archive = zipped(tmp_path / "ct", tmp_path / "ct.zip")
        shutil.rmtree(tmp_path / "ct")
        assert_whole(series, archive)
        assert list(tmp_path.iterdir()) == [archive]

    @pytest.mark.parametrize("options", [{}, {"shared": False}, {"slopes": (1, 0.5, 0.25, 1, 0.125, 1)}])
    def test_enhanced(self, tmp_path, options):
        series = Series(tmp_path, slope=1.0)
        file = series.write_enhanced(SHUFFLED, **options)
        assert_whole(series, file)
        assert_whole(series, tmp_path)

    def test_enhanced_without_places(self, tmp_path):
        edit = lambda data: delattr(data, "PerFrameFunctionalGroupsSequence")  # noqa: E731
        assert "6 frames without positions" in refusal(edited(Series(tmp_path).write_enhanced(), edit))

    @pytest.mark.parametrize(
        ("slope", "intercept", "signed"),
        [(0.5, -1000.5, False), (2, 10, True), (1, 0, True), (0.4, -1000, False), (0.3, -1000, False)],
    )
    def test_rescale(self, tmp_path, slope, intercept, signed):
        series = Series(tmp_path, slope=slope, intercept=intercept, signed=signed)
        series.write()
        _, voxels = read_ct(tmp_path)
        exact = series.stored * slope + intercept
        # Slopes that are no binary fractions are rounded themselves.
        assert np.abs(voxels - exact).max() <= 0.5 + 1e-3 * (slope % 0.5 > 0)

    def test_part_of_a_series(self, tmp_path):
        series = Series(tmp_path)
        volume = open_ct(series.write())
        box = slice(2, 9), slice(1, 5), slice(1, 4)
        assert np.array_equal(volume.hounsfield(box), series.hounsfield[1:4, 1:5, 2:9])
        np.testing.assert_allclose(volume.grid.part(box).origin, series.places(1)[1, 2], atol=1e-5)


class TestPadding:
    @pytest.mark.parametrize(
        ("signed", "stored", "tags"),
        [
            (True, -2000, {"PixelPaddingValue": -2000}),
            (False, 63536, {"PixelPaddingValue": 63536}),
            (False, 4095, {"PixelPaddingValue": 4095}),
            (False, 4090, {"PixelPaddingValue": 4085, "PixelPaddingRangeLimit": 4095}),
            (True, -2000, {}),
        ],
    )
    def test_padding_is_air(self, tmp_path, signed, stored, tags):
        series = Series(tmp_path, signed=signed)
        series.stored[:, :3] = stored
        series.write(**tags)
        _, voxels = read_ct(tmp_path)
        assert (voxels[:, :3] == AIR).all()
        assert np.array_equal(voxels[:, 3:], series.hounsfield[:, 3:])

    def test_unsigned_pixels_with_a_negative_padding(self, tmp_path):
        """Written as SS beside unsigned pixels, as implicit files of some scanners do."""
        series = Series(tmp_path)
        series.stored[:, :3] = 63536

        def padded(data, _):
            data.add_new("PixelPaddingValue", "SS", -2000)

        series.write(edit=padded)
        assert (read_ct(tmp_path)[1][:, :3] == AIR).all()

    def test_range_down_to_zero(self, tmp_path):
        series = Series(tmp_path, intercept=0, signed=True)
        series.stored[:] = 500
        series.stored[:, :3] = np.arange(3)[:, None]
        series.write(PixelPaddingValue=2, PixelPaddingRangeLimit=0)
        assert (read_ct(tmp_path)[1][:, :3] == AIR).all()


class TestChoice:
    def test_several_series(self, tmp_path):
        thin, thick = (
            Series(tmp_path, number=3, gap=1.25),
            Series(tmp_path, number=8, size=(12, 10, 3), gap=5),
        )
        thin.write()
        thick.write()
        volume = assert_whole(thin, tmp_path)
        assert len(volume.notes) == 1
        for words in (
            "of 2 series, number 3",
            "series 3 (CT, 6 slices, 1.25 mm apart)",
            "series 8 (CT, 3 slices, 5.00 mm",
        ):
            assert words in volume.notes[0]
        assert_whole(thick, tmp_path, series="8")
        assert_whole(thick, tmp_path, series=thick.uid[-8:])
        assert_whole(thick, tmp_path, series=thick.uid)
        assert_whole(thick, tmp_path, labels=DicomReferences(series=frozenset({thick.uid})))
        words = refusal(tmp_path, series="5")
        assert "--series 5 is no series" in words and "series 3" in words and "series 8" in words

    def test_series_of_one_number(self, tmp_path):
        one, other = Series(tmp_path / "a", number=4), Series(tmp_path / "b", number=4)
        one.write()
        other.write()
        words = refusal(tmp_path, series="4")
        assert "is 2 series" in words and one.uid[-6:] in words and other.uid[-6:] in words
        assert_whole(other, tmp_path, series=other.uid[-8:])

    def test_what_is_no_slice_is_left_out_and_said(self, tmp_path):
        series = Series(tmp_path)
        series.write()
        scout = series.slice(0, ImageType=["ORIGINAL", "PRIMARY", "LOCALIZER"])
        scout.ImageOrientationPatient, scout.SOPInstanceUID = [1, 0, 0, 0, 0, -1], generate_uid()
        save(scout, tmp_path / "scout.dcm")
        picture = series.slice(0, Modality="OT", SOPClassUID="1.2.840.10008.5.1.4.1.1.7")
        save(picture, tmp_path / "picture.dcm")
        notes = " ".join(assert_whole(series, tmp_path).notes)
        assert "left out, localisers: 1" in notes and "left out, no CT slices: 1 OT" in notes

    @pytest.mark.parametrize("number", ["", "4.5", "Doe^Jane"])
    def test_number_that_is_none(self, tmp_path, number):
        def odd(data, _):
            data["SeriesNumber"]._value = number

        series = Series(tmp_path)
        series.write(edit=odd)
        assert_whole(series, tmp_path)


class TestGeometry:
    def test_tilted_gantry(self, tmp_path):
        """In its slices' planes linear interpolation errs by h^2 f''/8; the file and the result round by
        1/2 HU each.
        """
        tilted = Rotation.from_euler("x", TILT, degrees=True).as_matrix()
        start = np.array([-31.5, 20.25, -400.0])
        series = Series(
            tmp_path, tilted, size=(24, 20, 9), field=bump, positions=lambda k: start + (0, 0, k * 2.5)
        )
        series.write(np.random.default_rng(1).permutation(9))
        volume, voxels = read_ct(tmp_path)
        # From the first slice to the last, eight times 2.5 mm along the table.
        shifted = f"by up to {20 * np.sin(np.radians(TILT)):.1f} mm"
        assert f"tilted by {TILT:.1f} degrees: slices shifted within their planes {shifted}" in " ".join(
            volume.notes
        )
        normal = tilted[:, 2]
        np.testing.assert_allclose(volume.grid.spacing, [0.8, 0.7, 2.5 * np.cos(np.radians(TILT))], atol=1e-5)
        np.testing.assert_allclose(volume.grid.direction[:, 2], normal, atol=1e-6)
        places = voxel_places(volume.grid)
        planes = np.arange(volume.grid.size[2])
        firsts = np.array([series.positions(k) for k in planes])[:, None, None]
        pixels = (places - firsts) @ tilted[:, :2] / series.spacing
        inside = ((pixels > 0.01) & (pixels < np.array(series.size[:2]) - 1.01)).all(axis=-1)
        outside = ((pixels < -0.01) | (pixels > np.array(series.size[:2]) + 0.01)).any(axis=-1)
        bend = 400 / 6**2
        tolerance = (0.8**2 + 0.7**2) / 8 * bend + 1
        assert inside.sum() > 0.8 * np.prod(series.size)
        assert np.abs(voxels - bump(places))[inside].max() <= tolerance
        assert (voxels[outside] == AIR).all() and outside.any()

    def test_steep_stack(self, tmp_path):
        """No gantry tilts by 60 degrees."""
        series = Series(tmp_path, DIRECTIONS["identity"])
        series.positions = lambda k: series.origin + k * np.array([0, 2.5 * np.tan(np.radians(60)), 2.5])
        series.write()
        assert "60" in refusal(tmp_path)

    def test_varying_gaps(self, tmp_path):
        """A plane stays one but where a slice within a tenth of a gap is taken as it is."""
        at = np.array([0, 1, 2.4, 3.4, 4.4, 5.8, 6.8])
        turned = DIRECTIONS["oblique"]
        start = np.array([-31.5, 20.25, -400.0])
        series = Series(
            tmp_path,
            turned,
            size=(12, 10, 7),
            field=lambda places: places @ SLOPE + 3300,
            positions=lambda k: start + 2.5 * at[k] * turned[:, 2],
        )
        series.write()
        volume, voxels = read_ct(tmp_path)
        assert "2.50 to 3.50 mm apart: resampled" in " ".join(volume.notes)
        tolerance = 0.1 * volume.grid.spacing[2] * abs(SLOPE @ turned[:, 2]) + 1
        assert np.abs(voxels - voxel_places(volume.grid) @ SLOPE - 3300).max() <= tolerance
        low, high = volume.grid.place([[0, 0, 0], [0, 0, volume.grid.size[2] - 1]])
        np.testing.assert_allclose(high - low, 2.5 * 6.8 * turned[:, 2], atol=1e-3)

    def test_positions_rounded_to_tenths(self, tmp_path):
        series = Series(tmp_path, DIRECTIONS["identity"], gap=0.625)
        series.write(
            edit=lambda data, k: setattr(
                data, "ImagePositionPatient", np.round(series.positions(k), 1).tolist()
            )
        )
        volume, voxels = read_ct(tmp_path)
        assert np.array_equal(voxels, series.hounsfield)
        assert volume.grid.spacing[2] == pytest.approx(0.625, abs=0.1 / 5)

    @pytest.mark.parametrize(
        ("order", "words"),
        [
            (
                (0, 1, 2, 4, 5),
                ("slice 3 (s1-2.dcm) at ", "slice 5 (s1-3.dcm) at ", "5.00 mm apart, the others 2.50"),
            ),
            ((0, 1, 2, 3, 4, 6, 7, 9), ("expected no slice to be missing", "(and 1 more such gaps)")),
            ((2,), ("one slice only",)),
        ],
    )
    def test_missing_slices(self, tmp_path, order, words):
        message = refusal(Series(tmp_path, size=(12, 10, 10)).write(order))
        assert all(part in message for part in words)

    @pytest.mark.parametrize(
        ("at", "tags", "words"),
        [
            # The same pixels beside their place are no copy.
            ((2.4, 0), {}, ("slice 3 (s1-2.dcm)", "1.00 mm apart")),
            ((2, 0.5), {}, ("slice 3 (s1-2.dcm)", "one position")),
            ((2, 0), dict(PixelData=bytes(240)), ("slice 3 (s1-2.dcm)", "one position")),
            ((6, 0), dict(PixelSpacing=[0.7, 0.82]), ("of different pixel spacing",)),
            ((6, 0), dict(ImageOrientationPatient=[1, 0, 0, 0, 0, -1]), ("of different orientation",)),
        ],
        ids=["too close", "beside it", "other pixels", "pixel spacing", "orientation"],
    )
    def test_one_slice_more(self, tmp_path, at, tags, words):
        series = Series(tmp_path)
        series.write()
        place = series.positions(at[0]) + at[1] * series.direction[:, 0]
        tags = dict(ImagePositionPatient=place.round(6).tolist(), InstanceNumber=30) | tags
        save(series.slice(2, SOPInstanceUID=generate_uid(), **tags), tmp_path / "z.dcm")
        message = refusal(tmp_path)
        assert all(part in message for part in (*words, "slice 30 (z.dcm)"))

    def test_copies_are_left_out(self, tmp_path):
        series = Series(tmp_path)
        series.write()
        shutil.copy(tmp_path / "s1-3.dcm", tmp_path / "copy.dcm")
        notes = assert_whole(series, tmp_path).notes
        # Without the file's name, which may be the patient's.
        assert notes == ("duplicates, taken once: slice 4",)


class TestRefused:
    @pytest.mark.parametrize(
        ("tags", "words"),
        [
            ({"Modality": "MR", "SOPClassUID": "1.2.840.10008.5.1.4.1.1.4"}, "no CT slices, but 6 MR"),
            ({"BurnedInAnnotation": "YES"}, "text burned into"),
            ({"NumberOfFrames": 2}, "2 frames"),
            ({"SamplesPerPixel": 3}, "colours"),
            ({"ImagePositionPatient": None}, "has no ImagePositionPatient"),
            ({"ImagePositionPatient": [1, 2]}, "ImagePositionPatient is 1, 2; expected 3 numbers"),
            ({"ImagePositionPatient": [1, 2, 1e30]}, "1, 2, 1e+30; expected 3 numbers, none beyond 1000000"),
            ({"ImageOrientationPatient": [1, 0, 0, 1, 0, 0]}, "is 1, 0, 0, 1, 0, 0; expected two orthogonal"),
            ({"ImageOrientationPatient": None}, "has no ImageOrientationPatient"),
            ({"PixelSpacing": None}, "has no PixelSpacing"),
            ({"PixelSpacing": [0, 0.7]}, "0.7 x 0 mm"),
            (
                {"PixelSpacing": [-0.7, 0.7]},
                "PixelSpacing are those of 12 x 10 pixels of 0.7 x -0.7 mm; expected",
            ),
            ({"Rows": 0}, "Rows and PixelSpacing are those of 12 x 0 pixels"),
            ({"PixelSpacing": [70, 70]}, "voxels of 70 x 70"),
            ({"RescaleSlope": 0}, "RescaleSlope is 0"),
            ({"RescaleIntercept": 1e30}, "RescaleIntercept is 1e+30; expected 1 number"),
            ({"ImageType": ["DERIVED", "PRIMARY", "AXIAL", "MTT"]}, "MTT; expected HU"),
        ],
    )
    def test_headers(self, tmp_path, tags, words):
        assert words in refusal(Series(tmp_path).write(**tags))

    @pytest.mark.parametrize(
        "name",
        [
            "PixelSpacing", "ImagePositionPatient", "ImageOrientationPatient", "RescaleSlope",
            "RescaleIntercept", "InstanceNumber",
            "NumberOfFrames",
        ],
    )  # fmt: skip
    @pytest.mark.parametrize("text", [b"Doe^Jane", b"nan\\nan "])
    def test_text_in_numbers(self, tmp_path, name, text):
        """The element is named; its text, which may be the patient's name, is not."""
        series = Series(tmp_path)

        def garbled(data, k):
            if k == 2:
                vr = dictionary_VR(name)
                data[Tag(name)] = RawDataElement(Tag(name), vr, len(text), text, 0, False, True)

        message = refusal(series.write(edit=garbled))
        assert f"s1-2.dcm: {name} " in message and "; expected" in message and "export" in message

    @pytest.mark.parametrize("tags", [{"Rows": 9}, {"Columns": 11}, {"BitsAllocated": 8}], ids=str)
    def test_more_pixels_than_the_header_has(self, tmp_path, tags):
        """Read by such Columns, every row would be shifted against the one before."""
        message = refusal(Series(tmp_path).write(**tags), name="s1-0.dcm")
        assert "PixelData has 240 bytes; expected" in message and "Rows, Columns, BitsAllocated" in message

    def test_a_slice_of_another_size_is_named(self, tmp_path):
        """One of many is taken for a localizer, and leaves a gap."""
        series = Series(tmp_path, size=(12, 10, 14))
        series.write(edit=lambda data, k: setattr(data, "Rows", 9) if k == 5 else None)
        message = refusal(tmp_path)
        assert "expected no slice to be missing" in message
        assert message.endswith("left out, in another view or size: slice 6 (s1-5.dcm)")

    def test_a_header_that_ends_early_is_named(self, tmp_path):
        """It has lost the UID of its series, so that the series lacks a slice."""
        series = Series(tmp_path)
        series.write()
        broken = tmp_path / "s1-3.dcm"
        content = broken.read_bytes()
        broken.write_bytes(content[: content.index(b"\x20\x00\x0d\x00")])
        message = refusal(tmp_path)
        assert (
            "expected no slice to be missing" in message and "left out, damaged: s1-3.dcm: has no" in message
        )

    def test_nothing_there(self, tmp_path):
        assert "no DICOM file" in refusal(tmp_path)
        assert "no such file" in refusal(tmp_path / "absent")
