"""Nephrometry scores of cases computed by hand, at each limit of the papers."""

import json

import numpy as np
import pytest
from ellipsoid_kidney import ball, kidney

from scenes.anatomy import LoadedAnatomy, load_anatomy
from scenes.kidney_axes import KidneyAxes
from scenes.nephrometry import Component, NephrometryScore, face_of, padua_score, renal_score
from scenes.scene import EMBEDDED, load_scene
from scenes.tumour_anatomy import TumourAnatomy
from scenes.tumour_complexity import Complexity, complexity

X, Y, Z = np.eye(3)
CONTOUR = ball(np.zeros(3), 50.0)  # no score uses it


def axes(polar_lines=(-20.0, 20.0), sinus_lines=(-30.0, 30.0), hilar=-X, estimated=False):
    """Of a left kidney in the patient's axes, around the origin."""
    return KidneyAxes(CONTOUR, np.zeros(3), Z, hilar, polar_lines, sinus_lines, estimated)


def tumour(centre=(15.0, -15.0, 0.0), half=10.0, kidney_axes=None, **changed):
    """A cube of points around a centre, half a side [mm]."""
    line = np.linspace(-half, half, 21)
    points = np.stack(np.meshgrid(line, line, line), axis=-1).reshape(-1, 3) + centre
    values = dict(
        tumours=1,
        diameter_mm=30.0,
        volume_ml=14.0,
        exophytic_share=0.6,
        contact_cm2=10.0,
        distance_mm={"urine": 12.0, "sinus": 9.0},
        touches_main_vessel=False,
        axes=kidney_axes or axes(),
        heights_mm=(centre[2] - half, centre[2] + half),
        points=points,
    )
    return TumourAnatomy(**{**values, **changed})


def points_of(score):
    return {each.name: each.points for each in score.components}


@pytest.mark.parametrize(
    ("diameter_mm", "renal", "padua"),
    [(10.0, 1, 1), (40.0, 1, 1), (40.1, 2, 2), (69.9, 2, 2), (70.0, 3, 2), (70.1, 3, 3)],
)
def test_size(diameter_mm, renal, padua):
    found = tumour(diameter_mm=diameter_mm)
    assert points_of(renal_score(found))["R"] == (renal,)
    assert points_of(padua_score(found))["size"] == (padua,)


@pytest.mark.parametrize(
    ("share", "points"), [(1.0, 1), (0.5, 1), (0.49, 2), (0.02, 2), (0.019, 3), (0.0, 3)]
)
def test_exophytic_rate(share, points):
    found = tumour(exophytic_share=share)
    assert points_of(renal_score(found))["E"] == points_of(padua_score(found))["exophytic"] == (points,)


@pytest.mark.parametrize(("nearest", "points"), [(7.0, 1), (6.9, 2), (4.1, 2), (4.0, 3), (0.0, 3)])
@pytest.mark.parametrize("tissue", ["urine", "sinus"])
def test_nearness_is_to_the_nearer_of_sinus_and_collecting_system(tissue, nearest, points):
    found = tumour(distance_mm={"urine": 30.0, "sinus": 30.0, "artery": 1.0} | {tissue: nearest})
    assert points_of(renal_score(found))["N"] == (points,)


@pytest.mark.parametrize(
    ("distances", "points", "needs"),
    [
        ({}, (1, 2, 3), ("collecting system", "renal sinus")),
        ({"sinus": 8.0}, (1, 2, 3), ("collecting system",)),
        ({"urine": 5.0}, (2, 3), ("renal sinus",)),
        ({"urine": 3.0}, (3,), ()),
    ],
)
def test_a_structure_without_a_label_may_be_nearer(distances, points, needs):
    nearness = renal_score(tumour(distance_mm=distances)).components[2]
    assert nearness.points == points and nearness.needs == needs


@pytest.mark.parametrize(
    ("height", "half", "points"),
    [
        (31.0, 10.0, 1),  # above the upper polar line, at 20
        (-31.0, 10.0, 1),
        (28.0, 10.0, 2),  # across it, 1/10 of the volume
        (-28.0, 10.0, 2),
        (19.0, 10.0, 3),  # more than half
        (9.0, 8.0, 3),  # between the lines
        (21.0, 22.0, 3),  # less than half, but across the midline
    ],
)
def test_location_by_polar_lines(height, half, points):
    assert points_of(renal_score(tumour((15.0, -15.0, height), half)))["L"] == (points,)


def test_the_midline_is_between_the_polar_lines():
    """Not the kidney's middle: a tumour across the latter is above a hilum of the lower half."""
    low = axes(polar_lines=(-40.0, -10.0))
    assert points_of(renal_score(tumour((15.0, 0.0, -2.0), 10.0, low)))["L"] == (2,)
    assert points_of(renal_score(tumour((15.0, 0.0, -2.0), 24.0, low)))["L"] == (3,)


@pytest.mark.parametrize(("height", "points"), [(45.0, 1), (31.0, 1), (29.0, 2), (0.0, 2), (-31.0, 1)])
def test_location_by_sinus_lines(height, points):
    assert points_of(padua_score(tumour((15.0, 0.0, height))))["location"] == (points,)


@pytest.mark.parametrize(
    ("y", "face"), [(-15.0, "a"), (-3.5, "a"), (-2.5, "x"), (0.0, "x"), (2.5, "x"), (3.5, "p"), (15.0, "p")]
)
def test_face(y, face):
    """A third of the cube is 6.7 mm: 3.3 mm from its middle."""
    found = tumour((15.0, y, 0.0))
    assert face_of(found) == face
    assert renal_score(found).suffix == face and padua_score(found).suffix == face.strip("x")


@pytest.mark.parametrize(("x", "hilar", "points"), [(15.0, -X, 1), (-5.0, -X, 2), (15.0, X, 2), (-5.0, X, 1)])
def test_rim(x, hilar, points):
    assert points_of(padua_score(tumour((x, 0.0, 0.0), kidney_axes=axes(hilar=hilar))))["rim"] == (points,)


@pytest.mark.parametrize(("distance", "points"), [(0.0, (2,)), (2.0, (2,)), (2.1, (1,)), (None, (1, 2))])
@pytest.mark.parametrize(("tissue", "name"), [("urine", "collecting system"), ("sinus", "renal sinus")])
def test_involvement(tissue, name, distance, points):
    distances = {"urine": 9.0, "sinus": 9.0, tissue: distance}
    found = tumour(distance_mm={each: mm for each, mm in distances.items() if mm is not None})
    others = {"collecting system", "renal sinus"} - {name}
    assert points_of(padua_score(found))[name] == points
    assert [points_of(padua_score(found))[each] for each in others] == [(1,)]


@pytest.mark.parametrize(
    ("case", "renal", "padua"),
    [
        # 3 cm, exophytic, anterior at the upper pole: 1 + 1 + 1 + 1, and 1 + 1 + 1 + 1 + 1 + 1.
        (dict(centre=(5.0, -12.0, 45.0)), "4a, low", "6a, low"),
        # 5 cm, 30 % exophytic, 5 mm from the sinus, posterior, across a polar line: 2 + 2 + 2 + 2, and 1 + 2
        # + 1 + 1 + 1 + 2.
        (
            dict(
                centre=(5.0, 12.0, 32.0),
                half=15.0,
                diameter_mm=50.0,
                exophytic_share=0.3,
                distance_mm={"urine": 9.0, "sinus": 5.0},
            ),
            "8p, moderate",
            "8p, intermediate",
        ),
        # 8 cm, endophytic, at the hilum, at the renal vein: 3 + 3 + 3 + 3, and 2 + 3 + 2 + 2 + 2 + 3.
        (
            dict(
                centre=(-10.0, 0.0, 0.0),
                diameter_mm=80.0,
                exophytic_share=0.0,
                distance_mm={"urine": 0.0, "sinus": 0.0},
                touches_main_vessel=True,
            ),
            "12xh, high",
            "14, high",
        ),
    ],
)
def test_whole_cases(case, renal, padua):
    found = tumour(**case)
    for score, expected in ((renal_score(found), renal), (padua_score(found), padua)):
        assert f"{score}, {score.complexity}" == expected


def test_classes_begin_and_end_at_the_totals_of_the_papers():
    """R.E.N.A.L. 4 to 6, 7 to 9, 10 to 12 (Kutikov and Uzzo 2009); PADUA 6 and 7, 8 and 9, 10 to 14
    (Ficarra et al. 2009).
    """

    def classes(score, totals):
        components = [(Component("all", (total,), None, "mm"),) for total in totals]
        return [NephrometryScore(each, "", score.classes).complexity for each in components]

    renal, padua = renal_score(tumour()), padua_score(tumour())
    assert classes(renal, range(4, 13)) == ["low"] * 3 + ["moderate"] * 3 + ["high"] * 3
    assert classes(padua, range(6, 15)) == ["low"] * 2 + ["intermediate"] * 2 + ["high"] * 5


def test_a_total_that_is_not_certain_is_a_range():
    unknown = axes(None, None, None, estimated=True)
    found = tumour(kidney_axes=unknown, distance_mm={}, touches_main_vessel=None)
    renal, padua = renal_score(found), padua_score(found)
    assert (str(renal), renal.complexity) == ("4 to 8", "low to moderate")
    assert (str(padua), padua.complexity) == ("6 to 10", "low to high")
    text = dict(Complexity(found, renal, padua).rows())
    assert text["not known"] == (
        "N, L, location, rim, renal sinus, collecting system, a/p, h; label the collecting system, renal "
        "sinus, renal artery and vein"
    )
    assert "estimated" not in text and "distance" not in text


def test_what_depends_on_the_concavity_is_marked():
    found = tumour(kidney_axes=axes(estimated=True), distance_mm={"urine": 9.0})
    text = dict(Complexity(found, renal_score(found), padua_score(found)).rows())
    assert text["estimated"] == "L, location, rim, a/p, from the hilar concavity; label the renal sinus"
    certain = tumour()
    shown = Complexity(certain, renal_score(certain), padua_score(certain)).rows()
    assert not {"estimated", "not known"} & set(dict(shown))


def test_lines_and_figures():
    found = tumour((5.0, -12.0, 45.0), tumours=2)
    made = Complexity(found, renal_score(found), padua_score(found))
    assert dict(made.rows()) == {
        "size": "30 mm, 60 % exophytic, contact 10.0 cm2; largest of 2 tumours",
        "distance": "collecting system 12.0, sinus 9.0 mm",
        "R.E.N.A.L.": "4a, low: R 1 (30.0 mm), E 1 (60 %), N 1 (9.0 mm), L 1 (0 %)",
        "PADUA": "6a, low: location 1, exophytic 1, rim 1, renal sinus 1, collecting system 1, size 1",
    }
    figures = json.loads(json.dumps(made.figures(), allow_nan=False))
    assert figures["renal"]["components"]["N"] == dict(points=[1], measure=9.0, unit="mm", estimated=False)
    assert (figures["renal"]["least"], figures["padua"]["most"], figures["renal"]["suffix"]) == (4, 6, "a")
    assert figures["distance_mm"] == {"collecting system": 12.0, "sinus": 9.0}


def test_without_a_tumour_there_is_nothing():
    assert complexity(LoadedAnatomy(kidney(), None, None, ()), None) is None


def test_a_mirrored_kidney_has_the_same_scores():
    """A right kidney: left and right are never used but through the hilum."""
    centre, radius = np.array([20.0, -8.0, 24.0]), 13.0
    made = []
    for sign in (1, -1):
        mirror = np.array([sign, 1, 1])
        parts = {"sinus": ball(mirror * [-20.0, 0.0, 0.0], 14.0)}
        organ = kidney((mirror * centre, radius))
        anatomy = LoadedAnatomy(organ, ball(mirror * centre, radius), None, (), parts=parts)
        made.append(complexity(anatomy, None))
    left, right = (dict(each.rows()) for each in made)
    assert left["R.E.N.A.L."].startswith("6 to 8a") and left["PADUA"].startswith("7 to 8a")
    for name in ("PADUA", "not known"):
        assert left[name] == right[name]
    assert str(made[0].renal) == str(made[1].renal)


def test_the_embedded_patient():
    """A tumour drawn as a ball of 12.4 mm with lobes, in the anterior lower half (``TUMOUR_SITE``), 2.5 mm
    under the surface.
    """
    scene = load_scene(EMBEDDED)
    found = complexity(load_anatomy(scene, EMBEDDED.parent), scene.attachment.at_mm)
    assert 24.8 < found.tumour.diameter_mm < 30 and 0.33 < found.tumour.exophytic_share < 0.45
    assert found.renal.suffix == "a" and found.tumour.touches_main_vessel is False
    assert points_of(found.renal) == {"R": (1,), "E": (2,), "N": (3,), "L": (2,)}
    assert set(found.tumour.distance_mm) == {"urine", "sinus", "artery", "vein"}
    assert found.tumour.heights_mm[1] < 0 and not found.estimated and not found.not_known
