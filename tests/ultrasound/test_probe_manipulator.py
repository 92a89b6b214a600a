"""The transducer's pose, and the hand that moves it."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from conftest import rotation_about

from rehearsal.build_solver import tool_of
from sim.fields import array_of
from ultrasound.probe import load_probe
from ultrasound.probe_manipulator import (
    ManipulatorState,
    ProbeManipulator,
    advanced,
    image_plane,
    indentation,
    moved_towards,
    pose_at,
    pose_of_image_plane,
    poses_between,
    touching,
)

SIZE = np.array([10.0, 6.0, 20.0])


def test_the_beam_of_a_pose_is_along_its_direction_from_the_face():
    pose = pose_at(np.array([1.0, 2.0, 3.0]), np.array([0.0, 2.0, 0.0]), np.array([1.0, 5.0, 0.0]), 20.0)
    assert pose[:3, :3] @ pose[:3, :3].T == pytest.approx(np.eye(3))
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    assert pose[:3, 2] == pytest.approx([0, -1, 0]) and pose[:3, 0] == pytest.approx([1, 0, 0])
    assert pose @ [0, 0, -10, 1] == pytest.approx([1, 2, 3, 1])


def test_a_lateral_along_the_direction_still_gives_a_pose():
    pose = pose_at(np.zeros(3), np.array([0, 0, 1.0]), np.array([0, 0, 1.0]), 20.0)
    assert pose[:3, :3] @ pose[:3, :3].T == pytest.approx(np.eye(3))


def test_image_plane_starts_at_the_face_with_x_to_the_marked_side_and_y_down():
    pose = pose_at(np.array([1.0, 2.0, 3.0]), np.array([0, 0, -1.0]), np.array([1.0, 0, 0]), 20.0)
    plane = image_plane(pose, 20.0, 40.0, 60.0)
    assert plane.world_from_plane @ [0, 0, 0, 1] == pytest.approx([1, 2, 3, 1])
    assert plane.world_from_plane @ [7, 0, 0, 1] == pytest.approx([8, 2, 3, 1])
    assert plane.world_from_plane @ [0, 9, 0, 1] == pytest.approx([1, 2, -6, 1])
    assert np.linalg.det(plane.world_from_plane[:3, :3]) == pytest.approx(1.0)


def test_the_pose_of_an_image_plane_is_the_pose_it_came_from():
    pose = pose_at(np.array([3.0, -2.0, 7.0]), np.array([1.0, 2.0, -1.5]), np.array([0.3, 1.0, 0.2]), SIZE[2])
    plane = image_plane(pose, SIZE[2], 30.0, 40.0)
    assert pose_of_image_plane(plane.world_from_plane, SIZE[2]) == pytest.approx(pose)


def test_touching_pressing_and_measuring_agree(ball):
    pose = pose_at(np.array([0, 0, 30.0]), np.array([0, 0, -1.0]), np.array([1.0, 0, 0]), SIZE[2])
    touch = touching(pose, SIZE, ball.vertices)
    assert indentation(touch, SIZE, ball.vertices) == pytest.approx(0.0, abs=1e-9)
    assert touch[2, 3] == pytest.approx(12.0 + 10.0, abs=0.2)
    assert indentation(advanced(touch, 4.5), SIZE, ball.vertices) == pytest.approx(4.5)
    assert indentation(advanced(touch, -3.0), SIZE, ball.vertices) == pytest.approx(-3.0)
    beside = pose.copy()
    beside[0, 3] = 40.0
    assert indentation(beside, SIZE, ball.vertices) == -np.inf
    assert touching(beside, SIZE, ball.vertices) == pytest.approx(beside)


def test_poses_between_are_even_in_place_and_angle():
    start, end = np.eye(4), np.eye(4)
    end[:3, :3], end[:3, 3] = rotation_about([0, 0, 1], 30), [3.0, 0, 0]
    poses = poses_between(start, end, 3)
    assert poses[[0, 3]] == pytest.approx(np.stack([start, end]))
    assert poses[1, :3, :3] == pytest.approx(rotation_about([0, 0, 1], 10)) and poses[
        1, 0, 3
    ] == pytest.approx(1.0)


def test_a_goal_is_approached_no_faster_than_the_limits():
    goal = np.eye(4)
    goal[:3, 3] = [10.0, 0, 0]
    assert moved_towards(np.eye(4), goal, 4.0, 90.0)[:3, 3] == pytest.approx([4, 0, 0])
    assert moved_towards(np.eye(4), goal, 40.0, 90.0) == pytest.approx(goal)
    goal[:3, :3] = rotation_about([1, 0, 0], 60)
    slow = moved_towards(np.eye(4), goal, 40.0, 6.0)
    assert slow[:3, :3] == pytest.approx(rotation_about([1, 0, 0], 6)) and slow[0, 3] == pytest.approx(1.0)


@pytest.fixture
def manipulator(ball: trimesh.Trimesh) -> ProbeManipulator:
    home = touching(pose_at(np.zeros(3), [0, 0, -1.0], [1.0, 0, 0], SIZE[2]), SIZE, ball.vertices)
    vertices, faces = np.array(ball.vertices), np.array(ball.faces, np.int64)
    return ProbeManipulator(vertices, faces, np.array(ball.vertex_normals), SIZE, home, np.array([1.0, 0, 0]))


def test_pointing_at_the_organ_puts_the_face_on_it_perpendicular(manipulator):
    manipulator.point(np.array([30.0, 0.0, 5.0]), np.array([-1.0, 0.0, 0.0]))
    met = np.array([(12.0**2 - 25) ** 0.5, 0.0, 5.0])
    # The ball's facets lie up to 0.1 mm inside it.
    assert (manipulator.aim @ [0, 0, -10, 1])[:3] == pytest.approx(met, abs=0.15)
    pose = manipulator.pose()
    assert pose[:3, 2] @ met / 12 > 0.99
    assert indentation(pose, SIZE, manipulator.samples) == pytest.approx(0.0, abs=1e-9)
    manipulator.point(np.array([30.0, 0.0, 50.0]), np.array([-1.0, 0.0, 0.0]))
    assert manipulator.pose() == pytest.approx(pose)


def test_keys_push_and_the_button_presses_until_let_go(manipulator):
    manipulator.push(2.0)
    manipulator.press(True, 0.25)
    assert indentation(manipulator.pose(), SIZE, manipulator.samples) == pytest.approx(5.0)
    for _ in range(100):
        manipulator.press(True, 0.1)
    assert indentation(manipulator.pose(), SIZE, manipulator.samples) == pytest.approx(15.0)
    for _ in range(10):
        manipulator.press(False, 0.1)
    assert indentation(manipulator.pose(), SIZE, manipulator.samples) == pytest.approx(2.0)
    manipulator.push(-5.0)
    assert indentation(manipulator.pose(), SIZE, manipulator.samples) == pytest.approx(-3.0)
    manipulator.state = ManipulatorState()
    assert manipulator.pose() == pytest.approx(manipulator.home)


def held_aslant(manipulator: ProbeManipulator) -> np.ndarray:
    """The aim of a hand that holds the probe where no axis of it is one of the world's."""
    manipulator.aim_at(np.array([6.0, -4.0, 9.6]), np.array([1.0, 2.0, 0.5]))
    return manipulator.aim


def test_turns_are_tilt_then_rock_then_rotate_about_axes_that_turn_along(manipulator):
    aim = held_aslant(manipulator)
    manipulator.turn(20.0, -30.0, 50.0)
    tilt, rock, rotate = (
        rotation_about(list(np.eye(3)[axis]), degrees) for axis, degrees in enumerate((20.0, -30.0, 50.0))
    )
    assert manipulator.pose()[:3, :3] == pytest.approx(aim[:3, :3] @ tilt @ rock @ rotate)


def test_a_turned_probe_keeps_its_face_at_the_aim(manipulator):
    aim = held_aslant(manipulator)
    manipulator.turn(25.0, -35.0, 10.0)
    pose = manipulator.pose()
    from_aim = pose[:3, 3] - (aim @ [0, 0, -SIZE[2] / 2, 1])[:3]
    # Touching and pressing move it along its axis alone.
    assert np.cross(from_aim, pose[:3, 2]) == pytest.approx(np.zeros(3), abs=1e-9)


def test_a_probe_is_held_as_it_is_taken(manipulator):
    aim = held_aslant(manipulator)
    for depth in (-5.0, 0.0, 3.0, 15.0):
        pose = advanced(touching(aim, SIZE, manipulator.samples), depth)
        manipulator.match(pose)
        assert manipulator.pose() == pytest.approx(pose)
        for _ in range(100):
            manipulator.press(False, 0.1)
        assert indentation(manipulator.pose(), SIZE, manipulator.samples) == pytest.approx(
            min(depth, 0.0), abs=1e-9
        )


def test_a_hand_with_a_curved_probe_touches_with_its_arc(manipulator):
    size, radius = np.array([20.0, 6.0, 20.0]), 25.0
    curved = replace(manipulator, size_mm=size, radius_mm=radius)
    held_aslant(curved)
    curved.push(2.0)
    assert indentation(curved.pose(), size, curved.samples, radius) == pytest.approx(2.0)
    curved.turn(0.0, 20.0, 0.0)
    assert indentation(curved.pose(), size, curved.samples, radius) == pytest.approx(2.0)


def test_normals_count_by_a_gaussian_of_their_distance(manipulator):
    for away in (6.0, 12.0, 24.0):
        manipulator.vertices, manipulator.normals = (
            np.array([[0.0, 0, 0], [away, 0, 0]]),
            np.array([[0.0, 0, 1], [1, 0, 0]]),
        )
        other = np.exp(-((away / 12.0) ** 2))
        assert manipulator.surface_normal(np.zeros(3)) == pytest.approx([other, 0, 1] / np.hypot(other, 1))


def test_tilts_end_where_a_hand_does(manipulator):
    manipulator.turn(500, -500, 500)
    assert manipulator.state.turn_deg == pytest.approx([60, -60, 500])


def test_a_curved_face_touches_where_its_arc_does():
    size, radius = np.array([66.0, 16.0, 30.0]), 60.0
    pose = pose_at(np.zeros(3), np.array([0, 0, -1.0]), np.array([1.0, 0, 0]), size[2])
    # A plane is touched by the middle of the arc; a bump beside it, as high as the arc is there, at the same
    # time.
    bump = np.array([20.0, 0.0, radius - np.sqrt(radius**2 - 20.0**2)])
    assert indentation(pose, size, np.zeros((1, 3)), radius) == pytest.approx(0.0)
    assert indentation(pose, size, bump[None], radius) == pytest.approx(0.0)
    assert indentation(pose, size, bump[None]) == pytest.approx(bump[2])
    lifted = touching(pose, size, np.array([bump + [0, 0, 5.0]]), radius)
    assert lifted[:3, 3] - pose[:3, 3] == pytest.approx([0, 0, 5.0])


def test_the_tool_of_a_curved_array_is_its_arc_to_a_tenth_of_a_millimetre(one_device):
    probe = load_probe("curvilinear")
    tool = tool_of(probe)
    planes = array_of(tool.half_space).astype(float)
    angle = np.radians(np.linspace(probe.theta_start_deg, probe.theta_stop_deg, 61))
    centre = np.array([0.0, 0.0, probe.radius_mm - probe.housing_mm[2] / 2])
    arc = centre + probe.radius_mm * np.column_stack([np.sin(angle), 0 * angle, -np.cos(angle)])
    outside = (arc @ planes[:, :3].T - planes[:, 3]).max(axis=1)
    assert np.all(outside <= 1e-4) and np.all(outside > -0.1)
    assert arc[30] == pytest.approx([0, 0, -15.0])


def test_a_probe_of_short_housing_is_not_pushed_in_beyond_what_holds_it(manipulator):
    manipulator.push(100.0)
    assert manipulator.state.depth_mm == manipulator.max_mm == 15.0
    short = replace(manipulator, size_mm=np.array([16.0, 9.0, 6.0]))
    short.push(100.0)
    assert short.state.depth_mm == 9.0


def test_the_depth_of_a_press_follows_its_share(manipulator):
    for share, depth in ((0.4, 6.0), (0.8, 12.0), (0.2, 3.0)):
        for _ in range(20):
            manipulator.press(True, 0.1, share)
        assert manipulator.state.pressed_mm == pytest.approx(depth)
    manipulator.press(True, 0.1, 1.0)
    assert manipulator.state.pressed_mm == pytest.approx(3.0 + 1.2)
    manipulator.press(True, 0.1, 0.0)
    assert manipulator.state.pressed_mm == pytest.approx(4.2 - 4.0)


RADIUS = 30.0


@pytest.fixture
def rider() -> ProbeManipulator:
    """A hand on top of a fine sphere."""
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    vertices, faces = np.array(sphere.vertices), np.array(sphere.faces, np.int64)
    top = pose_at(np.array([0, 0, RADIUS]), np.array([0, 0, -1.0]), np.array([1.0, 0, 0]), SIZE[2])
    return ProbeManipulator(
        vertices, faces, np.array(sphere.vertex_normals), SIZE, top, np.array([1.0, 0, 0])
    )


def slid(
    manipulator: ProbeManipulator, lateral_mm: float, elevation_mm: float, steps: int = 20
) -> np.ndarray:
    """Where the face is aimed at after so many equal steps."""
    for _ in range(steps):
        manipulator.slide(lateral_mm / steps, elevation_mm / steps)
    return (manipulator.aim @ [0, 0, -SIZE[2] / 2, 1])[:3]


def on_the_arc(towards: np.ndarray, way_mm: float) -> np.ndarray:
    angle = way_mm / RADIUS
    return RADIUS * (np.sin(angle) * np.asarray(towards, float) + np.cos(angle) * np.array([0, 0, 1.0]))


# A step d along the tangent becomes R atan(d / R), 0.04 % less for 1 mm; the sphere's edges are 2.2 mm long,
# so that its faces lie up to 2.2^2 / (8 R) = 0.02 mm under it, and their smoothed normals rock a step by no
# more than that over an edge.
@pytest.mark.parametrize(
    ("lateral", "elevation", "turned", "towards"),
    [
        (20.0, 0.0, (0, 0, 0), [1, 0, 0]),
        (0.0, -20.0, (0, 0, 0), [0, -1, 0]),
        (9.0, -12.0, (0, 0, 0), [0.6, -0.8, 0]),
        (15.0, 0.0, (0, 0, 90), [0, 1, 0]),
        (15.0, 0.0, (0, 50, 0), [1, 0, 0]),
    ],
)
def test_a_slide_goes_so_far_over_the_surface_as_the_picture_is_turned(
    rider, lateral, elevation, turned, towards
):
    rider.turn(*turned)
    place = on_the_arc(towards, np.hypot(lateral, elevation))
    assert slid(rider, lateral, elevation) == pytest.approx(place, abs=0.2)
    assert rider.aim[:3, 2] @ place / RADIUS > np.cos(np.radians(0.5))


def test_a_slide_continues_where_the_surface_normal_is_along_the_lateral_axis(rider):
    way = np.radians(150) * RADIUS
    assert slid(rider, way, 0.0, 75) == pytest.approx(on_the_arc([1, 0, 0], way), abs=0.8)


def test_a_slide_goes_over_the_surface_not_with_the_depth(rider):
    rider.push(4.0)
    rider.turn(20.0, -10.0, 0.0)
    assert np.linalg.norm(slid(rider, 5.0, 5.0, 5)) == pytest.approx(RADIUS, abs=0.03)
    assert (rider.state.depth_mm, tuple(rider.state.turn_deg)) == (4.0, (20.0, -10.0, 0.0))
