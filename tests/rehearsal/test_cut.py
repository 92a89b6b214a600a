"""Cuts of a ball, whose volumes are those of caps, balls, cones and frusta; any cut of an ellipsoid; and
what is refused.
"""

import numpy as np
import pytest
import trimesh
from conftest import rotation_about
from cut_ball import (
    HEIGHT_MM,
    MARKS,
    RIM_MM,
    R,
    ball,
    cap_mm3,
    circle,
    cut_by,
    half_space,
    inset,
    line_on_ball,
    ring,
)
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from rehearsal.resection.cut import (
    STEEPEST,
    Cut,
    CutSettings,
    _check_size,
    check_hilum,
    cut_organ,
    faces_of,
    grown,
    hilum_of,
    part_left,
)
from rehearsal.resection.proposal import line_around
from rehearsal.resection.score_line import ResectionError, score_line
from scenes.scene import Attachment
from scenes.solids import solid_of, surface_of

ORGAN = ball(R)
LINE = line_on_ball(ORGAN)
ABOVE = cap_mm3(R, R - HEIGHT_MM)
# A ball's surface is inside it by a share s; arcs between marks are inside their circle by 1 - cos(pi / n):
# together a share of each width, so twice of an area.
WIDTH_ERROR = 2 * inset(ORGAN) + 1 - np.cos(np.pi / MARKS)
# The cutter is simplified by 0.05 mm, all around.
VOLUME_ERROR = 2 * WIDTH_ERROR + 3 * 0.05 / RIM_MM


NOTHING = np.zeros((0, 3))


def cut(settings: CutSettings, tumour: np.ndarray = NOTHING) -> Cut:
    return cut_organ(ORGAN, LINE, settings, tumour)


def wedge(organ: trimesh.Trimesh, marks: np.ndarray, depth_mm: float) -> Cut:
    return cut_organ(organ, score_line(organ, marks), CutSettings("wedge", depth_mm=depth_mm), NOTHING)


def tumour_of(radius: float) -> np.ndarray:
    """Points of a ball about the middle of the line."""
    return np.asarray(ball(radius, (0.0, 0.0, HEIGHT_MM)).vertices)


HALF_BALL = 2 / 3 * np.pi * RIM_MM**3
CONE = np.pi * RIM_MM**2 * 12.0 / 3
# A floor at a depth is half as wide as the line.
FRUSTUM = CONE * (1 + 0.5 + 0.25)


@pytest.mark.parametrize(
    ("settings", "tumour", "below"),
    [
        (CutSettings("enucleation", 5.0), tumour_of(RIM_MM), HALF_BALL),
        (CutSettings("enucleoresection", 4.0), tumour_of(RIM_MM - 4.0), HALF_BALL),
        (CutSettings("wedge", depth_mm=12.0), NOTHING, CONE),
        (CutSettings("enucleation", depth_mm=12.0), NOTHING, FRUSTUM),
        (CutSettings("enucleoresection", depth_mm=12.0), NOTHING, FRUSTUM),
    ],
    ids=["enucleation", "enucleoresection", "wedge", "enucleation to a depth", "enucleoresection to a depth"],
)
def test_a_specimen_is_the_cap_and_what_the_technique_takes_below(settings, tumour, below):
    lost = VOLUME_ERROR * (ABOVE + below)
    # The margin's hull is up to 5 % of it larger, on the half ball's surface.
    wider = 0.05 * settings.margin_mm if len(tumour) and settings.technique == "enucleoresection" else 0.0
    more = cut(settings, tumour).specimen.volume - ABOVE - below
    assert -lost < more < lost + 2 * np.pi * RIM_MM**2 * wider


def test_the_walls_of_a_wedge_meet_below_the_tumour_and_its_margin():
    """A cone from the rim that touches a ball: its half-angle has the sine (r + m) / distance of apex and
    centre.
    """
    tumour = np.asarray(ball(3.0, (0.0, 0.0, HEIGHT_MM - 6.0)).vertices)
    made = cut(CutSettings("wedge", 2.0), tumour)
    distance = np.linalg.norm(made.resection_surface().triangles_center - [0, 0, HEIGHT_MM - 6.0], axis=1)
    # 5 mm, inside by mesh, simplification and the line's width, and 5 % of the margin outside.
    lost = 5 * inset(ball(3.0)) + 0.05 + WIDTH_ERROR * RIM_MM
    assert 5.0 - lost < distance.min() < 5.0 + 0.05 * 2.0 + lost
    deepest = HEIGHT_MM - made.specimen.vertices[:, 2].min()
    sine = 5.0 / (deepest - 6.0)
    tangent = RIM_MM / deepest
    assert sine / np.sqrt(1 - sine**2) == pytest.approx(tangent, rel=0.05)


# A rectangle on the top of an oblique block, off the origin: half of its length and width [mm].
LONG, WIDE = 22.0, 12.0
TURN, MIDDLE = rotation_about([2, -1, 3], 70), np.array([100.0, -60.0, 250.0])


def in_block(points: np.ndarray) -> np.ndarray:
    """Places (n, 3) from those along the block's axes, with the middle of its top at 0."""
    return np.asarray(points) @ TURN.T + MIDDLE


@pytest.fixture(scope="module")
def long_line():
    """The block, and the line on it."""
    block = trimesh.creation.box([90.0, 60.0, 40.0]).apply_translation([4.0, -3.0, -20.0])
    block = trimesh.Trimesh(in_block(block.vertices), block.faces, process=False)
    corners = np.array([[LONG, WIDE, 0], [-LONG, WIDE, 0], [-LONG, -WIDE, 0], [LONG, -WIDE, 0]])
    return block, score_line(block, in_block(corners))


def test_a_wedge_has_a_ridge_along_a_long_line(long_line):
    """A hipped roof: h b (3 a - b) / 6, where walls are as steep at the ends as at the sides."""
    block, line = long_line
    made = cut_organ(block, line, CutSettings("wedge", depth_mm=12.0), NOTHING)
    a, b = 2 * LONG, 2 * WIDE
    # The cutter is simplified by 0.05 mm on its walls of some 1500 mm2.
    assert made.specimen.volume == pytest.approx(12.0 * b * (3 * a - b) / 6, abs=0.05 * 1500)


@pytest.mark.parametrize("margin_mm", [0.0, 3.0])
def test_the_walls_of_a_long_wedge_keep_the_margin_of_a_long_tumour(long_line, margin_mm):
    """A line of points 5 mm deep: at a depth D the sides are at (D - 5) sin(angle), where tan(angle) = b /
    2 D.
    """
    block, line = long_line
    tumour = np.column_stack([np.linspace(-2.0, 9.0, 23), np.zeros(23), np.full(23, -5.0)])
    made = cut_organ(block, line, CutSettings("wedge", margin_mm), in_block(tumour))
    local = (np.asarray(made.specimen.vertices) - MIDDLE) @ TURN

    def depth(margin: float) -> float:
        return brentq(lambda d: (d - 5.0) * WIDE / np.hypot(d, WIDE) - margin, 5.0, 60.0)

    # A margin is up to 5 % wider; the cutter is simplified by 0.05 mm.
    assert depth(margin_mm) - 0.1 < -local[:, 2].min() < depth(1.05 * margin_mm) + 0.1
    bed = (made.resection_surface().triangles.view(np.ndarray) - MIDDLE) @ TURN
    nearest = trimesh.triangles.closest_point(
        np.repeat(bed, len(tumour), axis=0), np.tile(tumour, (len(bed), 1))
    )
    least = np.linalg.norm(nearest - np.tile(tumour, (len(bed), 1)), axis=1).min()
    assert margin_mm - 0.1 < least < 1.05 * margin_mm + 0.1


def test_a_wedge_is_not_steeper_than_stated():
    """A tumour as wide as the line would need walls that never meet."""
    tumour = np.asarray(ball(RIM_MM, (0.0, 0.0, HEIGHT_MM)).vertices) * [1.0, 1.0, 0.3] + [
        0,
        0,
        0.7 * HEIGHT_MM - 2.0,
    ]
    depth = HEIGHT_MM - tumour[:, 2].min()
    made = cut(CutSettings("wedge", 0.0), tumour)
    assert HEIGHT_MM - made.specimen.vertices[:, 2].min() == pytest.approx(STEEPEST * depth, abs=0.2)


@pytest.mark.parametrize("technique", ["enucleation", "enucleoresection", "wedge"])
def test_a_specimen_is_within_the_line_and_has_the_capsule_above(technique):
    made = cut(CutSettings(technique, 4.0), tumour_of(RIM_MM - 4.0))
    # The bed is within the organ, capsule faces are on the ball; a face at the rim is cut, and has the plane
    # of its own.
    capsule = faces_of(made.specimen, ~made.on_specimen)
    assert np.linalg.norm(capsule.vertices, axis=1).min() > R * (1 - 2 * inset(ORGAN))
    assert made.resection_surface().triangles_center[:, 2].min() < HEIGHT_MM - 5.0
    # Never beyond the line, seen along its direction.
    below = made.specimen.vertices[made.specimen.vertices[:, 2] < HEIGHT_MM - 1]
    assert np.linalg.norm(below[:, :2], axis=1).max() < RIM_MM + 0.1


def test_what_is_cut_in_another_place_stays_with_a_warning():
    """An organ like a C: the cutter above the lower arm reaches through the upper one."""
    block, slot = trimesh.creation.box([60.0, 40.0, 60.0]), trimesh.creation.box([60.0, 60.0, 20.0])
    organ = trimesh.boolean.difference([block, slot.apply_translation([15.0, 0.0, 0.0])])
    made = wedge(organ, ring(24, 8.0, -10.0) + [15.0, 0.0, 0.0], 9.0)
    assert made.specimen.volume == pytest.approx(np.pi * 64 * 9 / 3, rel=0.05)
    assert made.specimen.bounds[1, 2] < -9.9
    (warning,) = made.warnings
    # The column through the upper arm, 20 mm high.
    assert "another place" in warning and f"{np.pi * 64 * 20 / 1000:.1f} ml" in warning
    assert made.specimen.volume + made.remnant.volume == pytest.approx(organ.volume, rel=1e-9)


@pytest.mark.parametrize(("technique", "wider"), [("enucleoresection", 0.0), ("wedge", 4.0)])
def test_a_tumour_that_bulges_over_the_line_comes_with_the_specimen_whole(technique, wider):
    """A tumour at the end of a slim organ, where there is no room for its margin beside it."""
    slim, tumour = ball(1.0, fine=3), ball(13.0, (0.0, 0.0, 44.0), fine=3)
    slim.vertices *= [18.0, 18.0, 45.0]
    organ = surface_of(solid_of(slim, "kidney") + solid_of(tumour, "tumour"))[0]
    line = line_around(organ, tumour, 5.0 + wider, np.array([0.0, 0.6, 0.8]))
    aside = np.linalg.norm(line.points - [0.0, 0.0, 44.0], axis=1)
    assert aside.min() > 13.0 + 4.0
    made = cut_organ(organ, line, CutSettings(technique, 5.0), np.asarray(tumour.vertices))
    margin = np.linalg.norm(made.resection_surface().vertices - [0.0, 0.0, 44.0], axis=1) - 13.0
    assert margin.min() > 4.5
    assert made.specimen.vertices[:, 2].max() == pytest.approx(57.0, abs=0.1)


def test_a_tumour_wider_than_its_neck_is_cut_out_whole():
    """A score in the neck, 1.5 mm narrower than the tumour on all sides."""
    organ_mm, tumour_mm, neck_mm = 40.0, 13.0, 11.5
    neck, centre = np.sqrt(organ_mm**2 - neck_mm**2), np.sqrt(tumour_mm**2 - neck_mm**2)
    tumour = ball(tumour_mm, (0.0, 0.0, neck + centre), fine=3)
    organ = surface_of(solid_of(ball(organ_mm, fine=3), "kidney") + solid_of(tumour, "tumour"))[0]
    line = score_line(organ, ring(24, neck_mm, neck))
    made = cut_organ(organ, line, CutSettings("enucleoresection", 3.0), np.asarray(tumour.vertices))
    assert np.abs(made.specimen.bounds[:, :2]).min() > tumour_mm - 0.1


def test_what_hangs_on_the_specimen_alone_comes_with_it():
    """A knob on a thin stalk beside the score's middle: the cut of the stalk takes the knob."""
    stalk = trimesh.creation.cylinder(1.0, 8.0).apply_translation([0.0, 0.0, R + 3.0])
    knob = ball(5.0, (0.0, 0.0, R + 10.0))
    organ = trimesh.boolean.union([ORGAN, stalk, knob])
    made = wedge(organ, ring(16, 4.0, R), 4.0)
    assert made.specimen.bounds[1, 2] == pytest.approx(R + 15.0, abs=0.1)
    assert made.specimen.volume > knob.volume and made.remnant.body_count == 1
    assert made.specimen.volume + made.remnant.volume == pytest.approx(organ.volume, rel=1e-9)


@given(st.floats(0.01, 10), st.integers(0, 2**31))
@settings(max_examples=20, deadline=None)
def test_a_grown_body_contains_all_balls_and_little_more(by_mm, seed):
    random = np.random.default_rng(seed)
    points = random.normal(size=(30, 3)) * 8
    around = grown(points, by_mm)
    directions = random.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    more = (around @ directions.T).max(axis=0) - (points @ directions.T).max(axis=0)
    assert more.min() >= by_mm * (1 - 1e-9) and more.max() <= 1.05 * by_mm + 1e-9


# In the first two, rounding leaves a flat piece beside the specimen.
@example(63)
@example(566)
@given(st.integers(0, 2**31))
@settings(max_examples=25, deadline=None)
def test_any_cut_of_an_ellipsoid_is_closed_and_sums_to_the_whole(seed):
    random = np.random.default_rng(seed)
    organ = ball(1.0, fine=3).apply_scale([45.0, 28.0, 22.0])
    place = np.asarray(organ.vertices)[random.integers(len(organ.vertices))]
    tumour = ball(random.uniform(3, 9), tuple(0.8 * place), fine=2)
    marks = place + random.normal(size=(int(random.integers(3, 20)), 3)) * random.uniform(2, 14)
    technique = ("enucleation", "enucleoresection", "wedge")[random.integers(3)]
    depth = float(random.uniform(1, 25)) if random.random() < 0.4 else None
    settings = CutSettings(technique, random.uniform(0, 8), depth)
    try:
        made = cut_organ(organ, score_line(organ, marks), settings, np.asarray(tumour.vertices))
    except ResectionError:
        return
    for surface in (made.specimen, made.remnant):
        assert surface.is_watertight and surface.volume > 0 and surface.body_count == 1
    assert made.specimen.volume + made.remnant.volume == pytest.approx(organ.volume, rel=1e-6)
    assert faces_of(made.remnant, made.on_remnant).area == pytest.approx(
        made.resection_surface().area, rel=1e-4
    )


def test_a_deep_cut_stays_within_the_line():
    """Through to the other side."""
    deep = cut(CutSettings("wedge", depth_mm=200.0))
    assert np.abs(deep.specimen.vertices[:, :2]).max() < RIM_MM + 0.1


@pytest.mark.parametrize(
    ("degrees", "settings", "words"),
    [
        (35, CutSettings("wedge"), "no part of the tumour was seen"),
        (5, CutSettings("wedge", depth_mm=1.0), r"removes only 0.0\d ml"),
        (80, CutSettings("enucleation", depth_mm=25.0), r"removes \d\d% of the organ, expected at most 50%"),
    ],
)
def test_a_cut_of_nothing_that_was_seen_next_to_nothing_or_most_is_refused(degrees, settings, words):
    with pytest.raises(ResectionError, match=words):
        cut_organ(ORGAN, score_line(ORGAN, circle(60, np.radians(degrees))), settings, NOTHING)


def test_a_specimen_has_from_a_tenth_of_a_millilitre_to_half_of_the_organ():
    for volume_mm3 in (100.1, 999.0):
        _check_size(volume_mm3, 2000.0)
    for volume_mm3, words in ((99.9, r"only 0\.10 ml"), (1001.0, "50% of the organ")):
        with pytest.raises(ResectionError, match=words):
            _check_size(volume_mm3, 2000.0)


def test_the_hilum_is_the_ball_that_the_attachment_holds():
    """Relative to an origin that is asymmetric, so that no axis can stand for another."""
    hilum = hilum_of(Attachment(at_mm=(10.0, -20.0, 35.0), radius_mm=7.0), np.array([4.0, 5.0, -6.0]))
    np.testing.assert_allclose(np.linalg.norm(hilum.vertices - [6.0, -25.0, 41.0], axis=1), 7.0)
    assert hilum_of(Attachment(at_mm=None), np.zeros(3)) is None
    assert hilum_of(Attachment(at_mm=(1.0, 2.0, 3.0), radius_mm=0.0), np.zeros(3)) is None


@pytest.mark.parametrize("share", [0.24, 0.26])
def test_a_cut_takes_at_most_a_quarter_of_the_tissue_around_the_hilum(share):
    """All are boxes: a third of the hilum's is outside of the organ and does not count, so that its share
    is that of its height above the cut.
    """
    organ = trimesh.creation.box([40.0, 44.0, 50.0])
    hilum = trimesh.creation.box([12.0, 6.0, 20.0]).apply_translation([18.0, 3.0, -2.0])
    made = cut_by(organ, half_space(8.0 - 20.0 * share))
    if share < 0.25:
        check_hilum(made, organ, hilum)
    else:
        with pytest.raises(ResectionError, match="removes 26% of the tissue around the hilum"):
            check_hilum(made, organ, hilum)


def test_a_part_loses_what_is_in_the_specimen():
    made = cut(CutSettings("wedge", depth_mm=12.0))
    part = ball(6.0, (0.0, 0.0, HEIGHT_MM - 8.0))
    left = part_left(part, made)
    taken = trimesh.boolean.intersection([part, made.specimen]).volume
    assert taken > 100 and left.volume == pytest.approx(part.volume - taken, rel=1e-6)
    assert part_left(part, None) is part
    assert part_left(ball(2.0, (0.0, 0.0, HEIGHT_MM)), made) is None
    away = ball(4.0, (0.0, 0.0, -15.0))
    assert part_left(away, made).volume == pytest.approx(away.volume, rel=1e-9)


def test_what_is_outside_of_the_organ_stays_unless_the_part_is_within_it():
    made = cut(CutSettings("wedge", depth_mm=12.0))
    vessel = ball(5.0, (R, 0.0, 0.0))
    outside = trimesh.boolean.difference([vessel, ORGAN]).volume
    assert part_left(vessel, made).volume == pytest.approx(vessel.volume, rel=1e-9)
    assert part_left(vessel, made, is_within=True).volume == pytest.approx(vessel.volume - outside, rel=1e-6)


def test_a_piece_next_to_nothing_that_rounding_leaves_is_in_neither():
    """Beside the organ, above the score: too small to be a piece, so that it neither stays nor comes with
    the specimen.
    """
    crumb = trimesh.creation.icosahedron().apply_scale(0.002).apply_translation([0.0, 0.0, R + 2.0])
    organ = trimesh.util.concatenate([ORGAN, crumb])
    made = cut_organ(organ, LINE, CutSettings("wedge", depth_mm=12.0), NOTHING)
    assert made.specimen.body_count == 1 and made.remnant.body_count == 1
    assert made.specimen.bounds[1, 2] < R + 1.0
