"""Where the probe of an imported patient starts: over the middle of the tumour, or of the kidney, from
where it can be reached.
"""

import tomllib

import ellipsoid_kidney
import numpy as np
import pytest
import trimesh
from conftest import ROOT
from ellipsoid_kidney import HALF_AXES, ball, kidney

from scenes.patients.opening_pose import MOST_TILT_DEG, directions_around, opening_press
from scenes.patients.patient_scene import HOUSING_MM, PROBE
from scenes.surfaces import depth_below_hull, signed_distance_from

SUPINE, PRONE = (0.0, 1.0, 0.0), (0.0, -1.0, 0.0)
# Centre and radius of tumours: beside the front on the lateral side, and at the back.
LATERAL, BEHIND = ((20.0, -13.0, 8.0), 12.0), ((0.0, 16.0, -10.0), 9.0)
BITE = (-30.0, -18.0, 0.0), 22.0


def slab(gravity=SUPINE):
    """Under the organ."""
    mesh = trimesh.creation.box((80.0, 10.0, 140.0))
    mesh.apply_translation(30.0 * np.array(gravity))
    return mesh


@pytest.fixture(scope="module", autouse=True)
def coarse():
    """Triangles as large as those of an import."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ellipsoid_kidney, "STEP_MM", 3.0)
        yield


@pytest.fixture(scope="module")
def smooth():
    return kidney()


@pytest.fixture(scope="module")
def with_lateral_tumour():
    return kidney(LATERAL)


def face_of(press, organ):
    """Where the axis of a press enters the organ."""
    target, direction = np.array(press.target_mm), np.array(press.direction)
    along = np.linspace(0, 120, 1201)[:, None]
    points = target - along * direction / np.linalg.norm(direction)
    inside = signed_distance_from(organ, points) < 0
    return points[inside.nonzero()[0].max()]


def angle_deg(a, b):
    return np.degrees(np.arccos(np.dot(a, b) / np.linalg.norm(a) / np.linalg.norm(b)))


def test_the_directions_are_even_around_the_axis():
    axis = np.array([1.0, -2.0, 0.5])
    found = directions_around(axis)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1)
    tilt = np.degrees(np.arccos(np.clip(found @ axis / np.linalg.norm(axis), -1, 1)))
    assert tilt[0] < 1e-3 and tilt.max() == pytest.approx(MOST_TILT_DEG)
    # Half of the area is within acos(3/4).
    assert np.mean(tilt < np.degrees(np.arccos(0.75))) == pytest.approx(0.5, abs=0.01)
    nearest = np.sort(np.degrees(np.arccos(np.clip(found @ found.T, -1, 1))), axis=1)[:, 1]
    assert nearest.min() > 3 and nearest.max() < 9


def test_it_is_over_the_middle_of_a_tumour_along_its_outward_normal(with_lateral_tumour):
    organ, tumour = with_lateral_tumour, ball(*LATERAL)
    press = opening_press(organ, tumour, slab(), SUPINE, HOUSING_MM)
    assert press.target_mm == pytest.approx(LATERAL[0], abs=0.1)
    face = face_of(press, organ)
    assert np.linalg.norm(face - LATERAL[0]) == pytest.approx(LATERAL[1], abs=1.5)
    assert angle_deg(press.direction, SUPINE) < MOST_TILT_DEG + 1
    # The face's normal is that of the surface there.
    triangle = trimesh.proximity.closest_point_naive(organ, face[None])[2]
    assert angle_deg(-np.array(press.direction), organ.face_normals[triangle[0]]) < 25


@pytest.mark.parametrize("gravity", [SUPINE, PRONE])
def test_it_comes_from_above_where_the_tumour_is_at_the_back(gravity):
    """Through the kidney: behind is the support. Prone, the tumour is in front."""
    organ, tumour = kidney(BEHIND), ball(*BEHIND)
    press = opening_press(organ, tumour, slab(gravity), gravity, HOUSING_MM)
    assert press.target_mm == pytest.approx(BEHIND[0], abs=0.1)
    assert angle_deg(press.direction, gravity) < MOST_TILT_DEG + 1
    distance = np.linalg.norm(face_of(press, organ) - BEHIND[0])
    assert distance > 30 if gravity == SUPINE else distance < 11


def test_without_a_tumour_it_is_over_the_middle_on_the_flat_side(smooth):
    press = opening_press(smooth, None, slab(), SUPINE, HOUSING_MM)
    assert press.target_mm == pytest.approx((0.0, 0.0, 0.0), abs=0.2)
    assert angle_deg(press.direction, SUPINE) < 15
    assert np.linalg.norm(face_of(press, smooth)) == pytest.approx(HALF_AXES[1], abs=1.0)


def test_it_is_not_in_a_concavity():
    """The nearest surface is that of a hilum that opens to the front, where vessels leave and no
    instrument has room.
    """
    organ, tumour = kidney(bite=BITE), ball((-8.0, -6.0, 0.0), 6.0)
    press = opening_press(organ, tumour, slab(), SUPINE, HOUSING_MM)
    assert depth_below_hull(organ, face_of(press, organ)[None])[0] < 3.0
    nearest = np.array(BITE[0]) - (-8.0, -6.0, 0.0)
    assert angle_deg(-np.array(press.direction), nearest) > 30


def test_it_is_not_where_the_support_is(with_lateral_tumour):
    organ, tumour = with_lateral_tumour, ball(*LATERAL)
    free = opening_press(organ, tumour, slab(), SUPINE, HOUSING_MM)
    wall = trimesh.creation.box((20.0, 8.0, 20.0)).subdivide().subdivide().subdivide()
    wall.apply_translation(face_of(free, organ) - 8.0 * np.array(free.direction))
    beside = opening_press(organ, tumour, wall, SUPINE, HOUSING_MM)
    assert angle_deg(free.direction, beside.direction) > 15


@pytest.mark.parametrize("degrees", [25, -40])
def test_it_turns_with_the_patient(with_lateral_tumour, degrees):
    turn = trimesh.transformations.rotation_matrix(np.radians(degrees), [1.0, 0.5, 2.0])
    organ, tumour, support = with_lateral_tumour.copy(), ball(*LATERAL), slab()
    before = opening_press(organ, tumour, support, SUPINE, HOUSING_MM)
    for mesh in (organ, tumour, support):
        mesh.apply_transform(turn)
    gravity = tuple((turn[:3, :3] @ SUPINE).tolist())
    after = opening_press(organ, tumour, support, gravity, HOUSING_MM)
    assert after.target_mm == pytest.approx(turn[:3, :3] @ before.target_mm, abs=0.2)
    # Directions that are compared are some 6 degrees apart, and turned about gravity.
    assert angle_deg(after.direction, turn[:3, :3] @ before.direction) < 20


def test_the_housing_is_that_of_the_default_probe():
    values = tomllib.loads((ROOT / "ultrasound" / "probes" / f"{PROBE}.toml").read_text("utf-8"))
    assert tuple(values["HousingMm"]) == HOUSING_MM
