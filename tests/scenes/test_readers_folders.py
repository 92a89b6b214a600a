"""A folder with volume files as CT: the one that is no label map, beside DICOM none of them, and of
several none.
"""

import numpy as np
import pytest
import SimpleITK as sitk
from dicom_series import Series, read_ct, refusal
from test_readers import ENDINGS, noise

NONE = "one that is not named as labels"


def folder_of(folder, *names):
    """A folder with a CT of noise under the first name, and label maps of ones under the others."""
    for n, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        sitk.WriteImage(noise() * 0 + 1 if n else noise(), str(folder / name))
    return folder


@pytest.mark.parametrize("ending", ENDINGS)
def test_the_only_file(tmp_path, ending):
    """Whatever its name, and where a folder is within it."""
    for name in ("imaging", "deep/kidney_labels"):
        volume, hounsfield = read_ct(folder_of(tmp_path / name[:4], f"{name}{ending}"))
        assert np.array_equal(hounsfield, sitk.GetArrayFromImage(noise()))
        assert volume.notes == ()


@pytest.mark.parametrize(
    "names",
    [
        ["imaging.nii.gz", "segmentation.nii.gz", "aggregated_MAJ_seg.nii.gz"],
        ["ct.nii.gz", "segmentations/kidney_left.nii.gz", "segmentations/spleen.nii.gz"],
        ["CT 3 mm.nrrd", "Segmentation.seg.nrrd"],
        ["a.mha", "a-label.mha", "MASK_a.nrrd", "left renal mass.nii"],
        ["amazing-segue.nrrd", "LABELS.nrrd"],
        ["kidney_CT.nrrd", "kidney.nrrd"],
        ["venous.nrrd", "renal vein.nrrd", "ct_seg.nrrd"],
    ],
)
def test_the_one_that_is_not_named_as_labels(tmp_path, names):
    volume, hounsfield = read_ct(folder_of(tmp_path, *names))
    assert np.array_equal(hounsfield, sitk.GetArrayFromImage(noise()))
    assert volume.notes == (f"of {len(names)} volume files, the {NONE} was taken as the CT",)


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["arterial.nii.gz", "venous.nrrd"], "has 2 files that may be the CT: arterial.nii.gz, venous.nrrd; "
            "expected one"),
        (["a.nii.gz", "b/c.mha", "seg.nrrd"], "has 2 files that may be the CT: a.nii.gz, b/c.mha; expected "
            "one; give its path"),
        (["kidney.nii.gz", "labels.nrrd"], "has 2 files that may be the CT, all named as labels: kidney"),
    ],
)  # fmt: skip
def test_several_are_refused(tmp_path, names, words):
    assert words in refusal(folder_of(tmp_path, *names))


def test_a_folder_of_files_has_no_series(tmp_path):
    assert "leave --series out" in refusal(folder_of(tmp_path, "ct.nrrd"), series="1")


def test_beside_dicom_files_they_are_left_out(tmp_path):
    series = Series(tmp_path)
    series.write()
    folder_of(tmp_path, "Doe_Jane.nii.gz", "sub/kidney_left.nrrd")
    volume, hounsfield = read_ct(tmp_path)
    assert np.array_equal(hounsfield, series.hounsfield)
    assert volume.notes == ("left out, beside the DICOM files: 2 NIfTI, NRRD or MHA files",)
    # A damaged series is no reason to take another file for the CT.
    (tmp_path / "s1-2.dcm").unlink()
    assert "missing" in refusal(tmp_path)
