"""Which series and slices, in detail, and how they are put together."""

import numpy as np
import pytest
from dicom_series import Series, edited, read_ct, refusal, save
from pydicom.dataset import Dataset
from pydicom.uid import generate_uid
from synthetic_body import DIRECTIONS
from test_readers_dicom import SLOPE, assert_whole, voxel_places


class TestGeometry:
    @pytest.mark.parametrize("lean", [0.1, -0.1, 0.4, -0.4])
    def test_leans_either_way(self, tmp_path, lean):
        """A plane stays one: slices are shifted back up or down, by part of a pixel or by several."""
        start, slope = np.array([-31.5, 20.25, -400.0]), 10 * SLOPE
        series = Series(
            tmp_path, DIRECTIONS["identity"], field=lambda places: (places - start) @ slope + 2000,
            positions=lambda k: start + k * np.array([0, lean, 2.5]),
        )  # fmt: skip
        volume, voxels = read_ct(series.write())
        assert volume.grid.size == (12, 10 + np.ceil(5 * abs(lean) / 0.7), 6)
        places = voxel_places(volume.grid)
        low, high = 20.25 + max(0, 5 * lean), 20.25 + 9 * 0.7 + min(0, 5 * lean)
        held = (places[..., 1] > low - 0.01) & (places[..., 1] < high + 0.01)
        assert held.sum() > 200 and np.abs(voxels - (places - start) @ slope - 2000)[held].max() <= 1

    @pytest.mark.parametrize(("k", "aside"), [(2, 1.5), (5, 20.0), (0, 20.0)])
    def test_the_slice_out_of_line_is_named(self, tmp_path, k, aside):
        series = Series(tmp_path)
        at = series.positions
        series.positions = lambda n: at(n) + (n == k) * aside * series.direction[:, 0]
        assert f"slice {k + 1} (s1-{k}.dcm)" in refusal(series.write())

    def test_the_last_of_uneven_slices(self, tmp_path):
        """Of 7 gaps of 1.1 mm, which divided by their length are a hair less than 7."""
        at = 1.1 * np.array([0, 1, 2.4, 3.4, 4.4, 5.8, 6.8])
        series = Series(
            tmp_path, DIRECTIONS["identity"], size=(12, 10, 7), positions=lambda k: np.array([0, 0, at[k]])
        )
        voxels = read_ct(series.write())[1]
        assert voxels.shape[0] == 15 and np.array_equal(voxels[-1], series.hounsfield[-1])


class TestUnevenGaps:
    """Slices that alternate between two values lose their contrast on a grid that is coarser than they
    are, or misses them.
    """

    @pytest.mark.parametrize(
        "gaps",
        [(5, 7, 5, 7, 5), (7, 7, 5, 7, 7), (5, 6, 7, 5.5, 6.5), (2.5, 3.5, 2.5, 3.5, 3.5),
        (5.02, 6.97, 5, 7.04, 6.99)],
        ids=str,
    )  # fmt: skip
    def test_nothing_finer_is_lost(self, tmp_path, gaps):
        at = np.concatenate([[0.0], np.cumsum(gaps)])
        series = Series(
            tmp_path, DIRECTIONS["identity"], field=lambda places: np.interp(places[..., 2], at, [0,
            900] * 3),
            positions=lambda k: np.array([0, 0, at[k]]),
        )  # fmt: skip
        volume, voxels = read_ct(series.write((3, 0, 5, 1, 4, 2)))
        gap = volume.grid.spacing[2]
        assert gap <= min(gaps) and f"resampled to {gap:.2f} mm" in " ".join(volume.notes)
        planes = volume.grid.place([[0, 0, k] for k in range(len(voxels))])[:, 2]
        np.testing.assert_allclose(planes[[0, -1]], at[[0, -1]], atol=1e-6)
        # A slice within a tenth of a plane of it is taken as it is.
        expected = np.interp(planes, at, [0, 900] * 3)
        assert np.abs(voxels[:, 0, 0] - expected).max() <= 0.1 * gap * 900 / min(gaps) + 1
        nearest = np.abs(planes[:, None] - at).argmin(axis=0)
        assert np.array_equal(voxels[nearest], series.hounsfield)

    def test_no_more_planes_than_a_ct_resolves(self, tmp_path):
        """Of gaps without a common measure the planes are half a millimetre apart or more."""
        at = np.concatenate([[0.0], np.cumsum([1.57, 1.13, 1.23, 1.31, 1.49])])
        series = Series(tmp_path, DIRECTIONS["identity"], positions=lambda k: np.array([0, 0, at[k]]))
        volume, _ = read_ct(series.write())
        assert 0.45 <= volume.grid.spacing[2] <= 1.13

    @pytest.mark.parametrize("gap", [0.4, 0.6])
    def test_the_finest_gap_of_thin_slices_is_kept(self, tmp_path, gap):
        at = gap * np.array([0, 1, 2.4, 3.4, 4.4, 5.8])
        series = Series(tmp_path, DIRECTIONS["identity"], positions=lambda k: np.array([0, 0, at[k]]))
        volume, _ = read_ct(series.write())
        assert 0.8 * gap < volume.grid.spacing[2] <= gap


class TestSpacings:
    """A series whose spacing changes: no slice is missing, but it is no one volume."""

    def series(self, folder, gaps):
        at = np.concatenate([[0.0], np.cumsum(gaps)])
        turned = DIRECTIONS["oblique"]
        start = np.array([-31.5, 20.25, -400.0])
        return Series(
            folder, turned, size=(12, 10, len(at)), positions=lambda k: start + at[k] * turned[:, 2]
        ).write()

    @pytest.mark.parametrize(
        ("gaps", "spacings"),
        [
            ([5.0] * 6 + [2.5] * 6, ("5.00", "2.50")), ([1.5] * 9 + [5.0] * 4, ("1.50", "5.00")),
            ([1.5] * 4 + [5.0] * 9, ("1.50", "5.00")),
            ([2.5] * 6 + [4.0] + [5.0] * 4, ("2.50", "5.00")),
            ([5.0, 5.0, 5.0, 1.0, 1.0, 1.0, 1.0, 5.0, 5.0, 5.0], ("5.00", "1.00", "5.00")),
            ([1.3, 1.2, 1.3, 1.2, 5.0, 5.0, 5.0], ("1.25", "5.00")),
        ],
    )  # fmt: skip
    def test_parts_are_named(self, tmp_path, gaps, spacings):
        message = refusal(self.series(tmp_path, gaps))
        assert (
            f"{len(spacings)} parts of different slice spacing" in message
            and "in a separate folder" in message
        )
        parts = message.split("slice spacing: ")[1].split(", then ")
        assert len(parts) == len(spacings)
        for part, spacing in zip(parts, spacings, strict=True):
            assert f"{spacing} mm from slice " in part
        assert "from slice 1 (s1-0.dcm) at" in parts[0] and f"to slice {len(gaps) + 1} (" in parts[-1]

    @pytest.mark.parametrize(
        ("gaps", "words"),
        [
            ([2.5] * 5 + [5.0] + [2.5] * 5, "no slice to be missing"),
            ([2.5] * 5 + [5.0, 5.0] + [2.5] * 5, "no slice to be missing"),
            ([2.5] * 4 + [7.5] + [2.5] * 4 + [5.0] * 4, "no slice to be missing"),
            ([2.5] * 5 + [1.0, 1.5] + [2.5] * 5, "two acquisitions may overlap"),
        ],
    )
    def test_single_gaps_are_faults(self, tmp_path, gaps, words):
        assert words in refusal(self.series(tmp_path, gaps))


class TestSeries:
    def test_values_beyond_16_bits_are_cut(self, tmp_path):
        series = Series(tmp_path, slope=20.0)
        assert np.array_equal(read_ct(series.write())[1], np.clip(series.hounsfield, -1024, 32767))

    def test_no_word_on_hounsfield(self, tmp_path):
        volume = Series(tmp_path).write(RescaleIntercept=None, RescaleSlope=None)
        assert any("the files have no rescale" in note for note in read_ct(volume)[0].notes)

    def test_a_frames_own_values_count(self, tmp_path):
        """Not those that stand at the file's top, too."""

        def edit(data):
            data.RescaleIntercept, data.RescaleSlope, data.PixelSpacing = 0, 2, [1, 1]

        series = Series(tmp_path)
        assert_whole(series, edited(series.write_enhanced(), edit))

    def test_frames_that_are_no_hounsfield(self, tmp_path):
        def edit(data):
            kind = Dataset()
            kind.FrameType = ["DERIVED", "PRIMARY", "PERFUSION", "MTT"]
            data.SharedFunctionalGroupsSequence[0].CTImageFrameTypeSequence = [kind]

        assert "MTT, PERFUSION; expected HU" in refusal(edited(Series(tmp_path).write_enhanced(), edit))

    def test_legacy_converted(self, tmp_path):
        def edit(data):
            data.SOPClassUID = data.file_meta.MediaStorageSOPClassUID = "1.2.840.10008.5.1.4.1.1.2.2"

        series = Series(tmp_path)
        assert_whole(series, edited(series.write_enhanced(), edit))


class TestChoice:
    def test_scout_that_does_not_say_so(self, tmp_path):
        series = Series(tmp_path, size=(12, 10, 10))
        view = {"ImageOrientationPatient": [1, 0, 0, 0, 0, -1], "SOPInstanceUID": generate_uid()}
        save(series.slice(0, **view), series.write() / "scout.dcm")
        assert "left out, localisers: 1" in assert_whole(series, tmp_path).notes

    def test_axial_before_more_slices(self, tmp_path):
        axial = Series(tmp_path, DIRECTIONS["identity"], number=2)
        axial.write()
        Series(tmp_path, DIRECTIONS["slices first"], number=1, size=(12, 10, 9)).write()
        assert_whole(axial, tmp_path)

    def test_tall_before_more_slices(self, tmp_path):
        tall = Series(tmp_path, number=2, size=(12, 10, 7), gap=9.0)
        tall.write()
        Series(tmp_path, number=1, size=(12, 10, 20), gap=0.625).write()
        assert_whole(tall, tmp_path)

    def test_without_a_number(self, tmp_path):
        """It is empty in the findings."""
        assert read_ct(Series(tmp_path / "a").write(SeriesNumber=None))[0].series == ""
        assert read_ct(Series(tmp_path / "b", number=12).write())[0].series == "12"

    def test_a_number_is_no_end_of_a_uid(self, tmp_path):
        one, other = Series(tmp_path, number=8), Series(tmp_path, number=3)
        other.uid = "1.2.826.0.1.3680043.8"
        one.write()
        other.write()
        assert_whole(one, tmp_path, series="8")
