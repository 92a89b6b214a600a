"""How a region that was found agrees with the true one: balls of closed form."""

import numpy as np
import pytest

from rehearsal.reconstruction.patient_comparison import SegmentationMetrics, segmentation_metrics

VOXEL = 0.5


def voxel_ball(centre: list[float], radius: float) -> np.ndarray:
    """A ball, in voxels."""
    return np.linalg.norm(np.moveaxis(np.indices((60, 50, 50)), 0, -1) - centre, axis=-1) <= radius


def test_a_region_agrees_with_itself():
    assert segmentation_metrics(
        voxel_ball([25, 25, 25], 9), voxel_ball([25, 25, 25], 9), VOXEL
    ) == SegmentationMetrics(1, 0, 0, 0)


@pytest.mark.parametrize("shift", [1, 4, 9])
def test_a_shifted_ball_agrees_as_the_formula_of_two_balls_says(shift):
    radius = 18.0
    got = segmentation_metrics(
        voxel_ball([24 + shift, 25, 25], radius), voxel_ball([24, 25, 25], radius), VOXEL
    )
    # The lens of two balls; cutting it into voxels errs by less than a percent of so many.
    assert got.dice == pytest.approx(1 - 3 * shift / (4 * radius) + shift**3 / (16 * radius**3), abs=0.01)
    assert got.centroid_mm == pytest.approx(shift * VOXEL, abs=1e-9) and got.volume_percent == 0
    # A sphere's points lie evenly in the cosine of their angle to the shift. Surfaces are in half a voxel.
    cosine = np.linspace(-1, 1, 10001)
    distance = np.abs(np.sqrt(radius**2 + shift**2 - 2 * radius * shift * cosine) - radius)
    assert got.hd95_mm == pytest.approx(VOXEL * np.percentile(distance, 95), abs=VOXEL)


def test_a_larger_ball_is_larger_by_its_radius_to_the_third():
    got = segmentation_metrics(voxel_ball([25.3, 24.9, 25.1], 20), voxel_ball([25.3, 24.9, 25.1], 14), VOXEL)
    assert got.volume_percent == pytest.approx(100 * ((20 / 14) ** 3 - 1), rel=0.02)
    assert got.hd95_mm == pytest.approx(6 * VOXEL, abs=VOXEL) and got.centroid_mm < 0.1 * VOXEL
    assert got.dice == pytest.approx(2 * 14**3 / (14**3 + 20**3), abs=0.01)


def test_a_hollow_has_a_surface_of_its_own():
    whole = voxel_ball([25, 25, 25], 16)
    # The inner surface is a quarter of both, and farther from the outer by what the radii differ in.
    got = segmentation_metrics(whole & ~voxel_ball([25, 25, 25], 9), whole, VOXEL)
    assert got.hd95_mm == pytest.approx((16 - 9) * VOXEL, abs=VOXEL)


def test_hd95_is_the_greater_of_both_ways_and_blind_to_a_twentieth():
    truth = np.zeros((60, 12, 12), bool)
    truth[2:4, 1:11, 1:11] = True
    # All 200 voxels are surface: 8 more, 50 voxels off, are a 26th of those found, and 16 a 14th.
    for extra, hd95 in ((8, 0.0), (16, 50 * VOXEL)):
        found = truth.copy()
        found[53, 1:3, 1 : 1 + extra // 2] = True
        assert (
            segmentation_metrics(found, truth, VOXEL).hd95_mm
            == segmentation_metrics(truth, found, VOXEL).hd95_mm
            == hd95
        )


def test_where_nothing_was_found_there_is_no_distance():
    got = segmentation_metrics(np.zeros((60, 50, 50), bool), voxel_ball([25, 25, 25], 9), VOXEL)
    assert got.dice == 0 and got.volume_percent == -100 and np.isnan([got.hd95_mm, got.centroid_mm]).all()


def test_regions_that_cannot_be_compared_are_refused():
    with pytest.raises(ValueError, match="empty"):
        segmentation_metrics(np.ones((3, 3, 3), bool), np.zeros((3, 3, 3), bool), VOXEL)
    with pytest.raises(ValueError, match="grids"):
        segmentation_metrics(np.ones((3, 3, 3), bool), np.ones((3, 3, 4), bool), VOXEL)
