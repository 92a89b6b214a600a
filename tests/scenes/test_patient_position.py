"""How the patient lay in the CT: by the header, by the user, and by what the CT shows."""

import inspect

import numpy as np
import pytest
import SimpleITK as sitk
from conftest import DATA
from dicom_series import Series, edited
from pydicom.dataset import Dataset
from synthetic_body import body, coarsely, level, points_of, with_voxels

from app import main
from errors import PatientError
from scenes.patients.check_picture import as_table, summary_rows
from scenes.patients.import_request import import_request
from scenes.patients.patient_import import import_patient
from scenes.patients.patient_position import (
    GRAVITY,
    GRID_MM,
    POSITIONS,
    position_of,
    position_warnings,
    seen_position,
)
from scenes.patients.patient_scene import patient_scene
from scenes.patients.readers.ct_series import open_ct
from scenes.patients.readers.label_maps import LabelMap
from scenes.volumes.lazy_volume import LazyVolume

TERMS = {"S": "supine", "P": "prone", "DL": "left-decubitus", "DR": "right-decubitus"}
# Of the position after so many quarter turns of a picture, from its row axis (posterior) to its column axis
# (left).
TURNS = ("supine", "left-decubitus", "prone", "right-decubitus")


class TestHeader:
    @pytest.mark.parametrize("first", ["HF", "FF", "LF", "RF", "AF", "PF"])
    def test_each_term_of_dicom(self, first):
        for last, position in TERMS.items():
            assert position_of(first + last, None) == (position, ())

    @pytest.mark.parametrize("term", ["", "HF", "S", "HFSX", "DOE^JANE", "HFV"])
    def test_no_term_is_assumed_supine_and_never_quoted(self, term):
        position, (note,) = position_of(term, None)
        assert position == "supine" and "assumed supine" in note and "--position" in note
        assert not term or term not in note.replace("PatientPosition", "")

    def test_the_users_word_counts_and_is_noted_where_the_header_has_another(self):
        position, (note,) = position_of("HFS", "prone")
        assert position == "prone" and "lying prone, as given" in note and "HFS" in note
        assert position_of("HFP", "prone") == position_of("", "prone") == ("prone", ())

    @pytest.mark.parametrize(("term", "read"), [("FFDL", "FFDL"), ("hfp ", "HFP"), ("", ""), (None, "")])
    def test_of_slices(self, tmp_path, term, read):
        tags = {} if term is None else dict(PatientPosition=term)
        assert open_ct(Series(tmp_path).write(**tags)).patient_position == read

    @pytest.mark.parametrize(
        ("other", "read", "words"), [("", "HFP", ""), ("HFS", "", "different PatientPositions")]
    )
    def test_of_slices_that_differ(self, tmp_path, other, read, words):
        """Those without one do not count."""
        series = Series(tmp_path)
        series.write(edit=lambda data, k: setattr(data, "PatientPosition", "HFP" if k else other))
        volume = open_ct(tmp_path)
        assert volume.patient_position == read and bool(volume.notes) == bool(words)
        assert words in " ".join(volume.notes)

    @pytest.mark.parametrize("shared", [True, False, None])
    def test_enhanced(self, tmp_path, shared):
        """In the shared functional groups, in each frame's, or in the file's own header."""
        group = Dataset()
        group.PatientPosition = "FFP"

        def edit(data):
            shared_groups, frames = data.SharedFunctionalGroupsSequence, data.PerFrameFunctionalGroupsSequence
            for holder in {True: shared_groups, False: frames, None: []}[shared]:
                holder.CTPositionSequence = [group]
            if shared is None:
                data.PatientPosition = "FFP"

        assert open_ct(edited(Series(tmp_path).write_enhanced(), edit)).patient_position == "FFP"


@pytest.mark.parametrize("position", ["prone", "left-decubitus"])
def test_gravity_is_that_of_the_ct(monkeypatch, position):
    """Support, scene and words follow it; the patient's axes do not, so that bones behind are as they
    should be.
    """
    coarsely(monkeypatch)
    used = {}
    monkeypatch.setattr(
        "scenes.patients.patient_import.mould", lambda organ, gravity: used.update(gravity=gravity) or organ
    )
    ct, labels = body()
    voxels = sitk.GetArrayFromImage(ct)
    voxels[level(points_of(ct), (np.array([0.0, 75.0, 0.0]), np.array([22.0, 18.0, 400.0]))) < 0] = 500
    named = LabelMap.of(labels, {1: "kidney_right", 2: "kidney_left", 3: "tumour"})
    lazy = LazyVolume.of(with_voxels(ct, voxels))
    patient = import_patient(lazy, named, side="left", margin_mm=10.0, position=position)
    assert patient.position == position and patient.warnings == ()
    assert all(note.startswith("contrast phase") for note in patient.notes)
    np.testing.assert_array_equal(used["gravity"], GRAVITY[position])
    assert patient_scene(patient).gravity.direction == GRAVITY[position]
    assert {"prone": "lying prone", "left-decubitus": "left decubitus"}[position] in as_table(
        summary_rows(patient)
    )


def test_the_side_of_a_decubitus_position_is_down():
    """+x is the patient's left, +y the back."""
    downs = {
        "supine": (0, 1, 0),
        "prone": (0, -1, 0),
        "left-decubitus": (1, 0, 0),
        "right-decubitus": (-1, 0, 0),
    }
    assert downs == GRAVITY


def test_the_option_has_four_words_and_reaches_the_import(tmp_path, capfd, monkeypatch):
    arguments = {}

    def request(*values, **named):
        arguments.update(inspect.signature(import_request).bind(*values, **named).arguments)
        raise PatientError("enough")

    monkeypatch.setattr("scenes.patients.import_request.import_request", request)
    command = ["import", "ct", "labels", "--out", str(tmp_path / "p"), "--position"]
    assert main([*command, "left"]) == 2 and not arguments
    printed = capfd.readouterr().err
    assert all(position in printed for position in POSITIONS)
    assert main([*command, "left-decubitus"]) == 2
    assert arguments["position"] == "left-decubitus" and arguments["seed_mm"] is None


class Trunk:
    """Axial slices of a supine body, 300 x 200 mm, on the grid of the search: rows go to the back, columns
    to the left.
    """

    def __init__(self) -> None:
        self.y, self.x = np.mgrid[-80:80, -80:80] * GRID_MM[0]
        self.slice = np.full(self.x.shape, -1000.0)
        self.slice[np.hypot(self.x / 150, self.y / 100) < 1] = 40
        self.count = 8

    def with_table(self, hu: float = -100.0):
        """A shell of 4 mm, 15 mm under the back."""
        self.slice[(np.abs(self.x) < 180) & (np.abs(self.y - 117) < 2.5)] = hu
        return self

    def with_level(self, gas_side: float = -1.0):
        """A loop of bowel, half of it gas, one HU thinner than lung may be: the half in front, or with 1
        that behind.
        """
        self.slice[(np.hypot(self.x, self.y + 40) < 30) & (gas_side * (self.y + 40) > 0)] = -901
        return self

    def with_round_gas(self):
        self.slice[np.hypot(self.x, self.y + 40) < 20] = -1000
        return self

    def with_arm(self):
        self.slice[np.hypot(self.x - 185, self.y) < 30] = 40
        return self

    def with_lungs(self):
        """Their base is level, and is no fluid's; one HU denser than gas of bowel."""
        self.slice[(np.abs(np.abs(self.x) - 70) < 40) & (np.abs(self.y + 20) < 30)] = -899
        return self

    def image(self, turns: int = 0) -> sitk.Image:
        voxels = np.repeat(np.rot90(self.slice, turns)[None], self.count, axis=0)
        image = sitk.GetImageFromArray(np.ascontiguousarray(voxels).astype(np.int16))
        image.SetSpacing(GRID_MM.tolist())
        return image


@pytest.mark.parametrize("turns", range(4))
class TestSeen:
    def test_the_table(self, turns):
        assert seen_position(Trunk().with_table().image(turns)) == TURNS[turns]

    def test_a_level_of_fluid(self, turns):
        assert seen_position(Trunk().with_level().image(turns)) == TURNS[turns]

    def test_a_table_beside_which_an_arm_lies(self, turns):
        assert seen_position(Trunk().with_table().with_arm().image(turns)) == TURNS[turns]

    def test_neither(self, turns):
        for trunk in (Trunk(), Trunk().with_arm(), Trunk().with_round_gas(), Trunk().with_lungs()):
            assert seen_position(trunk.image(turns)) is None

    def test_a_level_that_contradicts_the_table(self, turns):
        assert seen_position(Trunk().with_table().with_level(gas_side=1.0).image(turns)) is None

    def test_any_direction_of_the_voxels(self, turns):
        image = Trunk().with_table().image(turns)
        for order in ("RAS", "LPI", "SPL"):
            assert seen_position(sitk.DICOMOrient(image, order)) == TURNS[turns]

    def test_the_warning(self, turns):
        image = Trunk().with_table().image(turns)
        assert position_warnings(image, TURNS[turns]) == ()
        (warning,) = position_warnings(image, TURNS[turns - 1])
        assert f"--position {TURNS[turns]}" in warning and "\n" not in warning


def test_an_empty_ct_shows_nothing():
    assert seen_position(sitk.Image([30, 30, 10], sitk.sitkInt16) - 1000) is None


@pytest.mark.skipif(not (DATA / "ct").is_dir(), reason="real data (../shared/data/ct) is not here")
@pytest.mark.parametrize("name", ["crlm_1004", "totalseg/ct.nii.gz"])
def test_real_patients_and_turned_copies(name):
    """Both lay supine."""
    ct = sitk.DICOMOrient(open_ct(DATA / "ct" / name).image(), "LPS")
    step = [max(1, int(1.5 / mm)) for mm in ct.GetSpacing()]
    ct = sitk.Cast(sitk.Shrink(ct, step), sitk.sitkInt16)
    voxels = sitk.GetArrayFromImage(ct)
    # Above the hips and under the lungs: the level of the kidneys.
    voxels = voxels[len(voxels) // 3 : -len(voxels) // 6]
    for turns in range(4):
        turned = sitk.GetImageFromArray(np.ascontiguousarray(np.rot90(voxels, turns, (1, 2))))
        turned.SetSpacing(ct.GetSpacing())
        assert seen_position(turned) == TURNS[turns]
