"""The kinds of pass of a plan, and unplanned sweeps, over a ball with a tumour."""

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from plan_ball import (
    FACET_MM,
    ORIGIN,
    PROBE,
    X,
    Y,
    Z,
    big_ball,
    case_of_ball,
    faces_in,
    in_patient,
    manipulator_on,
    sweep_of,
)

from rehearsal.planning.pass_kinds import (
    LEAST_COSINE,
    MOST_PASSES,
    RANGES,
    PassKind,
    directions,
    kinds_of,
    nearest_side,
    target_from,
)
from scenes.anatomy import LoadedAnatomy
from scenes.scene import Press
from sim.signed_distance import signed_distance
from studies.planning import plan_comparison
from studies.planning.baseline_sweeps import planned, random_sweep, row_by_row, straight
from ultrasound.coverage import VOXEL_MM, Coverage

pytestmark = pytest.mark.usefixtures("one_device")

R, WIDTH = 30.0, 16.0
NARROW = PROBE.model_copy(update=dict(transducer_width_mm=WIDTH))
# Directions of a Fibonacci spiral are no farther from any than this.
GRAIN_DEG = 9.0


def everywhere(poses: np.ndarray) -> np.ndarray:
    return np.ones(len(poses), bool)


def coverage_of(at: np.ndarray, radius: float = 7.0) -> Coverage:
    tumour = trimesh.creation.icosphere(subdivisions=3, radius=radius).apply_translation(at)
    return Coverage(big_ball(), tumour)


def aside_by(degrees: float) -> np.ndarray:
    return np.array([0.0, np.sin(np.radians(degrees)), np.cos(np.radians(degrees))])


def found_for(at: np.ndarray, reach=everywhere, radius: float = 7.0) -> list[PassKind]:
    return kinds_of(trial_of(coverage_of(at, radius).voxel_centres("tumour"), reach))


HAND = manipulator_on(big_ball())


def trial_of(places: np.ndarray, reach=everywhere, lateral: np.ndarray = X) -> SimpleNamespace:
    case = case_of_ball(probe=NARROW, press=Press(direction=-Z, lateral=lateral))
    return SimpleNamespace(case=case, manipulator=HAND, places=places, reach=reach)


def angle_deg(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))


def test_directions_are_units_evenly_around():
    vectors = directions(300)
    assert np.linalg.norm(vectors, axis=1) == pytest.approx(1)
    cosines = np.clip(np.random.default_rng(1).normal(size=(2000, 3)), -3, 3)
    cosines /= np.linalg.norm(cosines, axis=1, keepdims=True)
    assert np.degrees(np.arccos((cosines @ vectors.T).max(axis=1))).max() < GRAIN_DEG
    # Second moments of a sphere are those of a third along each axis.
    assert vectors.T @ vectors / 300 == pytest.approx(np.eye(3) / 3, abs=0.01)


@pytest.mark.parametrize("aside", [0.0, 40.0, -60.0])
def test_passes_are_from_above_and_those_of_a_tumour_at_the_side_from_there_too(aside):
    kinds = found_for(18.0 * aside_by(aside))
    side = "from the nearest side" if aside else "from above"
    besides = [("slide", side), ("tilt", side)]
    assert [(kind.motion, kind.side) for kind in kinds] == [("slide", "from above"), *besides][not aside :]
    above, others = kinds[0].frame, kinds[1:]
    assert above[:3, 2] == pytest.approx(Z) and above[:3, 0] == pytest.approx(X)
    assert above[:3, 3] == pytest.approx(18.0 * aside_by(aside), abs=VOXEL_MM / 2)
    assert all(angle_deg(kind.frame[:3, 2], aside_by(aside)) < GRAIN_DEG for kind in others)


def test_no_side_is_below_the_organ():
    outward = nearest_side(trial_of(-20.0 * Z[None]))
    assert outward @ Z >= LEAST_COSINE
    assert angle_deg(outward, np.array([*outward[:2], 0.0]) / np.linalg.norm(outward[:2])) < 2 * GRAIN_DEG


def test_the_nearest_side_is_one_that_can_be_reached():
    centre = 18.0 * aside_by(60)

    def from_left(poses: np.ndarray) -> np.ndarray:
        return poses[:, 1, 2] < -0.2

    outward = nearest_side(trial_of(centre[None], from_left))
    assert outward[1] < -0.1
    assert nearest_side(trial_of(centre[None], lambda poses: ~everywhere(poses))) is None
    nowhere = found_for(centre, lambda poses: ~everywhere(poses))
    assert len(nowhere) == 2 and all(kind.side == "from above" for kind in nowhere)


def test_half_of_a_target_is_measured_across_and_along():
    places = np.array([[1.0, 1, 1], [4, 1, 9], [-2, 1, 1], [1, -6, 1], [1, 8, 3]])
    frame, half, width, _ = target_from(trial_of(places, lateral=Y), Z)
    assert half == pytest.approx([7, 3]) and frame[:3, 3] == pytest.approx([1, 1, 3])
    assert width == pytest.approx(WIDTH)


def test_passes_are_as_many_as_the_target_is_wide_in_pictures():
    def needed(half: float) -> int:
        return target_from(trial_of(half * np.array([X, -X])), Z)[3]

    assert needed(0.4 * WIDTH) == 1
    counts = [needed(half) for half in np.arange(1.0, 200.0)]
    assert sorted(counts) == counts and counts[-1] == MOST_PASSES and set(np.diff(counts)) == {0, 1}


@pytest.mark.parametrize("motion", ["slide", "tilt"])
def test_parameters_go_from_end_to_end_of_their_ranges(motion):
    kind = kind_of(motion)
    low, high = (kind.values(np.full(len(RANGES[motion]), end)) for end in (-3.0, 7.0))
    for name, (least, greatest, *first) in RANGES[motion].items():
        assert (low[name], high[name]) == (least, greatest)
        assert least <= first[0] < first[1] <= greatest
    values = {name: 0.3 * low[name] + 0.7 * high[name] for name in low}
    assert kind.values(kind.scaled(values)) == pytest.approx(values)


@pytest.mark.parametrize("motion", ["slide", "tilt"])
def test_a_search_begins_with_passes_over_the_target(motion):
    kind = kind_of(motion)
    random = kind.random(np.random.default_rng(3), 40)
    ends = ("start", "end") if motion == "slide" else ("first_deg", "last_deg")
    backwards = 0
    for parameters in random:
        values = kind.values(parameters)
        assert kind.values(kind.scaled(values)) == pytest.approx(values)
        first, last = sorted(values[name] for name in ends)
        assert RANGES[motion][ends[0]][2] <= first and last <= RANGES[motion][ends[1]][3]
        backwards += values[ends[0]] > values[ends[1]]
    assert backwards == 20
    assert np.array_equal(random, kind.random(np.random.default_rng(3), 40))
    for parameters in [*kind.rows(), *random]:
        poses = kind.poses(HAND, kind.values(parameters))
        over = np.linalg.norm(np.cross(faces_in(poses) - kind.frame[:3, 3], kind.frame[:3, 2]), axis=1)
        assert over.max() < 3 * RADIUS


def test_rows_lie_side_by_side_over_the_whole_target():
    kind = kind_of("slide")
    rows = [kind.values(parameters) for parameters in kind.rows()]
    assert [row["heading_deg"] for row in rows] == pytest.approx([0.0] * 5 + [90.0] * 5)
    assert all(row["lean_deg"] == row["lean_aside_deg"] == row["follow"] == 0.0 for row in rows)
    # As many as needed, and one more; they share the target.
    two, three = ([row["aside"] * RADIUS for row in part] for part in (rows[:2], rows[2:5]))
    assert np.diff(two) == pytest.approx(RADIUS, rel=0.1) and np.mean(two) == pytest.approx(0, abs=1e-9)
    assert np.diff(three) == pytest.approx(2 * RADIUS / 3, rel=0.1) and three[1] == pytest.approx(0, abs=1e-9)
    narrow = replace(kind, width_mm=0.1)
    assert len(narrow.rows()) == 2 * (2 * MOST_PASSES + 1)


RADIUS = 12.0


def kind_of(motion: str) -> PassKind:
    kinds = found_for(16.0 * Z, radius=RADIUS)
    return next(kind for kind in kinds if kind.motion == motion)


def values_of(kind: PassKind, **changes: float) -> dict[str, float]:
    values = dict.fromkeys(RANGES[kind.motion], 0.0)
    assert changes.keys() <= values.keys()
    return values | changes


def test_sliding_follows_its_parameters():
    slide, manipulator = kind_of("slide"), HAND
    across, along = slide.half_mm
    numbers = values_of(slide, aside=0.25, start=-0.6, end=0.5)
    one = faces_in(slide.poses(manipulator, numbers)) - slide.frame[:3, 3]
    assert one[:, 0] == pytest.approx(0.25 * across)
    assert one[[0, -1], 1] == pytest.approx([-0.6 * along, 0.5 * along])
    back = faces_in(slide.poses(manipulator, numbers | dict(start=0.5, end=-0.6))) - slide.frame[:3, 3]
    assert back == pytest.approx(one[::-1])
    deeper = slide.poses(manipulator, numbers | dict(depth_mm=3.0))
    assert faces_in(deeper) - slide.frame[:3, 3] == pytest.approx(one - 3.0 * Z)
    turned = faces_in(slide.poses(manipulator, numbers | dict(heading_deg=90.0))) - slide.frame[:3, 3]
    assert turned[[0, -1], 0] == pytest.approx([0.6 * across, -0.5 * across])
    assert turned[:, 1] == pytest.approx(0.25 * along)
    for name, axis in (("lean_deg", [0, -0.5, np.sqrt(0.75)]), ("lean_aside_deg", [0.5, 0, np.sqrt(0.75)])):
        leant = slide.poses(manipulator, numbers | {name: 30.0})
        assert leant[:, :3, 2] == pytest.approx(np.tile(axis, (len(leant), 1)))
    beside = replace(slide, half_mm=np.array([100.0, 100.0]))
    assert beside.poses(manipulator, numbers | dict(aside=1.0)) is None


def test_a_sweep_has_few_passes_or_as_many_as_a_wide_target_needs():
    kind = kind_of("slide")
    for half, most in (([5.0, 5.0], 4), ([30.0, 50.0], 4), ([45.0, 39.0], 5), ([900.0, 900.0], MOST_PASSES)):
        assert replace(kind, half_mm=np.array(half), width_mm=16.0).most_passes == most
    point = replace(kind, half_mm=np.zeros(2))
    assert [point.values(parameters)["aside"] for parameters in point.rows()] == [0.0, -0.5, 0.5] * 2


def test_half_of_the_extent_across_and_along_depends_on_the_heading():
    slide = replace(kind_of("slide"), half_mm=np.array([7.0, 3.0]))
    assert slide.extent_mm(0.0) == pytest.approx((7, 3)) and slide.extent_mm(-90.0) == pytest.approx((3, 7))
    assert slide.extent_mm(45.0) == pytest.approx((10 / np.sqrt(2), 10 / np.sqrt(2)))


def test_tilting_follows_its_parameters():
    tilt = kind_of("tilt")
    numbers = values_of(tilt, first_deg=-10.0, last_deg=24.0, depth_mm=1.0)
    poses = tilt.poses(HAND, numbers)
    angles = np.degrees(np.arctan2(-poses[:, 1, 2], poses[:, 2, 2]))
    assert angles[[0, -1]] == pytest.approx([-10, 24], abs=1.5)
    assert faces_in(poses)[:, 2] == pytest.approx(R - 1.0, abs=FACET_MM)
    ahead = tilt.poses(HAND, numbers | dict(ahead=0.5))
    assert faces_in(ahead)[0, 1] - faces_in(poses)[0, 1] == pytest.approx(0.5 * tilt.half_mm[1], abs=1.0)


# Unplanned sweeps


@pytest.fixture(scope="module")
def trial() -> SimpleNamespace:
    return trial_of(coverage_of(16.0 * Z, 12.0).voxel_centres("tumour"))


def test_straight_sweeps_point_down_and_cover_the_target_side_by_side(trial):
    (one,), rows = straight(trial), row_by_row(trial)
    assert np.array([one[0], one[-1]])[:, :3, 2] == pytest.approx(np.stack([Z, Z]))
    assert faces_in(one)[:, 0] == pytest.approx(0, abs=VOXEL_MM / 2)
    assert faces_in(one)[[0, -1], 1] == pytest.approx([-12, 12], abs=VOXEL_MM)
    assert len(rows) == 2
    aside = [faces_in(poses)[0, 0] for poses in rows]
    assert np.diff(aside) == pytest.approx([WIDTH]) and np.mean(aside) == pytest.approx(0, abs=VOXEL_MM / 2)


def test_random_sweeps_depend_on_the_seed_and_are_over_the_target(trial):
    first, again, other = (random_sweep(trial, 3, seed) for seed in (5, 5, 6))
    assert len(first) == 3
    assert all(map(np.array_equal, first, again)) and not np.array_equal(first[0][0], other[0][0])
    assert (np.linalg.norm(faces_in(np.concatenate(first))[:, :2], axis=1) < 12 * (np.sqrt(2) + 1)).all()
    headings = [poses[-1, :3, 3] - poses[0, :3, 3] for poses in first]
    assert all(
        abs(angle_deg(a / np.linalg.norm(a), b / np.linalg.norm(b))) > 1 for a, b in pairwise(headings)
    )


def test_the_poses_of_a_plan_are_those_of_the_path_in_the_patient():
    slide, case = kind_of("slide"), case_of_ball()
    sides = [values_of(slide, start=-1.0, end=1.0, aside=aside) for aside in (-0.5, 0.5)]
    path = [slide.poses(HAND, values) for values in sides]
    poses = np.concatenate(path)
    placed = np.stack([case.probe_in_patient(pose) for pose in poses])
    # PLUS's axes of a probe: x to the marked side, y into the tissue, from the middle of the face.
    assert placed[:, :3, 3] == pytest.approx(faces_in(poses) + ORIGIN)
    assert placed[:, :3, 0] == pytest.approx(poses[:, :3, 0])
    assert placed[:, :3, 1] == pytest.approx(-poses[:, :3, 2])
    assert np.linalg.det(placed[:, :3, :3]) == pytest.approx(1)
    assert placed.tolist() == pytest.approx(np.array(in_patient(poses)))
    again = planned(SimpleNamespace(case=case), sweep_of(*path))
    assert [len(poses) for poses in again] == [len(poses) for poses in path]
    assert np.concatenate(again) == pytest.approx(poses, abs=1e-9)


def test_a_kidney_without_a_tumour_is_given_one_under_its_highest_place():
    organ = trimesh.creation.icosphere(subdivisions=4, radius=1.0)
    organ.vertices *= [25.0, 25.0, 50.0]
    with_one = plan_comparison.with_tumour(LoadedAnatomy(organ, None, None, ()), np.array([0, 9.81, 0]))
    tumour = with_one.tumour
    assert tumour.volume == pytest.approx(4 / 3 * np.pi * plan_comparison.TUMOUR_MM**3, rel=0.02)
    middle = tumour.vertices.mean(axis=0)
    share = (middle[2] + 50) / 100
    assert share == pytest.approx(plan_comparison.ALONG, abs=0.12) and middle[1] < 0 and abs(middle[0]) < 2
    depths = -signed_distance(organ.vertices, organ.faces, tumour.vertices)[0]
    assert depths.min() == pytest.approx(plan_comparison.UNDER_MM, abs=0.3)
    assert plan_comparison.with_tumour(with_one, Z) is with_one
