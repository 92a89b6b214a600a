"""The cut along the image plane: sections and faces of balls and blocks, known by hand; which half goes."""

import numpy as np
import pytest
import trimesh
from conftest import rotation_about

from render import cut_face
from render.cut_face import Raster, oriented_section, side_of_eye
from render.surface_shading import ShadedSurface
from sim.fields import array_of, field_of

RADIUS = 12.0


def plane(at=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0), degrees=0.0) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_about(list(axis), degrees), at
    return pose


@pytest.mark.parametrize("height", [0.3, 5.0, -9.0])
@pytest.mark.parametrize("degrees", [0.0, 70.0])
def test_a_ball_is_cut_in_a_circle(ball, height, degrees):
    pose = plane(axis=(0.3, 0.2, 1.0), degrees=degrees)
    pose[:3, 3] = [1.0, -2.0, 0.5] + height * pose[:3, 1]
    segments = oriented_section(ball.vertices + [1.0, -2.0, 0.5], ball.faces, pose)
    # The chords of the ball's triangles lie 2 % of its radius in at most.
    true = np.sqrt(RADIUS**2 - height**2)
    away = np.linalg.norm(segments, axis=-1)
    assert away.max() <= true + 1e-9 and away.min() > true - 0.03 * RADIUS
    # One ring: every segment begins where another ends.
    starts, ends = (np.unique(segments[:, i].round(6), axis=0) for i in (0, 1))
    assert np.allclose(starts, ends, atol=1e-5) and len(starts) == len(segments)


def test_a_plane_that_misses_cuts_nothing(ball):
    assert oriented_section(ball.vertices, ball.faces, plane((0, 12.5, 0))).shape == (0, 2, 2)


def test_a_block_covers_the_cells_that_it_covers(block):
    # 24 x 16 mm in x and z, the middle 3 mm aside.
    segments = oriented_section(block.vertices + [3.0, 0.0, 0.0], block.faces, plane())
    raster = Raster.around([segments], 61)
    covered = raster.covered(segments)
    u, v = raster.places().reshape(61, 61, 2).transpose(2, 0, 1)
    assert covered.sum() * raster.width**2 == pytest.approx(24 * 16, rel=0.02)
    beyond = np.maximum(np.abs(u - 3) - 12, np.abs(v) - 8)
    assert (covered[beyond < -1.5 * raster.width] > 1 - 1e-9).all()
    assert (covered[beyond > 1.5 * raster.width] < 1e-9).all()
    # Left and right edges are as exact as cells are covered.
    row = covered[30]
    assert row.sum() * raster.width == pytest.approx(24, abs=1e-6)
    assert (row * u[30]).sum() / row.sum() == pytest.approx(3, abs=0.01)


def test_a_hole_is_not_covered(ball):
    hole = trimesh.creation.icosphere(subdivisions=3, radius=6.0)
    segments = [
        oriented_section(mesh.vertices, faces, plane((0, 1, 0)))
        for mesh, faces in ((ball, ball.faces), (hole, hole.faces[:, ::-1]))
    ]
    raster = Raster.around(segments, 101)
    area = raster.covered(np.concatenate(segments)).sum() * raster.width**2
    assert area == pytest.approx(np.pi * (RADIUS**2 - 36), rel=0.02)


def test_surfaces_of_either_sense_cover(ball):
    segments = oriented_section(ball.vertices, ball.faces[:, ::-1], plane())
    raster = Raster.around([segments], 61)
    assert raster.covered(segments).sum() * raster.width**2 == pytest.approx(np.pi * RADIUS**2, rel=0.02)


def test_without_a_section_nothing_is_covered():
    nothing = np.zeros((0, 2, 2))
    assert Raster.around([nothing], 20).covered(nothing).max() == 0


@pytest.mark.parametrize(
    ("degrees", "before", "side"),
    [
        (40, 0.0, 1),
        (-40, 0.0, -1),
        (40, -1.0, 1),
        (-40, 1.0, -1),
        (10, -1.0, -1),
        (-10, 1.0, 1),
        (10, 0.0, 1),
        (-10, 0.0, -1),
    ],
)
def test_the_half_before_the_eye_is_removed_and_edge_on_the_side_is_kept(degrees, before, side):
    angle = np.radians(degrees)
    pose = plane((3.0, 4.0, 5.0), (0, 0, 1), 30.0)
    eye = pose[:3, :3] @ [200 * np.cos(angle), 200 * np.sin(angle), 0] + pose[:3, 3]
    assert side_of_eye(pose, eye, before) == side


class Handed:
    """A scene that keeps what it is handed."""

    def mesh(self, points, indices, normals, per_vertex_color):
        self.points, self.colours = array_of(points), array_of(per_vertex_color)
        self.triangles, self.normals = indices.reshape(-1, 3), array_of(normals)


def test_the_face_lies_on_the_plane_in_the_colours_of_what_it_cuts(device, ball, monkeypatch):
    monkeypatch.setattr(cut_face, "CELLS", 60)
    kernel = trimesh.creation.icosphere(subdivisions=2, radius=4.0).apply_translation([5.0, 0, 0])
    organ, tumour = (
        ShadedSurface(field_of(mesh.vertices, 1), np.asarray(mesh.faces, np.int32), colour)
        for mesh, colour in ((ball, (0.5, 0.1, 0.1)), (kernel, (1.0, 0.8, 0.0)))
    )
    pose, scene = plane((0, 1, 0), (0, 0, 1), 20.0), Handed()
    cut_face.CutFace().draw(scene, organ, [tumour], pose, np.array([0.0, 300.0, 0.0]))
    assert scene.points.shape == (3600, 3)
    assert (scene.points - pose[:3, 3]) @ pose[:3, 1] == pytest.approx(0, abs=1e-4)
    shown = np.zeros(3600, bool)
    shown[scene.triangles] = True
    away = np.linalg.norm(scene.points, axis=1)
    from_kernel = np.linalg.norm(scene.points - [5.0, 0, 0], axis=1)
    assert shown[away < RADIUS - 1].all() and not shown[away > RADIUS + 1].any()
    opacity = scene.colours[:, 3]
    assert (opacity[away < RADIUS - 1] > 1).all() and (opacity[away > RADIUS + 1] < 0).all()
    assert np.allclose(scene.colours[from_kernel < 3, :3], (1.0, 0.8, 0.0), atol=1e-5)
    flesh = (from_kernel > 5) & (away < RADIUS - 1)
    assert np.allclose(scene.colours[flesh, :3], cut_face.FLESH, atol=1e-5)
    assert np.allclose(scene.normals, [0, 1, 0], atol=0.05)
