"""Which segments are the organ: what the user names wins, and derived structures, copies and unknown names
are never silent.
"""

import re
import unicodedata
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from raw_nrrd import with_segments
from synthetic_body import LEFT, LEFT_ML, RIGHT, TUMOUR, body, coarsely, drawn, grid_around, level, points_of
from test_label_files import strips

from errors import PatientError
from scenes.patients.import_command import label_words
from scenes.patients.import_request import import_request
from scenes.patients.organ_selection import find_organs
from scenes.patients.readers.label_maps import LabelMap, Segment
from scenes.patients.readers.label_merge import merge_label_maps
from scenes.patients.readers.segment_choice import assign_tissues, choose_segments, with_commas
from scenes.patients.readers.segment_names import is_derived, side_of, tissue_of

LARGER = LEFT[0], LEFT[1] + 6.0
UPPER = LEFT[0] + [0, 0, 20.0], LEFT[1] * [1, 1, 0.5]
DERIVED = [
    "Kidney_L_PRV5",
    "Kidney_L_PRV05",
    "PRV_Kidney_L",
    "zRing_Kidney",
    "zKidney_L",
    "CTV_Kidney",
    "CTVp_6000",
    "PTV_L",
    "PTV1",
    "ITV_L",
    "iGTV",
    "OPT_Kidney_L",
    "Kidney_L_opt",
    "Kidney_L_margin",
    "Kidney_bbox",
    "Kidney_L_exp",
    "Kidney_L_expanded",
    "Kidney_R-PTV",
    "Kidney~_L",
    "Kidney_L+5mm",
    "Kidney_L_ring",
    "Kidney_eval",
    "Kidney_crop",
    "Kidney_L_5mm",
    "_Kidney_L",
]
NOT_DERIVED = [
    "Kidney_L",
    "GTV",
    "GTVp",
    "GTV_L",
    "optic_nerve",
    "Kidney-Tumor",
    "kidney_left_1",
    "Zyste",
    "expert_kidney",
    "tumour_3cm",
    "Lesion-2",
    "boxer",
]
LESIONS = {
    "tumour": "nodule nodules AML oncocytoma Onkozytom Läsion Laesion lesione lesión lesão Raumforderung "
    "Nierentumor masse masa nódulo Karzinom "
    "carcinome angiomyolipoma metastasis adenoma 肿瘤 腫瘍",
    "cyst": "Zyste kyste quiste cisti cisto Bosniak_2F 囊肿",
    "kidney": "riñón rein Niere rene rim_direito nier 腎 左肾",
    "urine": "uretère uréter Harnleiter Nierenbecken bassinet Left_kidney_pelvis 尿管",
    "sinus": "Nierensinus sinus_renal",
    None: "Befund ROI_1 finding unknown Опухоль "
    "Liver_lesion Leberzyste Splenic_cyst Bone_metastasis Adrenal_mass",
}


def segment(name, solid, spacing=(4.0, 4.0, 4.0)):
    image = drawn(grid_around((-120, -60, -70), (130, 80, 80), spacing), (1, solid))
    return LabelMap.single(*(lambda one: (one.grid, one.values > 0))(LabelMap.of(image)), Segment.named(name))


def organ_ml(maps, organ=()):
    chosen, notes = choose_segments(assign_tissues(maps, list(organ), {}), organ, bool(organ))
    merged, own = merge_label_maps(chosen, organ)
    return find_organs(merged, own)[-1].volume_ml, notes


class TestNames:
    @pytest.mark.parametrize("name", DERIVED)
    def test_derived(self, name):
        assert is_derived(name) and tissue_of(name) is None

    @pytest.mark.parametrize("name", NOT_DERIVED)
    def test_not_derived(self, name):
        assert not is_derived(name)

    @pytest.mark.parametrize("form", ["NFC", "NFD"])
    @pytest.mark.parametrize("tissue", LESIONS)
    def test_languages_and_encodings(self, tissue, form):
        names = [unicodedata.normalize(form, name) for name in LESIONS[tissue].split()]
        assert {name: tissue_of(name) for name in names} == dict.fromkeys(names, tissue)

    @pytest.mark.parametrize("form", ["NFC", "NFD"])
    def test_the_users_word_in_any_encoding(self, form):
        segment = Segment.named(unicodedata.normalize(form, "Läsion Süd"))
        assert segment.matches("läsion süd") and segment.matches(unicodedata.normalize("NFD", "LÄSION SÜD"))

    @pytest.mark.parametrize(
        ("name", "side"),
        [
            ("riñón izquierdo", "left"),
            ("rene destro", "right"),
            ("rim esquerdo", "left"),
            ("linke Niere", "left"),
            ("右腎", "right"),
        ],
    )
    def test_sides(self, name, side):
        assert side_of(name) == side

    def test_what_is_beside_the_kidney_is_no_kidney(self):
        for name in ("Renal_Fascia_L", "Gerota L", "kidney bed", "renal hilum", "pararenal space"):
            assert tissue_of(name) is None, name
        assert tissue_of("Perirenal_Fat_L") == "fat"


class TestComposite:
    """A kidney with or without its tumour: the kidney, where no other is there."""

    @pytest.mark.parametrize(
        "name",
        ["Kidney_L-GTV", "kidney w/o tumor", "kidney without mass", "Kidney+Tumor", "Kidney_L incl GTV"],
    )
    def test_alone_and_beside_the_kidney(self, name):
        assert tissue_of(name) == "kidney"
        tumour = segment("GTV", TUMOUR)
        assert organ_ml([segment(name, LEFT), tumour])[0] == pytest.approx(LEFT_ML + 2.5, rel=0.03)
        ml, notes = organ_ml([segment(name, (LEFT[0], LEFT[1] + 2.0)), segment("Kidney_L", LEFT), tumour])
        assert ml == pytest.approx(LEFT_ML + 2.5, rel=0.03) and f"“{name}”" in notes[0]

    def test_a_hyphen_alone_joins(self):
        assert tissue_of("Kidney-Tumor") == "tumour"


class TestDerived:
    @pytest.mark.parametrize("name", ["Kidney_L_PRV5", "PTV_Kidney_L"])
    @pytest.mark.parametrize("is_first", [True, False])
    def test_left_out_with_a_note(self, name, is_first):
        maps = [segment("Kidney_L", LEFT), segment(name, LARGER)]
        ml, notes = organ_ml(maps[::-1] if is_first else maps)
        assert ml == pytest.approx(LEFT_ML, rel=0.02)
        assert len(notes) == 1 and "derived" in notes[0] and f"“{name}”" in notes[0] and "--organ" in notes[0]

    def test_taken_where_the_user_names_it(self):
        maps = [segment("Kidney_L", LEFT), segment("Kidney_L_PRV5", LARGER)]
        ml, notes = organ_ml(maps, ["Kidney_L_PRV5"])
        assert ml == pytest.approx(4 / 3 * np.pi * LARGER[1].prod() / 1000, rel=0.02) and notes == ()

    def test_nothing_else(self):
        with pytest.raises(PatientError, match="derived from others: “PTV_L”.*--organ"):
            choose_segments([segment("PTV_L", LEFT)])


class TestDrawnTwice:
    @pytest.mark.parametrize("names", [("Kidney_L", "Kidney_L"), ("Kidney_L_AB", "Kidney_L_CD")], ids=str)
    def test_two_of_equal_rank_are_united_with_a_note(self, names):
        first, second = names
        ml, notes = organ_ml([segment(first, LEFT), segment(second, (LEFT[0] + [0, 0, 6.0], LEFT[1]))])
        assert ml > 1.04 * LEFT_ML
        assert notes == (f"united, as they are one structure drawn twice: “{first}”, “{second}”",)

    def test_each_name_is_said_once(self):
        _, notes = organ_ml([segment(name, LEFT) for name in ("Kidney_L", "Kidney_L_1", "Kidney_L old")])
        assert " ".join(notes).count("“Kidney_L old”") == 1

    @pytest.mark.parametrize("name", ["Kidney_L_Meier", "kidney left second look"])
    def test_a_longer_name_is_left_out(self, name):
        ml, notes = organ_ml([segment(name, LARGER), segment("Kidney_L", LEFT)])
        assert ml == pytest.approx(LEFT_ML, rel=0.02)
        assert len(notes) == 1 and f"“{name}”" in notes[0]

    def test_both_kidneys_of_one_name_are_two(self):
        maps = [segment("Kidney", LEFT), segment("Kidney", RIGHT)]
        chosen, notes = choose_segments(maps)
        assert notes == () and len(find_organs(merge_label_maps(chosen)[0])) == 2


class TestTheUsersWord:
    @pytest.mark.parametrize(
        "other", ["Kidney_L_PRV5", "kidney large", "renal cortex", "renal sinus", "veins"]
    )
    @pytest.mark.parametrize("is_first", [True, False])
    def test_the_organ_is_that_segment_alone(self, other, is_first):
        """Whatever covers it: also smaller structures, which are drawn over a kidney."""
        maps = [segment("Kidney_L", LEFT), segment(other, LARGER)]
        ml, _ = organ_ml(maps[::-1] if is_first else maps, ["Kidney_L"])
        assert ml == pytest.approx(LEFT_ML, rel=0.02)

    def test_what_is_in_it_keeps_its_tissue(self):
        maps = [segment("Kidney_L", LEFT), segment("renal cortex", UPPER), segment("GTV", TUMOUR)]
        merged, own = merge_label_maps(assign_tissues(maps, ["Kidney_L"], {}), ["Kidney_L"])
        (piece,) = find_organs(merged, own)
        assert {merged.segments[v].tissue for v in np.unique(piece.values[piece.mask]).tolist()} == {
            "kidney", "cortex", "tumour",
        }  # fmt: skip

    def test_names_with_commas(self):
        maps = [segment("Kidney, left", LEFT), segment("mass, left, lower", TUMOUR), segment("left", RIGHT)]
        assert with_commas(label_words("Kidney, left", "organ"), maps) == ["Kidney, left"]
        assert with_commas(["mass", "left", "lower", "left"], maps) == ["mass, left, lower", "left"]
        assert with_commas(["1", "2"], maps) == ["1", "2"]

    @pytest.mark.parametrize(
        ("names", "words"),
        [
            (("2", "1"), "“2” is the name of label 1 .* and the value of label 2"),
            (("finding", "FINDING"), "“finding” is the name of 2 labels, .*; give a value"),
        ],
    )
    def test_a_word_of_two_meanings_is_refused(self, names, words):
        with pytest.raises(PatientError, match=words):
            assign_tissues([strips(*names)], [], {"tumour": [names[0]]})

    def test_accents_tell_names_apart(self):
        maps = [strips("Kidney_L", unicodedata.normalize("NFD", "Läsion"), "Lasion")]
        (assigned,) = assign_tissues(maps, [], {"tumour": ["Läsion"], "cyst": ["Lasion"]})
        assert [s.tissue for s in assigned.segments.values()] == ["kidney", "tumour", "cyst"]

    def test_a_name_may_be_given_as_it_is_shown(self):
        """Without its typographic quotation marks."""
        organ = strips("Organ “L”").segments[1]
        assert str(organ) == "1 “Organ L”" and organ.matches("Organ L")


class TestUnknown:
    """A lesion under a name that no list has, within the kidney's label, is named with its volume and
    place.
    """

    @pytest.fixture(autouse=True)
    def coarse(self, monkeypatch):
        coarsely(monkeypatch)

    def write(self, folder: Path, name: str, form: str) -> tuple[Path, list[Path]]:
        ct, labels = body(spacing=(4.0, 4.0, 4.0))
        values = sitk.GetArrayFromImage(labels)
        kidney, lesion = ((np.isin(values, inside)).astype(np.uint8) for inside in ((2, 3), (3,)))
        sitk.WriteImage(ct, str(folder / "ct.nii.gz"))
        layers = {"kidney_left": kidney, name: lesion}
        images = []
        for voxels in layers.values():
            images.append(sitk.GetImageFromArray(voxels))
            images[-1].CopyInformation(ct)
        if form == "folder":
            (folder / "labels").mkdir()
            for one, image in zip(layers, images, strict=True):
                sitk.WriteImage(image, str(folder / "labels" / f"{one}.nii.gz"))
            return folder / "ct.nii.gz", [folder / "labels"]
        segments = [dict(Name=one, LabelValue=1, Layer=n) for n, one in enumerate(layers)]
        sitk.WriteImage(with_segments(sitk.Compose(*images), segments), str(folder / "a.seg.nrrd"))
        return folder / "ct.nii.gz", [folder / "a.seg.nrrd"]

    @pytest.mark.parametrize("form", ["folder", "Slicer"])
    @pytest.mark.parametrize("name", ["Befund", "Läsio 3"])
    def test_a_warning_with_volume_and_place(self, tmp_path, name, form):
        ct, labels = self.write(tmp_path, unicodedata.normalize("NFD", name), form)
        patient = import_request(ct, labels)
        (warning,) = [line for line in patient.warnings if "no known tissue" in line]
        assert name in unicodedata.normalize("NFC", warning)
        place = re.search(r"at (\d+), (\d+), (\d+) mm", warning)
        np.testing.assert_allclose([float(n) for n in place.groups()], TUMOUR[0], atol=1.5)
        assert " ml) in the organ" in warning and "--tumour" in warning
        assert patient.tumour is None
        named = import_request(ct, labels, tissues={"tumour": [name]})
        assert named.tumour is not None and not any("no known tissue" in line for line in named.warnings)

    @pytest.mark.parametrize(("name", "lines"), [("Renal_Fascia_L", 0), ("ROI_1", 1)])
    def test_what_is_around_the_organ_is_not_in_it(self, tmp_path, name, lines):
        """What is known there needs no warning."""
        ct, labels = self.write(tmp_path, "nodule", "folder")
        image = sitk.ReadImage(str(ct))
        around = sitk.GetImageFromArray((level(points_of(image), LARGER) < 0).astype(np.uint8))
        around.CopyInformation(image)
        sitk.WriteImage(around, str(labels[0] / f"{name}.nii.gz"))
        warnings = [line for line in import_request(ct, labels).warnings if f"“{name}”" in line]
        assert len(warnings) == lines and all("touches the organ" in line for line in warnings)


def test_no_tissue_remains_of_what_is_left_out():
    """Beside others in one map, which cannot be dropped."""
    one, other = segment("Kidney_L", LEFT), segment("GTV", TUMOUR)
    merged, _ = merge_label_maps([one, other])
    renamed = replace(
        merged,
        segments={
            v: replace(s, name="CTV", tissue=None) if s.name == "GTV" else s
            for v, s in merged.segments.items()
        },
    )
    (kept,), notes = choose_segments([renamed])
    assert {s.tissue for s in kept.segments.values()} == {"kidney", None} and "“CTV”" in notes[0]
