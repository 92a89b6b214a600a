"""The class image of a patient: written for 3D Slicer, corrected, imported beside the labels, and written
again.
"""

import re
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from skimage.color import rgb2lab
from synthetic_body import LEFT, TUMOUR, coarsely, points_of, without_picture
from test_dense_findings import ENHANCED_HU, KIDNEY, THIN, made, organ
from test_field_cases import SPINE, inside, scan, slicer, written

from app import main
from scenes.import_findings import read_findings
from scenes.patients.class_corrections import _changes, corrections_of
from scenes.patients.import_command import TISSUE_OPTIONS
from scenes.patients.readers.label_files import open_labels
from scenes.patients.readers.label_merge import MERGE_ORDER
from scenes.patients.readers.segment_names import TISSUE_OF_NAME, is_derived, tissue_of
from scenes.scene import load_scene
from scenes.tissue_classes.class_image import CLASS_IMAGE_FILE, DRAWN, DRAWN_NAME, class_image
from scenes.tissue_classes.corrections import with_corrections
from scenes.tissue_classes.tissue_colours import COLOURS, rgb_of
from scenes.tissue_classes.tissue_map import CODE, TISSUES, TissueMap, codes_of_labels, tissue_map
from scenes.volumes.voxel_grid import VoxelGrid
from ultrasound.acoustics import tissue_table

# Voxels that a class image divides along two axes.
SPACING = (2.5, 1.5, 4.0)
pytestmark = pytest.mark.usefixtures("arrays_stored")


def test_what_was_changed_is_named_by_its_volume_the_largest_first():
    """Voxels of 1 x 2 x 2.5 mm: 300 of muscle are spleen, 500 of bone are liver, 4 are too few."""
    names = ["muscle"] * 300 + ["bone"] * 504
    others = ["spleen"] * 300 + ["liver"] * 500 + ["spleen"] * 4
    found, stated = (np.array([CODE[name] for name in each], np.uint8) for each in (names, others))
    grid = VoxelGrid((1, 1, 804), np.array([1.0, 2.0, 2.5]), np.zeros(3), np.eye(3))
    changes = _changes(found, stated, np.ones(804, bool), grid)
    assert changes == ["bone is liver (2.5 ml)", "muscle is spleen (1.5 ml)"]


class TestTissues:
    def test_both_tables_have_the_same(self):
        assert set(TISSUES) == set(tissue_table()) - {"hounsfield"}

    def test_an_import_knows_all_and_no_others(self):
        assert {name: tissue_of(name) for name in TISSUES} == {name: name for name in TISSUES}
        assert set(MERGE_ORDER) - {None} == set(CODE)
        assert {tissue for tissue, _ in TISSUE_OF_NAME if tissue} | set(TISSUE_OPTIONS.values()) <= set(CODE)

    def test_what_was_drawn_is_no_tissue_of_an_import(self):
        for name in TISSUES:
            assert tissue_of(name + DRAWN_NAME) is None and is_derived(name + DRAWN_NAME)

    def test_colours_can_be_told_apart(self):
        assert set(COLOURS) == set(TISSUES)
        colours = rgb2lab([[rgb_of(tissue) for tissue in TISSUES]])[0]
        apart = np.linalg.norm(colours[:, None] - colours[None], axis=-1)
        # Two patches in CIELAB differ clearly from about 10.
        assert apart[~np.eye(len(TISSUES), dtype=bool)].min() > 9


def fields_of(path: Path) -> dict[str, str]:
    """The header's fields, as text of the file and not by ITK."""
    header = path.read_bytes().split(b"\n\n", 1)[0].decode()
    return dict(line.split(":=", 1) for line in header.splitlines() if ":=" in line)


def segments_of(path: Path) -> dict[str, dict[str, str]]:
    """The fields of each segment by its name."""
    fields = fields_of(path)
    numbers = sorted({int(found[1]) for key in fields if (found := re.match(r"Segment(\d+)_", key))})
    assert numbers == list(range(len(numbers)))
    found = [
        {
            key.removeprefix(f"Segment{n}_"): text
            for key, text in fields.items()
            if key.startswith(f"Segment{n}_")
        }
        for n in numbers
    ]
    return {each["Name"]: each for each in found}


def test_a_segmentation_as_3d_slicer_writes_it(tmp_path):
    """The fields of its documentation; the extents of voxels, the last included."""
    codes = np.zeros((4, 5, 6), np.uint8)
    codes[1:3, 2:5, 3], codes[0, 0, 0], codes[3, 4, 5] = CODE["fat"], CODE["cortex"], CODE["cortex"]
    drawn = np.zeros(codes.shape, bool)
    drawn[3, 4, 5] = True
    index_from_mm = np.diag([0.5, 1.0, 2.0, 1.0])
    index_from_mm[:3, 3] = [1.0, -2.0, 3.0]
    image = class_image(TissueMap(codes, np.zeros(codes.shape, np.int16), drawn, index_from_mm))
    sitk.WriteImage(image, str(tmp_path / "a.seg.nrrd"))
    found = segments_of(tmp_path / "a.seg.nrrd")
    assert list(found) == [*TISSUES, "cortex (drawn)"]
    extents = {name: each["Extent"] for name, each in found.items() if each["Extent"] != "0 -1 0 -1 0 -1"}
    assert extents == {"fat": "1 2 2 4 3 3", "cortex": "0 0 0 0 0 0", "cortex (drawn)": "3 3 4 4 5 5"}
    assert int(found["cortex (drawn)"]["LabelValue"]) == CODE["cortex"] + DRAWN
    assert {each["Layer"] for each in found.values()} == {"0"}
    assert found["fat"]["Color"] == " ".join(f"{each:.6g}" for each in rgb_of("fat"))
    assert len({each["ID"] for each in found.values()}) == len({each["Color"] for each in found.values()})
    read = sitk.ReadImage(str(tmp_path / "a.seg.nrrd"))
    assert read.GetPixelID() == sitk.sitkUInt8 and read.GetSpacing() == (2.0, 1.0, 0.5)
    assert read[2, 4, 3] == CODE["fat"] and read[3, 4, 5] == CODE["cortex"] + DRAWN
    np.testing.assert_allclose(read.TransformIndexToPhysicalPoint((2, 4, 3)), (2.0, 6.0, 0.0))
    (labels,) = (segmentation := open_labels(tmp_path / "a.seg.nrrd")).maps(None)
    assert segmentation.is_class_image and {s.name for s in labels.segments.values()} == set(extents)


@pytest.fixture(scope="module")
def coarse():
    with pytest.MonkeyPatch.context() as patch:
        coarsely(patch)
        without_picture(patch)
        yield


@pytest.fixture(scope="module")
def files(tmp_path_factory, coarse) -> tuple[Path, Path]:
    """A CT of fat, bone and two kidneys, one with a tumour; labels of the left one."""
    folder = tmp_path_factory.mktemp("source")
    ct = scan(SPACING)
    named = [("kidney_left", inside(ct, LEFT)), ("tumour", inside(ct, TUMOUR))]
    return written(folder / "ct.nrrd", ct), slicer(folder / "labels.seg.nrrd", ct, named)


def imported(files, out: Path, *more: Path) -> Path:
    assert main(["import", *map(str, (*files, *more)), "--out", str(out)]) == 0
    return out


def classes_of(patient: Path, out: Path) -> Path:
    assert main(["export", str(patient), "--out", str(out)]) == 0
    return out / CLASS_IMAGE_FILE


@pytest.fixture(scope="module")
def first(files, tmp_path_factory) -> tuple[Path, Path]:
    """The patient, and its class image."""
    folder = tmp_path_factory.mktemp("first")
    patient = imported(files, folder / "patient")
    return patient, classes_of(patient, folder / "out")


def changed(path: Path, out: Path, change) -> np.ndarray:
    """A class image whose voxels (z, y, x) were changed, as 3D Slicer does; the voxels."""
    image = sitk.ReadImage(str(path))
    voxels = sitk.GetArrayFromImage(image)
    change(voxels, image)
    new = sitk.GetImageFromArray(voxels)
    new.CopyInformation(image)
    for key in image.GetMetaDataKeys():
        new.SetMetaData(key, image.GetMetaData(key))
    sitk.WriteImage(new, str(out), useCompression=True)
    return voxels


def voxels_of(path: Path) -> np.ndarray:
    return sitk.GetArrayFromImage(sitk.ReadImage(str(path)))


def test_what_the_class_image_of_a_patient_has(first):
    patient, path = first
    found, read = voxels_of(path), sitk.ReadImage(str(path))
    ct = sitk.ReadImage(str(patient / "ct.nrrd"))
    # No longer than 1.6 mm: in two parts along x, and in three along z.
    np.testing.assert_allclose(np.divide(ct.GetSpacing(), read.GetSpacing()), (2, 1, 3))
    for name, solid, share in (("bone", SPINE, 0.9), ("tumour", TUMOUR, 0.5)):
        where = inside(read, (solid[0], solid[1] - 3))
        assert np.isin(found[where], CODE[name]).mean() > share, name
    kidney = inside(read, (LEFT[0], LEFT[1] - 4)) & ~inside(read, (TUMOUR[0], TUMOUR[1] + 6))
    drawn = [CODE[name] + DRAWN for name in ("cortex", "medulla")]
    assert np.isin(found[kidney], drawn).mean() > 0.9
    assert set(drawn) <= set(np.unique(found).tolist())


def test_an_atlas_that_is_off_draws_nothing(first, tmp_path):
    patient, path = first
    scene = patient / "plain.toml"
    text = (patient / "scene.toml").read_text("utf-8")
    assert "atlas = true" in text
    scene.write_text(text.replace("atlas = true", "atlas = false"), "utf-8")
    found, before = voxels_of(classes_of(scene, tmp_path / "out")), voxels_of(path)
    scene.unlink()
    assert found.max() <= len(TISSUES)
    # All else is as before.
    is_drawn = before > DRAWN
    assert is_drawn.any() and (found == before)[~is_drawn].all()


def test_a_corrected_segment_comes_back_and_nothing_else_changes(files, first, tmp_path):
    """Corrections are kept on the class image's own grid, so that nothing is lost: the tolerance is 0."""
    patient, path = first

    def change(voxels, image):
        voxels[voxels == CODE["bone"]] = CODE["spleen"]

    wanted = changed(path, tmp_path / "classes.seg.nrrd", change)
    again = imported(files, tmp_path / "again", tmp_path / "classes.seg.nrrd")
    assert (voxels_of(path) != wanted).sum() > 1000
    assert np.array_equal(voxels_of(classes_of(again, tmp_path / "out")), wanted)
    same = {"ct.nrrd", "labels.nrrd", "organ.stl", "support.stl", "tumour.stl"}
    assert all((again / name).read_bytes() == (patient / name).read_bytes() for name in same)
    notes = read_findings(again).notes
    (note,) = [each for each in notes if each.startswith("corrected")]
    assert "muscle" not in note
    ml = float((voxels_of(path) != wanted).sum() * np.prod(sitk.ReadImage(str(path)).GetSpacing()) / 1000)
    assert f"bone is spleen ({ml:.1f} ml)" in note
    assert any("drawn from an atlas: cortex, " in each for each in notes)
    assert load_scene(again / "scene.toml").anatomy.corrected_tissues == {str(CODE["spleen"]): "spleen"}


def test_an_uncorrected_class_image_changes_nothing(files, first, tmp_path):
    patient, path = first
    again = imported(files, tmp_path / "again", path)
    assert {file.name for file in again.iterdir()} == {file.name for file in patient.iterdir()}
    assert (again / "scene.toml").read_bytes() == (patient / "scene.toml").read_bytes()


def test_parts_of_the_kidney_are_corrected_but_not_its_border_nor_its_tumour(files, first, tmp_path):
    _, path = first
    stone, beside = (LEFT[0] - [0, 0, 20], np.full(3, 5.0)), (LEFT[0] - [32, 0, 0], np.full(3, 4.0))

    def change(voxels, image):
        voxels[inside(image, stone)] = CODE["stone"]
        voxels[inside(image, beside) & (voxels == CODE["fat"])] = CODE["kidney"]
        voxels[inside(image, TUMOUR)] = CODE["cyst"]

    before = voxels_of(path)
    changed(path, tmp_path / "classes.seg.nrrd", change)
    again = imported(files, tmp_path / "again", tmp_path / "classes.seg.nrrd")
    after, image = voxels_of(classes_of(again, tmp_path / "out")), sitk.ReadImage(str(path))
    where = inside(image, stone)
    assert (after[where] == CODE["stone"]).all() and np.array_equal(after[~where], before[~where])
    (note,) = [each for each in read_findings(again).notes if each.startswith("not taken")]
    assert "fat is kidney" in note and "tumour is cyst" in note and "stone" not in note


def test_a_class_image_may_be_cropped_and_have_layers_and_other_values(files, first, tmp_path):
    """As 3D Slicer writes it where segments overlap: the later layer has what was painted over the first."""
    _, path = first
    image = sitk.ReadImage(str(path))
    voxels = voxels_of(path)
    painted = inside(image, SPINE) & (voxels == CODE["bone"])
    first_layer = np.where(voxels == CODE["fat"], 77, voxels).astype(np.uint8)
    layers = sitk.JoinSeries(
        [
            with_information(sitk.GetImageFromArray(layer), image)
            for layer in (first_layer, painted.astype(np.uint8))
        ]
    )
    both = sitk.GetImageFromArray(np.moveaxis(sitk.GetArrayFromImage(layers), 0, -1), isVector=True)
    both = with_information(both, image)
    for key in image.GetMetaDataKeys():
        both.SetMetaData(key, image.GetMetaData(key))
    names = {name: n for n, name in enumerate(segments_of(path))}
    both.SetMetaData(f"Segment{names['fat']}_LabelValue", "77")
    both.SetMetaData(f"Segment{names['liver']}_LabelValue", "1")
    both.SetMetaData(f"Segment{names['liver']}_Layer", "1")
    low = [n // 4 for n in image.GetSize()]
    sitk.WriteImage(both[low[0] :, low[1] :, low[2] :], str(tmp_path / "b.seg.nrrd"), useCompression=True)
    again = imported(files, tmp_path / "again", tmp_path / "b.seg.nrrd")
    wanted = voxels.copy()
    part = tuple(slice(n, None) for n in low[::-1])
    wanted[part][painted[part]] = CODE["liver"]
    assert np.array_equal(voxels_of(classes_of(again, tmp_path / "out")), wanted)


def with_information(new, image):
    new.CopyInformation(image)
    return new


def test_a_class_image_alone_is_no_organ(files, first, tmp_path, capsys):
    assert main(["import", str(files[0]), str(first[1]), "--out", str(tmp_path / "a")]) == 2
    message = capsys.readouterr().err
    assert (
        message.count("\n") == 1 and "class image alone" in message and "give the kidney's labels" in message
    )


def test_what_was_drawn_in_a_corrected_tissue_is_corrected_with_it(tmp_path):
    """Layers in a muscle that is a liver: 3D Slicer shows them as a segment of their own, which nobody
    needs to paint over.
    """
    grid, hu, coded = made(THIN, ENHANCED_HU, [])
    hu[points_of(grid.image(coded))[..., 1] > KIDNEY[0][1] + KIDNEY[1][1] + 6] = 60.0
    own = codes_of_labels(coded.transpose(2, 1, 0), {1: "kidney"})
    ct = np.ascontiguousarray(hu.transpose(2, 1, 0), np.float32)
    drawn, bare = (tissue_map(ct, own, organ(), grid.index_from_mm, draws) for draws in (True, False))
    assert (drawn.mask("perimysium") & drawn.drawn).sum() > 1000
    sitk.WriteImage(class_image(drawn), str(tmp_path / "a.seg.nrrd"))

    def change(voxels, image):
        voxels[voxels == CODE["muscle"]] = CODE["liver"]

    changed(tmp_path / "a.seg.nrrd", tmp_path / "b.seg.nrrd", change)
    classes = open_labels(tmp_path / "b.seg.nrrd").maps(grid)
    corrections, _ = corrections_of(grid, hu, coded, {1: "kidney"}, organ(), classes)
    found = sitk.GetArrayFromImage(corrections).transpose(2, 1, 0)
    assert np.array_equal(found == CODE["liver"], bare.mask("muscle")) and set(np.unique(found)) == {
        0,
        CODE["liver"],
    }
    again = with_corrections(drawn, found, drawn.index_from_mm, {CODE["liver"]: "liver"})
    assert not again.mask("perimysium", "muscle").any()
    assert np.array_equal(again.drawn, drawn.drawn & ~drawn.mask("perimysium"))
