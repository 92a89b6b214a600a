"""The command import from end to end: what a hospital sends becomes a patient's folder that names nobody."""

import io
from contextlib import redirect_stderr, redirect_stdout

import numpy as np
import pytest
import SimpleITK as sitk
from dicom_series import PERSON, Series, write_segmentation, write_structures
from synthetic_body import BODY, DIRECTIONS, LEFT, RIGHT, TUMOUR, coarsely, level, section

from app import main
from errors import PatientError
from scenes.anatomy import load_anatomy
from scenes.import_findings import read_findings
from scenes.patients.import_command import position_mm
from scenes.patients.import_request import import_request, volume_of_labels
from scenes.patients.readers.label_files import open_labels
from scenes.scene import load_scene
from scenes.terminal import shell_command

SPINE = np.array([0.0, 70.0, 0.0]), np.array([22.0, 20.0, 400.0])
ORIGIN = (-175.0, -120.0, -56.0)
SIZE = (176, 121, 36)


def hounsfield(places):
    """HU of the synthetic body, with a spine."""
    values = np.full(places.shape[:-1], -1000.0)
    for value, solid in ((40, BODY), (500, SPINE), (120, LEFT), (120, RIGHT), (70, TUMOUR)):
        values[level(places, solid) < 0] = value
    return values


@pytest.fixture(scope="module", autouse=True)
def coarse():
    with pytest.MonkeyPatch.context() as patch:
        coarsely(patch)
        yield


@pytest.fixture(scope="module")
def hospital(tmp_path_factory):
    """A DICOM folder as a hospital sends it: a CT and a segmentation of it."""
    folder = tmp_path_factory.mktemp("hospital") / "Doe_Jane"
    voxels = dict(size=SIZE, gap=3.5, spacing=(2.0, 2.0), origin=ORIGIN)
    series = Series(folder / "ct", DIRECTIONS["identity"], field=hounsfield, **voxels)
    series.write()
    places = np.stack([series.places(k) for k in range(SIZE[2])])
    masks = {
        "Left kidney": level(places, LEFT) < 0,
        "Right kidney": level(places, RIGHT) < 0,
        "Renal mass": level(places, TUMOUR) < 0,
    }
    masks["Left kidney"] &= ~masks["Renal mass"]
    write_segmentation(folder / "seg" / "labels.dcm", series, masks)
    return folder, series


@pytest.fixture(scope="module")
def imported(hospital, tmp_path_factory):
    """The folder that the command leaves of it, the patient, and what was printed."""
    out, patients, printed = tmp_path_factory.mktemp("patients") / "a b", [], io.StringIO()

    def watched(*request):
        patients.append(import_request(*request))
        return patients[0]

    with pytest.MonkeyPatch.context() as patch, redirect_stdout(printed), redirect_stderr(printed):
        patch.setattr("scenes.patients.import_request.import_request", watched)
        assert main(["import", str(hospital[0]), "--side", "left", "--out", str(out)]) == 0
    return out, *patients, printed.getvalue()


@pytest.fixture(scope="module")
def written(imported):
    return imported[0]


@pytest.fixture(scope="module")
def taken_in(imported):
    return imported[1]


def test_the_folder_is_a_scene(written):
    scene = load_scene(written / "scene.toml")
    anatomy = load_anatomy(scene, written)
    assert scene.title == "Left kidney"
    np.testing.assert_allclose(anatomy.tumour.center_mass, TUMOUR[0], atol=1.0)
    assert anatomy.organ.center_mass[0] > 0 and anatomy.ct.voxels.ndim == 3
    # Held by its pedicle, and by the fat that the CT shows.
    held = scene.attachment
    assert held.at_mm is not None and held.radius_mm == 20 and held.stiffness_n_mm == 2.0
    assert (held.fat_young_kpa, held.fat_kpa_mm, held.approach) == (3.0, 0.3, None)
    assert anatomy.fat_mm.shape == (len(anatomy.organ.faces),)
    assert {file.name for file in written.iterdir()} == {
        "check.png", "ct.nrrd", "import.json", "labels.nrrd",
        "organ.stl", "scene.toml", "support.stl", "tumour.stl",
    }  # fmt: skip
    assert [entry.name for entry in written.parent.iterdir()] == ["a b"]


def test_the_findings_are_kept(written, taken_in):
    patient, findings = taken_in, read_findings(written)
    assert findings.side == "left" and findings.series == "1" and not findings.draft
    assert findings.source.size == SIZE and findings.ct.size == patient.ct.GetSize()
    np.testing.assert_allclose(findings.source.origin_mm, ORIGIN, atol=1e-3)
    assert findings.surfaces["organ"].label_ml == pytest.approx(patient.volumes_ml["organ"], abs=1e-3)
    assert findings.surfaces["tumour"].volume_ml == pytest.approx(patient.tumour.volume / 1000, abs=1e-3)
    assert findings.length_mm == pytest.approx(2 * LEFT[1][2], abs=3.5)
    assert findings.complexity["tumours"] == 1
    assert list(findings.open_warnings) == list(patient.warnings) and findings.notes == patient.notes


def test_nothing_names_the_patient(written, hospital):
    folder, series = hospital
    identifiers = [*PERSON.values(), "Doe", "Jane", series.uid, series.frame_of_reference, series.study]
    identifiers += [str(folder), "Doe_Jane", *series.sops]
    words = [value for value in identifiers if len(value) > 3]
    assert len(words) > 40
    for file in written.iterdir():
        content = file.read_bytes()
        assert not [word for word in words if word.encode() in content], file.name


def test_the_terminal_names_nobody_and_tells_the_facts(hospital, imported):
    out, _, printed = imported
    assert printed.endswith(f"then: {shell_command('rehearse', out)}\n")
    for text in ("left kidney", "parenchyma 15, tumour 60 kPa", "3 kPa, ", "The probe is drop-in"):
        assert text in printed
    for text in ("Doe", "Jane", "4711", "19600229", hospital[1].uid):
        assert text not in printed


def test_labels_of_another_examination(hospital, tmp_path):
    folder, _series = hospital
    other = Series(tmp_path / "ct", DIRECTIONS["identity"], size=(20, 20, 6), origin=ORIGIN, field=hounsfield)
    other.write()
    with pytest.raises(PatientError, match="another frame of reference"):
        import_request(tmp_path / "ct", [folder / "seg"])
    with pytest.raises(PatientError, match="no labels are with this CT.*--seed"):
        import_request(tmp_path / "ct")


class TestExchanged:
    """CT and labels in the wrong order, or one for the other: the message gives the right order."""

    @pytest.fixture(scope="class")
    def paths(self, tmp_path_factory):
        folder = tmp_path_factory.mktemp("exchanged")
        series = Series(folder / "ct", DIRECTIONS["identity"])
        series.write()
        ones = np.ones(series.size[::-1], np.uint8)
        write_segmentation(folder / "seg.dcm", series, {"Kidney": ones})
        write_structures(folder / "rt.dcm", {"Kidney": [series.places(1)[0]]}, series.uid)
        (folder / "kidney.stl").write_bytes(b"solid")
        for name, voxels in (("labels", ones), ("hounsfield", series.hounsfield.astype(np.int16))):
            sitk.WriteImage(sitk.GetImageFromArray(voxels), str(folder / f"{name}.nii.gz"))
        return folder

    @pytest.mark.parametrize(
        ("ct", "labels", "words"),
        [
            ("seg.dcm", "ct", "no CT slices, but 1 SEG; expected a CT; give the CT first, then the labels"),
            (
                "rt.dcm",
                "ct",
                "no CT slices, but 1 RTSTRUCT; expected a CT; give the CT first, then the labels",
            ),
            ("rt.dcm", "seg.dcm", "no CT slices, but 1 RTSTRUCT"),
            ("ct", "ct", "has no labels, but 6 CT slices; .*give the CT first, then the labels"),
            ("labels.nii.gz", "ct", "has no labels, but 6 CT slices; .*give the CT first, then the labels"),
            ("labels.nii.gz", "hounsfield.nii.gz", "check that CT and labels are not exchanged"),
            ("ct", "hounsfield.nii.gz", "check that CT and labels are not exchanged"),
            ("labels.nii.gz", "labels.nii.gz", "expected HU, .*give the CT first, then the labels"),
            ("kidney.stl", "ct", "is a surface; expected a CT; give the CT first, then its labels"),
        ],
    )
    def test_the_order_is_told(self, paths, ct, labels, words):
        with pytest.raises(PatientError, match=words):
            import_request(paths / ct, [paths / labels], side="left")


def test_the_folder_is_checked_before_the_work(tmp_path, capfd):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "precious.txt").write_text("mine")
    assert main(["import", "nowhere", "--out", str(tmp_path / "mine")]) == 2
    assert "exists and is not an empty folder" in capfd.readouterr().err
    assert main(["import", "nowhere", "--out", str(tmp_path / "mine" / "precious.txt" / "p")]) == 2
    assert "cannot be made in" in capfd.readouterr().err


@pytest.mark.parametrize("text", ["", "1,2", "1,2,3,4", "a,b,c", "1,2,nan"])
def test_a_seed_is_three_numbers(text):
    with pytest.raises(PatientError, match="three numbers X,Y,Z"):
        position_mm(text)


def test_a_seed_or_labels(tmp_path):
    with pytest.raises(PatientError, match="not both"):
        import_request(tmp_path, [tmp_path], seed_mm=np.zeros(3))


def test_the_series_that_labels_were_drawn_on(tmp_path):
    """Though another shows more."""
    thin = Series(tmp_path / "ct", number=3, gap=1.25, size=(12, 10, 12))
    thick = Series(
        tmp_path / "ct", number=8, gap=5.0, size=(12, 10, 3), frame_of_reference=thin.frame_of_reference
    )
    thin.write()
    thick.write()
    seg = write_segmentation(tmp_path / "seg.dcm", thick, {"Kidney": np.ones((3, 10, 12))})
    assert volume_of_labels(tmp_path / "ct", [open_labels(seg)]).grid.spacing[2] == pytest.approx(5.0)


def test_a_value_that_no_voxel_has_is_noted(hospital, taken_in, tmp_path, monkeypatch):
    monkeypatch.setattr("scenes.patients.import_request.import_patient", lambda *_, **__: taken_in)
    sitk.WriteImage(sitk.Image([5, 5, 5], sitk.sitkUInt8) + 1, str(tmp_path / "kits.nii.gz"))
    patient = import_request(
        hospital[0] / "ct", [tmp_path / "kits.nii.gz"], ["1", "2"], {"tumour": ["2"], "cyst": ["3"]}
    )
    assert patient.notes[-1] == "no voxel has the cyst's label 3"
    # A rehearsal without the tumour would be of another operation.
    assert patient.warnings[-1] == "no voxel has the tumour's label 2; the labels are 1"
    assert not any("tumour's label" in note for note in patient.notes)


def test_what_was_mended_in_contours_is_noted(hospital, taken_in, tmp_path, monkeypatch):
    monkeypatch.setattr("scenes.patients.import_request.import_patient", lambda *_, **__: taken_in)
    contours = [section((LEFT[0], np.full(3, 15.0)), LEFT[0] + [0, 0, 3.5 * k - 6.5]) for k in range(5)] * 2
    path = write_structures(tmp_path / "rt.dcm", {"Kidney left": contours}, hospital[1].uid)
    patient = import_request(hospital[0] / "ct", [path])
    assert "region 1: contours that stand twice in a plane, counted once: 5" in (
        *patient.notes,
        *patient.warnings,
    )


class TestProbeAndStiffness:
    """The options --probe and --uniform."""

    def scene_of(self, hospital, tmp_path, *options):
        out = tmp_path / "a"
        assert main(["import", str(hospital[0]), "--side", "left", "--out", str(out), *options]) == 0
        return load_scene(out / "scene.toml"), out

    def test_by_default_the_drop_in_probe_is_over_a_stiff_tumour(self, written):
        scene = load_scene(written / "scene.toml")
        assert scene.transducer.probe == "drop-in" and scene.image.outside == "fluid"
        assert scene.press.target_mm == pytest.approx(TUMOUR[0], abs=1.0)
        assert {name: part.young_kpa for name, part in scene.tissue.parts.items()} == {"tumour": 60.0}

    def test_uniform_tissue_under_a_probe_of_ones_own(self, hospital, tmp_path, capsys):
        mine = tmp_path / "mine.toml"
        mine.write_text('TransducerName = "Mine"\nHousingMm = [41.0, 9.0, 12.0]\n')
        scene, out = self.scene_of(hospital, tmp_path, "--probe", str(mine), "--uniform")
        assert scene.transducer.probe == str((out / "probe.toml").resolve())
        assert (out / "probe.toml").read_text() == mine.read_text()
        assert str(tmp_path) not in (out / "scene.toml").read_text()
        assert scene.tissue.parts == {}
        printed = capsys.readouterr().out
        assert "stiffness  15 kPa everywhere" in printed and "The probe is probe.toml" in printed

    @pytest.mark.parametrize(
        ("name", "words"),
        [
            ("dropin", "--probe: 'dropin' is no file, and known by name are curvilinear, drop-in, linear, "
            "micro, phased"),
            ("none.toml", "--probe: 'none.toml' is no file"),
            ("bad.toml", "TransducerWidthMm"),
            ("folder", "folder"),
            ("page.toml", "not text in UTF-8"),
        ],
    )  # fmt: skip
    def test_a_probe_that_is_none_is_refused_before_the_ct_is_read(
        self, tmp_path, capsys, monkeypatch, name, words
    ):
        monkeypatch.chdir(tmp_path)
        (tmp_path / "bad.toml").write_text('TransducerName = "Bad"\nTransducerWidthMm = -1.0\n')
        (tmp_path / "folder").mkdir()
        (tmp_path / "page.toml").write_bytes("# Müller\n".encode("cp1252"))
        assert main(["import", "no-such-ct", "--probe", name, "--out", "a"]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert words in line
        assert not (tmp_path / "a").exists()
