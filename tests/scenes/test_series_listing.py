"""What a path has to import, in rows: without a name, an ID or a date."""

import dataclasses

import numpy as np
import pytest
import SimpleITK as sitk
from dicom_series import PERSON, Series, refusal, save, write_segmentation, write_structures
from synthetic_body import DIRECTIONS

from scenes.patients.readers.ct_series import list_ct

CORONAL = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
VIEWS = {
    "axial": DIRECTIONS["identity"], "coronal": CORONAL, "sagittal": np.roll(np.eye(3), 1, axis=0),
    "oblique": np.array([[1, 0, 0], [0, 0.6, -0.8], [0, 0.8, 0.6]]),
}  # fmt: skip


def mask(series):
    return np.ones(series.size[::-1])


class TestSeries:
    @pytest.mark.parametrize("view", VIEWS)
    def test_a_whole_series(self, tmp_path, view):
        series = Series(tmp_path, VIEWS[view], number=4)
        (row,) = list_ct(series.write()).series
        heights = np.concatenate([series.places(k)[..., 2].ravel() for k in range(6)])
        assert (row.number, row.uid_end, row.slices, row.orientation) == ("4", "", 6, view)
        assert (row.spacing_mm, row.pixel_mm) == (pytest.approx(2.5), (0.8, 0.7))
        assert row.extent_mm == pytest.approx(np.ptp(heights))
        assert (row.patient, row.fault) == (1, "")

    def test_by_number_with_faults(self, tmp_path):
        Series(tmp_path / "b", number=10, size=(12, 10, 10)).write((0, 1, 2, 4, 5))
        Series(tmp_path / "a", number=9).write(BurnedInAnnotation="YES")
        Series(tmp_path / "c", number=11).write((0,))
        burned, gap, single = list_ct(tmp_path).series
        assert (burned.number, burned.slices, burned.spacing_mm, burned.pixel_mm) == ("9", 0, None, None)
        assert "text burned into" in burned.fault and "5.00 mm apart" in gap.fault
        assert single.fault.startswith("one slice only") and single.spacing_mm is None

    def test_one_number_twice(self, tmp_path):
        one, other = Series(tmp_path / "a", number=4), Series(tmp_path / "b", number=4)
        one.write()
        other.write()
        assert {row.uid_end for row in list_ct(tmp_path).series} == {one.uid[-6:], other.uid[-6:]}

    @pytest.mark.parametrize(
        ("of_first", "of_second", "of_third", "patients"),
        [
            ({"PatientID": "A"}, {"PatientID": "B"}, {"PatientID": "A"}, [1, 2, 1]),
            ({"PatientID": ""}, {"PatientID": ""}, {"PatientID": ""}, [1, 2, 3]),
            ({"PatientID": "A"}, {"PatientID": "A"}, {"PatientID": None}, [1, 1, 2]),
        ],
    )
    def test_patients(self, tmp_path, of_first, of_second, of_third, patients):
        """By ID; without it by study."""
        for n, tags in enumerate((of_first, of_second, of_third), start=1):
            Series(tmp_path / str(n), number=n).write(**tags)
        assert [row.patient for row in list_ct(tmp_path).series] == patients

    def test_an_id_that_is_missing_in_one_series_of_a_study(self, tmp_path):
        one, other = Series(tmp_path, number=1), Series(tmp_path, number=2)
        other.study = one.study
        one.write()
        other.write(PatientID=None)
        assert [row.patient for row in list_ct(tmp_path).series] == [1, 1]

    def test_slices_of_two_patients_in_one_series(self, tmp_path):
        series = Series(tmp_path)
        save(series.slice(5, PatientID="B-1"), series.write(range(5)) / "z.dcm")
        (row,) = list_ct(tmp_path).series
        assert "z.dcm: is of another patient" in row.fault and "B-1" not in row.fault

    def test_a_file(self, tmp_path):
        image = sitk.Image([8, 7, 6], sitk.sitkInt16)
        image.SetSpacing((0.8, 0.7, 2.5))
        sitk.WriteImage(image, str(tmp_path / "ct.nrrd"))
        (row,) = list_ct(tmp_path / "ct.nrrd").series
        assert (row.number, row.slices, row.spacing_mm, row.extent_mm) == ("", 6, 2.5, 12.5)
        assert (row.orientation, row.pixel_mm, row.patient, row.fault) == ("axial", (0.8, 0.7), 1, "")


class TestLabels:
    def test_kinds_names_and_series(self, tmp_path):
        drawn, other = Series(tmp_path, number=3), Series(tmp_path, number=5)
        drawn.write()
        other.write(PatientID="B")
        write_segmentation(tmp_path / "a.dcm", drawn, {"Kidney": mask(drawn), "mass": mask(drawn)})
        write_structures(
            tmp_path / "b.dcm", {"GTV": [drawn.places(1)[0]]}, frame_of_reference=other.frame_of_reference
        )
        seg, structures = list_ct(tmp_path).labels
        assert (seg.kind, seg.file, seg.segments, seg.series) == ("SEG", "a.dcm", ("Kidney", "mass"), ("3",))
        assert (structures.kind, structures.segments, structures.series) == ("RTSTRUCT", ("GTV",), ("5",))
        assert (seg.patient, structures.patient) == (1, 2)

    def test_those_of_none(self, tmp_path):
        series = Series(tmp_path)
        series.write()
        anonymous = {"edit": lambda data: delattr(data, "PatientID")}
        write_structures(tmp_path / "a.dcm", {"GTV": []}, "1.2.3", **anonymous)
        write_structures(tmp_path / "b.dcm", {"GTV": []})
        unknown, of_the_patient = list_ct(tmp_path).labels
        assert (unknown.series, unknown.patient) == ((), None)
        assert (of_the_patient.series, of_the_patient.patient) == ((), 1)

    def test_labels_alone(self, tmp_path):
        series = Series(tmp_path)
        listing = list_ct(write_segmentation(tmp_path / "a.dcm", series, {"Kidney": mask(series)}))
        assert listing.series == [] and len(listing.labels) == 1


def test_nothing_names_the_patient(tmp_path):
    series = Series(tmp_path)
    series.write()
    write_segmentation(tmp_path / "a.dcm", series, {"Kidney": mask(series)})
    shown = str(dataclasses.asdict(list_ct(tmp_path)))
    hidden = [*PERSON.values(), series.uid, series.study, series.frame_of_reference, *series.sops]
    assert not [text for text in hidden if len(text) > 1 and text in shown]


def test_nothing_to_list(tmp_path):
    assert "no DICOM file" in refusal(tmp_path, read=list_ct)
    assert "no such file" in refusal(tmp_path / "absent", read=list_ct)
    Series(tmp_path).write(Modality="MR", SOPClassUID="1.2.840.10008.5.1.4.1.1.4")
    assert "6 MR" in refusal(tmp_path, read=list_ct)
