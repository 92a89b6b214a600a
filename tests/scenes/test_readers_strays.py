"""Files in a CT's folder that are none of its slices, folders that cannot be read, and series that were
split.
"""

import os

import numpy as np
import pytest
from dicom_series import Series, read_ct, refusal, save, write_segmentation, zipped
from pydicom.uid import generate_uid
from synthetic_body import DIRECTIONS

from scenes.folder_files import entries_of, files_below
from scenes.patients.import_listing import listing_text
from scenes.patients.readers.label_files import open_labels
from scenes.patients.readers.volume_folder import volume_files
from scenes.surfaces import save_surface
from scenes.volumes.volume_files import save_image
from studies.beam.motion_capture import BeamError, load_captures

NO_PLACE = dict(ImagePositionPatient=None, ImageOrientationPatient=None)
SAVED_SCREEN = dict(ImageType=["DERIVED", "SECONDARY", "SCREEN SAVE"], BurnedInAnnotation="YES")


@pytest.mark.parametrize(
    "name",
    [
        "._s1-0.dcm",
        ".DS_Store",
        "Thumbs.db",
        "desktop.ini",
        "__MACOSX/s1-0.dcm",
        "System Volume Information/a.dcm",
    ],
)
def test_what_a_system_wrote_is_ignored(tmp_path, name):
    series = Series(tmp_path / "ct")
    expected = read_ct(series.write())[1]
    # A file that would be refused: one slice twice, of other pixels.
    save(series.slice(2, PixelSpacing=[0.5, 0.5]), tmp_path / "ct" / name)
    for path in (tmp_path / "ct", zipped(tmp_path / "ct", tmp_path / "ct.zip")):
        volume, voxels = read_ct(path)
        assert np.array_equal(voxels, expected) and not volume.notes


@pytest.mark.parametrize("name", ["._organ", "__MACOSX"])
def test_it_is_ignored_among_volumes_labels_surfaces_and_recordings(tmp_path, name, ball):
    series = Series(tmp_path / "ct")
    image = read_ct(series.write())[0].image()
    for ending in (".nrrd", ".nii.gz", ".stl", ".csv"):
        (tmp_path / f"{name}{ending}").write_bytes(b"\0\5\x16\7")
    (tmp_path / "__MACOSX").mkdir()
    (tmp_path / "__MACOSX" / "._ct.nrrd").write_bytes(b"\0\5\x16\7")
    if name == "__MACOSX":  # a folder of that name, and no more
        for ending in (".nrrd", ".nii.gz", ".stl", ".csv"):
            (tmp_path / f"{name}{ending}").unlink()
    assert volume_files(tmp_path) == []
    with pytest.raises(BeamError, match="holds no recordings"):
        load_captures(tmp_path)
    save_surface(ball.copy().apply_scale(4.0), tmp_path / "kidney_left.stl")
    assert open_labels(tmp_path).maps(read_ct(tmp_path / "ct")[0].grid)
    save_image(image > 0, tmp_path / "kidney_left.nrrd")
    assert volume_files(tmp_path) == [tmp_path / "kidney_left.nrrd"]
    assert [path.name for path in entries_of(tmp_path)] == ["ct", "kidney_left.nrrd", "kidney_left.stl"]


PAGES = {
    "screen save": SAVED_SCREEN | NO_PLACE,
    "dose page": dict(ImageType=["DERIVED", "SECONDARY", "DOSE_INFO"]) | NO_PLACE,
    "burned in": dict(BurnedInAnnotation="YES") | NO_PLACE,
    "colours": dict(SamplesPerPixel=3) | NO_PLACE,
    "thumbnail": dict(ImageType=["DERIVED", "SECONDARY"], Rows=5, Columns=6, PixelData=bytes(60)) | NO_PLACE,
    "screen save with a place": SAVED_SCREEN,
    "burned in with a place": dict(BurnedInAnnotation="YES"),
    "colours with a place": dict(SamplesPerPixel=3, PhotometricInterpretation="RGB"),
}


@pytest.mark.parametrize("tags", PAGES.values(), ids=PAGES)
@pytest.mark.parametrize("count", [1, 2])
def test_a_page_without_a_place_is_left_out_with_a_note(tmp_path, tags, count):
    series = Series(tmp_path)
    expected = read_ct(series.write())[1]
    for n in range(count):
        save(
            series.slice(n, SOPInstanceUID=generate_uid(), InstanceNumber=900 + n, **tags),
            tmp_path / f"page-{n}.dcm",
        )
    volume, voxels = read_ct(tmp_path)
    assert np.array_equal(voxels, expected)
    assert f"left out, no slices, such as screen saves: {count}" in volume.notes


def with_slabs(series, count, *kind, first=0.5):
    """The series, and images that were computed from its slices, under its own UID, from between its
    slices on.
    """
    series.write()
    for k in range(count):
        tags = dict(
            SOPInstanceUID=generate_uid(),
            InstanceNumber=100 + k,
            ImageType=["DERIVED", "SECONDARY", "AXIAL", *kind],
            ImagePositionPatient=np.round(series.positions(k + first), 6).tolist(),
        )
        save(series.slice(k, **tags), series.folder / f"slab-{k}.dcm")
    return series


@pytest.mark.parametrize("first", [0.0, 0.5, 6.0])
@pytest.mark.parametrize(
    "kind", ["MIP", "MINIP", "AVERAGE", "PROJECTION IMAGE", "MPR", "CURVED MPR", "VRT", "CT_SOM5 MIP"]
)
def test_images_computed_from_the_slices_are_left_out_with_a_note(tmp_path, kind, first):
    series = with_slabs(Series(tmp_path), 4, kind, first=first)
    volume, voxels = read_ct(tmp_path)
    assert np.array_equal(voxels, series.hounsfield)
    assert "left out, computed from the slices, such as MIP and MPR: 4 images" in volume.notes
    assert "cannot be imported" not in listing_text(tmp_path)


@pytest.mark.parametrize("kind", [["MPR"], ["CT_SOM5 MIP"], ["AVERAGE"], []])
def test_a_series_of_one_kind_stays_as_it_is(tmp_path, kind):
    series = Series(tmp_path)
    volume, voxels = read_ct(series.write(ImageType=["DERIVED", "SECONDARY", "AXIAL", *kind]))
    assert np.array_equal(voxels, series.hounsfield) and not volume.notes


def test_derived_slices_beside_original_ones_stay(tmp_path):
    series = with_slabs(Series(tmp_path), 3, first=6.0)
    volume, voxels = read_ct(tmp_path)
    assert len(voxels) == 9 and not volume.notes and np.array_equal(voxels[:6], series.hounsfield)


def test_slices_among_as_many_computed_images_are_refused(tmp_path):
    with_slabs(Series(tmp_path), 6, "MIP")
    assert "6 slices and 6 images computed from slices (MIP) are in one series" in refusal(tmp_path)


@pytest.mark.parametrize(
    ("tags", "words"),
    [
        (
            dict(ImageType=["DERIVED", "SECONDARY", "MPR"]),
            ("no slice to be missing", "left out, computed from the slices: slice 4 (s1-3.dcm)"),
        ),
        (NO_PLACE, ("no slice to be missing", "left out, no slices: s1-3.dcm")),
        *(
            ({tag: None}, (f"s1-3.dcm: has no {tag}",))
            for tag in ("ImagePositionPatient", "ImageOrientationPatient", "PixelSpacing")
        ),
    ],
)
def test_a_slice_is_not_lost_in_silence(tmp_path, tags, words):
    series = Series(tmp_path)
    series.write()
    save(series.slice(3, **tags), tmp_path / "s1-3.dcm")
    message = refusal(tmp_path)
    assert all(part in message for part in words) and "s1-" in listing_text(tmp_path)


@pytest.mark.parametrize("lost", [4, 6])
def test_a_series_of_which_most_has_no_place_is_refused(tmp_path, lost):
    series = Series(tmp_path)
    series.write()
    for k in range(lost):
        save(series.slice(k, **NO_PLACE), tmp_path / f"s1-{k}.dcm")
    message = refusal(tmp_path)
    assert f"{lost} of 6 files of this series are no slices" in message
    assert "s1-0.dcm: has no ImageOrientationPatient" in message


@pytest.fixture
def closed(monkeypatch):
    """Folders that cannot be listed, by their names; root may list all."""
    names, scandir = set(), os.scandir

    def listed(path):
        if os.path.basename(path) in names:
            raise PermissionError(13, "Permission denied", path)
        return scandir(path)

    monkeypatch.setattr(os, "scandir", listed)
    return names


@pytest.mark.parametrize("names", [{"b"}, {"b", "c"}])
def test_a_subfolder_that_cannot_be_read_is_said(tmp_path, closed, names):
    series = Series(tmp_path / "a")
    series.write()
    for name in "bc":
        (tmp_path / name).mkdir()
    assert "cannot be read" not in " ".join(read_ct(tmp_path)[0].notes) + listing_text(tmp_path)
    closed |= names
    note = f"{len(names)} subfolders cannot be read"
    assert note in " ".join(read_ct(tmp_path)[0].notes) and note in listing_text(tmp_path)
    (tmp_path / "a" / "s1-3.dcm").unlink()
    message = refusal(tmp_path)
    assert (
        "no slice to be missing" in message
        and f"subfolders that cannot be read: {', '.join(sorted(names))}" in message
    )
    closed.add("a")
    assert "cannot be read in a, b" in refusal(tmp_path)


def test_files_below_a_folder_are_in_order(tmp_path):
    names = ["b", "a/2", "a/1", "a/b/3"]
    for name in names:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    below = [file.relative_to(tmp_path).as_posix() for file in files_below(tmp_path)]
    assert below == ["b", "a/1", "a/2", "a/b/3"]


def split(series, **changes):
    """The slices with a SeriesInstanceUID each; ``changes`` map a tag to a function of the slice's number."""

    def edit(data, k):
        data.SeriesInstanceUID, data.SeriesNumber = generate_uid(), k + 1
        for tag, value in changes.items():
            setattr(data, tag, value(k))

    return series.write(edit=edit)


@pytest.mark.parametrize("direction", ["identity", "oblique"])
def test_slices_with_a_series_each_are_one_series(tmp_path, direction):
    series = Series(tmp_path, DIRECTIONS[direction])
    volume, voxels = read_ct(split(series))
    assert np.array_equal(voxels, series.hounsfield) and len(volume.references.series) == 6
    assert any("6 slices has a SeriesInstanceUID of its own" in note for note in volume.notes)
    assert "6 " in listing_text(tmp_path) and "cannot be imported" not in listing_text(tmp_path)


@pytest.mark.parametrize(
    ("tag", "value"),
    [
        ("StudyInstanceUID", lambda k: f"1.2.{k}"),
        ("FrameOfReferenceUID", lambda k: f"1.2.{k}"),
        ("PixelSpacing", lambda k: [0.7 + 0.01 * k] * 2),
        ("ImagePositionPatient", lambda k: [0, 0, 2.5 * k * k]),
        ("ImagePositionPatient", lambda k: [0, 0, 5.0]),
        ("ImageType", lambda k: ["DERIVED", "SECONDARY", ("AXIAL", "MIP")[k % 3 == 1]]),
    ],
)
def test_slices_that_share_no_stack_are_not_joined(tmp_path, tag, value):
    series = Series(tmp_path, DIRECTIONS["identity"])
    split(series, **{tag: value})
    options = dict(series="1") if tag == "StudyInstanceUID" else {}
    assert "6 slices have a SeriesInstanceUID of their own each" in refusal(tmp_path, **options)


def test_a_segmentation_of_slices_with_a_series_each_is_theirs(tmp_path):
    series = Series(tmp_path / "ct", DIRECTIONS["identity"])
    split(series)
    write_segmentation(tmp_path / "seg.dcm", series, {"Left kidney": series.hounsfield > 300})
    labels = open_labels(tmp_path / "seg.dcm")
    assert (
        read_ct(tmp_path / "ct", labels=labels.references)[0].references.instances
        & labels.references.instances
    )
