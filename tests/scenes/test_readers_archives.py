"""Limits of archives, and shares of fractional segments."""

import numpy as np
import pydicom
from dicom_series import Series, write_segmentation, zipped
from test_readers_hostile import refused  # noqa: F401
from test_readers_labels import by_name, ct_grid

from scenes.patients.readers import dicom_files
from scenes.patients.readers.label_files import open_labels


class TestArchives:
    def test_many_large_entries(self, tmp_path, refused, monkeypatch):
        path = zipped(Series(tmp_path / "ct").write(), tmp_path / "a.zip")
        monkeypatch.setattr(
            dicom_files, "MOST_ARCHIVE_BYTES", 2 * len((tmp_path / "ct" / "s1-0.dcm").read_bytes())
        )
        assert "GiB of DICOM; expected at most" in refused(path)

    def test_one_that_ends_early(self, tmp_path, refused):
        path = zipped(Series(tmp_path / "ct").write(), tmp_path / "a.zip")
        path.write_bytes(path.read_bytes()[:-100])
        assert "a damaged archive" in refused(path)

    def test_many_files(self, tmp_path, refused, monkeypatch):
        monkeypatch.setattr(dicom_files, "MOST_FILES", 5)
        assert "more than 5 files" in refused(Series(tmp_path / "ct").write())


class TestSegmentations:
    def test_half_is_in(self, tmp_path):
        """127 of 254."""
        series, shares = Series(tmp_path / "ct"), np.zeros((6, 10, 12))
        shares[1:4, 2:6, 2:6], shares[2, 3, 3] = 0.4, 0.5
        data = pydicom.dcmread(
            path := write_segmentation(tmp_path / "seg.dcm", series, {"Kidney": shares}, "FRACTIONAL")
        )
        data.PixelData, data.MaximumFractionalValue = data.PixelData.replace(b"\x80", b"\x7f"), 254
        data.save_as(path)
        found = by_name(open_labels(path).maps(None), ct_grid(series))["Kidney"]
        assert np.array_equal(found, shares == 0.5)
