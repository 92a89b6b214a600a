"""Surfaces of labels, and the support moulded under an organ."""

import igl
import numpy as np
import pytest
import SimpleITK as sitk
import trimesh
from synthetic_body import (
    DIRECTIONS,
    LEFT,
    LEFT_ML,
    SPACINGS,
    TUMOUR,
    assert_sound,
    coarsely,
    drawn,
    grid_around,
    least_gap,
    level,
    voxels_to_boundary,
)
from trimesh.exchange.ply import export_ply
from trimesh.exchange.stl import export_stl_ascii

from errors import PatientError
from scenes.patients.label_surfaces import decimate, self_intersections, surface_from_mask
from scenes.patients.organ_support import mould
from scenes.surfaces import distances_on_grid, load_surface


@pytest.fixture
def coarse(monkeypatch):
    coarsely(monkeypatch)


class TestSurface:
    @pytest.mark.parametrize(
        ("direction", "spacing"),
        [("left-handed", "thick"), ("slices first", "thick"), ("oblique", "thick"), ("oblique", "even")],
    )
    def test_lies_where_the_label_is(self, direction, spacing):
        (centre, axes), direction, spacing = LEFT, DIRECTIONS[direction], SPACINGS[spacing]
        mask = drawn(grid_around(centre - axes - 12, centre + axes + 7, spacing, direction), (1, LEFT))
        surface = surface_from_mask(mask, faces=2000)

        assert_sound(surface)
        assert len(surface.faces) == pytest.approx(2000, abs=20)
        label_ml = sitk.GetArrayViewFromImage(mask).sum() * np.prod(spacing) / 1000
        assert surface.volume / 1000 == pytest.approx(label_ml, rel=1e-3)
        assert surface.volume / 1000 == pytest.approx(LEFT_ML, rel=0.03)
        assert voxels_to_boundary(surface, mask).max() < 1
        # The label knows each boundary point to half a voxel; the smoothed surface must not be worse than
        # that against the true ellipsoid, along the normal, where a voxel measures |n| . spacing.
        gradient = (surface.vertices - centre) / axes**2
        normal = gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
        off = np.abs(level(surface.vertices, LEFT) / np.linalg.norm(gradient, axis=1))
        assert (off <= 0.5 * np.abs(normal @ direction) @ np.array(spacing)).all()
        assert np.abs(surface.center_mass - centre).max() < 0.1 * max(spacing)

    def test_has_no_stairs_between_thick_slices(self):
        centre, axes = LEFT
        mask = drawn(grid_around(centre - axes - 9, centre + axes + 9, (0.8, 0.8, 5.0)), (1, LEFT))
        surface = surface_from_mask(mask)
        # Stairs would turn the normal by 90 degrees at each of 18 slices; 5000 even triangles of an
        # ellipsoid with 9 mm as its least radius of curvature turn by about 1.5 mm / 9 mm, 10 degrees.
        turn = np.degrees(surface.face_adjacency_angles)
        assert np.percentile(turn, 99) < 15
        assert np.degrees(surface.face_angles.min(axis=1)).min() > 5

    def test_drops_islands_and_fills_holes(self, coarse):
        centre, axes = LEFT
        empty = grid_around(centre - axes - 30, centre + axes + 10, (1.5, 1.5, 1.5))
        island = centre - axes - 15, np.full(3, 5.0)
        hole = centre, np.full(3, 6.0)
        surface = surface_from_mask(drawn(empty, (1, LEFT), (1, island), (0, hole)), faces=2000)
        assert_sound(surface)
        assert surface.volume / 1000 == pytest.approx(LEFT_ML, rel=0.01)

    def test_empty_mask_is_refused(self):
        with pytest.raises(ValueError, match="empty"):
            surface_from_mask(sitk.Image([9, 9, 9], sitk.sitkUInt8))

    def test_same_bits_twice(self, coarse):
        centre, axes = TUMOUR
        mask = drawn(grid_around(centre - axes - 9, centre + axes + 9, (1.5, 1.5, 1.5)), (1, TUMOUR))
        first, second = surface_from_mask(mask, 500), surface_from_mask(mask, 500)
        assert np.array_equal(first.vertices, second.vertices)
        assert np.array_equal(first.faces, second.faces)

    def test_self_intersections_are_found(self):
        ball = trimesh.creation.icosphere(subdivisions=2)
        assert self_intersections(ball) == 0
        ball.vertices[0] = -1.5 * ball.vertices[0]
        assert self_intersections(ball) > 0

    def test_walls_close_to_each_other_stay_apart(self):
        """A ball folded into a bowl: thinned without regard to the other wall, each wall goes through it."""
        ball = trimesh.creation.icosphere(subdivisions=3, radius=10.0)
        x, y, z = ball.vertices.T
        bowl = trimesh.Trimesh(
            np.column_stack([x, y, np.where(z < 0, -0.95 * z, z)]), ball.faces, process=False
        )
        thin = decimate(bowl, 120)
        assert len(thin.faces) == 120 and thin.is_watertight
        assert self_intersections(bowl) == self_intersections(thin) == 0


class TestSupport:
    @pytest.mark.parametrize("gravity", [(0, 0, -1), (0, 1, 0), (0.6, 0, -0.8)])
    def test_lies_under_the_organ_and_clear_of_it(self, gravity):
        organ = trimesh.creation.icosphere(subdivisions=4)
        organ.vertices = organ.vertices * (28, 14, 18) + (10, -300, 40)
        support = mould(organ, np.array(gravity))

        assert_sound(support)
        assert len(support.faces) == pytest.approx(5000, abs=50)
        assert 0.0 < least_gap(support, organ) < 0.35
        down = np.array(gravity)
        height = np.ptp(organ.vertices @ down)
        bottom, top = (organ.vertices @ down).max(), (support.vertices @ down).min()
        assert bottom - top == pytest.approx(0.35 * height, abs=0.1)
        assert (support.vertices @ down).max() == pytest.approx(bottom + 8, abs=0.1)

    def test_moulds_the_underside(self):
        organ = trimesh.creation.icosphere(subdivisions=4, radius=20)
        support = mould(organ, np.array([0, 0, -1]), clearance_mm=0.5)
        # Polar angles up to 40 degrees lie in the mould, well inside of its filleted rim (at 73 degrees).
        under = organ.vertices[organ.vertices[:, 2] < -20 * np.cos(np.radians(40))]
        faces = np.asarray(support.faces, np.int64)
        gap = igl.signed_distance(np.ascontiguousarray(under), np.asarray(support.vertices), faces)[0]
        assert np.abs(gap - 0.5).max() < 0.15

    def test_organ_can_be_lifted_out(self):
        leaning = trimesh.creation.icosphere(subdivisions=4, radius=20)
        leaning.vertices[:, 0] -= leaning.vertices[
            :, 2
        ]  # its lower end reaches far under the rim: an undercut
        up = np.array([0.0, 0.0, 1.0])
        support = mould(leaning, -up)
        for lift in (1.0, 5.0, 20.0):
            lifted = leaning.copy().apply_translation(lift * up)
            assert least_gap(support, lifted) > 0

    @pytest.mark.parametrize("gravity", [(0, 0, 0), (np.nan, 0, 1)])
    def test_gravity_without_direction_is_refused(self, gravity):
        with pytest.raises(ValueError, match="gravity"):
            mould(trimesh.creation.icosphere(radius=30), np.array(gravity))


@pytest.mark.parametrize("kind", ["stl", "ply", "obj", "ascii.stl", "ascii.ply"])
@pytest.mark.parametrize("share", [0.0, 0.002, 0.02, 0.3, 0.7, 0.99])
def test_a_file_that_is_cut_off(tmp_path, kind, share):
    """In words: what the reader that was tried last misses is no help."""
    ball, path = trimesh.creation.icosphere(2), tmp_path / f"ball.{kind}"
    if kind == "ascii.stl":
        path.write_text(export_stl_ascii(ball))
    elif kind == "ascii.ply":
        path.write_bytes(export_ply(ball, encoding="ascii"))
    else:
        ball.export(path)
    assert len(load_surface(path).faces) == len(ball.faces)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(PatientError, match="is empty|incomplete") as caught:
        load_surface(path)
    assert "Error" not in str(caught.value) and str(path) in str(caught.value)


@pytest.mark.parametrize("ending", ["stl", "ply", "obj", "3mf", "dae", "xyz", "txt"])
@pytest.mark.parametrize("content", [b"Doe^Jane is ill\n" * 40, bytes(500), bytes(range(256)) * 4])
def test_a_file_of_another_kind(tmp_path, ending, content):
    (tmp_path / f"a.{ending}").write_bytes(content)
    with pytest.raises(PatientError, match="expected a closed surface in an STL, PLY or OBJ file") as caught:
        load_surface(tmp_path / f"a.{ending}")
    assert "Error" not in str(caught.value) and "Doe" not in str(caught.value)


@pytest.mark.parametrize("exact_mm", [(-8.0, 8.0), (-np.inf, 3.0)])
def test_distances_on_a_grid_are_exact_near_the_surface_and_nearly_so_elsewhere(exact_mm):
    """Of a box, whose corners and medial planes are the worst for what is between points; the grid does
    not end at a coarse point.
    """
    box = trimesh.creation.box([40.0, 30.0, 22.0]).apply_translation([3.0, 1.0, -2.0])
    low, counts, spacing = np.array([-37.0, -31.5, -30.0]), (28, 22, 20), 3.0
    found = distances_on_grid(box, low, counts, spacing, exact_mm)
    over = np.abs(low + spacing * np.moveaxis(np.indices(counts), 0, -1) - [3.0, 1.0, -2.0]) - [
        20.0,
        15.0,
        11.0,
    ]
    truth = np.linalg.norm(np.maximum(over, 0), axis=-1) + np.minimum(over.max(axis=-1), 0)
    away = np.abs(found - truth)
    # A distance changes by no more than the way to a point at which it is known: half a coarse cell's
    # diagonal.
    assert away.max() < spacing * np.sqrt(3)
    # What is interpolated is off by less than that, and taken as it is only where it is out of the range by
    # itself.
    inner = (truth > exact_mm[0] + spacing * np.sqrt(3)) & (truth < exact_mm[1] - spacing * np.sqrt(3))
    assert away[inner].max(initial=0.0) < 1e-9 and away[truth < 0].max() < (
        1e-9 if exact_mm[0] == -np.inf else 4.0
    )


def test_a_full_memory_is_no_damaged_surface(tmp_path, monkeypatch):
    def out_of_memory(*given, **named):
        raise MemoryError

    trimesh.creation.box().export(tmp_path / "organ.stl")
    monkeypatch.setattr(trimesh, "load_mesh", out_of_memory)
    with pytest.raises(MemoryError):
        load_surface(tmp_path / "organ.stl")
