"""B-mode images of patients: figures of truths made by hand, a made CT, a real one where it is, and the
command.
"""

import json
from itertools import islice

import numpy as np
import pytest
import SimpleITK as sitk
import trimesh
from conftest import DATA
from ellipsoid_kidney import HALF_AXES, in_ellipsoid
from PIL import Image
from scipy import ndimage
from scipy.stats import norm
from study_runs import refusal

import app
from scenes.anatomy import Grid, LoadedAnatomy
from scenes.patients.organ_selection import find_organs
from scenes.patients.part_surfaces import organ_surface
from scenes.patients.readers.ct_series import open_ct
from scenes.patients.readers.label_maps import LabelMap
from scenes.scene import AnatomyFiles, Scene
from studies.echo.echo_phantom import EchoPhantom
from studies.image_quality import depth_of_noise_mm, snr_db
from studies.patient_images import patient_image_scans
from studies.patient_images.image_figures import (
    agent_figures,
    capsule_figures,
    level_at_like_depth,
    picture_figures,
    roc_area,
)
from studies.patient_images.image_sheet import COLOURS, coloured
from studies.patient_images.kidney_outline import closed, dice, kidney_contour, outlined_kidney
from studies.patient_images.patient_image_scans import ImagedPatient, standard_planes
from studies.patient_images.patient_images_command import COLUMNS
from studies.patient_images.patient_truth import (
    PatientTruth,
    ScanlineTruth,
    incidence_deg,
    on_scanlines,
    picture_truth,
    pixel_places,
    sample_depths,
)
from ultrasound.acoustics import CORTEX_DB, acoustic_table, tissue_table
from ultrasound.probe import load_probe
from ultrasound.scanned_anatomy import ScannedAnatomy

RADIUS = 25.0
FAT, KIDNEY, BONE, GAS = -100.0, 30.0, 800.0, -1000.0
# What a curved array sees beside and behind a kidney.
AROUND_MM = 50.0


class TestPictureFigures:
    @pytest.mark.parametrize("apart", [0.0, 1.0, 2.5])
    def test_the_area_under_the_curve_is_that_of_two_normal_distributions(self, apart):
        draw = np.random.default_rng(1)
        brighter, darker = draw.normal(apart, 1, 20_000), draw.normal(0, 1, 20_000)
        # Its standard error is below 1 / sqrt(12 * 20 000 / 2).
        assert roc_area(brighter, darker) == pytest.approx(norm.cdf(apart / np.sqrt(2)), abs=0.01)

    def test_a_few_pixels_are_no_area(self):
        assert np.isnan(roc_area(np.ones(199), np.zeros(1000)))
        assert roc_area(np.ones(200), np.zeros(1000)) == 1.0 and roc_area(np.ones(200), np.ones(200)) == 0.5


class TestOutline:
    PIXEL = 0.5, 0.4

    def ellipse(self, centre, half, shape=(150, 200)):
        row, column = np.indices(shape)
        return ((row - centre[0]) * self.PIXEL[0] / half[0]) ** 2 + (
            (column - centre[1]) * self.PIXEL[1] / half[1]
        ) ** 2 <= 1

    def picture(self, kidney, sinus, contrast):
        """Kidney darker than what is around it, a bright sinus, and what averaging leaves of speckle."""
        image = np.where(kidney & ~sinus, 60.0, 60.0 + contrast)
        return image + np.random.default_rng(0).normal(0, 6, image.shape)

    def outline(self, image, covered=None):
        return outlined_kidney(
            image, np.ones(image.shape, bool) if covered is None else covered, (70, 100), self.PIXEL
        )

    def test_a_kidney_that_is_darker_is_outlined_with_its_sinus(self):
        kidney, sinus = self.ellipse((70, 100), (20, 34)), self.ellipse((75, 100), (6, 14))
        assert dice(self.outline(self.picture(kidney, sinus, 60.0)), kidney) > 0.9

    def test_a_gap_of_the_bright_fat_is_bridged(self):
        kidney, fat = self.ellipse((70, 100), (20, 34)), self.ellipse((70, 100), (26, 40))
        # Below the kidney there is no fat over 12 mm, and beyond the fat it is as dark as in the kidney.
        fat[110:, 85:115] = False
        image = self.picture(~fat | kidney, np.zeros_like(kidney), 60.0)
        assert dice(self.outline(image), kidney) > 0.9

    def test_a_kidney_that_the_scanlines_do_not_reach_everywhere_is_outlined(self):
        kidney, sinus = self.ellipse((70, 100), (25, 50)), self.ellipse((75, 100), (6, 14))
        covered = np.ones(kidney.shape, bool)
        covered[80:, 120:135] = False
        image = np.where(covered, self.picture(kidney, sinus, 60.0), 0.0)
        assert dice(self.outline(image, covered), kidney & covered) > 0.9

    def test_without_contrast_it_is_not(self):
        kidney, sinus = self.ellipse((70, 100), (20, 34)), self.ellipse((75, 100), (6, 14))
        assert dice(self.outline(self.picture(kidney, sinus, 0.0)), kidney) < 0.8

    def test_dice_of_shifted_squares(self):
        one, other = np.zeros((2, 30, 30), bool)
        one[5:15, 5:15], other[5:15, 10:20] = True, True
        assert dice(one, other) == 0.5 and dice(one, one) == 1.0 and np.isnan(dice(one & ~one, one & ~one))

    def test_a_gap_is_closed_and_an_edge_stays(self):
        gap = np.ones((150, 200), bool)
        gap[60:68] = False
        assert closed(gap, 6.0, self.PIXEL).all()
        half = np.zeros((150, 200), bool)
        half[:70] = True
        np.testing.assert_array_equal(closed(half, 6.0, self.PIXEL), half)

    def test_the_contour_of_parenchyma_includes_the_sinus(self):
        kidney = self.ellipse((75, 100), (25, 34))
        sinus = self.ellipse((75, 100), (8, 15))
        mouth = np.zeros_like(kidney)
        mouth[67:83, 100:] = True
        label = kidney & ~sinus & ~mouth
        assert dice(label, kidney) < 0.9 < 0.97 < dice(kidney_contour(label, self.PIXEL), kidney)


def ball_anatomy(*, plate=None, agent=None, kidney_hu=KIDNEY):
    """A kidney that is a ball of RADIUS about the origin in fat, 1 mm voxels; beyond 40 mm water.

    A plate: (lowest y, highest y, HU).
    """
    place = np.moveaxis(np.indices((101, 101, 101)), 0, -1) - 50.0
    away = np.linalg.norm(place, axis=-1)
    hu = np.select([away <= RADIUS, away <= 40], [kidney_hu, FAT], 0.0).astype(np.float32)
    if plate is not None:
        hu[(place[..., 1] >= plate[0]) & (place[..., 1] <= plate[1]) & (place[..., 0] > 3)] = plate[2]
    if agent is not None:
        hu[away <= agent] = kidney_hu + 300
    index_from_mm = np.eye(4)
    index_from_mm[:3, 3] = 50
    organ = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    return ScannedAnatomy(organ, hu, index_from_mm, (away <= RADIUS).astype(np.int32), {1: "kidney"})


def pose_above(depth_mm):
    """Beam towards +y, lateral +x, the face so far before the origin."""
    pose = np.eye(4)
    pose[:3, 3] = 0, -depth_mm, 0
    return pose


class TestTruth:
    def test_the_masks_are_those_of_a_ball(self, device):
        probe, pose = load_probe("linear"), pose_above(30.0)
        truth = picture_truth(PatientTruth.of(ball_anatomy()), probe, pose, (300, 200))
        place = pixel_places(probe, (300, 200))
        away = np.hypot(place[..., 0], place[..., 1] - 30.0)
        sure = np.abs(away - RADIUS) > 0.75
        assert (truth.kidney == (away < RADIUS))[sure].all()
        assert truth.seen.all()
        deep = (place[..., 1] >= 4) & (place[..., 1] <= 45)
        near = (away > RADIUS) & (away < RADIUS + 12)
        sure &= np.abs(away - RADIUS - 12) > 0.75
        assert (truth.judged_kidney == (deep & (away < RADIUS)))[sure].all()
        assert (truth.surroundings == (deep & near))[sure].all()
        # At the kidney's border the CT is between both.
        assert (truth.fat == truth.surroundings)[away > RADIUS + 2].all() and not truth.fat[
            ~truth.surroundings
        ].any()

    @pytest.mark.parametrize("hu", [BONE, GAS])
    def test_behind_gas_and_bone_nothing_is_judged(self, device, hu):
        probe, pose = load_probe("linear"), pose_above(40.0)
        patient = PatientTruth.of(ball_anatomy(plate=(-32.0, -30.0, hu)))
        hidden = patient.hidden_from_mm(probe, pose)
        x = probe.elements()[:, 0]
        # The plate begins 3 mm to the side and 8 mm deep; between voxels the CT is linear.
        assert np.isinf(hidden[x < 2.5]).all()
        assert hidden[x > 3.8] == pytest.approx(8.0, abs=1.0)
        truth = picture_truth(patient, probe, pose, (300, 200))
        place = pixel_places(probe, (300, 200))
        behind = (place[..., 0] > 3.8) & (place[..., 1] > 9)
        assert not truth.seen[behind].any() and not truth.judged_kidney[behind].any()
        assert truth.seen[(place[..., 0] < 2.0)].all()

    def test_contrast_agent_is_no_bone_and_a_stone_is(self, device):
        probe, pose = load_probe("linear"), pose_above(30.0)
        enhanced = PatientTruth.of(ball_anatomy(agent=6.0, kidney_hu=180.0))
        assert np.isinf(enhanced.hidden_from_mm(probe, pose)).all()
        truth = picture_truth(enhanced, probe, pose, (300, 200))
        place = pixel_places(probe, (300, 200))
        away = np.hypot(place[..., 0], place[..., 1] - 30.0)
        assert not truth.judged_kidney[away < 5].any() and truth.judged_kidney[(away > 7) & (away < 14)].all()
        stone = PatientTruth.of(ball_anatomy(agent=6.0))
        assert stone.hidden_from_mm(probe, pose)[probe.number_of_scanlines // 2] == pytest.approx(24.0, abs=1)
        assert (stone.agent_mm.values > 0).all()

    def test_incidence_is_that_on_a_ball(self, device):
        probe, pose = load_probe("linear"), pose_above(30.0)
        patient = PatientTruth.of(ball_anatomy())
        x = probe.elements()[:, 0]
        depth = 30.0 - np.sqrt(RADIUS**2 - x**2)
        at = np.argmin(np.abs(sample_depths(probe) - depth[:, None]), axis=1)
        place = on_scanlines(probe, pose, sample_depths(probe))[np.arange(len(x)), at][:, None]
        along = np.tile([0.0, 1.0, 0.0], (len(x), 1))
        found = incidence_deg(patient, place, along)[:, 0]
        # Distances are interpolated between points 1 mm apart, and the ball has facets of 2 mm.
        assert found == pytest.approx(np.degrees(np.arcsin(np.abs(x) / RADIUS)), abs=2.5)


def scanline_truth(power, incidence=0.0, surface=10.0, back=40.0, agent=np.inf):
    """60 scanlines of 600 samples, 0.1 mm apart, through a kidney between two depths, with contrast agent
    from a depth on for 5 mm.
    """
    depth = (np.arange(600) + 0.5) * 0.1
    signed = np.maximum(surface - depth, depth - back)
    shape = 60, 600

    def wide(values):
        return np.broadcast_to(np.asarray(values, float), shape)

    agent_mm = np.maximum(agent - depth, depth - agent - 5.0) if np.isfinite(agent) else np.full(600, 99.0)
    hu = np.where(agent_mm < 0, 600.0, 180.0)
    everything = wide(signed), wide(incidence), wide(signed), wide(agent_mm), wide(hu)
    return ScanlineTruth(wide(power(depth)), depth, *everything, np.ones(shape, bool))


class TestScanlineFigures:
    def test_the_capsule_is_as_high_as_it_was_made(self):
        def with_capsule(ratio):
            return lambda depth: np.where(np.abs(depth - 40.0) < 0.25, ratio, 1.0)

        square = scanline_truth(with_capsule(10.0), incidence=4.0, surface=2.0)
        aslant = scanline_truth(with_capsule(2.0), incidence=17.0, surface=2.0)
        between = scanline_truth(with_capsule(1000.0), incidence=12.0, surface=2.0)
        found = capsule_figures([square, aslant, between])
        assert found["capsule_db"] == pytest.approx(10.0)
        assert found["capsule_aslant_db"] == pytest.approx(10 * np.log10(2.0))
        assert found["capsule_control_db"] == pytest.approx(0.0)

    def test_both_sides_are_pooled_by_mean_power_but_not_the_first_millimetres(self):
        def capsules(depth):
            return np.select([np.abs(depth - 10) < 0.25, np.abs(depth - 40) < 0.25], [30.0, 10.0], 1.0)

        assert capsule_figures([scanline_truth(capsules)])["capsule_db"] == pytest.approx(10 * np.log10(20))
        near = scanline_truth(lambda depth: capsules(depth + 7), surface=3.0, back=33.0)
        assert capsule_figures([near])["capsule_db"] == pytest.approx(10.0)

    def test_where_it_is_not_crossed_there_is_no_figure(self):
        nothing = capsule_figures([scanline_truth(np.ones_like, incidence=50.0)])
        assert np.isnan(list(nothing.values())).all()

    def test_the_greatest_of_speckle_is_its_own_control(self):
        """Of n independent samples of exponential power the greatest is on average the n-th harmonic
        number.
        """
        draw = np.random.default_rng(4)
        truth = scanline_truth(np.ones_like)
        speckle = ScanlineTruth(draw.exponential(1.0, (60, 600)), *list(vars(truth).values())[1:])
        found = capsule_figures([speckle] * 3)
        harmonic = (1 / np.arange(1, 21)).sum()
        assert found["capsule_control_db"] == pytest.approx(10 * np.log10(harmonic), abs=0.5)
        assert found["capsule_db"] == pytest.approx(10 * np.log10(harmonic), abs=0.5)

    def patient(self):
        class Truth:
            median_hu = 180.0

        return Truth()

    def test_contrast_agent_and_what_is_behind_it_against_like_depth(self):
        def falling(depth):
            # Within a bin of depth, 0.1 dB.
            return 10 ** (-depth / 200)

        def with_agent(depth):
            steps = [(depth >= 20) & (depth < 25), depth >= 25]
            return falling(depth) * np.select(steps, [10**-2.0, 10**0.4], 1.0)

        found = agent_figures(
            [scanline_truth(falling), scanline_truth(with_agent, agent=20.0)], self.patient()
        )
        assert found["agent_db"] == pytest.approx(-20.0, abs=0.1)
        assert found["behind_agent_db"] == pytest.approx(4.0, abs=0.1)

    def test_without_agent_there_is_no_figure(self):
        assert np.isnan(list(agent_figures([scanline_truth(np.ones_like)], self.patient()).values())).all()

    def test_levels_are_compared_at_like_depth(self):
        draw = np.random.default_rng(2)
        shallow, deep = draw.uniform(0, 30, 5000), draw.triangular(0, 30, 30, 5000)
        level = level_at_like_depth(2 * 10 ** (-deep / 10), deep, 10 ** (-shallow / 10), shallow)
        # Within a bin of 2 mm, 2 dB, both are distributed almost alike.
        assert level == pytest.approx(10 * np.log10(2), abs=0.2)
        assert np.isnan(level_at_like_depth(np.ones(50), np.full(50, 5.0), np.ones(50), np.full(50, 9.0)))


class TestSignalToNoise:
    @pytest.mark.parametrize("name", ["drop-in", "linear", "curvilinear"])
    def test_a_rendered_block_has_the_closed_form(self, device, name):
        probe = load_probe(name)
        phantom = EchoPhantom(probe)
        _, attenuation, level_db, _ = acoustic_table("cortex")
        phantom.fill(attenuation=attenuation, backscatter=10 ** ((CORTEX_DB + level_db) / 20))
        with_noise = phantom.amplitude() ** 2
        silent = phantom.amplitude(probe=probe.model_copy(update={"noise_db": -200.0})) ** 2
        phantom.fill(attenuation=attenuation)
        noise = phantom.amplitude() ** 2
        middle = slice(probe.number_of_scanlines // 4, -probe.number_of_scanlines // 4)
        for share in (0.4, 0.6, 0.8):
            depth = share * probe.depth_mm
            window = np.abs(phantom.depth_mm - depth) < 3.0
            signal, own, both = (each[middle, window].mean() for each in (silent, noise, with_noise))
            # A thousand speckles, whose mean power has an error of 3 %; tissue samples are up to half a voxel
            # deeper.
            assert 10 * np.log10(signal / own) == pytest.approx(snr_db(probe, depth), abs=0.8)
            assert both == pytest.approx(signal + own, rel=0.1)

    @pytest.mark.parametrize("name", ["drop-in", "linear", "curvilinear"])
    def test_at_the_depth_of_the_noise_it_is_zero(self, name):
        probe = load_probe(name)
        assert snr_db(probe, depth_of_noise_mm(probe)) == pytest.approx(0.0, abs=0.01)
        quieter = probe.model_copy(update={"noise_db": -200.0})
        assert np.isnan(depth_of_noise_mm(quieter)) or depth_of_noise_mm(quieter) > depth_of_noise_mm(probe)


class TestPlanes:
    @pytest.mark.parametrize("name", ["drop-in", "curvilinear"])
    def test_the_face_touches_the_organ(self, name):
        organ = trimesh.creation.icosphere(subdivisions=5, radius=1.0).apply_scale(HALF_AXES)
        probe = load_probe(name)
        planes = standard_planes(organ, None, probe)
        assert len(planes) == 8
        for pose in planes.values():
            assert pose[:3, :3] @ pose[:3, :3].T == pytest.approx(np.eye(3), abs=1e-9)
            face = on_scanlines(probe, pose, np.zeros(1))[:, 0]
            # The face is 4 mm high: where the beam is aslant on the surface, the middle of it is off by up to
            # 2 mm times the slope.
            assert -0.05 < in_ellipsoid(face).min() < 0.6

    def test_front_is_the_patients_front_and_the_side_is_opposite_the_hilum(self):
        organ = trimesh.creation.icosphere(subdivisions=5, radius=1.0).apply_scale(HALF_AXES)
        hollow = trimesh.creation.icosphere(subdivisions=4, radius=12.0).apply_translation([-28.0, 0, 0])
        kidney = trimesh.boolean.difference([organ, hollow])
        planes = standard_planes(kidney, [-28.0, 0.0, 0.0], load_probe("drop-in"))
        beams = {name: pose[:3, 1] for name, pose in planes.items()}
        assert beams["front, long axis"] == pytest.approx([0, 1, 0], abs=0.1)
        assert beams["back, short axis"] == pytest.approx([0, -1, 0], abs=0.1)
        assert beams["side, long axis"] == pytest.approx([-1, 0, 0], abs=0.1)
        assert beams["lower pole"] == pytest.approx([0, 0, 1], abs=0.1)


def made_patient():
    """A small CT, unenhanced, in which the kidney alone is labelled: an ellipsoid in fat, before muscle,
    with bowel gas.
    """
    spacing = np.array([1.5, 1.5, 3.0])
    count = np.array([80, 80, 48])
    low = -spacing * (count - 1) / 2
    place = low + spacing * np.moveaxis(np.indices(count), 0, -1)
    signed = in_ellipsoid(place.reshape(-1, 3)).reshape(count)
    gas = np.linalg.norm(place - [30.0, -45.0, 20.0], axis=-1) < 6
    hu = np.select([signed < 0, gas, place[..., 1] > 34], [KIDNEY, GAS, 60.0], FAT)
    hu = hu + np.random.default_rng(0).normal(0, 8, hu.shape)
    index_from_mm = np.diag([*(1 / spacing), 1.0])
    index_from_mm[:3, 3] = -low / spacing
    organ = trimesh.creation.icosphere(subdivisions=4, radius=1.0).apply_scale(HALF_AXES)
    return LoadedAnatomy(
        organ,
        None,
        Grid(hu.astype(np.float32), index_from_mm),
        (),
        Grid((signed < 0).astype(np.float32), index_from_mm),
        {1: "kidney"},
    )


def write_patient(anatomy, folder):
    anatomy.organ.export(folder / "organ.stl")
    for name, grid in (("ct", anatomy.ct), ("labels", anatomy.labels)):
        image = sitk.GetImageFromArray(np.ascontiguousarray(grid.voxels.T.astype(np.int16)))
        mm_from_index = np.linalg.inv(grid.index_from_mm)
        image.SetSpacing(np.diag(mm_from_index)[:3].tolist())
        image.SetOrigin(mm_from_index[:3, 3].tolist())
        sitk.WriteImage(image, str(folder / f"{name}.nrrd"))
    (folder / "scene.toml").write_text(
        'title = "Left kidney"\n[anatomy]\norgan = "organ.stl"\nct = "ct.nrrd"\nlabels = "labels.nrrd"\n'
        '[anatomy.tissues]\n1 = "kidney"\n'
    )


def three_planes(*given):
    """Of the eight, from the front and the side: each takes a second."""
    return dict(islice(standard_planes(*given).items(), 3))


class TestMadePatient:
    @pytest.fixture(scope="class")
    def result(self, tmp_path_factory):
        folder, out = (tmp_path_factory.mktemp(name) for name in ("Nemo", "out"))
        write_patient(made_patient(), folder)
        arguments = ["study", "patient-images", str(folder), "--probe", "linear", "--out", str(out)]
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(patient_image_scans, "standard_planes", three_planes)
            assert app.main(arguments) == 0
        return out

    def test_what_is_not_labelled_can_be_told_from_the_kidney(self, result):
        (row,) = json.loads((result / "patient-images.json").read_text())["rows"]
        assert (row["patient"], row["title"], row["probe"]) == (1, "Left kidney", "linear")
        assert {form.strip("{}").split(":")[0] for form in COLUMNS.values()} == set(row)
        assert row["fat_auc"] > 0.85
        assert 0 <= row["outlined"] <= 1 and row["agent_db"] is None

    def test_the_sheet_shows_no_name_and_is_small(self, result):
        assert sorted(file.name for file in result.iterdir()) == [
            "patient-1-linear.png",
            "patient-images.csv",
            "patient-images.json",
        ]
        sheet = Image.open(result / "patient-1-linear.png")
        assert sheet.width >= 3 * 300 and (result / "patient-1-linear.png").stat().st_size < 1.5e6
        assert all(b"Nemo" not in file.read_bytes() for file in result.iterdir())

    def test_the_speckle_over_noise_is_in_the_report(self, result):
        (noise,) = json.loads((result / "patient-images.json").read_text())["speckle_over_noise"]
        assert noise["at_50_mm_db"] == pytest.approx(snr_db(load_probe("linear"), 50.0), abs=1e-5)

    def test_a_patient_without_ct_is_refused_in_words(self, tmp_path, capsys):
        trimesh.creation.icosphere(radius=20.0).export(tmp_path / "organ.stl")
        (tmp_path / "scene.toml").write_text('[anatomy]\norgan = "organ.stl"\n')
        line = refusal(capsys, "study", "patient-images", tmp_path, "--out", tmp_path / "out")
        assert "has no CT or no labels" in line

    def test_a_wrong_patient_is_refused_before_any_work(self, tmp_path, capsys):
        out = tmp_path / "out"
        write_patient(made_patient(), tmp_path)
        line = refusal(capsys, "study", "patient-images", tmp_path, tmp_path / "nobody", "--out", out)
        assert "nobody: no such scene" in line and not out.exists()


def test_every_tissue_has_a_colour():
    assert set(tissue_table()) - {"hounsfield"} <= set(COLOURS)
    assert (coloured(np.array([["fat", "?"]])) == [COLOURS["fat"], (70, 70, 70)]).all()


@pytest.mark.skipif(not (DATA / "ct").is_dir(), reason="real data (../shared/data/ct) is not here")
def test_a_real_kidneys_fat_is_brighter_than_it(device):
    """The unenhanced CT around the right kidney, two planes of eight."""
    labels = open_ct(DATA / "ct" / "totalseg/kidneys.nii.gz").image()
    near = around(sitk.GetArrayFromImage(labels) == 2, round(AROUND_MM / min(labels.GetSpacing())))
    ct, labels = (
        open_ct(DATA / "ct" / "totalseg" / name).image()[near] for name in ("ct.nii.gz", "kidneys.nii.gz")
    )
    right = find_organs(LabelMap.of(labels))[0]
    grids = [
        Grid(sitk.GetArrayFromImage(each).T.astype(np.float32), _index_from_mm(each)) for each in (ct, labels)
    ]
    grids[1] = Grid((grids[1].voxels == 2).astype(np.float32), grids[1].index_from_mm)
    anatomy = LoadedAnatomy(organ_surface(right), None, grids[0], (), grids[1], {1: "kidney"})
    scene = Scene(anatomy=AnatomyFiles(organ="organ.stl"))
    patient, probe = ImagedPatient.of(scene, anatomy), load_probe("curvilinear")
    assert patient.truth.median_hu < 60
    scans = list(islice(patient.scans(probe), 2))
    assert picture_figures(scans)["fat_auc"] > 0.85


def around(mask, voxels):
    """The box (x, y, z) around a mask (z, y, x), so many voxels wider."""
    box = ndimage.find_objects(mask.astype(np.uint8))[0]
    return tuple(slice(max(a.start - voxels, 0), a.stop + voxels) for a in box[::-1])


def _index_from_mm(image):
    mm_from_index = np.eye(4)
    mm_from_index[:3, :3] = np.array(image.GetDirection()).reshape(3, 3) * image.GetSpacing()
    mm_from_index[:3, 3] = image.GetOrigin()
    return np.linalg.inv(mm_from_index)
