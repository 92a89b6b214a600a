"""The embedded patient is a left kidney with a tumour, in LPS, in a contrast-enhanced CT."""

import numpy as np
import pytest
import SimpleITK as sitk
from scipy import ndimage
from skimage.morphology import ball, convex_hull_image

from scenes.phantom.embedded_patient import phantom_folder
from scenes.phantom.kidney import NOISE_SD, Label, make_phantom


@pytest.fixture(scope="module")
def phantom() -> tuple[sitk.Image, sitk.Image]:
    return make_phantom()


@pytest.fixture(scope="module")
def hu(phantom) -> np.ndarray:
    return sitk.GetArrayFromImage(phantom[0]).astype(np.float32)


@pytest.fixture(scope="module")
def labels(phantom) -> np.ndarray:
    return sitk.GetArrayFromImage(phantom[1])


@pytest.fixture(scope="module")
def spacing(phantom) -> float:
    return phantom[0].GetSpacing()[0]


def _positions(mask: np.ndarray, image: sitk.Image) -> np.ndarray:
    """LPS [mm] of the voxels of a mask, shape (n, 3)."""
    return np.argwhere(mask)[:, ::-1] * np.array(image.GetSpacing()) + np.array(image.GetOrigin())


def test_it_is_the_one_that_another_process_made(hu):
    kept = sitk.ReadImage(str(phantom_folder() / "ct.nrrd"))
    assert np.array_equal(sitk.GetArrayViewFromImage(kept), hu)


def test_grid_is_isotropic_lps_and_shared(phantom):
    ct, label_map = phantom
    assert ct.GetPixelID() == sitk.sitkInt16
    assert label_map.GetPixelID() == sitk.sitkUInt8
    assert ct.GetDirection() == (1, 0, 0, 0, 1, 0, 0, 0, 1)
    assert len(set(ct.GetSpacing())) == 1
    assert 0.8 <= ct.GetSpacing()[0] <= 1.0
    for of in ("GetSize", "GetSpacing", "GetOrigin", "GetDirection"):
        assert getattr(ct, of)() == getattr(label_map, of)()


# Voxels, and their mean place [mm].
PARTS = {
    Label.CORTEX: (161873, (63.67, 29.54, -327.46)),
    Label.MEDULLA: (38272, (68.42, 31.69, -327.32)),
    Label.SINUS: (16717, (59.15, 26.30, -328.76)),
    Label.URINE: (9218, (59.48, 26.65, -330.86)),
    Label.ARTERY: (2250, (57.85, 23.09, -331.16)),
    Label.VEIN: (2958, (61.60, 22.91, -331.39)),
    Label.TUMOUR: (10865, (84.07, 11.05, -344.30)),
}


def test_it_is_the_patient_of_the_documents(phantom, labels, hu):
    """Figures of the documents were measured on it: who changes it measures them anew.

    A few voxels are rounding.
    """
    for label, (count, place) in PARTS.items():
        own = labels == label
        assert own.sum() == pytest.approx(count, abs=4), label
        assert _positions(own, phantom[1]).mean(axis=0) == pytest.approx(place, abs=0.015), label
    assert set(np.unique(labels)) == set(Label)
    assert hu.mean() == pytest.approx(-1.706, abs=0.01)


def test_kidney_has_the_size_of_a_kidney(phantom, labels, spacing):
    assert 150 < (labels > 0).sum() * spacing**3 / 1000 < 190
    points = _positions(labels > 0, phantom[1])
    axes = np.linalg.svd(np.cov(points.T))[0]
    thickness, width, length = sorted(np.ptp(points @ axes, axis=0))
    assert 100 < length < 118
    assert 55 < width < 70
    assert 42 < thickness < 60  # with the bulge of the tumour


def test_tumour_is_25_mm_and_partly_exophytic(labels, spacing):
    tumour = labels == Label.TUMOUR
    diameter = (6 * tumour.sum() * spacing**3 / np.pi) ** (1 / 3)
    assert 22 < diameter < 28
    # What stands out is beyond the convex hull of the rest; every third voxel is enough for a share.
    coarse = np.s_[::3, ::3, ::3]
    rest = convex_hull_image(((labels > 0) & ~tumour)[coarse])
    assert 0.15 < (tumour[coarse] & ~rest).sum() / tumour[coarse].sum() < 0.6


def test_union_is_one_solid_without_cavities(labels):
    organ = labels > 0
    assert ndimage.label(organ)[1] == 1
    assert np.array_equal(ndimage.binary_fill_holes(organ), organ)


def test_union_is_nowhere_thin(labels, spacing):
    """A ball of 3 mm radius reaches all but 0.6 % of the organ, and the rest is within 3 mm of that."""
    organ = labels > 0
    thick = ndimage.binary_opening(organ, ball(round(3 / spacing)))
    assert (organ & ~thick).sum() < 0.006 * organ.sum()
    assert ndimage.distance_transform_edt(~thick, sampling=spacing)[organ].max() < 3


def test_organ_keeps_clear_of_the_border(labels):
    for axis in range(3):
        inside = np.flatnonzero((labels > 0).any(axis=tuple({0, 1, 2} - {axis})))
        assert inside[0] >= 8
        assert inside[-1] < labels.shape[axis] - 8


@pytest.mark.parametrize(
    ("label", "margin", "low", "high"),
    [
        (Label.CORTEX, 2, 170, 195),
        (Label.MEDULLA, 2, 100, 120),
        (Label.SINUS, 2, -115, -80),
        (Label.URINE, 2, 0, 20),
        (Label.ARTERY, 1, 145, 215),
        (Label.VEIN, 2, 175, 215),
        (Label.TUMOUR, 1, 70, 90),
    ],
)
def test_mean_attenuation_of_each_tissue(hu, labels, label, margin, low, high):
    """Away from its borders by more than the point spread, so that no neighbour is mixed in."""
    core = ndimage.binary_erosion(labels == label, iterations=margin)
    assert core.sum() > 20
    assert low < hu[core].mean() < high


def test_tumour_has_a_core_of_lower_attenuation(hu, labels):
    depth = ndimage.distance_transform_edt(labels == Label.TUMOUR)
    rim, core = hu[(depth > 2) & (depth < 6)], hu[depth > 0.75 * depth.max()]
    assert core.mean() < rim.mean() - 25


def test_noise_has_its_sd_and_is_correlated(hu, labels):
    """Differences over 4 voxels hold two independent draws of the noise, those of neighbours hold less."""
    cortex = ndimage.binary_erosion(labels == Label.CORTEX, iterations=2)

    def sd(lag: int) -> float:
        both = cortex[..., lag:] & cortex[..., :-lag]
        return (hu[..., lag:] - hu[..., :-lag])[both].std() / np.sqrt(2)

    assert 0.9 * NOISE_SD < sd(4) < 1.25 * NOISE_SD
    assert sd(1) < 0.8 * sd(4)


def test_calyces_and_vessels_lie_within_the_kidney_or_a_few_mm_out_of_the_hilum(phantom, labels):
    """All that is labelled beyond cortex and tumour is central; only the medial side may show it."""
    surface = (labels > 0) & ~ndimage.binary_erosion(labels > 0)
    shown = surface & np.isin(labels, (Label.SINUS, Label.URINE, Label.ARTERY, Label.VEIN))
    assert 20 < shown.sum() < 0.1 * surface.sum()
    assert _positions(shown, phantom[1])[:, 0].max() < _positions(labels > 0, phantom[1])[:, 0].mean()


def test_renal_vessels_run_on_to_the_aorta_without_a_label(phantom, hu, labels):
    beyond = (ndimage.gaussian_filter(hu, 0.7) > 130) & (labels == Label.OUTSIDE)
    parts, _ = ndimage.label(beyond)
    touching = np.unique(
        parts[ndimage.binary_dilation(np.isin(labels, (Label.ARTERY, Label.VEIN)), iterations=2) & beyond]
    )
    runs = [_positions(parts == part, phantom[0]) for part in touching if part]
    assert any(np.ptp(run[:, 0]) > 40 for run in runs)


def test_volume_is_filled_with_tissue(hu):
    """Bowel gas is the only air; fat and soft tissue both take a large share."""
    assert (hu < -300).mean() < 0.02
    assert 0.3 < ((hu > -150) & (hu < -60)).mean() < 0.7
    assert ((hu > 20) & (hu < 140)).mean() > 0.2
