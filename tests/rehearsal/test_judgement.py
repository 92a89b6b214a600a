"""The figures of cuts by planes and balls, whose margins, areas and volumes have closed forms."""

import re
from dataclasses import asdict
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from conftest import rotation_about
from cut_ball import R, ball, cap_mm3, circle, cut_by, half_space, inset
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from rehearsal.commands.plan_command import table_of
from rehearsal.resection.cut import CutSettings
from rehearsal.resection.judgement import (
    FACE_MM,
    LEAST_OPENED_MM2,
    NOT_LABELLED,
    Carried,
    DividedVessel,
    Judgement,
    MarginMap,
    _opened_mm2,
    diameter_of_section,
    divided_vessels,
    drawn_mm,
    findings_of,
    judge,
    shown,
)
from rehearsal.resection.proposal import cost_ml, cost_terms, why_first
from rehearsal.resection.resection_page import (
    CAPSULE,
    COLOURS,
    _axes,
    _colours,
    _draw_histogram,
    figures_of,
    rows_of,
)
from rehearsal.resection.score_line import ScoreLine
from scenes.anatomy import Grid

ORGAN = ball(R)
# Volumes and areas of a ball's mesh are less by this share: it is inside by a share s.
MESH = 3 * inset(ORGAN)


def judged(cut, tumour, parts=None, scale=(1.0, 1.0), **labels) -> Judgement:
    """The judgement of a cut, where the organ and the rest were larger by two factors when it was cut."""
    organ, others = scale
    surfaces = (cut.specimen, cut.remnant, tumour)
    then = Carried(organ * ORGAN.vertices, *(others * surface.vertices for surface in surfaces))
    return judge(cut, ORGAN, tumour, parts or {}, then, **labels)


def test_the_margin_of_concentric_balls_is_the_difference_of_their_radii():
    specimen, tumour = ball(14.0), ball(9.0)
    judgement = judged(cut_by(ORGAN, specimen), tumour)
    margin = judgement.margin
    # Both surfaces are inside their balls, by their own share at most.
    lost = 14 * inset(specimen)
    assert 5 - lost <= margin.margin_mm.min() and margin.margin_mm.max() <= 5 + 9 * inset(tumour)
    assert margin.mean_mm == pytest.approx(5.0, abs=lost)
    area = specimen.area
    assert margin.area_mm2.sum() == pytest.approx(area, rel=1e-9)
    assert margin.area_below(5.5) == pytest.approx(area, rel=1e-9) and margin.area_below(4.5) == 0
    assert margin.middle.shape == (len(margin.area_mm2), 3)
    assert np.linalg.norm(margin.middle, axis=1) == pytest.approx(14.0, abs=lost)
    report = judgement.report()
    assert report["margin_below_3_mm2"] == 0 and report["margin_below_5_mm2"] <= round(area, 1)
    assert report["bed_mm2"] == round(area, 1) and report["positive_margin_mm2"] == 0
    assert report["specimen_ml"] == round(specimen.volume / 1000, 3)


def test_eccentric_balls_have_their_least_margin_on_one_side():
    specimen, tumour = ball(14.0), ball(9.0, (2.0, 0.0, 0.0))
    margin = judged(cut_by(ORGAN, specimen), tumour).margin
    lost = 14 * inset(specimen)
    assert margin.margin_mm.min() == pytest.approx(3.0, abs=lost + FACE_MM**2 / 14)
    # The distance of a point of the larger ball from the other's centre is, in the mean, R + d^2 / 3 R.
    assert margin.mean_mm == pytest.approx(14 + 4 / (3 * 14) - 9, abs=lost)


@pytest.mark.parametrize("height", [-3.0, 0.0, 4.0])
def test_a_plane_through_the_tumour_leaves_its_cap_and_a_positive_margin(height):
    tumour = ball(10.0)
    judgement = judged(cut_by(ORGAN, half_space(height)), tumour)
    left = cap_mm3(10.0, 10.0 + height)
    small = 3 * inset(tumour)
    assert judgement.tumour_left_ml == pytest.approx(left / 1000, rel=2 * small)
    disc, whole = np.pi * (100 - height**2), np.pi * (R**2 - height**2)
    # A ring of faces at the border counts wholly or not.
    ring = 2 * np.pi * 10 * FACE_MM / 2
    assert judgement.margin.area_below(0.0) == pytest.approx(disc, abs=ring + 2 * small * disc)
    assert judgement.margin.area_mm2.sum() == pytest.approx(whole, rel=MESH)
    assert judgement.margin.margin_mm.min() == 0.0
    # The mean of rho' - r beyond the disc, with rho' the distance from the middle of the ball.
    rim = R
    outer = (2 / 3 * np.pi * (rim**3 - 1000.0)) - 10 * np.pi * (rim**2 - 100.0)
    assert judgement.margin.mean_mm == pytest.approx(outer / whole, rel=2 * MESH)


def test_specimen_and_parenchyma_are_what_is_above_the_plane():
    """Of the parts that are no parenchyma, a half, a cap, and the whole are above it, and one is below."""
    tumour, urine = ball(6.0, (0.0, 0.0, 15.0)), ball(5.0, (0.0, 15.0, 6.0))
    sinus, cyst = ball(6.0, (0.0, -16.0, 4.0)), ball(4.0, (14.0, 0.0, 14.0))
    parts = dict(urine=urine, sinus=sinus, cyst=cyst, vessel=ball(3.0, (-14.0, 0.0, -8.0)))
    judgement = judged(cut_by(ORGAN, half_space(6.0)), tumour, parts)
    cap = cap_mm3(R, R - 6.0)
    removed = cap - tumour.volume - urine.volume / 2 - cap_mm3(6.0, 4.0) - cyst.volume
    whole = ORGAN.volume - tumour.volume - sum(part.volume for part in parts.values())
    assert judgement.specimen_ml == pytest.approx(cap / 1000, rel=MESH)
    assert judgement.parenchyma_removed_ml == pytest.approx(removed / 1000, rel=MESH)
    assert judgement.parenchyma_removed_percent == pytest.approx(100 * removed / whole, rel=MESH)
    disc = np.pi * 25
    ring = 2 * np.pi * 5 * FACE_MM / 2
    assert judgement.collecting_system_opened_mm2 == pytest.approx(disc, abs=ring)
    assert judgement.tumour_left_ml == 0
    # A part that the cut does not reach is not opened.
    assert judgement.vessels == () and "vessels cut" not in findings_of(judgement)
    assert _opened_mm2(cut_by(ORGAN, half_space(6.0)).resection_surface(), parts["vessel"]) == 0


def test_what_is_not_labelled_is_not_said_to_be_whole():
    judgement = judged(cut_by(ORGAN, half_space(6.0)), ball(6.0, (0.0, 0.0, 15.0)))
    report, shown = judgement.report(), findings_of(judgement)
    assert report["collecting_system_opened_mm2"] is report["vessels"] is None
    assert shown["calyces opened"] == shown["vessels cut"] == NOT_LABELLED
    assert cost_ml(judgement, 0.0) == pytest.approx(judgement.parenchyma_removed_ml)


def test_figures_as_cut_are_those_of_the_tissue_then():
    """Specimen, remnant and tumour twice as large, the organ by a tenth: margins are doubled, and volumes
    compare.
    """
    specimen, tumour = ball(14.0), ball(9.0)
    judgement = judged(cut_by(ORGAN, specimen), tumour, scale=(1.1, 2.0))
    assert judgement.margin_as_cut.margin_mm.min() == pytest.approx(10.0, abs=2 * 14 * inset(specimen))
    assert judgement.margin.margin_mm.min() == pytest.approx(5.0, abs=14 * inset(specimen))
    assert judgement.volume_change_percent == pytest.approx(100 * (2**3 / 1.1**3 - 1), rel=1e-6)


@pytest.mark.parametrize("tilt", [0, 30, 60])
def test_an_oblique_section_of_a_round_vessel_has_the_vessels_diameter(tilt):
    """A disc of 2 mm, seen along the vessel, is an ellipse with one axis longer by 1 / cos."""
    steps = 40
    radius, angle = np.meshgrid((np.arange(steps) + 0.5) / steps, 2 * np.pi * np.arange(steps) / steps)
    disc = 2.0 * radius.ravel() * np.array([np.cos(angle).ravel(), np.sin(angle).ravel(), np.zeros(steps**2)])
    middle = disc.T / [np.cos(np.radians(tilt)), 1.0, 1.0]
    turned = middle @ rotation_about([3, 1, 2], 40).T + [5.0, -3.0, 8.0]
    # The middle of each ring for its mean square: off by 1 / (2 n^2).
    assert diameter_of_section(turned, radius.ravel()) == pytest.approx(4.0, rel=1 / steps**2)


def vessels() -> trimesh.Trimesh:
    """Two vessels across the plane z = 6: of 4 mm, oblique, and of 3 mm."""
    wide, narrow = (trimesh.creation.cylinder(radius, 40.0, sections=64) for radius in (2.0, 1.5))
    wide.apply_transform(trimesh.transformations.rotation_matrix(np.radians(40), [0, 1, 0]))
    wide.apply_translation([-5.0, -8.0, 6.0])
    return trimesh.util.concatenate([wide, narrow.apply_translation([0.0, 14.0, 0.0])])


def labelled() -> Grid:
    """Oblique voxels, of another size along each axis: 1 where y < -7.2 mm, 2 elsewhere."""
    mm_from_index = np.eye(4)
    mm_from_index[:3, :3] = rotation_about([3, 1, 2], 50) * [0.8, 1.1, 2.5]
    mm_from_index[:3, 3] = -mm_from_index[:3, :3] @ [60, 45, 20]
    index = np.moveaxis(np.indices((121, 91, 41)), 0, -1)
    y = index @ mm_from_index[1, :3] + mm_from_index[1, 3]
    return Grid(np.where(y < -7.2, 1.0, 2.0).astype(np.float32), np.linalg.inv(mm_from_index))


def test_divided_vessels_are_named_by_the_labels_and_ordered_by_their_width():
    parts, tumour = dict(vessel=vessels()), ball(5.0, (0.0, 0.0, 18.0))
    cut = cut_by(ORGAN, half_space(6.0))
    # Of the wide one, whose middle is at y = -8, a third is labelled as an artery.
    named = judged(cut, tumour, parts, labels=labelled(), tissues={1: "vein", 2: "artery"})
    divided = named.vessels
    assert [vessel.tissue for vessel in divided] == ["vein", "artery"]
    # Faces at the border count wholly or not: a random half of an edge.
    assert [vessel.diameter_mm for vessel in divided] == pytest.approx([4.0, 3.0], abs=FACE_MM / 2)
    assert [vessel["tissue"] for vessel in named.report()["vessels"]] == ["vein", "artery"]


@pytest.mark.parametrize(("share", "counts"), [(0.9, False), (1.1, True)])
def test_a_part_that_the_cut_only_grazes_is_not_opened(share, counts):
    """Twelve faces of one area are inside a part, of which together they make a share of what counts."""
    side = np.sqrt(share * LEAST_OPENED_MM2 / 6)
    corner = np.arange(77).reshape(11, 7)
    a, b, c, d = (
        part.ravel() for part in (corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:])
    )
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    places = np.indices((11, 7, 1)).reshape(3, -1).T * side
    surface = trimesh.Trimesh(places, faces, process=False)
    # Three by two squares, from the fourth and the third on.
    part = trimesh.creation.box(bounds=[[3 * side, 2 * side, -1.0], [6 * side, 4 * side, 1.0]])
    # Without labels, and where they name neither arteries nor veins.
    for labels in (None, labelled()):
        vessels_cut = divided_vessels(surface, part, labels, {1: "cortex", 2: "medulla"})
        assert [vessel.tissue for vessel in vessels_cut] == ["vessel"] * counts
    assert _opened_mm2(surface, part) == pytest.approx(share * LEAST_OPENED_MM2 * counts, rel=1e-9)


@pytest.mark.parametrize(
    "value, digits, text", [(0.0, 0, "0 ml"), (0.2, 0, "< 1 ml"), (1.4, 0, "1 ml"), (0.004, 2, "< 0.01 ml")]
)
def test_a_trace_is_not_written_as_zero(value, digits, text):
    assert shown(value, "ml", digits) == text


VESSELS = DividedVessel("vein", 7.0), DividedVessel("artery", 5.0), DividedVessel("vein", 2.0)
# Figures that the report has as they are.
AS_THEY_ARE = dict(
    specimen_ml=21.52,
    tumour_left_ml=0.44,
    parenchyma_removed_ml=13.2,
    parenchyma_removed_percent=8.25,
    collecting_system_opened_mm2=12.6,
    volume_change_percent=-0.31,
)


def by_hand(**changed) -> Judgement:
    """A cut of five faces: 10 mm2 2 mm deep in the tumour, 20 mm2 within the error of its surface, the
    others beside it.
    """
    area, distance = np.array([10.0, 20.0, 30.0, 40.0, 50.0]), np.array([-2.0, -0.05, 0.5, 2.5, 4.0])
    margins = (MarginMap(np.zeros((5, 3)), area, distance + more) for more in (0.0, 2.6))
    values = dict(zip(("margin", "margin_as_cut"), margins, strict=True), vessels=VESSELS)
    return Judgement(**AS_THEY_ARE | values | changed)


REPORT = dict(
    margin_min_mm=0.0,
    margin_mean_mm=2.1,  # (30 x 0.5 + 40 x 2.5 + 50 x 4) / 150
    margin_min_as_cut_mm=0.6,
    margin_mean_as_cut_mm=4.56,  # (10 x 0.6 + 20 x 2.55 + 30 x 3.1 + 40 x 5.1 + 50 x 6.6) / 150
    margin_below_1_mm2=60.0,
    margin_below_3_mm2=100.0,
    margin_below_5_mm2=150.0,
    positive_margin_mm2=10.0,
    bed_mm2=150.0,
    vessels=[asdict(vessel) for vessel in VESSELS],
    **AS_THEY_ARE,
)


def test_the_figures_of_a_cut_by_hand():
    made = by_hand()
    assert made.report() == REPORT
    assert made.warnings() == [
        "the cut goes through the tumour over 10 mm2; 0.4 ml of it left",
        "the cut divides a vein of 7.0 mm, as wide as a main vessel",
    ]
    assert len(by_hand(vessels=(DividedVessel("artery", 5.0),)).warnings()) == 2
    beside = MarginMap(np.zeros((1, 3)), np.array([9.0]), np.array([-0.09]))
    # Along the tumour's surface, as an enucleation: no positive margin.
    assert by_hand(margin=beside, vessels=(DividedVessel("artery", 4.9),)).warnings() == []
    assert findings_of(made) == {
        "least margin": "0.0 mm",
        "positive margin": "10 mm2",
        "specimen": "21.5 ml",
        "parenchyma": "-13.2 ml (8.2 %)",
        "calyces opened": "13 mm2",
        "vessels cut": "3, vein 7.0 mm",
    }


def test_the_cost_of_a_cut_by_hand():
    """100 mm2 of collecting system or a vessel of 3 mm are 1 ml, a missing millimetre 5 ml, and 1 cm2 of
    tumour 50 ml.
    """
    terms = cost_terms(by_hand(), 4.0)
    vessels = 0.14 * np.pi / 4 * (49.0 + 25.0 + 4.0)
    expected = {
        "parenchyma": 13.2,
        "collecting system": 0.126,
        "vessels": vessels,
        "missing margin": 5 * (4.0 - 0.1),
        "positive margin": 5.0,
    }
    assert terms == pytest.approx(expected) and 0.14 * np.pi / 4 * 9 == pytest.approx(1, abs=0.02)
    assert cost_ml(by_hand(), 4.0) == pytest.approx(sum(expected.values()))
    assert cost_terms(by_hand(), 0.0)["missing margin"] == 0


def proposed(technique: str, cost_ml: float, **changed) -> SimpleNamespace:
    settings = CutSettings(technique, 4.0)
    return SimpleNamespace(settings=settings, cost_ml=cost_ml, judgement=by_hand(**changed))


def test_proposals_are_compared_by_their_figures():
    first = proposed("enucleoresection", 30.25)
    second = proposed(
        "wedge", 33.5, parenchyma_removed_ml=16.5, collecting_system_opened_mm2=None, vessels=None
    )
    assert [re.split("  +", line.strip()) for line in table_of([first, second]).splitlines()[2:]] == [
        ["enucleoresection", "30.2", "0.0", "13.2", "12.6", "3"],
        ["wedge", "33.5", "0.0", "16.5", "not labelled", "not labelled"],
    ]
    assert why_first([first, second]) == (
        "The first, enucleoresection, costs 3.2 points less than the next: parenchyma 13.2 points "
        "instead of 16.5, "
        "collecting system 0.1 points instead of 0.0, vessels 8.6 points instead of 0.0."
    )


def test_the_reports_distance_of_the_score_is_the_least():
    """Of points 3 and 5 mm beside a cube of 10 mm."""
    line = SimpleNamespace(frame=lambda: np.eye(3), points=np.array([[8.0, 0, 9], [8, 9, 9]]))
    cut = SimpleNamespace(line=line, settings=CutSettings("wedge", 4.0, 12.0, "air"))
    how = dict(technique="wedge", margin_asked_mm=4.0, depth_mm=12.0, filling="air")
    seen = dict(tumour_seen_percent=81.6, score_to_tumour_mm=3.0)
    assert figures_of(cut, by_hand(), trimesh.creation.box([10.0] * 3), 81.6) == how | seen | REPORT


def test_the_page_writes_the_figures_of_the_report():
    settings = dict(technique="wedge", margin_asked_mm=4.0, depth_mm=None, filling="air")
    seen = dict(tumour_seen_percent=81.6, score_to_tumour_mm=2.34)
    assert dict(rows_of(settings | seen | REPORT | dict(import_warnings=["a", "b"]))) == {
        "technique": "wedge, to the tumour's depth; air in the crater",
        "tumour surface seen": "82 %",
        "margin": "0.0 mm least, 2.1 mm mean; asked 4",
        "less than "
        "asked": "kept only from the tumour surface seen; the score is 2.3 mm from the tumour; the walls of "
        "a wedge are straight",
        "margin, tissue as cut": "0.6 mm least, 4.6 mm mean",
        "area below 1, 3, 5 mm": "60, 100, 150 mm2",
        "positive margin": "10 mm2; tumour left 0.44 ml",
        "specimen": "21.5 ml",
        "parenchyma removed": "13.2 ml, 8.2 % of the kidney",
        "collecting system": "13 mm2 opened",
        "vessels cut": "vein 7.0 mm, artery 5.0 mm, vein 2.0 mm",
        "bed": "1.5 cm2",
        "import": "2 warnings not acknowledged",
    }


def test_the_page_draws_the_area_of_each_margin_in_its_colour():
    axes = Figure().add_subplot()
    _draw_histogram(axes, by_hand())
    drawn = {bar.get_x(): (bar.get_height(), to_hex(bar.get_facecolor())) for bar in axes.patches}
    # Along the tumour's surface, which is no positive margin, it is 0.
    areas = {-2.0: 0.1, 0.0: 0.2, 0.5: 0.3, 2.5: 0.4, 4.0: 0.5}
    assert {x: cm2 for x, (cm2, _) in drawn.items() if cm2} == pytest.approx(areas)
    colours = [COLOURS[number] for number in (0, 1, 1, 2, 3)]
    assert [drawn[x][1] for x in areas] == colours
    faces = SimpleNamespace(on_specimen=np.array([True] * 5 + [False]))
    of_faces = _colours(np.append(drawn_mm(by_hand().margin.distance_mm), 1.0), faces)
    assert [to_hex(colour) for colour in of_faces] == [*colours, CAPSULE]


def test_the_page_shows_the_specimen_unmirrored():
    """Right, up and towards the eye are right-handed; from below, the line's direction points away."""
    turn = rotation_about([2, -1, 3], 70)
    points = circle(40) * [0.5, 1.0, 1.0] @ turn.T
    cut = SimpleNamespace(line=ScoreLine(points, points, turn[:, 2]))
    # The line is longest along the second axis.
    first, out = turn[:, 1], turn[:, 2]
    first = first * np.sign(cut.line.frame()[0] @ first)
    second = np.cross(out, first)
    below, beside = _axes(cut, (0, 0, -1), (0, 1, 0)), _axes(cut, (0, -1, 0), (0, 0, 1))
    np.testing.assert_allclose(below, [-first, second, -out], atol=1e-12)
    np.testing.assert_allclose(beside, [first, out, -second], atol=1e-12)
