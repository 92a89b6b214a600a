"""Axes of kidneys whose shape is known in closed form."""

import numpy as np
import pytest
from ellipsoid_kidney import HALF_AXES, MEDIAL, ball, kidney
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from scenes.anatomy import load_anatomy
from scenes.kidney_axes import UNDER_SURFACE_MM, kidney_axes
from scenes.phantom.kidney import KIDNEY_AXES
from scenes.scene import EMBEDDED, load_scene
from scenes.surfaces import signed_distance_from

HILUM = MEDIAL * HALF_AXES
SINUS = HILUM + [4.0, 0.0, 8.0], 16.0  # centre, radius


def angle_deg(a, b):
    return np.degrees(np.arccos(np.clip(a @ b, -1, 1)))


def opening_ends(centre, radius, under_mm=0.0):
    """Heights where the medial outline of the ellipsoid, or a line so far under it, leaves a ball."""

    def outside(angle):
        point = HALF_AXES * [-np.cos(angle), 0.0, np.sin(angle)]
        normal = point / HALF_AXES**2
        inner = point - under_mm * normal / np.linalg.norm(normal)
        return np.linalg.norm(inner - centre) - radius, point[2]

    middle = np.arcsin(centre[2] / HALF_AXES[2])
    ends = [brentq(lambda t: outside(t)[0], middle, middle + sign * 1.2) for sign in (-1, 1)]
    return [outside(end)[1] for end in ends]


@pytest.fixture(scope="module")
def plain():
    return kidney()


@pytest.fixture(scope="module")
def bitten():
    """A kidney with a hilar concavity."""
    return kidney(bite=SINUS)


@pytest.mark.parametrize("turn", [(0, 0, 0), (25, 0, 0), (-10, 20, 40)])
def test_the_polar_axis_is_the_long_axis_towards_the_head(plain, turn):
    turned = Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
    organ = plain.copy()
    organ.apply_transform(np.block([[turned, np.full((3, 1), 7.0)], [np.zeros(3), np.ones(1)]]))
    axes = kidney_axes(organ, [], {})
    assert angle_deg(axes.polar, turned @ [0, 0, 1]) < 0.5
    np.testing.assert_allclose(axes.centre, 7.0, atol=0.1)
    assert axes.length_mm == pytest.approx(2 * HALF_AXES[2], rel=0.01)
    # Without sinus and hilum nothing else is known.
    assert axes.hilar is axes.anterior is axes.polar_lines is axes.sinus_lines is None


def test_a_large_tumour_does_not_turn_the_polar_axis():
    """Nor the cyst beside it, which is left out too."""
    centre, radius, cyst = [25.0, 0.0, 38.0], 22.0, ([28.0, 0.0, -20.0], 6.0)
    organ, lesions = kidney((centre, radius), cyst), [ball(centre, radius), ball(*cyst)]
    off = angle_deg(kidney_axes(organ, lesions, {}).polar, np.array([0.0, 0.0, 1.0]))
    assert off < 6 < angle_deg(kidney_axes(organ, [], {}).polar, np.array([0.0, 0.0, 1.0]))


def test_lines_of_a_labelled_sinus(plain):
    """Polar lines: the ends of the opening in the medial surface. Sinus lines: the ends of the sinus."""
    axes = kidney_axes(plain, [], {"sinus": ball(*SINUS)})
    assert not axes.estimated
    np.testing.assert_allclose(axes.polar_lines, opening_ends(*SINUS, UNDER_SURFACE_MM), atol=1.5)
    np.testing.assert_allclose(axes.sinus_lines, [8.0 - 16.0, 8.0 + 16.0], atol=0.5)
    assert angle_deg(axes.hilar, MEDIAL) < 3 and angle_deg(axes.anterior, np.array([0.0, -1.0, 0.0])) < 3


def test_the_plane_of_a_malrotated_kidney(plain):
    """With the hilum to the front, the coronal plane of the kidney is the patient's sagittal plane."""
    axes = kidney_axes(plain, [], {"sinus": ball([-2.0, -22.0, 0.0], 12.0)})
    assert angle_deg(axes.hilar, np.array([0.0, -1.0, 0.0])) < 8 and abs(axes.anterior[0]) > 0.99


def test_without_a_labelled_sinus_the_concavity_is_the_hilum(bitten):
    axes = kidney_axes(bitten, [], {}, HILUM + [10.0, 0.0, 8.0])
    assert axes.estimated and axes.polar_lines == axes.sinus_lines
    assert angle_deg(axes.hilar, MEDIAL) < 5
    low, high = opening_ends(*SINUS)
    # The mouth is where the contour is half as far from the parenchyma as in its middle: within the lips,
    # over most of their distance.
    assert low - 1 < axes.polar_lines[0] and axes.polar_lines[1] < high + 1
    assert np.diff(axes.polar_lines)[0] > 0.4 * (high - low)
    assert np.mean(axes.polar_lines) == pytest.approx((low + high) / 2, abs=2.0)


def test_a_kidney_without_a_concavity_shows_no_hilum(plain):
    axes = kidney_axes(plain, [], {}, HILUM)
    assert axes.polar_lines is None and axes.hilar is None


@pytest.mark.parametrize("height", [30.0, -30.0])
def test_a_vessel_elsewhere_does_not_move_the_hilum(plain, height):
    """Another opening, of a vessel at the lateral surface, is smaller than the hilum."""
    vessel = ball(-HILUM + [0.0, 0.0, height], 9.0)
    alone = kidney_axes(plain, [], {"sinus": ball(*SINUS)})
    both = kidney_axes(plain, [], {"sinus": ball(*SINUS), "vessel": vessel})
    assert signed_distance_from(vessel, plain.vertices).min() < -2
    assert both.polar_lines == alone.polar_lines


def test_the_embedded_patient():
    """The kidney was drawn along these axes; where its sinus is not labelled, the concavity shows nearly
    the same lines.
    """
    scene = load_scene(EMBEDDED)
    anatomy = load_anatomy(scene, EMBEDDED.parent)
    axes = kidney_axes(anatomy.organ, [anatomy.tumour], anatomy.parts)
    assert angle_deg(axes.polar, KIDNEY_AXES[2]) < 1
    assert angle_deg(axes.anterior, KIDNEY_AXES[1]) < 5 and angle_deg(axes.hilar, -KIDNEY_AXES[0]) < 5
    estimated = kidney_axes(anatomy.organ, [anatomy.tumour], {}, scene.attachment.at_mm)
    assert estimated.estimated and not axes.estimated
    np.testing.assert_allclose(estimated.polar_lines, axes.polar_lines, atol=3.0)
