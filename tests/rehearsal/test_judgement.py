"""The figures of cuts by planes and balls, whose margins, areas and volumes have closed forms."""

import numpy as np
import pytest
import trimesh
from conftest import rotation_about
from cut_ball import R, ball, cap_mm3, cut_by, half_space, inset

from rehearsal.resection.judgement import (
    FACE_MM,
    LEAST_OPENED_MM2,
    NOT_LABELLED,
    Carried,
    Judgement,
    diameter_of_section,
    divided_vessels,
    findings_of,
    judge,
    shown,
)
from rehearsal.resection.proposal import cost_ml
from scenes.anatomy import Grid

ORGAN = ball(R)
# Volumes and areas of a ball's mesh are less by this share: it is inside by a share s.
MESH = 3 * inset(ORGAN)


def judged(cut, tumour, parts=None, scale=(1.0, 1.0), **labels) -> Judgement:
    """The judgement of a cut, where the organ and the rest were larger by two factors when it was cut."""
    organ, others = scale
    surfaces = (cut.specimen, cut.remnant, tumour)
    then = Carried(organ * ORGAN.vertices, *(others * each.vertices for each in surfaces))
    return judge(cut, ORGAN, tumour, parts or {}, then, **labels)


def test_the_margin_of_concentric_balls_is_the_difference_of_their_radii():
    specimen, tumour = ball(14.0), ball(9.0)
    found = judged(cut_by(ORGAN, specimen), tumour)
    margin = found.margin
    # Both surfaces are inside their balls, by their own share at most.
    lost = 14 * inset(specimen)
    assert 5 - lost <= margin.margin_mm.min() and margin.margin_mm.max() <= 5 + 9 * inset(tumour)
    assert margin.mean_mm == pytest.approx(5.0, abs=lost)
    area = specimen.area
    assert margin.area_mm2.sum() == pytest.approx(area, rel=1e-9)
    assert margin.area_below(5.5) == pytest.approx(area, rel=1e-9) and margin.area_below(4.5) == 0
    assert margin.middle.shape == (len(margin.area_mm2), 3)
    assert np.linalg.norm(margin.middle, axis=1) == pytest.approx(14.0, abs=lost)
    report = found.report()
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
    found = judged(cut_by(ORGAN, half_space(height)), tumour)
    left = cap_mm3(10.0, 10.0 + height)
    small = 3 * inset(tumour)
    assert found.tumour_left_ml == pytest.approx(left / 1000, rel=2 * small)
    disc, whole = np.pi * (100 - height**2), np.pi * (R**2 - height**2)
    # A ring of faces at the border counts wholly or not.
    ring = 2 * np.pi * 10 * FACE_MM / 2
    assert found.margin.area_below(0.0) == pytest.approx(disc, abs=ring + 2 * small * disc)
    assert found.margin.area_mm2.sum() == pytest.approx(whole, rel=MESH)
    assert found.margin.margin_mm.min() == 0.0
    # The mean of rho' - r beyond the disc, with rho' the distance from the middle of the ball.
    rim = R
    outer = (2 / 3 * np.pi * (rim**3 - 1000.0)) - 10 * np.pi * (rim**2 - 100.0)
    assert found.margin.mean_mm == pytest.approx(outer / whole, rel=2 * MESH)


def test_specimen_and_parenchyma_are_what_is_above_the_plane():
    tumour, urine = ball(6.0, (0.0, 0.0, 15.0)), ball(5.0, (0.0, 15.0, 6.0))
    found = judged(cut_by(ORGAN, half_space(6.0)), tumour, dict(urine=urine))
    cap = cap_mm3(R, R - 6.0)
    removed = cap - tumour.volume - urine.volume / 2
    whole = ORGAN.volume - tumour.volume - urine.volume
    assert found.specimen_ml == pytest.approx(cap / 1000, rel=MESH)
    assert found.parenchyma_removed_ml == pytest.approx(removed / 1000, rel=MESH)
    assert found.parenchyma_removed_percent == pytest.approx(100 * removed / whole, rel=MESH)
    disc = np.pi * 25
    ring = 2 * np.pi * 5 * FACE_MM / 2
    assert found.collecting_system_opened_mm2 == pytest.approx(disc, abs=ring)
    assert found.tumour_left_ml == 0


def test_a_part_that_the_cut_does_not_reach_is_not_opened():
    below = ball(5.0, (0.0, 0.0, -10.0))
    cut, tumour = cut_by(ORGAN, half_space(6.0)), ball(6.0, (0.0, 0.0, 15.0))
    found = judged(cut, tumour, dict(urine=below, vessel=below))
    assert found.collecting_system_opened_mm2 == 0 and found.vessels == ()
    assert "vessels cut" not in findings_of(found)


def test_what_is_not_labelled_is_not_said_to_be_whole():
    found = judged(cut_by(ORGAN, half_space(6.0)), ball(6.0, (0.0, 0.0, 15.0)))
    report, shown = found.report(), findings_of(found)
    assert report["collecting_system_opened_mm2"] is report["vessels"] is None
    assert shown["calyces opened"] == shown["vessels cut"] == NOT_LABELLED
    assert cost_ml(found, 0.0) == pytest.approx(found.parenchyma_removed_ml)


def test_figures_as_cut_are_those_of_the_tissue_then():
    """Specimen, remnant and tumour twice as large, the organ by a tenth: margins are doubled, and volumes compare."""
    specimen, tumour = ball(14.0), ball(9.0)
    found = judged(cut_by(ORGAN, specimen), tumour, scale=(1.1, 2.0))
    assert found.margin_as_cut.margin_mm.min() == pytest.approx(10.0, abs=2 * 14 * inset(specimen))
    assert found.margin.margin_mm.min() == pytest.approx(5.0, abs=14 * inset(specimen))
    assert found.volume_change_percent == pytest.approx(100 * (2**3 / 1.1**3 - 1), rel=1e-6)


@pytest.mark.parametrize("tilt", [0, 30, 60])
def test_an_oblique_section_of_a_round_vessel_has_the_vessels_diameter(tilt):
    """A disc of 2 mm, seen along the vessel, is an ellipse with one axis longer by 1 / cos."""
    steps = 40
    radius, angle = np.meshgrid((np.arange(steps) + 0.5) / steps, 2 * np.pi * np.arange(steps) / steps)
    long = 2.0 / np.cos(np.radians(tilt))
    middle = np.column_stack(
        [
            long * (radius * np.cos(angle)).ravel(),
            2.0 * (radius * np.sin(angle)).ravel(),
            np.zeros(steps**2),
        ]
    )
    turned = middle @ rotation_about([3, 1, 2], 40).T + [5.0, -3.0, 8.0]
    # The middle of each ring for its mean square: off by 1 / (2 n^2).
    assert diameter_of_section(turned, radius.ravel()) == pytest.approx(4.0, rel=1 / steps**2)


def vessels() -> trimesh.Trimesh:
    """Two vessels across the plane z = 6: of 4 mm, oblique, and of 3 mm."""
    wide = trimesh.creation.cylinder(2.0, 40.0, sections=64)
    wide.apply_transform(trimesh.transformations.rotation_matrix(np.radians(40), [0, 1, 0]))
    narrow = trimesh.creation.cylinder(1.5, 40.0, sections=64).apply_translation([0.0, 14.0, 0.0])
    return trimesh.util.concatenate([wide.apply_translation([-5.0, -8.0, 6.0]), narrow])


def labelled() -> Grid:
    """Voxels of 1 mm: 1 where y < 0, 2 elsewhere."""
    index_from_mm = np.eye(4)
    index_from_mm[:3, 3] = 40.0
    voxels = np.full((81, 81, 81), 2.0, np.float32)
    voxels[:, :40] = 1.0
    return Grid(voxels, index_from_mm)


def test_divided_vessels_are_named_by_the_labels_and_ordered_by_their_width():
    parts, tumour = dict(vessel=vessels()), ball(5.0, (0.0, 0.0, 18.0))
    cut = cut_by(ORGAN, half_space(6.0))
    named = judged(cut, tumour, parts, labels=labelled(), tissues={1: "vein", 2: "artery"})
    found = named.vessels
    assert [vessel.tissue for vessel in found] == ["vein", "artery"]
    # Faces at the border count wholly or not: a random half of an edge.
    assert [vessel.diameter_mm for vessel in found] == pytest.approx([4.0, 3.0], abs=FACE_MM / 2)
    assert [each.tissue for each in judged(cut, tumour, parts).vessels] == ["vessel", "vessel"]
    # Labels that name neither arteries nor veins there.
    other = judged(cut, tumour, parts, labels=labelled(), tissues={1: "cortex", 2: "medulla"}).vessels
    assert {each.tissue for each in other} == {"vessel"}
    assert [vessel["tissue"] for vessel in named.report()["vessels"]] == ["vein", "artery"]


def test_a_vessel_that_the_cut_only_grazes_is_none():
    """Its section is less than what counts."""
    surface = cut_by(ORGAN, half_space(6.0)).resection_surface()
    vertices, faces = trimesh.remesh.subdivide_to_size(surface.vertices, surface.faces, 0.5)
    fine = trimesh.Trimesh(vertices, faces, process=False)
    grazing = ball(5.0, (0.0, 0.0, 6.0 - 5.0 + 0.01))
    assert np.pi * 2 * 5.0 * 0.01 < LEAST_OPENED_MM2
    assert divided_vessels(fine, grazing, None, {}) == ()
    assert len(divided_vessels(fine, ball(5.0, (0.0, 0.0, 3.0)), None, {})) == 1
    assert divided_vessels(fine, None, None, {}) is None, "not labelled"


@pytest.mark.parametrize(
    "value, digits, text", [(0.0, 0, "0 ml"), (0.2, 0, "< 1 ml"), (1.4, 0, "1 ml"), (0.004, 2, "< 0.01 ml")]
)
def test_a_trace_is_not_written_as_zero(value, digits, text):
    assert shown(value, "ml", digits) == text
