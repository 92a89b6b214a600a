"""Measurements of an anatomy: a ball in a ball, and outlines whose place in the picture is known by hand."""

from types import SimpleNamespace

import igl
import numpy as np
import pytest
import trimesh

from rehearsal.measurements.tumour_measurements import Measurement, measure, penetration_of
from scenes.surfaces import FineSurface
from ultrasound.array_contact import footprint
from ultrasound.probe import load_probe

LINEAR, CURVED = load_probe("linear"), load_probe("curvilinear")
NOWHERE = np.zeros((0, 2, 2))


def ball(radius: float, at=(0, 0, 0), subdivisions: int = 3) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius).apply_translation(at)


def posed(face=(0.0, 0.0, 40.0), probe=LINEAR) -> np.ndarray:
    """Looks down -z, the middle of the face there."""
    pose = np.eye(4)
    pose[:3, 3] = np.asarray(face) + [0, 0, probe.housing_mm[2] / 2]
    return pose


def anatomy_of(
    organ=None, tumour=None, shift=(0, 0, 0), now=None, pose=None, probe=LINEAR, outline=NOWHERE, **load
) -> SimpleNamespace:
    """What is measured: an organ at rest, or deformed as ``now``, and a tumour that has shifted; ``load`` is
    what a frame has of the contact.
    """
    organ = organ or ball(30.0)
    now = np.asarray(organ.vertices if now is None else now, float)
    fine = FineSurface.of(trimesh.Trimesh(now, organ.faces, process=False))
    return SimpleNamespace(
        case=SimpleNamespace(size_mm=np.array(probe.housing_mm), probe=probe),
        organ=organ,
        vertices=now,
        fine_organ=lambda: (fine, fine.vertices),
        pose=posed() if pose is None else pose,
        tumour=tumour,
        frame=SimpleNamespace(**{"wrench": None, "lag_mm": 0.0, **load}),
        tumour_vertices=None if tumour is None else np.asarray(tumour.vertices) + shift,
        tumour_outline=lambda: None if tumour is None else outline,
    )


def reading(probe=LINEAR, touches=None, **parts):
    every = np.ones(probe.number_of_scanlines, bool)
    return measure(anatomy_of(probe=probe, **parts), probe, every if touches is None else touches)


def test_penetration_is_that_in_the_whole_fine_surface():
    """Whose faces far from the probe are left undivided."""
    organ = ball(30.0)
    rng = np.random.default_rng(0)
    organ.vertices += rng.normal(0, 0.2, organ.vertices.shape)
    probe = load_probe("drop-in")
    for deep_mm in (-1.0, 0.5, 3.0, 6.0):
        pose = posed((2.0, 1.0, 29.0 - deep_mm), probe)
        anatomy = anatomy_of(organ, pose=pose, probe=probe)
        fine, vertices = anatomy.fine_organ()
        assert fine.faces_where(np.abs(organ.vertices[:, 2]) > 20).shape[0] < len(fine.faces)
        places = footprint(probe) @ pose[:3, :3].T + pose[:3, 3]
        whole = trimesh.Trimesh(vertices, fine.faces, process=False)
        assert whole.is_watertight
        distance = igl.signed_distance(places, vertices, fine.faces)[0]
        assert penetration_of(anatomy) == pytest.approx(max(-distance.min(), 0.0), abs=1e-9)


def test_without_a_tumour_there_is_nothing_to_say_of_it():
    assert reading() == Measurement(compression_mm=0, contact_mm2=0)


def test_what_is_pressed_is_read_of_the_organ_as_it_lies():
    organ = trimesh.creation.box([60.0, 60.0, 40.0])
    measurement = reading(organ=organ, now=organ.vertices * [1, 1, 0.9], pose=posed((0, 0, 18)))
    assert measurement.contact_mm2 == pytest.approx(400)
    assert measurement.compression_mm == pytest.approx(4, abs=1e-5)


@pytest.mark.parametrize("name", ["drop-in", "linear", "curvilinear"])
@pytest.mark.parametrize(
    "at", [(0, 0, 0), (3.5, 1, 5), (-5.5, -2, 3), (60, 5, 0), (-60, 0, 9), (5, 30, 0), (0, -30, 0)]
)
def test_from_the_face_to_the_tumour(name, at):
    probe = load_probe(name)
    turned = trimesh.transformations.random_rotation_matrix(np.array([0.2, 0.7, 0.4]))
    measurement = reading(
        probe,
        tumour=ball(4.0, at).apply_transform(turned),
        pose=turned @ posed((0, 0, 12), probe),
        organ=ball(100.0),
    )
    # The nearest point of the face, on the arc that it has along x; of so many that the nearest is told by
    # looking.
    half = np.array(probe.housing_mm[:2]) / 2
    x, y = np.linspace(-half[0], half[0], 20_001), np.clip(at[1], -half[1], half[1])
    z = 12 + (probe.radius_mm and probe.radius_mm - np.sqrt(probe.radius_mm**2 - x**2))
    true = np.sqrt((x - at[0]) ** 2 + (y - at[1]) ** 2 + (z - at[2]) ** 2).min() - 4
    # The face's places are 0.77 mm apart at most, so it ends 0.4 mm beyond the last of them; facets lie 0.5 %
    # in.
    assert true - 1e-3 < measurement.to_tumour_mm < true + 0.02 + np.hypot(0.4, 0.4)
    if abs(at[0]) < half[0] - 1 and abs(at[1]) < half[1] - 1 and probe.radius_mm == 0:
        # Over it, half a place aside costs its square.
        assert measurement.to_tumour_mm < true + 0.02 + 2 * 0.385**2 / (2 * (true + 4))


@pytest.mark.parametrize("at", [(0, 0, 10), (12, -9, 8), (-16, 12, 0)])
def test_how_deep_a_tumour_lies(at):
    organ = ball(30.0, subdivisions=4)
    measurement = reading(
        organ=organ, tumour=ball(5.0, at), now=organ.vertices * 1.1 + [1, 2, 3], shift=(1, 2, 3)
    )
    # Facets of the organ lie 0.15 % in. The tumour's nearest vertex is 9 degrees from the way out at most.
    true = 33 - np.linalg.norm(at) - 5
    assert true - 0.05 < measurement.tumour_depth_mm < true + 5 * (1 - np.cos(np.radians(9)))


def test_how_deep_a_tumour_lies_under_large_triangles():
    # Under the middle of a face no vertex of the organ is near.
    organ = trimesh.creation.box([60.0, 60.0, 40.0])
    assert reading(organ=organ, tumour=ball(5.0, (15, 2, 13))).tumour_depth_mm == pytest.approx(2.0, abs=0.05)


@pytest.mark.parametrize("at", [(0, 0, 16), (0, 0, 22), (29, 0, 17)])
def test_a_tumour_that_sticks_out_has_no_depth(at):
    organ = trimesh.creation.box([60.0, 60.0, 40.0])
    assert reading(organ=organ, tumour=ball(5.0, at)).tumour_depth_mm == 0


def test_how_far_a_tumour_has_moved():
    measurement = reading(tumour=ball(5.0, (1, 2, 3)), shift=(2, -3, 6))
    assert measurement.tumour_shift_mm == pytest.approx(7)


def along(*corners, parts: int = 10) -> np.ndarray:
    """An outline through corners (u, v), every side in so many segments."""
    ends = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    points = np.concatenate([np.linspace(a, b, parts, endpoint=False) for a, b in ends])
    return np.stack([points, np.roll(points, -1, axis=0)], axis=1)


def square(u: float, v: float, half: float = 5.0) -> np.ndarray:
    """40 segments of 1 mm about a place, for a half of 5 mm."""
    return along((u - half, v - half), (u + half, v - half), (u + half, v + half), (u - half, v + half))


def seen(probe, outline, touches=None) -> tuple:
    measurement = reading(probe, touches, tumour=ball(5.0), outline=outline)
    return measurement.in_view, measurement.margin_mm


# 40 mm wide, 60 deep.
@pytest.mark.parametrize(
    "u, v, in_view, margin",
    [
        (8, 20, 1.0, 7.0),
        (-10, 20, 1.0, 5.0),
        (0, 53, 1.0, 2.0),
        (18, 20, 0.6, -3.0),  # of 40 segments the far 10, and 3 of both between, are out
        (-18, 20, 0.6, -3.0),
        (0, 58, 0.6, -3.0),
        (0, 2, 0.6, 15.0),  # behind the face nothing is shown; what is beside and under it stays
        (40, 20, 0.0, -25.0),
        (0, 80, 0.0, -25.0),
        (15, 20, 1.0, 0.0),
        (0, 55, 1.0, 0.0),
    ],
)
def test_a_square_in_a_linear_picture(u, v, in_view, margin):
    # 1e-9 aside, so that segments on the edge are in it.
    outline = square(u * (1 - 1e-10), v * (1 - 1e-10))
    assert seen(LINEAR, outline) == pytest.approx((in_view, margin), abs=1e-6)


def test_an_outline_is_weighed_by_its_length():
    outline = square(18, 20)
    out = outline.mean(axis=1)[:, 0] > 20
    start, run = outline[out, 0], outline[out, 1] - outline[out, 0]
    halved = [np.stack([start + a * run, start + b * run], axis=1) for a, b in ((0, 0.5), (0.5, 1))]
    halves = np.concatenate([outline[~out], *halved])
    assert len(halves) > len(outline)
    assert seen(LINEAR, halves)[0] == pytest.approx(0.6)


def test_what_lies_before_lines_that_do_not_touch_is_not_in_view():
    # Lines of u < 8 do not touch: the left side, and 3 of both between.
    touches = LINEAR.elements()[:, 0] > 8
    assert seen(LINEAR, square(10, 20), touches) == pytest.approx((0.6, 5.0))
    assert seen(LINEAR, square(10, 20), ~touches) == pytest.approx((0.4, 5.0))


def test_a_plane_that_misses_the_tumour_shows_none_of_it():
    assert seen(LINEAR, NOWHERE) == (None, None)


def sector(first: float, last: float, near: float, far: float) -> np.ndarray:
    """Between angles [degrees] and depths [mm] of the curvilinear probe: arcs of 1 degree, radii of 1 mm."""
    angles, depths = np.radians(np.arange(first, last + 0.5)), np.arange(near, far + 0.5)

    def polar(angle, depth):
        radius = depth + 60
        return np.column_stack([radius * np.sin(angle), radius * np.cos(angle) - 60])

    sides = [
        polar(angles, near),
        polar(angles[-1], depths),
        polar(angles, far)[::-1],
        polar(angles[0], depths)[::-1],
    ]
    return np.concatenate([np.stack([side[:-1], side[1:]], axis=1) for side in sides])


# Of an arc of one degree, of radius 1.
CHORD = 2 * np.sin(np.radians(0.5))


# 60 mm of radius, from -30 to 30 degrees, 120 mm deep.
@pytest.mark.parametrize(
    "first, last, near, far, in_view, margin",
    [
        # The first radial segment's middle is 20.5 deep: 80.5 mm from where the lines leave, 5 degrees from
        # the last.
        (-5, 25, 20, 40, 1.0, 80.5 * np.radians(5)),
        (-25, 5, 20, 40, 1.0, 80.5 * np.radians(5)),
        # An arc's chord is nearer by 1 - cos(0.5 degrees) of 175 mm.
        (-5, 5, 100, 115, 1.0, 120 - (175 * np.cos(np.radians(0.5)) - 60)),
        # Arcs of radius 80 and 100: 10 degrees of 15 in, and one radius of 20 mm of two. Out by 5 degrees of
        # the farthest, at 39.5.
        (20, 35, 20, 40, (10 * 180 * CHORD + 20) / (15 * 180 * CHORD + 40), -99.5 * np.radians(5)),
        (-35, -20, 20, 40, (10 * 180 * CHORD + 20) / (15 * 180 * CHORD + 40), -99.5 * np.radians(5)),
        # Behind the face, where lines count as far apart as on it, nothing is shown. Of 12 degrees each side:
        # arcs of radius 54 and 66 mm, two radii of 12 mm.
        (-12, 12, -6, 6, (66 * 24 * CHORD + 12) / (120 * 24 * CHORD + 24), 60 * np.radians(18)),
    ],
)
def test_a_piece_of_a_sector_in_a_curvilinear_picture(first, last, near, far, in_view, margin):
    assert seen(CURVED, sector(first, last, near, far)) == pytest.approx((in_view, margin), rel=1e-6)


def test_force_and_torque_are_the_sizes_of_the_wrench():
    wrench = np.array([1.0, -2.0, 2.0, 0.0, 6.0, 8.0])
    with_force = reading(wrench=wrench, sliding_share=0.75, friction_ratio=0.25)
    assert (with_force.force_n, with_force.torque_n_mm) == (3.0, 10.0)
    assert (with_force.sliding_share, with_force.friction_ratio) == (0.75, 0.25)
    assert reading().force_n is None and reading().torque_n_mm is None
