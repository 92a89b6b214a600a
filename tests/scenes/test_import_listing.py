"""The listing of import --list: what there is to import, before anything is made."""

import nibabel
import numpy as np
from dicom_series import PERSON, Series, write_segmentation

from app import main


def words(printed: str) -> list[list[str]]:
    """The words of each line."""
    return [line.split() for line in printed.splitlines() if line.strip()]


def test_series_faults_and_labels_are_listed(tmp_path, capfd):
    whole = Series(tmp_path / "ct", number=4)
    whole.write()
    Series(tmp_path / "ct", number=7, size=(12, 10, 8), frame_of_reference=whole.frame_of_reference).write(
        (0, 1, 2, 5, 6, 7)
    )
    write_segmentation(tmp_path / "ct" / "seg.dcm", whole, {"Kidney": np.ones(whole.size[::-1])})
    label = np.zeros((6, 5, 4), np.uint8)
    label[1:3, 1, 1], label[4, 2, 2] = 1, 2
    nibabel.save(nibabel.Nifti1Image(label, np.diag([10.0, 10.0, 10.0, 1])), tmp_path / "map.nii.gz")
    assert main(["import", str(tmp_path / "ct"), str(tmp_path / "map.nii.gz"), "--list"]) == 0
    printed = capfd.readouterr()
    lines = words(printed.out)
    assert ["4", "6", "2.50", "0.80", "x", "0.70"] in [line[:6] for line in lines]
    assert any(line[:2] == ["7", "6"] for line in lines)
    assert "series 7 cannot be imported" in printed.out and "7.50 mm apart" in printed.out
    assert "seg.dcm: Kidney; of series 4" in printed.out
    # Value and volume: two voxels of 1 ml, and one; no columns for names, which these labels lack.
    assert ["value", "ml"] in lines
    assert ["1", "2.0"] in lines and ["2", "1.0"] in lines
    assert not any(value in printed.out + printed.err for value in PERSON.values() if len(value) > 3)
    assert {path.name for path in tmp_path.iterdir()} == {"ct", "map.nii.gz"}


def test_labels_of_one_file_per_organ(tmp_path, capfd):
    folder = tmp_path / "labels"
    folder.mkdir()
    ones = nibabel.Nifti1Image(np.ones((10, 10, 10), np.uint8), np.eye(4))
    for name in ("ct", "labels/kidney_left", "labels/lung"):
        nibabel.save(ones, tmp_path / f"{name}.nii.gz")
    assert main(["import", str(tmp_path / "ct.nii.gz"), str(folder), "--list"]) == 0
    lines = words(capfd.readouterr().out)
    assert ["kidney_left", "kidney", "left", "1.0"] in lines and ["file", "10"] in [
        each[:2] for each in lines
    ]


def test_a_volume_file_beside_dicom_labels_is_the_ct(tmp_path, capfd):
    series = Series(tmp_path / "elsewhere")
    write_segmentation(tmp_path / "case" / "seg.dcm", series, {"Kidney": np.ones(series.size[::-1])})
    nibabel.save(nibabel.Nifti1Image(np.ones((10, 10, 10)), np.eye(4)), tmp_path / "case" / "ct.nii.gz")
    assert main(["import", str(tmp_path / "case"), "--list"]) == 0
    printed = capfd.readouterr().out
    assert ["file", "10"] in [each[:2] for each in words(printed)] and "seg.dcm: Kidney" in printed


def test_a_path_without_anything_is_refused_in_words(tmp_path, capfd):
    assert main(["import", str(tmp_path), "--list"]) == 2
    assert "no DICOM file found" in capfd.readouterr().err
    (tmp_path / "kidney.stl").write_bytes(b"solid")
    assert main(["import", str(tmp_path), "--list"]) == 2
    assert (
        "surfaces, and no CT; expected a CT before them: python app.py import CT " in capfd.readouterr().err
    )
    assert main(["import", str(tmp_path)]) == 2
    assert "--list" in capfd.readouterr().err
