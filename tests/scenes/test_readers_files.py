"""Volumes in files, in detail: values, where a box is."""

import gzip
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import SimpleITK as sitk
from dicom_series import Series, save
from synthetic_body import DIRECTIONS, grid_around, with_voxels
from test_readers import AIR, noise, written

from errors import PatientError
from scenes.patients.readers.ct_series import open_ct
from scenes.volumes.voxel_grid import VoxelGrid


class TestFiles:
    @pytest.mark.parametrize("ending", [".nii.gz", ".mha"])
    def test_values_beyond_16_bits_are_cut(self, tmp_path, ending):
        voxels = sitk.GetArrayFromImage(noise()).astype(np.float64)
        voxels[0, 0, :2] = 40_000, -40_000
        path = written(tmp_path / f"ct{ending}", with_voxels(noise(), voxels))
        assert open_ct(path).hounsfield()[0, 0, :2].tolist() == [32767, AIR]

    @pytest.mark.parametrize(
        ("written_as", "renamed", "words"),
        [
            ("a.nii", "b.nii.gz", "NIfTI, not compressed by gzip; .*rename it to end in .nii$"),
            (
                "a.nii.gz",
                "b.nii",
                "NIfTI, compressed by gzip; expected NIfTI by .*rename it to end in .nii.gz$",
            ),
            ("<!DOCTYPE html>", "b.nii.gz", "is a web page or XML"),
            ("\n<html>", "b.nii", "is a web page or XML"),
            (
                "ten words that are no volume of anything",
                "b.nii.gz",
                "is no known volume, not compressed by gzip; .*copy or export",
            ),
        ],
    )
    def test_nifti_that_is_not_what_its_name_says(self, tmp_path, written_as, renamed, words):
        path = tmp_path / renamed
        if written_as.startswith("a."):
            written(tmp_path / written_as, noise()).rename(path)
        else:
            path.write_text(written_as)
        with pytest.raises(PatientError, match=words) as caught:
            open_ct(path)
        assert "Error" not in str(caught.value)

    @pytest.mark.parametrize(
        ("true", "named", "words"),
        [
            ("a.nii", "b.nrrd", "is NIfTI; expected NRRD by its name; rename it to end in .nii$"),
            ("a.nii.gz", "b.nrrd", "is NIfTI, compressed by gzip; expected NRRD .* to end in .nii.gz$"),
            ("a.nii.gz", "b.mha", "is NIfTI, compressed by gzip; expected MetaImage .* to end in .nii.gz$"),
            ("a.nrrd", "b.nii", "is NRRD; expected NIfTI by its name; rename it to end in .nrrd$"),
            ("a.nrrd", "b.nii.gz", "is NRRD, not compressed by gzip; expected NIfTI .* to end in .nrrd$"),
            ("a.nrrd", "b.mhd", "is NRRD; expected MetaImage by its name; rename it to end in .nrrd$"),
            ("a.mha", "b.nii", "is MetaImage; expected NIfTI by its name; rename it to end in .mha$"),
            ("a.mha", "b.nrrd", "is MetaImage; expected NRRD by its name; rename it to end in .mha$"),
            ("a.mha", "b.seg.nrrd", "is MetaImage; expected NRRD by its name; rename it to end in .mha$"),
        ],
    )
    def test_a_volume_under_the_name_of_another_format(self, tmp_path, true, named, words):
        path = tmp_path / named
        written(tmp_path / true, noise()).rename(path)
        with pytest.raises(PatientError, match=words):
            open_ct(path)

    @pytest.mark.parametrize(
        ("true", "named", "words"),
        [
            (
                "a.nrrd",
                "b.nii.gz",
                "is NRRD; expected NIfTI compressed .*; decompress it, and rename .* .nrrd$",
            ),
            ("a.mha", "b.nii", "is MetaImage, compressed by gzip; .*; decompress it, and rename .* .mha$"),
        ],
    )
    def test_another_format_in_gzip(self, tmp_path, true, named, words):
        (tmp_path / named).write_bytes(gzip.compress(written(tmp_path / true, noise()).read_bytes()))
        with pytest.raises(PatientError, match=words):
            open_ct(tmp_path / named)

    @pytest.mark.parametrize("named", ["b.nii", "b.nrrd"])
    def test_dicom_under_the_name_of_a_volume(self, tmp_path, named):
        save(Series(tmp_path).slice(0), tmp_path / named)
        with pytest.raises(PatientError, match="is DICOM; expected .* rename it to end in .dcm$"):
            open_ct(tmp_path / named)

    def test_what_no_memory_holds_is_refused_with_what_it_takes(self, tmp_path, monkeypatch):
        ct = open_ct(written(tmp_path / "ct.mha", noise()))
        needed = 5 * np.prod(ct.grid.size)
        monkeypatch.setattr("psutil.virtual_memory", lambda: SimpleNamespace(available=needed - 1))
        with pytest.raises(
            PatientError, match=r"ct\.mha: takes 0\.0 GB to read, and 0\.0 GB are free; close"
        ):
            ct.read()
        assert ct.read((slice(0, 2),) * 3).shape == (2, 2, 2)
        monkeypatch.setattr("psutil.virtual_memory", lambda: SimpleNamespace(available=needed))
        assert ct.read().size == needed / 5


class TestGrid:
    def test_part_of_a_voxel_is_another_grid(self):
        """And so are finer voxels with the same corners."""
        one = VoxelGrid.of(grid_around((0, 0, 0), (9, 8, 6), (1.0, 1.0, 2.0)))
        finer = replace(one, size=tuple(2 * n - 1 for n in one.size), spacing=one.spacing / 2)
        assert one.same_as(replace(one, origin=one.origin + [0.005, 0, 0]))
        assert not one.same_as(replace(one, origin=one.origin + [0.5, 0, 0])) and not one.same_as(finer)

    @pytest.mark.parametrize("direction", DIRECTIONS)
    def test_box_covers_its_places(self, direction):
        grid = VoxelGrid.of(
            grid_around((-60, -60, -60), (60, 60, 60), (0.9, 1.3, 2.0), DIRECTIONS[direction])
        )
        low, high = np.array([-20.3, -11.1, -7.7]), np.array([10.4, 15.2, 9.9])
        box = grid.box_around(low, high)
        places = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T
        indices, first, last = grid.index(places), [a.start for a in box], [a.stop - 1 for a in box]
        assert ((indices >= first) & (indices <= last)).all()
        assert (indices.min(axis=0) - first < 1).all() and (last - indices.max(axis=0) < 1).all()
