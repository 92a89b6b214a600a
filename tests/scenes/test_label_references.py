"""Labels and the CT that they refer to: those of another are refused, and of several patients the labels'
own is taken.
"""

import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
from dicom_series import PERSON, Series, edited, write_segmentation, write_structures
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
        ("F S 12 A", "", ""), ("F S 12 B", "", ""), (". S . .", "", ""), (". . 3 .", "", ""),
        (". . . .", "", ""), (". . . A", "", ""),
        ("F T 78 A", "", "another series of this CT's frame"), ("F . . B", "", "another patient ID"),
        ("G S 12 A", "", "another frame of reference"), ("G . 2 A", "", "another frame of reference"),
        (". T 2 .", "", ""),
        ("G T 78 A", "another frame of reference", ""), ("G . . A", "another frame of reference", ""),
        (". T . A", "another series", ""), (". T 78 .", "another series", ""),
        (". . 78 .", "another series", ""),
        ("F T 78 B", "another patient ID, and refer to another series", ""),
        (". . . B", "another patient ID, and no frame", ""),
    ],
)  # fmt: skip
def test_what_belongs_to_a_ct(labels, fault, doubt):
    refers = references(labels)
    assert (fault in mismatch(refers, CT)) and bool(fault) == bool(mismatch(refers, CT))
    notes = () if fault else doubts(refers, CT)
    assert bool(notes) == bool(doubt) and doubt in " ".join(notes)


@pytest.fixture
def series(tmp_path):
    made = Series(tmp_path / "ct", DIRECTIONS["identity"])
    made.write()
    return made


def contour_names(sop):
    """The first contour of a structure set names a slice."""

    def edit(data):
        image = pydicom.Dataset()
        image.ReferencedSOPInstanceUID = sop
        data.ROIContourSequence[0].ContourSequence[0].ContourImageSequence = [image]

    return edit


def names_its_study_alone(data):
    del data.ReferencedFrameOfReferenceSequence[0].RTReferencedStudySequence[0].RTReferencedSeriesSequence


EVERYTHING = dict(frame_of_reference="1.2", series_uid="1.3", sops=["1.4", "1.5"])
# Options of a structure set, and what it refers to: frame, series, slices.
STRUCTURES = {
    "all": (EVERYTHING, "1.2", "1.3", ["1.4", "1.5"]),
    "series": (dict(series_uid="1.3"), "", "1.3", []),
    "slices": (dict(sops=["1.4"]), "", "", ["1.4"]),
    "frame": (dict(frame_of_reference="1.2"), "1.2", "", []),
    "nothing": ({}, "", "", []),
    "slices of contours": (dict(edit=contour_names("1.4")), "", "", ["1.4"]),
    "a study, which is no slice": (dict(series_uid="1.3", edit=names_its_study_alone), "", "", []),
}


def structures(folder, series, **options):
    circle = ring(series.places(2)[5, 6], 2.6, series.direction)
    return write_structures(folder / "rt.dcm", {"Kidney": [circle]}, **options)


@pytest.mark.parametrize("case", STRUCTURES)
def test_what_structures_refer_to(series, tmp_path, case):
    options, frame, uid, sops = STRUCTURES[case]
    expected = DicomReferences(
        frozenset(filter(None, [frame])), frozenset(filter(None, [uid])), frozenset(sops), PERSON["PatientID"]
    )
    assert open_labels(structures(tmp_path, series, **options)).references == expected


def segmentation(path, series, name="Kidney"):
    return write_segmentation(path, series, {name: np.ones(series.size[::-1])})


def without_frame(data):
    data.FrameOfReferenceUID = None


def without_series(data):
    del data.ReferencedSeriesSequence


@pytest.mark.parametrize("edit", [without_frame, without_series])
def test_what_a_segmentation_refers_to(series, tmp_path, edit):
    """Its frames name their slices, too."""
    references = open_labels(edited(segmentation(tmp_path / "seg.dcm", series), edit)).references
    assert references.frames == (set() if edit is without_frame else {series.frame_of_reference})
    assert references.series == (set() if edit is without_series else {series.uid})
    assert references.instances == set(series.sops)


def without_place(data):
    del data.SharedFunctionalGroupsSequence[0].PlaneOrientationSequence


def test_a_segmentation_without_a_place_in_the_patient(series, tmp_path):
    path = edited(segmentation(tmp_path / "seg.dcm", series), without_place)
    with pytest.raises(PatientError, match="belongs to no volume"):
        volume_of_labels(tmp_path / "ct", [open_labels(path)])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (dict(frame_of_reference="1.2.3"), "another frame of reference"),
        (dict(series_uid="1.2.3"), "refer to another series"),
        (dict(edit=lambda data: setattr(data, "PatientID", "Roe-17")), "another patient ID"),
    ],
)
def test_labels_of_another_ct_are_refused_without_its_identifiers(series, tmp_path, options, words):
    labels = open_labels(structures(tmp_path, series, **options))
    with pytest.raises(PatientError, match=f"{words}.*expected the CT that they were drawn on") as caught:
        volume_of_labels(tmp_path / "ct", [labels])
    assert not any(part in str(caught.value) for part in ("1.2.3", "Roe-17", PERSON["PatientID"]))


def test_labels_of_another_reconstruction_are_taken_with_a_note(series, tmp_path):
    frame = series.frame_of_reference
    labels = open_labels(structures(tmp_path, series, frame_of_reference=frame, series_uid="1.2.3"))
    notes = volume_of_labels(tmp_path / "ct", [labels]).notes
    assert "another series of this CT's frame of reference" in " ".join(notes)


def test_regions_of_two_frames(series, tmp_path):
    def edit(data):
        data.StructureSetROISequence[1].ReferencedFrameOfReferenceUID = "1.2.3"

    frame = series.frame_of_reference
    path = write_structures(
        tmp_path / "rt.dcm", {"Kidney": [], "GTV": []}, frame_of_reference=frame, edit=edit
    )
    with pytest.raises(PatientError, match="regions are in 2 frames of reference"):
        open_labels(path)


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
        edit = lambda data: setattr(data, "PatientID", f"Roe-{n + 1}")  # noqa: E731
        labels = open_labels(write_structures(tmp_path / "rt.dcm", {"Kidney": []}, edit=edit))
        self.assert_taken(volume_of_labels(ct, [labels]), pair[n], "the labels have its patient ID")

    def label_map(self, path, series, box=(slice(None),) * 3, flipped=False):
        grid = ct_grid(series)
        image = grid.image(np.ones(grid.size[::-1], np.uint8))[box]
        sitk.WriteImage(sitk.Flip(image, [True, True, False]) if flipped else image, str(path))
        return open_labels(path)

    @pytest.mark.parametrize(("n", "flipped"), [(0, False), (1, True)])
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
        volumes = []

        def stop(volume, *_, **__):
            volumes.append(volume)
            raise PatientError("read")

        monkeypatch.setattr("scenes.patients.import_request.import_patient", stop)

        def request(*arguments, **options):
            with pytest.raises(PatientError, match="^read$"):
                import_request(*arguments, **options)
            return volumes[-1]

        return request

    @pytest.fixture
    def pair(self, tmp_path):
        made = []
        for n in (1, 2):
            series = Series(
                tmp_path / "in" / f"ct{n}", DIRECTIONS["identity"], number=n, size=(12, 10, 5 + n)
            )
            series.write(PatientID=f"Roe-{n}")
            file = segmentation(tmp_path / "in" / f"seg{n}.dcm", series, f"Kidney {n}")
            edited(file, lambda data, n=n: setattr(data, "PatientID", f"Roe-{n}"))
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
        for name in ("a.dcm", "b.dcm"):
            segmentation(tmp_path / "in" / "ct1" / name, pair[0])
        with pytest.raises(PatientError, match="2 segmentations .* were found: .*a.dcm.*b.dcm"):
            import_request(tmp_path / "in" / "ct1")

    def test_of_none(self, pair, tmp_path):
        for n in (1, 2):
            write_structures(tmp_path / "in" / "ct1" / f"{n}.dcm", {"Kidney": []}, frame_of_reference="1.2.3")
        with pytest.raises(PatientError, match="2 segmentations and structure sets, none of this CT,"):
            import_request(tmp_path / "in" / "ct1")
