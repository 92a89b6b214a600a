"""The geometry of plans, on a ball: paths, layouts, reach and scores."""

from dataclasses import asdict, replace
from itertools import pairwise, product
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from conftest import rotation_about
from plan_ball import (
    FACET_MM,
    GOOD,
    NORMAL_DEG,
    SIZE,
    R,
    X,
    Y,
    Z,
    big_ball,
    case_of_ball,
    faces_in,
    from_above,
    manipulator_on,
)

from rehearsal.planning.plan_file import LIFT_MM
from rehearsal.planning.sweep_path import (
    NEAR_MM,
    STEP_DEG,
    STEP_MM,
    frame_towards,
    reachable,
    sliding,
    tilted,
    tilting,
    transfer,
    turned,
)
from rehearsal.planning.sweep_score import (
    WORDING,
    ScoreTerms,
    face_centres,
    in_words,
    incidence_deg,
    path_mm,
    points,
    score,
    why_better,
)
from rehearsal.planning.sweep_trial import Trial
from scenes.scene import Scene, Trocar
from ultrasound.probe_manipulator import ProbeManipulator, advanced, pose_at, poses_between, rigid


@pytest.fixture(scope="module")
def manipulator() -> ProbeManipulator:
    return manipulator_on(big_ball())


def angle_between_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip(np.einsum("...i,...i->...", a, b), -1, 1)))


# Layouts


def test_a_layout_has_right_handed_unit_axes_with_lateral_nearest_to_what_was_asked():
    outward = np.array([1.0, 2.0, 2.0]) / 3
    frame = frame_towards(np.array([5.0, 6, 7]), outward, X)
    axes = frame[:3, :3]
    assert axes.T @ axes == pytest.approx(np.eye(3)) and np.linalg.det(axes) == pytest.approx(1)
    assert frame[:3, 2] == pytest.approx(outward) and frame[:3, 3] == pytest.approx([5, 6, 7])
    assert frame[:3, 0] @ X == pytest.approx(np.sqrt(1 - outward[0] ** 2))


@pytest.mark.parametrize(
    ("lean", "heading", "axes"),
    [
        ((0, 0), 0, [X, Y, Z]),
        ((90, 0), 0, [X, Z, -Y]),
        ((0, 90), 0, [-Z, Y, X]),
        ((0, 0), 90, [Y, -X, Z]),
        # First about lateral, then about ahead as it was.
        ((90, 90), 0, [-Z, X, -Y]),
        # A heading turns about outward as it leans.
        ((90, 0), 90, [Z, -X, -Y]),
    ],
)
def test_a_layout_leans_and_turns_about_its_own_axes(lean, heading, axes):
    base = rotation_about([1, 2, 3], 50)
    after = turned(rigid(base, np.array([1.0, 2, 3])), lean, heading)
    assert after[:3, :3].T @ base == pytest.approx(np.stack(axes), abs=1e-12)
    assert after[:3, 3].tolist() == [1.0, 2.0, 3.0]


# Sliding


@pytest.mark.parametrize("depth", [0.0, 2.5])
def test_a_pass_along_the_surface_normal_is_evenly_spaced_at_its_depth(manipulator, depth):
    path = sliding(manipulator, from_above(), np.array([-6.0, 6.0]), -12.0, 13.0, depth, 1.0)
    assert [len(poses) for poses in path] == [int(np.ceil(25 / STEP_MM)) + 1] * 2
    for poses, aside, sign in zip(path, (-6.0, 6.0), (1, -1), strict=True):
        faces = faces_in(poses)
        radii = faces / np.linalg.norm(faces, axis=1, keepdims=True)
        assert angle_between_deg(poses[:, :3, 2], radii).max() < NORMAL_DEG
        # A flat face on a ball touches with its middle.
        assert np.linalg.norm(faces, axis=1) == pytest.approx(R - depth, abs=FACET_MM)
        off = (depth + FACET_MM) * np.radians(NORMAL_DEG) + R * np.radians(NORMAL_DEG) / 2
        places = R * radii
        assert places[:, 0] == pytest.approx(aside, abs=off)
        assert places[:, 1] == pytest.approx(np.linspace(-12, 13, len(poses))[::sign], abs=off)
        assert (poses[:, :3, 0] @ X > 0.9).all()


def test_a_pass_along_its_layout_has_the_axes_of_that(manipulator):
    frame = turned(from_above(), (0.0, 0.0), 90.0)
    (poses,) = sliding(manipulator, frame, np.array([3.0]), -15.0, 15.0, 1.0, 0.0)
    assert poses[:, :3, 2] == pytest.approx(np.tile(Z, (len(poses), 1)))
    assert poses[:, :3, 0] == pytest.approx(np.tile(Y, (len(poses), 1)))
    faces = faces_in(poses)
    assert faces[:, 1] == pytest.approx(3.0)
    assert faces[:, 0] == pytest.approx(-np.linspace(-15, 15, len(poses)))
    # The highest place under the face is that of its footprint which is nearest to the ball's axis; where
    # that is at an edge, the nearest sample lies up to 1.2 mm from it, on a slope of 0.4 at most.
    beside = np.maximum(np.abs(faces[:, 0]) - SIZE[1] / 2, 0)
    assert faces[:, 2] == pytest.approx(np.sqrt(R**2 - beside**2) - 1.0, abs=1.2 * 0.4)
    assert faces[beside == 0, 2] == pytest.approx(R - 1.0, abs=FACET_MM)


def test_half_following_is_halfway_between_layout_and_normal(manipulator):
    (poses,) = sliding(manipulator, from_above(), np.zeros(1), -14.0, 14.0, 0.0, 0.5)
    ahead = np.linspace(-14, 14, len(poses))
    # The place under the layout's line, not the face's middle, says where the surface looks.
    half = np.degrees(np.arcsin(ahead / R)) / 2
    leans = np.degrees(np.arctan2(poses[:, 1, 2], poses[:, 2, 2]))
    assert leans == pytest.approx(half, abs=NORMAL_DEG)


def test_a_pass_ends_where_the_organ_does_and_one_beside_it_is_left_out(manipulator):
    path = sliding(manipulator, from_above(), np.array([0.0, 45.0]), -40.0, 40.0, 0.0, 1.0)
    ahead = np.linspace(-40, 40, int(np.ceil(80 / STEP_MM)) + 1)
    (only,) = path
    # Where the surface is as steep as its facets are long, a ray may pass by.
    assert abs(len(only) - (np.abs(ahead) < R).sum()) <= 2
    assert sliding(manipulator, from_above(), np.array([45.0]), -4.0, 4.0, 0.0, 1.0) == []


@pytest.mark.parametrize("sign", [1, -1])
def test_of_two_lobes_the_longer_is_swept(sign):
    small = trimesh.creation.icosphere(subdivisions=3, radius=8.0).apply_translation([0, -22.0 * sign, 0])
    large = trimesh.creation.icosphere(subdivisions=3, radius=15.0).apply_translation([0, 22.0 * sign, 0])
    lobes = manipulator_on(trimesh.util.concatenate([small, large]))
    (poses,) = sliding(lobes, from_above(), np.zeros(1), -40.0, 40.0, 0.0, 0.0)
    ahead = faces_in(poses)[:, 1] * sign
    assert ahead.min() > 22 - 15.1 and ahead.max() < 22 + 15.1 and np.ptp(ahead) > 26


# Tilting


def test_tilting_turns_about_the_centre_of_the_face_in_equal_steps(manipulator):
    path = tilting(manipulator, from_above(), np.array([-5.0, 5.0]), 4.0, (-20.0, 31.0), 1.5)
    count = int(np.ceil(51 / STEP_DEG)) + 1
    assert [len(poses) for poses in path] == [count, count]
    for poses, sign in zip(path, (1, -1), strict=True):
        faces = faces_in(poses)
        assert np.abs(faces - faces[0]).max() < 1e-9
        assert np.linalg.norm(faces[0]) == pytest.approx(R - 1.5, abs=FACET_MM)
        radius = faces[0] / np.linalg.norm(faces[0])
        # Seen along its lateral axis, which stays: from the radius.
        lateral = poses[0, :3, 0]
        assert np.abs(poses[:, :3, 0] - lateral).max() < 1e-9
        angles = np.degrees(
            np.arctan2(np.cross(radius, poses[:, :3, 2]) @ lateral, poses[:, :3, 2] @ radius),
        )
        assert angles == pytest.approx(np.linspace(-20, 31, count)[::sign], abs=NORMAL_DEG)
    beside = tilting(manipulator, from_above(), np.array([50.0]), 0.0, (-10.0, 10.0), 0.0)
    assert beside == []


# ScoreTerms


def test_the_path_is_that_of_the_centre_of_the_face(manipulator):
    at = np.array([[0.0, 0, 0], [3, 4, 0], [3, 4, 12]])
    poses = np.stack([pose_at(place, -Z, X, SIZE[2]) for place in at])
    assert face_centres(manipulator, poses) == pytest.approx(at)
    assert path_mm(manipulator, poses) == pytest.approx(5 + 12)
    tilted_poses = np.stack([tilted(poses[0], SIZE[2], angle) for angle in (0, 20, -30)])
    assert path_mm(manipulator, tilted_poses) == pytest.approx(0, abs=1e-9)


def test_incidence_is_the_mean_angle_to_the_surface(manipulator):
    top = pose_at(R * Z, -Z, X, SIZE[2])
    poses = np.stack([tilted(top, SIZE[2], angle) for angle in (-10.0, 20.0, 30.0)])
    assert incidence_deg(manipulator, poses) == pytest.approx(20.0, abs=NORMAL_DEG)


def test_the_terms_of_a_path_are_those_of_its_poses(manipulator):
    """Over 5 mm in two of five poses, restored in one of these and another; one of three cannot be held."""
    case = case_of_ball(scene=Scene(anatomy={}, transducer=dict(compression_warning_mm=5.0)))
    held = np.array([True, False, True])
    trial = SimpleNamespace(case=case, manipulator=manipulator, held=lambda passes: held)
    top = pose_at(R * Z, -Z, X, SIZE[2])
    poses = np.stack([tilted(top, SIZE[2], angle) for angle in (-10.0, 20.0, 30.0, 0.0, 0.0)])
    compressions, contacts = [1.0, 5.0, 5.1, 9.0, 2.4], [0.2, 0.4, 0.9, 1.0, 0.5]
    restored = np.array([False, True, False, True, False])
    terms = Trial.terms(
        trial, [poses[:2], poses[2:]], compressions, contacts, restored, seen=0.7, path_mm=40.0, time_s=4.0
    )
    expected = ScoreTerms(0.7, 4.5, 9.0, 0.6, 0.6, 12.0, 40.0, 4.0, 2 / 3)
    assert asdict(terms) == pytest.approx(asdict(expected), abs=NORMAL_DEG) and terms.incidence_deg > 11
    figures = {name: value for name, value in asdict(terms).items() if name != "incidence_deg"}
    assert figures == pytest.approx({name: asdict(expected)[name] for name in figures})


# Reach


def reached(
    trocar: Trocar, poses: np.ndarray, manipulator: ProbeManipulator, target: np.ndarray = 0 * X
) -> list[bool]:
    """With the organ's middle at a place in the patient, to which the trocar is relative."""
    origin = np.array([10.0, -20.0, 30.0])
    if trocar.at_mm is not None:
        trocar = trocar.model_copy(update=dict(at_mm=tuple(np.array(trocar.at_mm) + origin)))
    return reachable(trocar, manipulator, origin, target, poses).tolist()


def with_back_at(back: np.ndarray, outward: np.ndarray = Z) -> np.ndarray:
    return pose_at(back - SIZE[2] * outward, -outward, X, SIZE[2])


TINY = manipulator_on(trimesh.creation.icosphere(subdivisions=1, radius=1.0))


@pytest.mark.parametrize("cone", [20.0, 45.0, 90.0])
@pytest.mark.parametrize("axis", [None, (0.0, 0.0, -3.0)])
def test_the_shaft_leans_no_farther_than_the_cone(cone, axis):
    trocar = Trocar(at_mm=(0, 0, 100), axis=axis, cone_deg=cone, wrist_deg=180)
    lean = np.radians(cone + np.array([-0.1, 0.1]))
    backs = 60 * np.column_stack([np.sin(lean), 0 * lean, -np.cos(lean)]) + [0, 0, 100]
    assert reached(trocar, np.stack([with_back_at(back) for back in backs]), TINY) == [True, False]


@pytest.mark.parametrize("wrist", [0.0, 30.0, 90.0, 120.0])
def test_the_probe_turns_no_farther_from_the_shaft_than_the_wrist(wrist):
    bends = np.radians([wrist, wrist - 0.1, wrist + 0.1, -wrist - 0.1])
    axes = np.column_stack([0 * bends, np.sin(bends), np.cos(bends)])
    poses = np.stack([with_back_at(60.0 * Z, axis) for axis in axes])
    # A wrist of 0 turns no less.
    expected = [True, wrist > 0, False, False]
    assert reached(Trocar(at_mm=(0, 0, 150), wrist_deg=wrist), poses, TINY) == expected


def test_without_an_axis_the_cone_is_about_the_direction_to_the_target(manipulator):
    trocar = Trocar(at_mm=(0, 0, 100), cone_deg=10, wrist_deg=180)
    poses = np.stack([with_back_at(60 * Z), with_back_at(60 * Z + 40 * X)])
    assert reached(trocar, poses, manipulator) == [True, False]
    assert reached(trocar, poses, manipulator, 100 * X) == [False, True]


def test_the_shaft_is_no_longer_than_the_instrument_and_without_a_trocar_as_long_as_needed(manipulator):
    poses = np.stack([with_back_at(70.1 * Z), with_back_at(69.9 * Z), with_back_at(900 * X)])
    assert reached(Trocar(at_mm=(0, 0, 150), longest_mm=80), poses, manipulator) == [True, False, False]
    assert reached(Trocar(), poses, manipulator) == [True] * 3


def test_the_shaft_does_not_pass_through_the_organ(manipulator):
    """Against the chord of a ball, for poses all around it."""
    chance = np.random.default_rng(3)
    at = np.array([0.0, -70.0, 90.0])
    trocar = Trocar(at_mm=tuple(at), cone_deg=90, wrist_deg=180, longest_mm=500)
    backs = chance.normal(size=(400, 3))
    backs *= chance.uniform(R - 5, R + 25, (400, 1)) / np.linalg.norm(backs, axis=1, keepdims=True)
    is_reached = reached(trocar, np.stack([with_back_at(back) for back in backs]), manipulator)
    shafts = backs - at
    length = np.linalg.norm(shafts, axis=1)
    along = shafts / length[:, None]
    middle = -(along @ at)
    under = R**2 - (at @ at - middle**2)
    enters = np.where(under > 0, middle - np.sqrt(np.maximum(under, 0)), np.inf)
    free = enters > length - NEAR_MM
    # A grazing shaft passes facets by, and one that ends as near as it may is text by them.
    sure = (np.abs(under) > 2 * R * FACET_MM) & (np.abs(enters - length + NEAR_MM) > 0.3)
    assert sure.mean() > 0.9 and 0.2 < free[sure].mean() < 0.8
    assert np.array_equal(np.array(is_reached)[sure], free[sure])


# Score


WORSE = dict(
    seen=0.5,
    compression_mean_mm=5.0,
    over_limit=0.5,
    contact=0.3,
    incidence_deg=40.0,
    path_mm=300.0,
    reachable=0.9,
)


@pytest.mark.parametrize(("term", "worse"), WORSE.items(), ids=WORSE)
def test_a_worse_term_lowers_the_score_and_is_explained(term, worse):
    other = replace(GOOD, **{term: worse})
    assert score(other) < score(GOOD) == pytest.approx(sum(points(GOOD).values()))
    lost = points(GOOD).get(term, 0.0) - points(other)[term]
    assert lost == pytest.approx(score(GOOD) - score(other)) and lost > 0
    text = why_better(GOOD, other)
    if term == "reachable":
        assert text == "it is reachable at all poses, the other is not at 10 %"
    else:
        share = 100 if term in ("seen", "over_limit", "contact") else 1
        _, words, _, unit = WORDING[term]
        figures = [unit.format(share * getattr(terms, term)) for terms in (GOOD, other)]
        assert text == f"it {words.format(figures[0])} instead of {figures[1]} ({lost:+.1f} points)"
        assert words.format(figures[1]) in in_words(other)


def test_the_largest_disadvantage_is_explained_too():
    text = why_better(GOOD, replace(GOOD, seen=0.4, path_mm=20.0))
    assert ", although it has a path of 60 mm instead of 20 mm (" in text


@pytest.mark.parametrize(("apart_deg", "poses"), [(10, 2), (60, 3), (110, 3), (175, 12)])
def test_from_one_pass_to_the_next_the_probe_moves_outside_the_organ(manipulator, apart_deg, poses):
    angles = np.radians([-0.5 * apart_deg, 0.5 * apart_deg])
    outwards = np.column_stack([np.sin(angles), 0 * angles, np.cos(angles)])
    ends = [pose_at((R - 2.0) * outward, -outward, Y, SIZE[2]) for outward in outwards]
    way = transfer(manipulator, *ends)
    assert len(way) == pytest.approx(poses, abs=2 if poses > 3 else 0)
    # It comes down to the usual height above the next pass.
    assert way[-1] == pytest.approx(advanced(ends[1], -LIFT_MM))
    moved = np.concatenate([poses_between(one, other, 40) for one, other in pairwise(way)])
    corners = SIZE / 2 * np.array(list(product((-1, 1), repeat=3)))
    for pose in moved:
        # The centre and the corners of the face: in the ball is nothing of the probe.
        face = np.vstack([corners[corners[:, 2] < 0], [0.0, 0.0, -SIZE[2] / 2]])
        assert np.linalg.norm(face @ pose[:3, :3].T + pose[:3, 3], axis=1).min() > R - FACET_MM


def test_the_score_terms_are_a_sentence():
    assert in_words(ScoreTerms(0.94, 2.2, 3.4, 0.0, 0.97, 4.6, 211.0, 21.0, 1.0)) == (
        "it covers 94 % of the target, compresses the tissue by 2.2 mm on average, by 3.4 mm at most, "
        "exceeds the compression limit at 0 % of its poses, "
        "has contact on 97 % of the array, has a mean angle of incidence of 5 degrees, "
        "and has a path of 211 mm"
    )


def test_any_reachable_path_scores_more_than_one_that_is_not():
    poor = ScoreTerms(0.0, 15.0, 20.0, 1.0, 0.0, 90.0, 2000.0, 100.0, 1.0)
    perfect = ScoreTerms(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.99)
    assert score(poor) > score(perfect) > score(replace(perfect, reachable=0.5)) > score(ScoreTerms())
    assert why_better(poor, perfect) == "it is reachable at all poses, the other is not at 1 %"
