"""The outline of a surface where an image plane cuts it."""

import numpy as np
import pytest
import trimesh
from conftest import rotation_about
from scipy.spatial.distance import cdist

from ultrasound.probe_manipulator import image_plane, pose_at
from ultrasound.scanner import plane_section

RADIUS = 12.0


def oblique_plane() -> np.ndarray:
    """A plane (4, 4), from world, at an angle to every edge of the ball, 3 mm off its centre."""
    plane = np.eye(4)
    plane[:3, :3] = rotation_about([0, 0, 1], 40) @ rotation_about([1, 2, 0], 35)
    plane[:3, 3] = [1.5, -4.0, 3.0]
    return plane


def cut(mesh: trimesh.Trimesh, plane: np.ndarray) -> np.ndarray:
    return plane_section(np.array(mesh.vertices), np.array(mesh.faces), plane)


def is_closed(segments: np.ndarray) -> bool:
    """Whether each end is where exactly two segments end."""
    ends = segments.reshape(-1, 2)
    return bool(((cdist(ends, ends) < 1e-6).sum(axis=1) == 2).all())


def length(segments: np.ndarray) -> float:
    return float(np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1).sum())


@pytest.mark.parametrize("distance", [0.4, 3.0, 7.3, 11.0])
def test_a_ball_gives_the_circle_of_its_distance(ball, distance):
    plane = oblique_plane()
    plane[2, 3] = distance
    segments = cut(ball, plane)
    # The facets lie between the sphere and the one that touches the nearest of them, and the outline between
    # their circles.
    nearest = np.einsum("ij,ij->i", ball.face_normals, ball.triangles[:, 0]).min()
    inner, outer = np.sqrt(np.array([nearest, RADIUS]) ** 2 - distance**2)
    reach = np.linalg.norm(segments - plane[:2, 3], axis=2)
    assert reach.min() >= inner and reach.max() <= outer + 1e-9
    # Of convex outlines one within another, the inner is the shorter.
    assert 2 * np.pi * inner <= length(segments) <= 2 * np.pi * outer
    assert is_closed(segments)


def test_a_block_gives_its_rectangle(block):
    plane = np.eye(4)
    plane[:3, 3] = [5.0, 6.0, 7.0]
    segments = cut(block, plane)
    assert length(segments) == pytest.approx(2 * (24 + 20)) and is_closed(segments)
    assert segments.min(axis=(0, 1)) == pytest.approx([5 - 12, 6 - 10])
    assert segments.max(axis=(0, 1)) == pytest.approx([5 + 12, 6 + 10])


def test_u_is_to_the_marked_side_and_v_down_from_the_probes_face(ball):
    pose = pose_at(np.array([-7.0, 0.0, 20.0]), np.array([0, 0, -1.0]), np.array([1.0, 0, 0]), 20.0)
    plane = image_plane(pose, 20.0, 40.0, 60.0)
    segments = cut(ball, np.linalg.inv(plane.world_from_plane))
    assert segments.mean(axis=(0, 1)) == pytest.approx([7.0, 20.0], abs=0.1)


def test_vertices_on_the_plane_keep_it_closed(ball):
    assert (np.abs(ball.vertices[:, 2]) < 1e-9).sum() > 10
    assert is_closed(cut(ball, np.eye(4)))


@pytest.mark.parametrize("side", [1, -1])
def test_edges_on_the_plane_keep_it_closed(block, side):
    along = np.array([24.0, side * 20.0, 0.0]) / np.hypot(24, 20)
    diagonal = np.eye(4)
    diagonal[:3, :3] = [along, [0, 0, 1], np.cross(along, [0, 0, 1])]
    assert (np.abs(block.vertices @ diagonal[2, :3]) < 1e-9).sum() == 4
    rectangle = cut(block, diagonal)
    assert length(rectangle) == pytest.approx(2 * (np.hypot(24, 20) + 16)) and is_closed(rectangle)


@pytest.mark.parametrize("distance", [12.5, -12.5])
def test_a_miss_has_no_segments(ball, distance):
    plane = np.eye(4)
    plane[2, 3] = distance
    assert cut(ball, plane).shape == (0, 2, 2)
