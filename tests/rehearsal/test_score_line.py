"""The score on a ball, where shortest paths are great circles, and what is refused."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from conftest import rotation_about
from cut_ball import ANGLE, R, ball, circle, inset
from hypothesis import given, settings
from hypothesis import strategies as st
from plan_ball import case_of_ball

from rehearsal.phase_hints import hint
from rehearsal.resection.cut import CutSettings
from rehearsal.resection.operation import _nearest_to_probe
from rehearsal.resection.proposal import marks_around
from rehearsal.resection.resection_state import MOST_MARKS, NO_RESECTION, CutRequest
from rehearsal.resection.resection_view import ResectionView
from rehearsal.resection.score_line import (
    SPACING_MM,
    ResectionError,
    crosses_itself,
    evenly_spaced,
    places_on,
    score_line,
    with_vertices,
)
from render.viewer import Phase

ORGAN = ball(R)


@pytest.mark.parametrize("count", [3, 5, 24])
def test_the_line_is_made_of_great_circles(count):
    line = score_line(ORGAN, circle(count))
    # Neighbours are apart by an arc whose chord is 2 R sin(angle) sin(pi / n).
    exact = count * 2 * R * np.arcsin(np.sin(ANGLE) * np.sin(np.pi / count))
    # Lengths on the faces, inside the ball by a share s, are shorter by s and at edges longer by as much;
    # points 1 mm apart cut off corners by 1 mm at each mark at most, as far as the path turns there.
    turned = 2 * np.pi - exact / R if count > 3 else np.pi
    assert abs(line.length_mm / exact - 1) < 2 * inset(ORGAN) + SPACING_MM * turned / exact / 2
    on_ball = np.linalg.norm(line.points, axis=1)
    assert R * (1 - 2 * inset(ORGAN)) - SPACING_MM**2 / R < on_ball.min() and on_ball.max() <= R * (1 + 1e-9)


def test_its_direction_is_out_of_the_organ_whichever_way_round_the_marks_are():
    for marks in (circle(), circle()[::-1]):
        line = score_line(ORGAN, marks)
        # The marks are on a circle; the faces that carry them tilt it by less than the faces' own distance
        # from the ball.
        assert line.direction @ [0, 0, 1] > 1 - inset(ORGAN)
        frame = line.frame()
        np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(frame) == pytest.approx(1) and (frame[2] == line.direction).all()


def test_the_order_of_the_marks_does_not_matter():
    shuffled = np.random.default_rng(4).permutation(circle(7))
    assert score_line(ORGAN, shuffled).length_mm == pytest.approx(
        score_line(ORGAN, circle(7)).length_mm, abs=1.0
    )


def test_the_first_axis_of_the_frame_is_along_the_longest_extent():
    marks = circle(40) * [1.0, 0.5, 1.0]
    line = score_line(ORGAN, marks)
    assert abs(line.frame()[0] @ [1, 0, 0]) > 0.99


def test_points_of_a_line_are_evenly_spaced():
    corners = np.array([[0.0, 0, 0], [10, 0, 0], [10, 4, 0], [0, 4, 0]])
    points = evenly_spaced(corners)
    assert len(points) == 28 / SPACING_MM
    np.testing.assert_allclose(np.linalg.norm(np.diff(points, axis=0), axis=1), SPACING_MM, atol=1e-12)
    # A short line has eight points still.
    assert len(evenly_spaced(corners / 100)) == 8


@pytest.mark.parametrize("share", [[1.0, 0.0, 0.0], [0.5, 0.5, 0.0], [0.2, 0.3, 0.5]])
def test_a_mark_is_a_vertex_of_the_divided_surface(share):
    place = np.array(share) @ ORGAN.triangles[17]
    vertices, faces, own = with_vertices(ORGAN, place[None])
    divided = trimesh.Trimesh(vertices, faces, process=False)
    assert divided.is_watertight and len(faces) == len(ORGAN.faces) + 2
    assert divided.volume == pytest.approx(ORGAN.volume, rel=1e-12) and divided.area_faces.min() > 0
    longest = ORGAN.edges_unique_length.max()
    # At an edge or a corner it is moved into the face, by the least share of three corners.
    assert np.linalg.norm(vertices[own[0]] - place) <= 3 * 0.02 * longest


def test_places_are_the_nearest_of_the_surface():
    points = np.array([[0.0, 0, 50.0], [0, -7.0, 0]])
    places, normals = places_on(ORGAN, points)
    apart = np.linalg.norm(places - points, axis=1)
    assert (apart >= [20.0, 23.0 - R * inset(ORGAN)]).all()
    assert (apart <= [20.0 + R * inset(ORGAN), 23.0]).all()
    assert (np.einsum("na,na->n", normals, places) > 0).all()


@given(st.integers(4, 12), st.integers(0, 2**31))
@settings(max_examples=40, deadline=None)
def test_a_polygon_crosses_itself_as_pairs_of_its_sides_say(count, seed):
    polygon = np.random.default_rng(seed).uniform(-1, 1, (count, 2))

    def crossed(a, b, c, d) -> bool:
        """By the solution of a + s (b - a) = c + t (d - c)."""
        s, t = np.linalg.solve(np.column_stack([b - a, c - d]), c - a)
        return 0 < s < 1 and 0 < t < 1

    sides = [(polygon[k], polygon[(k + 1) % count]) for k in range(count)]
    pairs = [(i, j) for i in range(count) for j in range(i) if (i - j) % count != 1 and (j - i) % count != 1]
    assert crosses_itself(polygon) == any(crossed(*sides[i], *sides[j]) for i, j in pairs)


@pytest.mark.parametrize(
    ("marks", "words"),
    [
        (circle(60)[:2], "the score has 2 marks; expected 3 or more"),
        (np.zeros((0, 3)), "the score has 0 marks"),
        (np.array([[np.sin(a), 0.0, np.cos(a)] for a in (0.1, 0.4, 0.8)]) * R, "encloses only"),
    ],
)
def test_scores_that_enclose_nothing_are_refused(marks, words):
    with pytest.raises(ResectionError, match=words):
        score_line(ORGAN, marks)


def test_a_line_that_crosses_itself_is_refused():
    """Marks anywhere on the ball: the line between them goes all round it."""
    marks = np.random.default_rng(0).normal(size=(8, 3))
    with pytest.raises(ResectionError, match="crosses itself; remove its last marks"):
        score_line(ORGAN, R * marks / np.linalg.norm(marks, axis=1, keepdims=True))


def test_the_order_of_the_marks_keeps_a_bent_outline_from_crossing_itself():
    """On a flat plate, in the order in which they were set the marks would cross."""
    plate = trimesh.creation.box([80.0, 80.0, 4.0])
    set_marks = np.array([[-30, 0, 2], [30, 20, 2], [30, 0, 2], [-30, 20, 2], [0, 25, 2]], float)
    assert crosses_itself(set_marks[:, :2])
    assert not crosses_itself(score_line(plate, set_marks).marks[:, :2])


@pytest.mark.parametrize("across_mm", [-9.0, 3.0, 14.0])
def test_a_mark_of_the_image_is_on_the_capsule_nearest_to_the_probe(across_mm):
    """A section like an oblique ellipse: of both places at a lateral position, the shallower one."""
    half, turn, middle = np.array([20.0, 12.0]), rotation_about([0, 0, 1], 25)[:2, :2], np.array([3.0, 24.0])
    angle = np.linspace(0, 2 * np.pi, 1001)
    points = half * np.column_stack([np.cos(angle), np.sin(angle)]) @ turn.T + middle
    place = _nearest_to_probe(np.stack([points[:-1], points[1:]], axis=1), across_mm)
    # x' A x = 1, with x from the middle: a quadratic equation in the depth.
    form = turn @ np.diag(half**-2.0) @ turn.T
    aside = across_mm - middle[0]
    roots = np.roots([form[1, 1], 2 * form[0, 1] * aside, form[0, 0] * aside**2 - 1])
    # Chords of 0.1 mm are inside the ellipse by less than 0.001 mm.
    assert place == pytest.approx((across_mm, middle[1] + roots.min()), abs=1e-3)
    with pytest.raises(ResectionError, match="ends before the edge"):
        _nearest_to_probe(np.stack([points[:-1], points[1:]], axis=1), 30.0)


def test_figures_and_hint_of_a_score_say_how_near_it_is_and_how_much_was_seen():
    """A point that is half a millimetre nearer than the margin is not near."""

    def hint_of(phase: Phase, settings: CutSettings) -> str:
        with_tumour = SimpleNamespace(case=SimpleNamespace(tumour=ORGAN), cut=None)
        return hint(phase, with_tumour, None, view, settings)

    anatomy = SimpleNamespace(
        case=case_of_ball(organ=ORGAN),
        frame=SimpleNamespace(resection=NO_RESECTION.with_marks(circle(7)), time_s=0.0),
        geometry=SimpleNamespace(version=0, whole=None),
        cut=None,
        skin=lambda points: SimpleNamespace(update=lambda: None, vertices=SimpleNamespace(memory=points)),
    )
    view, wedge = ResectionView(anatomy), CutSettings("wedge", 5.0)
    assert view.score(5.0) is None and view.figures(wedge) == {
        "marks": "0",
        "technique": "wedge",
        "margin asked": "5 mm",
        "depth": "as seen",
    }
    view.update(wedge, lambda points: np.ones(len(points), bool))
    view.tumour_mm, view.seen_share = np.array([4.6, 3.27, 9.0]), 0.63
    length = f"{score_line(ORGAN, circle(7)).length_mm:.0f}"
    assert view.figures(wedge) == {
        "marks": "7",
        "technique": "wedge",
        "line": f"{length} mm",
        "line to tumour": "3.3 mm",
        "margin asked": "5 mm",
        "depth": "as seen",
        "tumour surface seen": "63 %",
    }
    assert "3.3 mm from the tumour where it is red, 5 mm are asked" in hint_of("Score", wedge)
    assert "surface: 63 %" in hint_of("Excise", wedge)
    assert view.score(5.0).is_near.tolist() == [False, True, False]
    deep = CutSettings("enucleation", 3.5, 12.0)
    assert "keeps 3.3 mm" in hint_of("Score", deep) and view.figures(deep)["depth"] == "12 mm"
    assert hint_of("Excise", deep).endswith("enucleation, 4 mm of margin, 12 mm deep.")
    nearer = hint_of("Excise", CutSettings("wedge", 5.0, 12.0))
    assert nearer.endswith("wedge, 5 mm of margin, 12 mm deep; the line is nearer, 3.3 mm at least.")


def test_marks_are_added_until_there_are_too_many_or_a_cut():
    marked = NO_RESECTION.with_marks(circle(5)).with_marks(circle(3))
    assert marked.points().shape == (8, 3) and NO_RESECTION.marks == ()
    with pytest.raises(ResectionError, match=f"has 8 marks already; expected at most {MOST_MARKS}"):
        marked.with_marks(np.zeros((MOST_MARKS - 7, 3)))


def test_what_was_seen_of_a_tumour_belongs_to_that_tumour():
    seen = np.random.default_rng(1).random(37) > 0.5
    request = CutRequest.of(None, seen, np.zeros((4, 3)))
    assert (request.seen_of(37) == seen).all() and request.nodes_mm.shape == (4, 3)
    with pytest.raises(ResectionError, match="another tumour"):
        request.seen_of(50)


@pytest.mark.parametrize("margin_mm", [0.0, 5.0])
def test_the_proposed_line_is_around_tumour_and_margin(margin_mm):
    """A ball of 8 mm below the top: along the normal the line is a circle of 8 mm, margin and slack."""
    turned = rotation_about([1, 2, 0], 50)
    up = turned @ [0.0, 0.0, 1.0]
    tumour = ball(8.0, tuple(18.0 * up))
    marks = marks_around(ORGAN, tumour, margin_mm, up)
    aside = np.linalg.norm(marks - np.outer(marks @ up, up), axis=1)
    wanted = 8.0 + margin_mm + 0.5
    # Tumour and hull are polyhedra: inside by the mesh, and 5 % of margin and slack farther out at most; an
    # organ's face is not quite below the ray, by its own distance from the ball.
    assert wanted - 8 * inset(ball(8.0)) - 0.05 < aside.min()
    assert aside.max() < wanted + 0.05 * (margin_mm + 0.5) + 0.05
    assert (marks @ up > 0).all()
    assert len(marks) == 16


def test_beside_the_organ_the_line_is_at_its_nearest_place_with_the_margin():
    middle = np.array([R - 4.0, 0.0, 0.0])
    marks = marks_around(ORGAN, ball(8.0, tuple(middle)), 5.0, np.array([0.0, 0.0, 1.0]))
    assert np.abs(np.linalg.norm(marks, axis=1) - R).max() < 2 * R * inset(ORGAN)
    # Some 14 mm from the middle: the vertices of the organ are 2 mm apart.
    away = np.linalg.norm(marks - middle, axis=1)
    assert away.min() > 8.0 + 5.0 and (away < 8.0 + 5.5 + 2.0).sum() > 3
