"""Region growing from a seed: synthetic bodies known in LPS mm, the phantom, and real CTs with labels
where they are there.
"""

from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from scipy import ndimage
from synthetic_body import DIRECTIONS, grid_around, level, points_of

from errors import PatientError
from scenes.anatomy import files_of
from scenes.patients.readers.ct_series import open_ct
from scenes.patients.readers.label_maps import LabelMap, box_of, resample_nearest
from scenes.patients.region_growing import DRAFT, WORKING_MM, draft_segmentation
from scenes.scene import EMBEDDED, load_scene
from scenes.volumes.lazy_volume import LazyVolume
from scenes.volumes.volume_files import file_volume
from scenes.volumes.voxel_grid import VoxelGrid

CENTRE = np.array([62.0, 31.0, -118.0])
KIDNEY = CENTRE, np.array([30.0, 24.0, 52.0])
KIDNEY_ML = 4 / 3 * np.pi * KIDNEY[1].prod() / 1000
# Both touch the kidney and go on beyond the CT: over 2 % of its surface, and 5 % (or 11 %, pressed on it).
PSOAS = CENTRE + [-46.0, 14.0, 0.0], np.array([20.0, 20.0, 400.0])
LIVER = CENTRE + [27.0, -66.0, 56.0], np.array([75.0, 60.0, 60.0])
PRESSED = CENTRE + [25.0, -60.0, 55.0], LIVER[1]
WRAPPED = CENTRE + [58.0, -25.0, 25.0], np.array([58.0, 72.0, 72.0])  # over 27 % of the kidney's surface
VESSEL = CENTRE + [-40.0, -40.0, 0.0], np.array([9.0, 9.0, 1e4])
RIB = CENTRE + [10.0, 50.0, 0.0], np.array([8.0, 8.0, 1e4])
CYST = CENTRE + [50.0, 30.0, -50.0], np.array([13.0, 13.0, 13.0])
GAS = CENTRE + [40.0, -40.0, -40.0], np.array([12.0, 12.0, 12.0])
FAT_HU = -100.0
# A surface that is everywhere one working voxel off changes the volume by twice this share, and Dice by about
# it.
ONE_VOXEL = 0.5 * WORKING_MM * (1 / KIDNEY[1]).sum()


def scanned(solids, noise_hu=10.0, direction="identity", spacing=(1.8, 1.8, 2.5), half_mm=60.0):
    """A CT of fat with solids (HU, (centre, half-axes)) painted in turn, and noise."""
    image = grid_around(CENTRE - half_mm, CENTRE + half_mm, spacing, DIRECTIONS[direction])
    points = points_of(image)
    hounsfield = np.full(points.shape[:3], FAT_HU)
    for hu, solid in solids:
        hounsfield[level(points, solid) < 0] = hu
    hounsfield += np.random.default_rng(5).normal(0.0, noise_hu, hounsfield.shape)
    return VoxelGrid.of(image).image(np.rint(hounsfield).astype(np.int16))


def placed(labels: LabelMap, grid: VoxelGrid) -> np.ndarray:
    return resample_nearest(labels.grid, labels.values, grid) > 0


def dice(a, b):
    return 2 * (a & b).sum() / (a.sum() + b.sum())


def seeds_in(grid: VoxelGrid, inside: np.ndarray, count: int, deep_mm: float = 5.0):
    """Places at random, deeper in what is labelled than stated."""
    box = box_of(inside)[::-1]
    # A rim of nothing, and what is labelled is as deep as in the whole.
    piece = np.pad(inside[box], 1)
    found = np.argwhere(ndimage.distance_transform_edt(piece, sampling=grid.spacing[::-1]) > deep_mm)
    deep = found + [axis.start - 1 for axis in box]
    return grid.place(np.random.default_rng(11).permutation(deep)[:count, ::-1])


def refused(ct, seed, words):
    with pytest.raises(PatientError, match=words) as error:
        draft_segmentation(LazyVolume.of(ct), seed)
    # Deeper is no help from a seed in good parenchyma.
    assert "\n" not in str(error.value) and "seed" in str(error.value) and "deeper" not in str(error.value)


@pytest.fixture(scope="module")
def crowded():
    solids = (60.0, PSOAS), (110.0, LIVER), (160.0, VESSEL), (700.0, RIB), (10.0, CYST), (-950.0, GAS)
    return scanned([*solids, (150.0, KIDNEY)])


@pytest.fixture(scope="module")
def coarse():
    """An unenhanced CT, and the kidney in it from a seed in the middle."""
    ct = scanned(
        [(55.0, PSOAS), (58.0, PRESSED), (30.0, KIDNEY)], 12.0, spacing=(3.0, 3.0, 3.0), half_mm=70.0
    )
    return ct, draft_segmentation(LazyVolume.of(ct), CENTRE)


class TestSynthetic:
    # HU of kidney and liver, noise, and the seed from the centre: enhanced, also beside a large liver; the
    # same HU; unenhanced, the kidney darkest.
    @pytest.mark.parametrize(
        "kidney, liver, touching, noise, off",
        [
            (150.0, 110.0, PRESSED, 20.0, (12.0, -6.0, -30.0)),
            (150.0, 110.0, WRAPPED, 15.0, (12.0, -6.0, -30.0)),
            (105.0, 105.0, LIVER, 12.0, (12.0, -6.0, -30.0)),
            (30.0, 58.0, PRESSED, 12.0, (0.0, 0.0, 0.0)),
        ],
    )
    def test_parts_from_what_touches(self, kidney, liver, touching, noise, off):
        ct = scanned([(55.0, PSOAS), (liver, touching), (kidney, KIDNEY)], noise)
        labels = draft_segmentation(LazyVolume.of(ct), CENTRE + off)
        truth = level(points_of(ct), KIDNEY) < 0
        assert dice(placed(labels, VoxelGrid.of(ct)), truth) > 1 - ONE_VOXEL
        assert labels.segments == {1: DRAFT} and labels.segments[1].tissue == "kidney"

    # Unenhanced, in voxels of 3 mm: from the surface inwards, the HU fall to those of fat.
    @pytest.mark.parametrize("deep_mm", [0.5, 1.5])
    def test_the_kidney_does_not_depend_on_the_depth_of_the_seed(self, coarse, deep_mm):
        ct, expected = coarse
        found = draft_segmentation(LazyVolume.of(ct), CENTRE + [0.0, KIDNEY[1][1] - deep_mm, 0.0])
        grid = VoxelGrid.of(ct)
        assert dice(placed(found, grid), placed(expected, grid)) > 1 - 0.5 * ONE_VOXEL

    def test_from_a_pyramid_as_dark_as_the_liver_the_liver_is_left_out(self):
        """The bands of the pyramid hold the liver; those of the whole organ, which are tried then, do not."""
        pyramid = CENTRE, np.array([9.0, 9.0, 9.0])
        ct = scanned([(55.0, PSOAS), (80.0, WRAPPED), (150.0, KIDNEY), (80.0, pyramid)], 15.0)
        truth = level(points_of(ct), KIDNEY) < 0
        assert (
            dice(placed(draft_segmentation(LazyVolume.of(ct), CENTRE), VoxelGrid.of(ct)), truth)
            > 1 - ONE_VOXEL
        )

    def test_sinus_that_opens_to_the_outside_is_filled(self):
        sinus = CENTRE, np.array([8.0, 8.0, 12.0])
        hilum = CENTRE + [-20.0, 0.0, 0.0], np.array([20.0, 3.0, 3.0])
        ct = scanned([(150.0, KIDNEY), (FAT_HU, sinus), (FAT_HU, hilum)])
        found = placed(draft_segmentation(LazyVolume.of(ct), CENTRE + [12.0, -6.0, -30.0]), VoxelGrid.of(ct))
        assert found[level(points_of(ct), sinus) < 0].all()

    @pytest.mark.parametrize("direction", ["RAS", "oblique"])
    def test_lies_where_the_kidney_is(self, direction):
        ct = scanned([(150.0, KIDNEY)], direction=direction)
        labels = draft_segmentation(LazyVolume.of(ct), CENTRE + [8.0, -4.0, 20.0])
        places = labels.grid.place(np.argwhere(labels.values)[:, ::-1])
        np.testing.assert_allclose(places.mean(axis=0), CENTRE, atol=0.5 * WORKING_MM)
        volume_ml = len(places) * np.prod(labels.grid.spacing) / 1000
        assert volume_ml == pytest.approx(KIDNEY_ML, rel=ONE_VOXEL)  # half a working voxel off
        assert np.allclose(labels.grid.spacing, ct.GetSpacing())
        start = VoxelGrid.of(ct).index(labels.grid.origin[None])  # on the CT's own voxels
        np.testing.assert_allclose(start, np.rint(start), atol=1e-6)

    def test_same_seed_same_voxels(self):
        ct = scanned([(150.0, KIDNEY)], spacing=(3.0, 3.0, 3.0))
        first, second = (draft_segmentation(LazyVolume.of(ct), CENTRE) for _ in range(2))
        assert first.grid.same_as(second.grid)
        np.testing.assert_array_equal(first.values, second.values)

    def test_reads_only_around_the_seed(self, monkeypatch):
        monkeypatch.setattr("scenes.patients.region_growing.REACH_MM", 65.0)
        image = scanned([(150.0, KIDNEY)], spacing=(3.0, 3.0, 3.0), half_mm=80.0)
        whole, read = LazyVolume.of(image), []  # a view: the image has to stay
        ct = LazyVolume(whole.name, whole.grid, lambda box: (read.append(box), whole.read_box(box))[1])
        draft_segmentation(ct, CENTRE)
        assert len(read) == 1
        assert all((a.stop - a.start - 2) * 3.0 <= 2 * 65.0 for a in read[0])


class TestRefused:
    @pytest.mark.parametrize(
        "where, words",
        [
            (CENTRE + [0.0, 0.0, 300.0], "outside the CT"),
            (CENTRE * [-1.0, -1.0, 1.0], "outside the CT.*RAS"),
            (np.array([np.nan, 0.0, 0.0]), "outside the CT"),
            (GAS[0], "in air, -"),
            (CENTRE + [-10.0, -40.0, -40.0], "in fat, -"),
            (CENTRE + [KIDNEY[1][0] + 4.0, 0.0, 0.0], "in fat, -"),  # the kidney is near
            (RIB[0], "in bone"),
            (VESSEL[0] + [0.0, 0.0, -40.0], "goes on .* into tissue of 1[0-9]+ HU"),
            (PSOAS[0], "cut off at the border"),
            (CYST[0], "only [0-9]+ ml"),
        ],
    )
    def test_seed_in_something_else(self, crowded, where, words):
        refused(crowded, where, words)

    def test_liver_of_the_same_hu_pressed_on_it(self):
        refused(
            scanned([(105.0, PRESSED), (105.0, KIDNEY)], half_mm=70.0),
            CENTRE,
            "goes on to the front and to the head into tissue of 105 HU",
        )

    @pytest.mark.parametrize("direction", ["identity", "slices first"])
    def test_liver_that_is_hardly_darker_is_told_by_its_side(self, direction):
        ct = scanned([(112.0, WRAPPED), (140.0, KIDNEY)], direction=direction)
        refused(
            ct,
            CENTRE,
            "edge on [78][0-9]% of its surface.*; to the patient's left and to the head, tissue of like "
            "HU.*farther from there",
        )

    def test_kidney_in_one_with_its_neighbours(self):
        muscle = CENTRE, np.array([70.0, 60.0, 70.0])
        ct = scanned([(60.0, muscle), (62.0, KIDNEY)], half_mm=70.0)
        refused(ct, CENTRE, "goes on .* into tissue of 60 HU")

    def test_kidney_that_the_ct_cuts_off(self):
        cut = CENTRE + [0.0, 0.0, 60.0], KIDNEY[1]
        refused(scanned([(150.0, cut)]), cut[0], "border")

    def test_what_has_no_kidneys_shape(self):
        bars = [np.array([60.0, 11.0, 11.0]), np.array([11.0, 60.0, 11.0]), np.array([11.0, 11.0, 60.0])]
        refused(scanned([(120.0, (CENTRE, bar)) for bar in bars]), CENTRE, "convex hull")


def test_phantom():
    """Seeds are in cortex and medulla; the tumour, the sinus and its fat belong to the organ and may be
    missed.
    """
    folder, files = files_of(load_scene(EMBEDDED), EMBEDDED.parent)
    ct, labels = (file_volume(folder / name) for name in (files.ct, files.labels))
    tissue = labels.read(labels.grid.full_box())
    firm = [int(code) for code, name in files.tissues.items() if name in ("cortex", "medulla")]
    (seed,) = seeds_in(ct.grid, np.isin(tissue, firm), count=1, deep_mm=3.0)
    assert dice(placed(draft_segmentation(ct, seed), ct.grid), tissue > 0) > 0.9


class TestReal:
    # Of 16 to 28 seeds a kidney the least was 0.94 (enhanced, by a label that is threshold and growing
    # itself) and 0.86
    # (unenhanced, 3 mm, an extrarenal pelvis at the right one).
    @pytest.mark.parametrize(
        "ct, kidneys, value, least",
        [
            ("crlm_1004", "crlm_1004_labels/kidneys_provisional.nii.gz", 1, 0.9),
            ("totalseg/ct.nii.gz", "totalseg/kidneys.nii.gz", 2, 0.8),
        ],
    )
    def test_kidney(self, data: Path, ct, kidneys, value, least):
        volume = open_ct(data / "ct" / ct)
        image = sitk.ReadImage(str(data / "ct" / kidneys))
        grid, truth = VoxelGrid.of(image), sitk.GetArrayFromImage(image) == value
        (seed,) = seeds_in(grid, truth, count=1)
        assert dice(placed(draft_segmentation(volume, seed), grid), truth) > least

    def test_spleen_and_kidney_in_one_refused(self, data: Path):
        volume = open_ct(data / "ct" / "crlm_1004")
        with pytest.raises(PatientError, match="an edge on 8[0-4]% of its surface"):
            draft_segmentation(volume, volume.grid.place(np.array([390.0, 290.0, 22.0])))
