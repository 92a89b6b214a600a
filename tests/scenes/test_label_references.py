"""Labels and the CT that they refer to: those of another are refused, and of several patients the labels'
own is taken.
"""

import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
from dicom_series import PERSON, Series, write_segmentation, write_structures
from synthetic_body import DIRECTIONS
from test_readers_labels import ct_grid, ring

from errors import PatientError
from scenes.patients.import_request import import_request, volume_of_labels
from scenes.patients.readers.ct_series import open_ct
from scenes.patients.readers.label_files import open_labels
from scenes.volumes.dicom_references import DicomReferences, doubts, mismatch

CT = DicomReferences(frozenset("F"), frozenset("S"), frozenset("123"), "A")


def references(text):
    """Frame, series, slices and patient of a word such as "F S 12 A"; a dot is absent."""
    frame, series, slices, patient = ("" if part == "." else part for part in text.split())
    return DicomReferences(frozenset(frame), frozenset(series), frozenset(slices), patient)


@pytest.mark.parametrize(
    ("labels", "fault", "doubt"),
    [
        ("F S 12 "
         "A", "", ""), ("F S 12 "
            "B", "", ""), (". S . .", "", ""), (". . 3 .", "", ""), (". . . .", "", ""), (". . . A", "", ""),
        ("F T 78 A", "", "another series of this CT's frame"), ("F . . B", "", "another patient ID"),
        ("G S 12 "
         "A", "", "another frame of "
            "reference"), ("G . 2 A", "", "another frame of reference"), (". T 2 .", "", ""),
        ("G T 78 A", "another frame of reference", ""), ("G . . A", "another frame of reference", ""),
        (". T . "
         "A", "another series", ""), (". T 78 .", "another series", ""), (". . 78 .", "another series", ""),
        ("F T 78 "
         "B", "another patient ID, and refer to another "
            "series", ""), (". . . B", "another patient ID, and no frame", ""),
    ],
)  # fmt: skip
def test_what_belongs_to_a_ct(labels, fault, doubt):
    found = references(labels)
    assert (fault in mismatch(found, CT)) and bool(fault) == bool(mismatch(found, CT))
    notes = () if fault else doubts(found, CT)
    assert bool(notes) == bool(doubt) and doubt in " ".join(notes)


class TestStructures:
    @pytest.fixture
    def series(self, tmp_path):
        made = Series(tmp_path / "ct", DIRECTIONS["identity"])
        made.write()
        return made

    def drawn(self, series, tmp_path, **options):
        path = write_structures(
            tmp_path / "rt.dcm", {"Kidney": [ring(series.places(2)[5, 6], 2.6, series.direction)]}, **options
        )
        return volume_of_labels(tmp_path / "ct", [open_labels(path)])

    def test_of_this_ct(self, series, tmp_path):
        frame = series.frame_of_reference
        for options in (
            dict(frame_of_reference=frame, series_uid=series.uid, sops=series.sops),
            dict(series_uid=series.uid), dict(sops=series.sops[2:3]), dict(frame_of_reference=frame), {},
        ):  # fmt: skip
            assert self.drawn(series, tmp_path, **options).notes == ()

    def test_of_another_reconstruction(self, series, tmp_path):
        volume = self.drawn(
            series, tmp_path, frame_of_reference=series.frame_of_reference, series_uid="1.2.3", sops=["1.2.4"]
        )
        assert "another series of this CT's frame of reference" in " ".join(volume.notes)

    @pytest.mark.parametrize(
        "options", [{"frame_of_reference": "1.2.3"}, {"series_uid": "1.2.3"}, {"sops": ["1.2.3", "1.2.4"]}]
    )
    def test_of_another_ct(self, series, tmp_path, options):
        with pytest.raises(PatientError, match="expected the CT that they were drawn on") as caught:
            self.drawn(series, tmp_path, **options)
        assert "1.2.3" not in str(caught.value)

    def test_frame_of_the_ct_alone(self, series, tmp_path):
        """Of the labels it is absent: then their series counts."""
        other = Series(tmp_path / "other")
        with pytest.raises(PatientError, match="refer to another series"):
            self.drawn(series, tmp_path, series_uid=other.uid, sops=other.sops)

    def test_slices_that_the_contours_alone_name(self, series, tmp_path):
        def edit(sop):
            def change(data):
                image = pydicom.Dataset()
                image.ReferencedSOPInstanceUID = sop
                data.ROIContourSequence[0].ContourSequence[0].ContourImageSequence = [image]

            return change

        assert self.drawn(series, tmp_path, edit=edit(series.sops[2])).notes == ()
        with pytest.raises(PatientError, match="refer to another series"):
            self.drawn(series, tmp_path, edit=edit("1.2.3"))

    def test_a_study_is_no_slice(self, series, tmp_path):
        """Some structure sets name the study alone."""

        def edit(data):
            del (
                data.ReferencedFrameOfReferenceSequence[0]
                .RTReferencedStudySequence[0]
                .RTReferencedSeriesSequence
            )

        assert self.drawn(series, tmp_path, edit=edit, series_uid="1.2.3").notes == ()

    def test_patients_without_anything_in_common(self, series, tmp_path):
        with pytest.raises(PatientError, match="another patient ID") as caught:
            self.drawn(series, tmp_path, edit=lambda data: setattr(data, "PatientID", "Roe-17"))
        assert "Roe-17" not in str(caught.value) and PERSON["PatientID"] not in str(caught.value)

    def test_regions_of_two_frames(self, series, tmp_path):
        def edit(data):
            data.StructureSetROISequence[1].ReferencedFrameOfReferenceUID = "1.2.3"

        circle = [ring(series.places(2)[5, 6], 2.6, series.direction)]
        path = write_structures(
            tmp_path / "rt.dcm",
            {"Kidney": circle, "GTV": circle},
            frame_of_reference=series.frame_of_reference,
            edit=edit,
        )
        with pytest.raises(PatientError, match="regions are in 2 frames of reference"):
            open_labels(path)


class TestSegmentations:
    """Without a frame of reference, or with one of its own, the series and slices count."""

    @pytest.fixture
    def pair(self, tmp_path):
        own, other = Series(tmp_path / "ct"), Series(tmp_path / "other")
        own.write()
        return own, other

    def drawn(self, series, tmp_path, edit):
        path = write_segmentation(tmp_path / "seg.dcm", series, {"Kidney": np.ones(series.size[::-1])})
        data = pydicom.dcmread(path)
        edit(data)
        data.save_as(path)
        return volume_of_labels(tmp_path / "ct", [open_labels(path)])

    @pytest.mark.parametrize("frame", [None, "1.2.3"])
    def test_frame_that_is_missing_or_replaced(self, pair, tmp_path, frame):
        def edit(data):
            data.FrameOfReferenceUID = frame

        own, other = pair
        notes = " ".join(self.drawn(own, tmp_path, edit).notes)
        assert ("another frame of reference" in notes) == (frame is not None)
        with pytest.raises(PatientError, match="expected the CT that they were drawn on"):
            self.drawn(other, tmp_path, edit)

    def test_slices_that_the_frames_alone_name(self, pair, tmp_path):
        def edit(data):
            del data.ReferencedSeriesSequence, data.FrameOfReferenceUID

        own, other = pair
        assert self.drawn(own, tmp_path, edit).notes == ()
        with pytest.raises(PatientError, match="refer to another series"):
            self.drawn(other, tmp_path, edit)

    def test_no_place_in_the_patient(self, pair, tmp_path):
        def edit(data):
            del data.SharedFunctionalGroupsSequence[0].PlaneOrientationSequence

        with pytest.raises(PatientError, match="belongs to no volume"):
            self.drawn(pair[0], tmp_path, edit)


class TestTwoPatients:
    """One folder with the CTs of two patients; the second has more slices, so that it would be taken."""

    @pytest.fixture
    def pair(self, tmp_path):
        one = Series(tmp_path / "ct", DIRECTIONS["identity"], number=3)
        other = Series(
            tmp_path / "ct", DIRECTIONS["identity"], number=5, size=(12, 10, 9), origin=(-31.5, 20.25, -380)
        )
        one.write(PatientID="Roe-1")
        other.write(PatientID="Roe-2")
        return one, other

    @pytest.fixture
    def ct(self, tmp_path):
        return tmp_path / "ct"

    def assert_taken(self, volume, series, why):
        assert volume.grid.size == series.size
        (note,) = volume.notes
        assert (
            f"of 2 series of 2 patients, number {series.number} was taken: {why}" in note
            and "Roe" not in note
        )

    def test_without_labels(self, pair, ct):
        with pytest.raises(PatientError, match="CTs of 2 patients.*patient 1.*patient 2.*--series") as caught:
            open_ct(ct)
        assert "Roe" not in str(caught.value)
        assert open_ct(ct, "3").grid.size == pair[0].size

    def test_without_ids(self, tmp_path):
        for number in (3, 5):
            Series(tmp_path, number=number).write(PatientID=None)
        with pytest.raises(PatientError, match="CTs of 2 studies, and no patient ID"):
            open_ct(tmp_path)

    @pytest.mark.parametrize(
        ("options", "why"),
        [
            (lambda s: dict(series_uid=s.uid), "the labels refer to it"),
            (lambda s: dict(sops=s.sops[:2]), "the labels refer to its slices"),
            (
                lambda s: dict(frame_of_reference=s.frame_of_reference),
                "the labels have its frame of reference",
            ),
        ],
    )
    @pytest.mark.parametrize("n", [0, 1])
    def test_structures(self, pair, ct, tmp_path, options, why, n):
        def edit(data):
            del data.PatientID

        contour = [ring(pair[n].places(2)[5, 6], 2.6, pair[n].direction)]
        path = write_structures(tmp_path / "rt.dcm", {"Kidney": contour}, edit=edit, **options(pair[n]))
        self.assert_taken(volume_of_labels(ct, [open_labels(path)]), pair[n], why)

    @pytest.mark.parametrize("n", [0, 1])
    def test_a_patient_id(self, pair, ct, tmp_path, n):
        path = write_structures(
            tmp_path / "rt.dcm", {"Kidney": []}, edit=lambda data: setattr(data, "PatientID", f"Roe-{n + 1}")
        )
        self.assert_taken(
            volume_of_labels(ct, [open_labels(path)]), pair[n], "the labels have its patient ID"
        )

    def label_map(self, path, series, box=(slice(None),) * 3, flipped=False):
        grid = ct_grid(series)
        image = grid.image(np.ones(grid.size[::-1], np.uint8))[box]
        sitk.WriteImage(sitk.Flip(image, [True, True, False]) if flipped else image, str(path))
        return open_labels(path)

    @pytest.mark.parametrize("n", [0, 1])
    @pytest.mark.parametrize("flipped", [False, True])
    def test_voxels_of_a_label_map(self, pair, ct, tmp_path, n, flipped):
        labels = self.label_map(tmp_path / "kidney.nii.gz", pair[n], flipped=flipped)
        self.assert_taken(volume_of_labels(ct, [labels]), pair[n], "the labels have its voxels")

    def test_a_label_map_within_one(self, pair, ct, tmp_path):
        labels = self.label_map(tmp_path / "k.nrrd", pair[1], (slice(3, 9), slice(2, 8), slice(5, 9)))
        self.assert_taken(volume_of_labels(ct, [labels]), pair[1], "the labels lie in it")

    def test_a_label_map_within_both_or_none(self, pair, ct, tmp_path):
        """From -380 to -387.5 mm both have slices."""
        both = Series(tmp_path / "both", DIRECTIONS["identity"], size=(6, 6, 2), origin=(-29, 22, -390))
        both.gap = 1.0
        neither = Series(tmp_path / "none", DIRECTIONS["identity"], origin=(300, 22, -390))
        shared = Series(ct, DIRECTIONS["identity"], number=7)
        shared.write(PatientID="Roe-3")
        for series in (both, neither):
            labels = self.label_map(tmp_path / "k.nrrd", series)
            with pytest.raises(PatientError, match="CTs of 3 patients"):
                volume_of_labels(ct, [labels])

    def test_labels_of_a_third(self, pair, ct, tmp_path):
        path = write_structures(tmp_path / "rt.dcm", {"Kidney": []}, "1.2.3")
        with pytest.raises(PatientError, match="CTs of 2 patients"):
            volume_of_labels(ct, [open_labels(path)])


class TestLabelsBesideTheCt:
    """Of several in one folder those of the CT are taken."""

    @pytest.fixture
    def requested(self, monkeypatch):
        """The CT and the labels that a request reads."""
        found = []

        def stop(volume, *_, **__):
            found.append(volume)
            raise PatientError("read")

        monkeypatch.setattr("scenes.patients.import_request.import_patient", stop)

        def request(*arguments, **options):
            with pytest.raises(PatientError, match="^read$"):
                import_request(*arguments, **options)
            return found[-1]

        return request

    @pytest.fixture
    def pair(self, tmp_path):
        made = []
        for n in (1, 2):
            series = Series(
                tmp_path / "in" / f"ct{n}", DIRECTIONS["identity"], number=n, size=(12, 10, 5 + n)
            )
            series.write(PatientID=f"Roe-{n}")
            file = tmp_path / "in" / f"seg{n}.dcm"
            write_segmentation(file, series, {f"Kidney {n}": np.ones(series.size[::-1])})
            data = pydicom.dcmread(file)
            data.PatientID = f"Roe-{n}"
            data.save_as(file)
            made.append(series)
        return made

    @pytest.mark.parametrize("n", [1, 2])
    def test_two_patients(self, pair, tmp_path, requested, n):
        assert requested(tmp_path / "in", organ=[f"Kidney {n}"], series=str(n)).grid.size == pair[n - 1].size
        with pytest.raises(PatientError, match="2 segmentations and structure sets of 2 patients.*--series"):
            import_request(tmp_path / "in")
        # Another file in the folder changes nothing.
        sitk.WriteImage(ct_grid(pair[0]).image(pair[0].hounsfield), str(tmp_path / "in" / "copy.nii.gz"))
        assert requested(tmp_path / "in", organ=[f"Kidney {n}"], series=str(n)).grid.size == pair[n - 1].size

    @pytest.mark.parametrize("n", [1, 2])
    def test_two_patients_in_a_folder_of_labels(self, pair, tmp_path, requested, n):
        labels = tmp_path / "labels"
        labels.mkdir()
        for file in (tmp_path / "in").glob("seg*"):
            file.rename(labels / file.name)
        ct = tmp_path / "in" / f"ct{n}"
        assert requested(ct, [labels], organ=[f"Kidney {n}"]).grid.size == pair[n - 1].size

    def test_of_one_patient(self, pair, tmp_path):
        """Both belong to the CT: the user chooses."""
        write_segmentation(
            tmp_path / "in" / "ct1" / "a.dcm", pair[0], {"Kidney": np.ones(pair[0].size[::-1])}
        )
        write_segmentation(
            tmp_path / "in" / "ct1" / "b.dcm", pair[0], {"Kidney": np.ones(pair[0].size[::-1])}
        )
        with pytest.raises(
            PatientError, match="2 segmentations and structure sets were found: .*a.dcm.*b.dcm"
        ):
            import_request(tmp_path / "in" / "ct1")

    def test_of_none(self, pair, tmp_path):
        for n in (1, 2):
            write_structures(tmp_path / "in" / "ct1" / f"{n}.dcm", {"Kidney": []}, frame_of_reference="1.2.3")
        with pytest.raises(PatientError, match="2 segmentations and structure sets, none of this CT,"):
            import_request(tmp_path / "in" / "ct1")
