"""Measures of balls in an ellipsoid, against closed forms."""

import numpy as np
import pytest
import trimesh
from ellipsoid_kidney import HALF_AXES, ball, in_ellipsoid, kidney
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from scenes.anatomy import Grid
from scenes.tumour_anatomy import (
    AROUND_MM,
    CONTACT_MM,
    contact_mm2,
    main_vessel_gap_mm,
    points_inside,
    touches_main_vessel,
    tumour_anatomy,
    voxel_distance_mm,
)

DEEP = [6.0, 0.0, 10.0], 12.0  # centre, radius
HALF_OUT = [28.0, 0.0, 0.0], 12.0
MOSTLY_OUT = [34.0, 0.0, 0.0], 12.0
POLAR = [0.0, 0.0, 57.0], 14.0


def shares_outside(centre, radius):
    """Shares of a ball's volume and of its surface outside the ellipsoid, by evenly spread points."""
    u, v, w = qmc.Sobol(3, seed=1).random(2**15).T
    z, turn = 2 * u - 1, 2 * np.pi * v
    flat = np.sqrt(1 - z**2)
    directions = np.column_stack([flat * np.cos(turn), flat * np.sin(turn), z])
    inside = centre + radius * directions * w[:, None] ** (1 / 3)
    return (in_ellipsoid(inside) > 0).mean(), (in_ellipsoid(centre + radius * directions) > 0).mean()


def measured(*tumours, parts=None, **others):
    surfaces = [ball(*each) for each in tumours]
    return tumour_anatomy(kidney(*tumours), trimesh.util.concatenate(surfaces), parts or {}, **others)


@pytest.mark.parametrize("tumour", [DEEP, HALF_OUT, MOSTLY_OUT, POLAR], ids=["deep", "half", "most", "polar"])
def test_a_ball(tumour):
    centre, radius = tumour
    found = measured(tumour)
    volume, area = shares_outside(np.array(centre), radius)
    assert found.tumours == 1
    assert found.diameter_mm == pytest.approx(2 * radius, rel=1e-3)
    assert found.volume_ml == pytest.approx(4 / 3 * np.pi * radius**3 / 1000, rel=0.01)
    # The convex hull spans the tumour's place by a plane in one direction at least: it is up to the sagitta,
    # r^2 / 2R, under the ellipsoid, where R is the radius of curvature along the long axis.
    curvature_mm = HALF_AXES[2] ** 2 / HALF_AXES[0] if centre[2] < 40 else HALF_AXES[0] ** 2 / HALF_AXES[2]
    sagitta = min(radius**2 / (2 * curvature_mm), radius)
    assert -0.01 <= found.exophytic_share - volume <= 0.01 + 0.75 * sagitta / radius * (volume > 0)
    # Along the edge of the contact, a strip of CONTACT_MM is counted or left out by the angle between both
    # surfaces.
    strip = CONTACT_MM * 2 * np.pi * radius * (0 < area < 1)
    assert found.contact_cm2 == pytest.approx(
        ((1 - area) * 4 * np.pi * radius**2) / 100, rel=0.02, abs=strip / 100
    )


def test_an_oblique_ellipsoid():
    """Its diameter is its long axis; along an axis p it is 2 |diag(a) R' p| high, within the kidney all
    around.
    """
    half, turn = np.array([9.0, 6.0, 13.0]), Rotation.from_rotvec([0.5, 0.9, -0.4]).as_matrix()
    centre = np.array([4.0, 2.0, 17.0])
    surface = trimesh.creation.icosphere(subdivisions=4)
    surface = trimesh.Trimesh(surface.vertices * half @ turn.T + centre, surface.faces)
    found = tumour_anatomy(kidney(), surface, {})
    assert found.diameter_mm == pytest.approx(26.0, rel=2e-3)
    assert found.volume_ml == pytest.approx(4 / 3 * np.pi * half.prod() / 1000, rel=5e-3)
    polar = found.axes.polar
    height, reach = (centre - found.axes.centre) @ polar, np.linalg.norm(half * (turn.T @ polar))
    assert found.heights_mm == pytest.approx((height - reach, height + reach), abs=0.02)
    # Thomsen's formula is right to 1.1 %.
    pairs = [np.prod(np.delete(half, axis)) ** 1.6075 for axis in range(3)]
    assert found.contact_cm2 == pytest.approx(4 * np.pi * np.mean(pairs) ** (1 / 1.6075) / 100, rel=0.015)
    assert found.exophytic_share == 0


@pytest.mark.parametrize("depth_mm", [4.0, 10.0, 16.0])
def test_contact_of_a_ball_cut_by_a_plane(depth_mm):
    """The spherical cap, 2 pi r d: the formula of Hsieh et al. 2016; and the strip along its edge, in
    closed form too.
    """
    radius, half = 10.0, 30.0
    block = trimesh.creation.box([2 * half] * 3)
    tumour = ball([0.0, 0.0, half + radius - depth_mm], radius)
    organ = trimesh.boolean.union([block, tumour])
    found, cap = contact_mm2(organ, tumour), 2 * np.pi * radius * depth_mm
    strip = 2 * np.pi * CONTACT_MM * radius * (radius - depth_mm) / (radius + CONTACT_MM)
    assert found == pytest.approx(cap + strip, rel=0.02) and found == pytest.approx(cap, rel=0.08)


def test_points_are_even_in_the_volume():
    points = points_inside(ball([5.0, 6.0, 7.0], 10.0))
    assert len(points) == pytest.approx(20_000, rel=0.03)
    np.testing.assert_allclose(points.mean(axis=0), [5, 6, 7], atol=0.05)
    np.testing.assert_allclose(points.var(axis=0), 100 / 5, rtol=0.02)


def test_the_largest_of_several_tumours_is_measured():
    found = measured(([28.0, 0.0, 20.0], 6.0), DEEP)
    assert found.tumours == 2 and found.diameter_mm == pytest.approx(24, rel=1e-3)
    np.testing.assert_allclose(found.points.mean(axis=0), DEEP[0], atol=0.05)


def test_distances_to_surfaces():
    """Balls apart by the distance of their centres less both radii; 0 where they overlap."""
    parts = {"urine": ball([-14.0, 0.0, 10.0], 4.0), "sinus": ball([-8.0, 0.0, 10.0], 6.0)}
    found = measured(DEEP, parts=parts)
    assert found.distance_mm == pytest.approx({"urine": 20 - 4 - 12, "sinus": 0.0}, abs=0.05)


def test_vessels_without_labels_are_one_kind():
    found = measured(DEEP, parts={"vessel": ball([-14.0, 0.0, 10.0], 2.0)})
    assert found.distance_mm == pytest.approx({"vessel": 6.0}, abs=0.05)
    assert found.touches_main_vessel is None


STRAIGHT = np.eye(3)
TURNED = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def voxels_of(field, spacing, turn=STRAIGHT):
    """Voxels (nx, ny, nz) where a field is negative, on turned axes around the origin."""
    count = np.ceil(60 / np.asarray(spacing)).astype(int)
    mm_from_index = np.eye(4)
    mm_from_index[:3, :3] = turn * spacing
    mm_from_index[:3, 3] = -mm_from_index[:3, :3] @ (count / 2)
    index = np.stack(np.meshgrid(*map(np.arange, count), indexing="ij"), axis=-1)
    return Grid(
        field(index @ mm_from_index[:3, :3].T + mm_from_index[:3, 3]) < 0, np.linalg.inv(mm_from_index)
    )


def tube(x_mm, radius):
    """A vessel along z."""
    return lambda points: np.hypot(points[..., 0] - x_mm, points[..., 1]) - radius


@pytest.mark.parametrize("spacing", [(0.8, 0.8, 0.8), (0.8, 0.8, 5.0)])
@pytest.mark.parametrize("turn", [STRAIGHT, TURNED], ids=["straight", "turned"])
def test_distance_to_labelled_voxels(spacing, turn):
    tumour, vessel = ball([0.0, 0.0, 0.0], 10.0), voxels_of(tube(-20.0, 3.0), spacing, turn)
    assert voxel_distance_mm(tumour, vessel) == pytest.approx(20 - 3 - 10, abs=0.6)
    assert voxel_distance_mm(tumour, voxels_of(tube(-12.5, 3.0), spacing, turn)) == pytest.approx(0, abs=0.1)


@pytest.mark.parametrize("turn", [STRAIGHT, TURNED], ids=["straight", "turned"])
def test_only_the_wide_part_of_a_vessel_is_the_main_one(turn):
    tumour = ball([0.0, 0.0, 0.0], 10.0)
    main, branch = tube(-18.0, 3.0), tube(-11.5, 1.2)
    both = voxels_of(lambda p: np.minimum(main(p), branch(p)), (0.4, 0.8, 1.6), turn)
    assert voxel_distance_mm(tumour, both) < 1
    # Half a voxel across the vessel, and one along the distance from the border.
    assert main_vessel_gap_mm(tumour, both, 4.0) == pytest.approx(18 - 3 - 10, abs=0.6)
    assert main_vessel_gap_mm(tumour, both, 5.0) < np.inf == main_vessel_gap_mm(tumour, both, 7.7)


def test_a_main_vessel_is_searched_around_the_tumour():
    small = ball([0.0, 0.0, 0.0], 2.0)
    near, far = (voxels_of(tube(x, 3.0), (0.8,) * 3) for x in (-18.0, -26.0))
    assert main_vessel_gap_mm(small, near, 4.0) == pytest.approx(18 - 3 - 2, abs=0.8)
    assert AROUND_MM < 26 - 3 - 2 and main_vessel_gap_mm(small, far, 4.0) == np.inf


def test_the_tumour_touches_a_main_vessel_or_it_is_not_known():
    tumour = ball([0.0, 0.0, 0.0], 10.0)
    near, far, thin = (voxels_of(tube(-x, r), (0.8,) * 3) for x, r in ((13.5, 3.2), (20.0, 3.2), (11.5, 1.2)))
    assert touches_main_vessel(tumour, {"artery": near}) is True
    assert touches_main_vessel(tumour, {"artery": far, "vein": far}) is False
    assert touches_main_vessel(tumour, {"artery": thin, "vein": thin}) is False
    assert touches_main_vessel(tumour, {"artery": far}) is None
    assert touches_main_vessel(tumour, {}) is None


def test_labels_name_the_vessels():
    """Value 3 is the artery; a value without voxels is none."""
    artery = voxels_of(lambda points: tube(-14.0, 3.0)(points), (0.8,) * 3)
    labels = Grid(3.0 * artery.voxels, artery.index_from_mm)
    found = measured(DEEP, labels=labels, tissues={1: "kidney", 3: "artery", 4: "vein"})
    assert set(found.distance_mm) == {"artery"}
    assert found.distance_mm["artery"] == pytest.approx(20 - 3 - 12, abs=0.6)


def test_a_vessel_that_does_not_reach_the_kidney_is_not_its_own():
    """As the aorta, where the renal artery is not labelled."""
    aorta = voxels_of(lambda points: tube(-22.0, 4.0)(points + [0.0, 24.0, 0.0]), (0.8,) * 3)
    labels = Grid(3.0 * aorta.voxels, aorta.index_from_mm)
    found = measured(([0.0, 0.0, 8.0], 10.0), labels=labels, tissues={1: "kidney", 3: "vessel"})
    assert found.distance_mm == {} and found.touches_main_vessel is None
