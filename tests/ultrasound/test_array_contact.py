"""The transducer's face: how much touches and how far tissue is squeezed, against closed forms."""

import numpy as np
import pytest
import trimesh
from conftest import rotation_about

from ultrasound.array_contact import CONTACT_MM, depth_in, face_points, footprint, gap_to, measure_contact
from ultrasound.probe import load_probe

# 20 x 10 places of 0.75 x 0.75 mm.
SIZE = np.array([15.0, 7.5, 20.0])
CELL = 0.75
TOP = 8.0
CURVED, RADIUS = np.array([66.0, 16.0, 30.0]), 60.0


def over(x: float = 0.0, y: float = 0.0, height: float = TOP, length: float = 20.0) -> np.ndarray:
    """Pose that looks down -z, the middle of its face at a place."""
    pose = np.eye(4)
    pose[:3, 3] = x, y, height + length / 2
    return pose


def tilted(degrees: float) -> np.ndarray:
    """Pose over the top's middle, turned about y, whose lower edge (at x > 0 for positive angles) is on
    the top.
    """
    pose = np.eye(4)
    pose[:3, :3] = rotation_about([0, 1, 0], degrees)
    edge = pose[:3, :3] @ [np.sign(degrees) * SIZE[0] / 2, 0, -SIZE[2] / 2]
    pose[0, 3], pose[2, 3] = SIZE[2] / 2 * pose[0, 2], TOP - edge[2]
    return pose


def pressed(pose, now, mesh, size=SIZE, radius=0.0):
    return measure_contact(
        pose, size, radius, np.asarray(now), np.asarray(mesh.vertices), np.asarray(mesh.faces)
    )


@pytest.mark.parametrize("x, y, wide, high", [(0, 0, 15, 7.5), (6, 7.75, 13.5, 6), (-6, -7.75, 13.5, 6)])
def test_a_flat_face_on_a_flat_top_touches_where_they_overlap(block, x, y, wide, high):
    # The edges of the block run between places, so that none is cut; whether its faces are large or small,
    # from whichever corner.
    small = block.subdivide().subdivide().subdivide()
    turned = [
        trimesh.Trimesh(small.vertices, np.roll(small.faces, n, axis=1), process=False) for n in range(3)
    ]
    for mesh in (block, *turned):
        assert pressed(over(x, y), mesh.vertices, mesh).area_mm2 == pytest.approx(wide * high, rel=1e-12)


@pytest.mark.parametrize("gap, area", [(0.4, 112.5), (0.6, 0.0), (-0.4, 112.5)])
def test_the_face_touches_as_far_as_half_a_millimetre(block, gap, area):
    assert pressed(over(height=TOP + gap), block.vertices, block).area_mm2 == pytest.approx(area)


@pytest.mark.parametrize("x, y", [(20, 0), (-20, 0), (0, 15), (0, -15)])
def test_beside_the_organ_nothing_touches(block, x, y):
    contact = pressed(over(x, y), block.vertices * [1, 1, 0.5] + [0, 0, 4], block)
    assert (contact.area_mm2, contact.compression_mm) == (0, 0)


@pytest.mark.parametrize("degrees", [4.0, 10.0, -10.0])
def test_a_tilted_face_touches_in_a_strip_along_its_lower_edge(block, degrees):
    # The gap grows with the tangent; a strip of places is off by half of one.
    strip = CONTACT_MM / np.tan(np.radians(abs(degrees)))
    assert pressed(tilted(degrees), block.vertices, block).area_mm2 == pytest.approx(
        strip * SIZE[1], abs=CELL / 2 * SIZE[1]
    )
    # There is no organ under the other edge, nor under this one.
    beside = block.vertices + [12 * np.sign(degrees), 0, 0]
    assert pressed(tilted(degrees), beside, block).area_mm2 > 0
    assert pressed(tilted(-degrees), beside, block).area_mm2 == 0


def test_a_curved_face_touches_over_the_chord_of_its_sagitta(block):
    # Its middle touches; a chord c lies CONTACT_MM behind the middle where c^2 = 2 r s - s^2. Places are off
    # by half of one a side.
    half = np.sqrt(2 * RADIUS * CONTACT_MM - CONTACT_MM**2)
    arc = RADIUS * np.arcsin(half / RADIUS)
    at = over(length=CURVED[2])
    whole = pressed(at, block.vertices, block, CURVED, RADIUS).area_mm2
    assert whole == pytest.approx(2 * arc * CURVED[1], abs=1.01 * CELL * CURVED[1])
    right = pressed(at, block.vertices + [12.0, 0, 0], block, CURVED, RADIUS).area_mm2
    assert right == pytest.approx(whole / 2)


def test_the_points_of_a_curved_face_lie_on_it_and_stand_for_all_of_it():
    points, area = face_points(CURVED, RADIUS)
    assert np.hypot(points[:, 0], points[:, 2] + CURVED[2] / 2 - RADIUS) == pytest.approx(RADIUS)
    # The midpoint rule on 88 places of 1 / sqrt(1 - x^2 / r^2), whose second derivative is less than 10 / r^2
    # here.
    whole = 2 * RADIUS * np.arcsin(33 / RADIUS) * CURVED[1]
    assert area.sum() == pytest.approx(whole, rel=CELL**2 * 10 / RADIUS**2 / 24)


def test_a_block_squeezed_is_shorter_by_what_it_lost(block):
    now = block.vertices * [1.1, 1.1, 0.75]
    # However the rest lies, and wherever the transducer is over the top.
    elsewhere = block.copy()
    elsewhere.apply_transform(trimesh.transformations.random_rotation_matrix(np.array([0.1, 0.5, 0.8])))
    for mesh in (block, elsewhere):
        assert pressed(over(3, 1, 6.0), now, mesh).compression_mm == pytest.approx(0.25 * 16)
    assert pressed(over(height=6.6), now, block).compression_mm == 0
    assert pressed(over(height=10), block.vertices * [1, 1, 1.25], block).compression_mm == 0


@pytest.mark.parametrize("shear", [0.0, 0.2, -0.2])
def test_a_ball_squeezed_and_sheared_is_shorter_along_its_longest_chord(ball, shear):
    map_ = np.array([[1.1, 0, shear], [0, 1.05, 0], [0, 0, 0.8]])
    back = np.linalg.inv(map_)
    # A chord along z now was longer by this; the longest goes through the middle, 12 mm of radius both ways
    # at rest.
    longer = np.linalg.norm(back[:, 2])
    most = 2 * 12 * (1 - 1 / longer)
    # Facets lie between the ball and one that they all touch; the nearest place is half a cell's diagonal
    # from the middle.
    inner = np.abs(np.einsum("ij,ij->i", ball.triangles_center, ball.face_normals)).min()
    aside = CELL / np.sqrt(2) * np.linalg.norm(back, 2)
    least = 2 * np.sqrt(inner**2 - aside**2) * (1 - 1 / longer)
    compression = pressed(over(height=0.8 * 12), ball.vertices @ map_.T, ball).compression_mm
    assert 0.98 * most < least <= compression <= most


def test_of_several_layers_the_first_under_the_face_counts():
    layers = [trimesh.creation.box([24, 24, 6]).apply_translation([0, 0, z]) for z in (12.0, 0.0, -10.0)]
    whole = trimesh.util.concatenate(layers)
    now = np.asarray(whole.vertices).copy()
    for n, lost in enumerate((1.0, 2.0, 4.0)):
        layer = now[8 * n : 8 * n + 8]
        layer[layer[:, 2] < layer[:, 2].mean(), 2] += lost
    # The middle one's top is at z = 3; another lies behind the face, a third before it.
    contact = pressed(over(height=3.0), now, whole)
    assert contact.compression_mm == pytest.approx(2.0)
    assert contact.area_mm2 == pytest.approx(112.5)


@pytest.mark.parametrize("seed", range(8))
def test_moving_all_changes_nothing(ball, block, seed):
    random = np.random.default_rng(seed)
    turn = trimesh.transformations.random_rotation_matrix(random.random(3))
    turn[:3, 3] = random.normal(size=3) * 50
    cases = [
        (ball, ball.vertices * [1, 1, 0.8], over(1, -2, 9.4), SIZE, 0.0),
        (block, block.vertices * [1, 1, 0.9], over(5, 3, 7.0, 30.0), CURVED, RADIUS),
        # Places on the diagonal of the top are in one of its triangles, however rounding falls.
        (block, block.vertices * [20 / 24, 1, 1], over(), np.array([7.5, 7.5, 20.0]), 0.0),
    ]
    for mesh, now, pose, size, radius in cases:
        still = pressed(pose, now, mesh, size, radius)
        moved = pressed(turn @ pose, trimesh.transform_points(now, turn), mesh, size, radius)
        assert still.area_mm2 > 5
        assert moved.area_mm2 == pytest.approx(still.area_mm2)
        assert moved.compression_mm == pytest.approx(still.compression_mm, abs=1e-9)


def test_the_footprint_is_on_the_rounded_face():
    probe = load_probe("drop-in")
    half, rounded = np.array(probe.housing_mm) / 2, probe.edge_radius_mm
    points = footprint(probe)
    q = np.abs(points) - (half - rounded)
    distance = np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0) - rounded
    assert np.abs(distance).max() < 1e-9
    # Centre, edges and corners: a corner is a third of the way round.
    assert np.abs(points - [0, 0, -half[2]]).sum(axis=1).min() == 0
    corner = half - rounded * (1 - 1 / np.sqrt(3))
    assert np.abs(points - corner * [1, -1, -1]).sum(axis=1).min() < 1e-9
    sharp = footprint(load_probe("linear"))
    assert (sharp[:, 2] == -10).all() and np.ptp(sharp, axis=0) == pytest.approx([40, 10, 0])


def test_depth_in_a_surface_is_the_distance_from_inside():
    ball = trimesh.creation.icosphere(5, 20.0)
    places = np.array([[0, 0, 25.0], [0, 0, 19.0], [0, 0, 13.5], [0, 30.0, 0]])
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    # The facets of the sphere are up to 0.01 mm inside of it.
    assert depth_in(places, vertices, faces) == pytest.approx(6.5, abs=0.02)
    assert depth_in(places[[0, 3]], vertices, faces) == 0.0
    assert gap_to(places[[0, 3]], vertices, faces) == pytest.approx(5.0, abs=0.02)
