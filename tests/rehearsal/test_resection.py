"""A resection in a rehearsal: marks from the image and by a ray, cut, judgement, undo, record and replay; files and refusals."""

import gc
import json
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from coarse_patient import coarse_patient
from conftest import ROOT
from rehearsal.inputs.user_input import UserInput
from rehearsal.open_window import geometry_of
from rehearsal.sessions.session import Session

from rehearsal.asked_files import read_files
from rehearsal.commands.command_line import CommandError
from rehearsal.commands.rehearse_options import RehearseOptions
from rehearsal.measurements.live_measurements import LiveMeasurements
from rehearsal.resection import proposal
from rehearsal.resection.cut import CutSettings
from rehearsal.resection.judgement import findings_of
from rehearsal.resection.operation import (
    cut,
    distance_to_tumour,
    mark_under,
    marks_of_image,
    places_at_rest,
    set_marks,
)
from rehearsal.resection.proposal import line_around, propose, why_first
from rehearsal.resection.resection_page import draw_page, figures_of, report_of, rows_of, save_page, why_less
from rehearsal.resection.resection_plan import (
    ResectionPlan,
    ResectionPlanError,
    against_plan,
    is_resection_plan,
    planned_cut,
    read_resection_plan,
    write_resection_plan,
)
from rehearsal.resection.resection_state import NO_RESECTION, Resection
from rehearsal.resection.resection_view import ResectionView, cut_settings
from rehearsal.resection.score_file import save_score
from rehearsal.resection.score_line import ResectionError
from rehearsal.resection.script import ResectionScript, ScriptedAction
from rehearsal.sessions.packed_arrays import pack_state, unpack_state
from rehearsal.sessions.recorder import record
from rehearsal.sessions.replay import Replay
from rehearsal.sessions.session_file import read_log
from rehearsal.tracking.pose_file import PoseError, load_timed_poses
from render.viewer import Controls, Settings
from scenes.surfaces import signed_distance_from
from sim.fields import Field, array_of
from ultrasound.probe_manipulator import advanced, pose_at, touching

pytestmark = pytest.mark.usefixtures("arrays_stored")

MARGIN_MM = 5.0
# What the readers look for.
KEYS = (
    *("margin_min_mm", "margin_mean_mm", "positive_margin_mm2", "parenchyma_removed_ml", "specimen_ml"),
    *("collecting_system_opened_mm2", "volume_change_percent", "vessels"),
)


@pytest.fixture(scope="module")
def patient(one_device):
    return coarse_patient()


@pytest.fixture
def rehearsal(patient):
    patient[0].reset()
    patient[0].update_surfaces()
    return patient[0]


@pytest.fixture(scope="module")
def marks(patient) -> np.ndarray:
    """Marks of a line around tumour and margin."""
    whole, tumour = patient[0].whole_organ, patient[0].whole_tumour
    return line_around(whole, tumour, MARGIN_MM, np.array([0.65, -0.75, 0.12])).marks


def acting(rehearsal, *actions: ScriptedAction, coverage=None) -> UserInput:
    session = Session(rehearsal, coverage=coverage)
    return UserInput(session, script=ResectionScript(list(actions)))


def moved(live: UserInput, steps: int = 1, **controls) -> None:
    """Steps of a session; the controls are those of the first."""
    rehearsal = live.session.rehearsal
    for number in range(steps):
        given = Controls(
            Settings(young_kpa=15.0, iterations=4, substeps=1), **(controls if number == 0 else {})
        )
        pose = live.next_pose(given)
        if pose is not None:
            live.after_step(rehearsal.timed_step(pose))
        live.after_frame()


def resected(rehearsal, marks: np.ndarray, settings: CutSettings | None = None) -> UserInput:
    scored = [tuple(map(float, mark + rehearsal.origin)) for mark in marks]
    live = acting(
        rehearsal,
        ScriptedAction(0.0, score=scored),
        ScriptedAction(0.0, cut=settings or CutSettings("enucleoresection", MARGIN_MM)),
    )
    moved(live, 2)
    return live


def test_a_cut_keeps_the_margin_and_undo_brings_all_back_bit_for_bit(rehearsal, marks):
    for _ in range(3):
        rehearsal.advance(rehearsal.pose)
    rehearsal.update_surfaces()
    look = rehearsal.image_plane(), rehearsal.probe, "both", "speckle", 350, 40
    image = rehearsal.scanner.images(*look).by_name
    before, vertices = rehearsal.digest(), array_of(rehearsal.organ_skin.vertices)
    live = resected(rehearsal, marks)
    cut, judged = rehearsal.cut, rehearsal.judgement
    report = report_of(rehearsal)
    assert set(KEYS) <= set(report)
    # The line is half a millimetre wider, and distances of the hull of the tumour's vertices are shorter by their chords.
    assert MARGIN_MM - 0.1 < report["margin_min_mm"] <= report["margin_mean_mm"] < MARGIN_MM + 0.6
    assert report["positive_margin_mm2"] == report["tumour_left_ml"] == 0.0 and rehearsal.tumour is None
    assert abs(report["margin_min_as_cut_mm"] - report["margin_min_mm"]) < 0.5
    assert abs(report["volume_change_percent"]) < 0.5
    assert cut.specimen.volume + cut.remnant.volume == pytest.approx(rehearsal.whole_organ.volume, rel=1e-9)
    assert rehearsal.organ is cut.remnant and {"artery", "vein"} >= {v.tissue for v in judged.vessels}
    for _ in range(20):
        rehearsal.advance(rehearsal.pose)
        assert not rehearsal.notice
    assert np.isfinite(array_of(rehearsal.body.position)).all()
    assert rehearsal.volume_ratio() == pytest.approx(1.0, abs=0.01)
    assert findings_of(judged)["specimen"].endswith("ml")
    assert len(geometry_of(rehearsal).bed[1]) == cut.on_remnant.sum() > 100
    moved(live, undo=True)
    assert rehearsal.cut is geometry_of(rehearsal).bed is None and len(rehearsal.resection.marks) == len(
        marks
    )
    moved(live, undo=True)
    assert rehearsal.resection == NO_RESECTION and rehearsal.cut is rehearsal.judgement is None
    assert rehearsal.digest() == before and rehearsal.organ is rehearsal.whole_organ
    rehearsal.update_surfaces()
    assert np.array_equal(array_of(rehearsal.organ_skin.vertices), vertices)
    again = rehearsal.scanner.images(*look).by_name
    assert all(np.array_equal(image[name], again[name]) for name in image)
    moved(live, redo=True)
    moved(live, redo=True)
    # The same cut again, with other surfaces: their version shows it to what draws them.
    cut, version, drawn = rehearsal.cut, rehearsal.geometry_version, rehearsal.organ_skin
    moved(live, undo=True)
    moved(live, redo=True)
    assert rehearsal.cut is cut is not None and rehearsal.organ_skin is not drawn
    assert rehearsal.geometry_version == version + 2


def test_the_images_show_the_crater(rehearsal, marks):
    rehearsal.pose = touching_at(rehearsal, rehearsal.whole_tumour.center_mass)
    plane = rehearsal.image_plane()

    def ct() -> np.ndarray:
        return rehearsal.scanner.images(plane, rehearsal.probe, "ct", "speckle", 2000, 0).by_name["CT"]

    before = ct()
    resected(rehearsal, marks, CutSettings("enucleoresection", MARGIN_MM, None, "air"))
    after = ct()
    # Air is black, and fills more of the image than the tumour did.
    assert ((after == 0) & (before > 100)).sum() > 0.2 * before.size
    moved(acting(rehearsal), undo=True)


def touching_at(rehearsal, target: np.ndarray) -> np.ndarray:
    """A pose over a point, from the direction of the tumour."""
    direction = np.array([0.65, -0.75, 0.12])
    start = pose_at(target, -direction, np.array([0.0, 0.0, 1.0]), rehearsal.size_mm[2])
    samples, radius = rehearsal.manipulator.samples, rehearsal.probe.radius_mm
    return touching(advanced(start, -80.0), rehearsal.size_mm, samples, radius)


def test_marks_of_the_image_are_a_margin_beside_the_tumour_on_the_capsule(rehearsal):
    tumour = rehearsal.whole_tumour
    rehearsal.pose = touching_at(rehearsal, tumour.center_mass)
    with pytest.raises(ResectionError, match="no lateral edge"):
        # The tumour is wider than the image.
        marks_of_image(rehearsal, MARGIN_MM)
    rehearsal.pose = touching_at(rehearsal, tumour.center_mass + np.array([0.0, 0.0, 12.0]))
    plane = rehearsal.image_plane()
    places = marks_of_image(rehearsal, MARGIN_MM)
    assert len(places) == 1
    on_surface = signed_distance_from(rehearsal.whole_organ, places)
    assert abs(on_surface[0]) < 1e-3
    now = rehearsal.model.lattice.carried(places, array_of(rehearsal.body.position))
    across = ((now - plane.world_from_plane[:3, 3]) @ plane.world_from_plane[:3, :3])[0]
    outline = rehearsal.tumour_outline()
    edges = outline[..., 0].min() - MARGIN_MM, outline[..., 0].max() + MARGIN_MM
    # float32 of the skin.
    assert min(abs(across[0] - edge) for edge in edges) < 1e-2 and abs(across[2]) < 1e-2


def test_a_mark_under_the_mouse_is_where_the_ray_first_meets_the_organ(rehearsal):
    place = rehearsal.whole_organ.vertices[np.argmax(rehearsal.whole_organ.vertices[:, 0])]
    now = array_of(rehearsal.organ_skin.vertices).astype(float)
    target = now[np.argmax(rehearsal.whole_organ.vertices[:, 0])]
    ray = target + [50.0, 0, 0], np.array([-1.0, 0, 0])
    assert np.linalg.norm(mark_under(rehearsal, *ray)[0] - place) < 0.1
    with pytest.raises(ResectionError, match="not on the organ"):
        mark_under(rehearsal, target + [50.0, 0, 0], np.array([1.0, 0, 0]))


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        (CutSettings("wedge", 5.0, 60.0), "of the organ, expected at most"),
        (CutSettings("enucleoresection", 5.0, 0.01), "removes only"),
    ],
)
def test_absurd_cuts_are_refused_in_words_and_change_nothing(rehearsal, marks, settings, text):
    # Around most of the organ, or a scratch.
    middle = places_at_rest(rehearsal, marks.mean(axis=0)[None] + rehearsal.origin)
    wide = middle + (4.0 if settings.depth_mm == 60.0 else 0.1) * (marks - marks.mean(axis=0))
    set_marks(Session(rehearsal), places_at_rest(rehearsal, wide + rehearsal.origin))
    state, live = rehearsal.resection, acting(rehearsal, ScriptedAction(0.0, cut=settings))
    moved(live)
    (notice,) = live.notices.present(lambda words: words)
    assert text in notice and rehearsal.resection == state and rehearsal.cut is None


def test_what_cannot_be_done_is_refused_in_words(rehearsal, marks):
    live = acting(rehearsal, ScriptedAction(0.0, cut=CutSettings()))
    moved(live)
    assert "0 marks" in live.notices.present(lambda words: words)[0]
    live = acting(
        rehearsal,
        ScriptedAction(0.0, score=[tuple(map(float, mark + rehearsal.origin)) for mark in marks]),
        ScriptedAction(0.0, cut=CutSettings()),
        coverage=lambda: LiveMeasurements(rehearsal).coverage,
    )
    moved(live, 2)
    assert "no part of the tumour was seen" in live.notices.present(lambda words: words)[0]
    every_other = SimpleNamespace(is_seen=lambda points: np.arange(len(points)) % 2 == 0)
    live = acting(rehearsal, ScriptedAction(0.0, cut=CutSettings()), coverage=lambda: every_other)
    moved(live)
    assert rehearsal.cut is not None and "tumour surface seen 50 %" in live.notices.present()[0]


def test_a_cut_through_the_hilum_is_refused(rehearsal):
    hilum = np.array(rehearsal.scene.attachment.at_mm) - rehearsal.origin
    around = [hilum + 14 * np.array([0.0, np.cos(a), np.sin(a)]) for a in np.linspace(0, 2 * np.pi, 9)[:-1]]
    set_marks(Session(rehearsal), places_at_rest(rehearsal, np.array(around) + rehearsal.origin))
    live = acting(rehearsal, ScriptedAction(0.0, cut=CutSettings("enucleoresection", 5.0, 25.0)))
    moved(live)
    assert "hilum" in live.notices.present(lambda words: words)[0] and rehearsal.cut is None


def test_a_session_with_a_cut_replays_bit_for_bit_from_everywhere(patient, rehearsal, marks, tmp_path):
    scored = [tuple(map(float, mark + rehearsal.origin)) for mark in marks]
    far = tuple(map(float, 2 * marks[0] - 3 * marks.mean(axis=0) + rehearsal.origin))
    session = Session(rehearsal)
    recorder = record(session, patient[1], "x64", tmp_path)
    step_s = rehearsal.settings.time_step_s
    actions = [
        ScriptedAction(3 * step_s, score=scored[:8]),
        ScriptedAction(5 * step_s, score=scored[8:]),
        ScriptedAction(6 * step_s, score=[far, scored[8]]),
        ScriptedAction(10 * step_s, cut=CutSettings("enucleoresection", MARGIN_MM)),
    ]
    live = UserInput(session, recorder, script=ResectionScript(actions))
    moved(live, 8)
    # A line with the far mark could not be cut.
    assert len(rehearsal.resection.marks) > len(marks)
    moved(live, 5, undo=True)
    assert rehearsal.cut is not None and len(rehearsal.resection.marks) == len(marks)
    moved(live, bookmark=True)
    moved(live, 4, undo=True)
    assert rehearsal.cut is None and len(rehearsal.resection.marks) == len(marks)
    moved(live, 6, redo=True)
    moved(live, 3, bookmark=True)
    report, digest = report_of(rehearsal), rehearsal.digest()
    recorder.close({})
    log = read_log(recorder.path)
    for at_s in (0.0, log.length_s - step_s):
        rehearsal.reset()
        replay = Replay(rehearsal, log)
        assert (replay.begin_at(at_s) > 0) == (at_s > 0)
        for _ in replay.go_to(log.length_s):
            pass
        assert replay.differs_s is None and rehearsal.digest() == digest
        assert report_of(rehearsal) == report


def test_undo_of_a_cut_restores_friction_under_a_pressing_probe(rehearsal, marks):
    direction = np.array([0.65, -0.75, 0.12])
    start = touching_at(rehearsal, rehearsal.whole_tumour.center_mass)
    rehearsal.pose = start
    for number in range(12):
        rehearsal.advance(advanced(start, 0.5 * number))

    def dragged() -> str:
        pressed = rehearsal.pose
        for number in range(4):
            aside = np.eye(4)
            aside[:3, 3] = 0.3 * (number + 1) * np.cross(direction, [1.0, 0, 0])
            rehearsal.advance(aside @ pressed)
        return rehearsal.digest()

    before = rehearsal.snapshot()
    digest = dragged()
    rehearsal.restore(before)
    set_marks(Session(rehearsal), marks)
    cut(Session(rehearsal), CutSettings("enucleoresection", MARGIN_MM), None)
    rehearsal.restore(before)
    assert rehearsal.contacts.has_friction and dragged() == digest


def test_a_part_that_cannot_be_cut_refuses_the_cut_before_anything_changes(rehearsal, marks, monkeypatch):
    vessels = rehearsal.whole_parts["vessel"].copy()
    vessels.faces = np.vstack([vessels.faces[0][::-1], vessels.faces[1:]])
    set_marks(Session(rehearsal), marks)
    before = rehearsal.model.lattice
    monkeypatch.setitem(rehearsal.whole_parts, "vessel", vessels)
    live = acting(rehearsal, ScriptedAction(0.0, cut=CutSettings("enucleoresection", MARGIN_MM)))
    moved(live)
    assert "cannot be cut" in live.notices.present(lambda words: words)[0]
    assert rehearsal.cut is None and rehearsal.model.lattice is before and rehearsal.resection.cut is None


def test_cuts_that_are_undone_leave_no_fields_and_a_cut_survives_as_text(rehearsal, marks):
    set_marks(Session(rehearsal), marks)
    uncut = rehearsal.snapshot()
    cut(Session(rehearsal), CutSettings("enucleoresection", MARGIN_MM), None)
    cut_out = rehearsal.snapshot()
    rehearsal.reset()
    assert rehearsal.cut is None
    from_text = unpack_state(pack_state(cut_out), rehearsal.settled)
    assert from_text.resection == cut_out.resection
    fields = []
    for _ in range(4):
        rehearsal.restore(uncut)
        assert rehearsal.cut is None
        rehearsal.restore(from_text)
        assert rehearsal.cut is not None
        gc.collect()
        fields.append(sum(isinstance(each, Field) for each in gc.get_objects()))
    assert fields[1] == fields[3]


def test_the_distance_of_a_line_to_the_tumour_is_negative_over_it():
    """Along the line's outward direction, here z: a point over the middle of a cube of 10 mm, one over its edge, and two beside it."""
    line = SimpleNamespace(
        frame=lambda: np.eye(3), points=np.array([[0.0, 0, 9], [5, 0, 9], [8, 0, 9], [8, 9, 9]])
    )
    tumour = trimesh.creation.box([10.0, 10.0, 10.0])
    found = distance_to_tumour(line, tumour)
    assert found == pytest.approx([-5.0, 0.0, 3.0, 5.0], abs=1e-12)
    assert len(distance_to_tumour(line, None)) == 0


def test_the_view_warns_of_a_line_that_is_too_near_and_shows_the_coming_cut(rehearsal, marks):
    shown = ResectionView(rehearsal)
    seen = LiveMeasurements(rehearsal).coverage
    seen.seen[:] = True
    shown.update(CutSettings(), seen.is_seen, 0.0)
    assert shown.score(MARGIN_MM) is None and shown.status(CutSettings()) == ""
    rehearsal.set_resection(Resection().with_marks(marks))
    shown.update(CutSettings(), seen.is_seen, 0.0)
    score = shown.score(MARGIN_MM)
    assert not score.is_near.any() and "margin" not in shown.status(CutSettings())
    # Between marks a geodesic may be nearer than they are, by the sagitta of their arc.
    assert distance_to_tumour(rehearsal.score, rehearsal.whole_tumour).min() > MARGIN_MM - 0.5
    assert shown.score(MARGIN_MM + 2.0).is_near.all()
    assert "red: " in shown.status(CutSettings(margin_mm=MARGIN_MM + 2.0))
    assert f"{rehearsal.score.length_mm:.0f} mm" in shown.status(CutSettings())
    assert "seen" not in shown.status(CutSettings())
    seen.seen[:] = False
    shown.update(CutSettings(), seen.is_seen, 1.0)
    assert "no part of the tumour was seen" in shown.status(CutSettings())
    assert "tumour surface seen 0 %" in shown.status(CutSettings())
    assert "surface seen" not in shown.status(CutSettings(depth_mm=12.0))
    assert shown.section(np.eye(4)) is None
    seen.seen[:] = True
    shown.update(CutSettings(), seen.is_seen, 2.0)
    rehearsal.pose = touching_at(rehearsal, rehearsal.whole_tumour.center_mass)
    plane = rehearsal.image_plane()
    section = shown.section(np.linalg.inv(plane.world_from_plane))
    depth = section[..., 1].max() - rehearsal.tumour_outline()[..., 1].max()
    assert MARGIN_MM - 1.0 < depth < MARGIN_MM + 1.0
    assert asdict(cut_settings(Settings(cut_depth_mm=12, air_in_crater=True, technique="wedge"))) == dict(
        technique="wedge", margin_mm=5.0, depth_mm=12.0, filling="air"
    )


def test_it_is_cut_but_once_and_page_score_and_plan_are_written_and_compared(
    patient, rehearsal, marks, tmp_path, monkeypatch
):
    _, anatomy = patient
    resected(rehearsal, marks)
    again = ScriptedAction(0.0, cut=CutSettings()), ScriptedAction(0.0, score=[(0.0, 0.0, 0.0)])
    live = acting(rehearsal, *again)
    moved(live, 2)
    notices = live.notices.present(lambda words: words)
    assert all("cut out already" in notice for notice in notices) and len(notices) == 2
    # A line takes half a second: from fewer directions.
    few = SimpleNamespace(vertices=trimesh.creation.icosahedron().vertices[::4])
    creation = SimpleNamespace(icosahedron=lambda: few)
    monkeypatch.setattr(proposal, "trimesh", SimpleNamespace(creation=creation))
    about = anatomy.organ, anatomy.tumour, anatomy.parts, MARGIN_MM, anatomy.labels, anatomy.tissues
    proposals = propose(*about)
    # What is refused when it is cut is not proposed.
    monkeypatch.setattr(proposal, "_lines", lambda *_: [proposals[0].cut.line])
    with pytest.raises(ResectionError, match="hilum"):
        propose(*about, trimesh.creation.icosphere().apply_translation(anatomy.tumour.center_mass))
    costs = [each.cost_ml for each in proposals]
    assert len(costs) > 1 and costs == sorted(costs) and proposals[0].settings.technique == "enucleoresection"
    assert proposals[0].judgement.margin.margin_mm.min() > MARGIN_MM - 0.1
    why = why_first(proposals)
    assert why.startswith(
        f"The first, enucleoresection, costs {costs[1] - costs[0]:.1f} points less than the next: "
    )
    assert why_first(proposals[:1]) == "" and "None" not in why
    best = proposals[0]
    figures = figures_of(best.cut, best.judgement, anatomy.tumour)
    assert (
        "tumour surface seen" not in dict(rows_of(figures))
        and figures["score_to_tumour_mm"] > MARGIN_MM - 0.5
    )
    draw_page(best.cut, best.judgement, anatomy.tumour, figures, tmp_path / "plan.png", "Planned resection")
    assert (tmp_path / "plan.png").stat().st_size > 10_000
    cuts = [planned_cut(each, np.zeros(3)) for each in proposals]
    plan, path = ResectionPlan(anatomy="a", margin_mm=MARGIN_MM, cuts=cuts), tmp_path / "plan.json"
    write_resection_plan(plan, path)
    assert is_resection_plan(path) and read_resection_plan(path) == plan
    with pytest.raises(CommandError, match="the scripted press cuts nothing; open it in a window, or add"):
        read_files(RehearseOptions(headless=True, plan=path))
    assert read_files(RehearseOptions(plan=path)).resection_plan == plan
    report = report_of(rehearsal, plan)
    # The rehearsed line is the planned one.
    assert report["against_plan"]["parenchyma_removed_ml_more"] == pytest.approx(0.0, abs=0.05)
    less_planned = best.judgement.report() | dict(
        parenchyma_removed_ml=best.judgement.parenchyma_removed_ml - 2.0
    )
    other = plan.model_copy(update=dict(cuts=[cuts[0].model_copy(update=dict(figures=less_planned))]))
    assert other.compared(best.judgement)["parenchyma_removed_ml_more"] == pytest.approx(2.0, abs=0.01)
    more = dict(parenchyma_removed_ml_more=1.26, margin_min_mm_more=-0.5, positive_margin_mm2_more=0.04)
    difference = against_plan(report["against_plan"] | more | dict(collecting_system_opened_mm2_more=None))
    assert difference.endswith(f" by {cuts[0].technique}: parenchyma +1.3 ml, least margin -0.5 mm")
    assert dict(rows_of(report))["against the plan"].startswith("cost ")
    page, figures = save_page(rehearsal, report, tmp_path)
    assert page.stat().st_size > 10_000 and json.loads(figures.read_text()) == report
    assert dict(rows_of(report))["positive margin"].startswith("0 mm2")
    assert why_less(report) == []
    less = report | dict(margin_min_mm=3.9, score_to_tumour_mm=4.8)
    assert why_less(less) == [("less than asked", "the score is 4.8 mm from the tumour")]
    assert (
        "surface seen; the score" in dict(rows_of(less | dict(tumour_seen_percent=53.4)))["less than asked"]
    )
    curve = json.loads(save_score(rehearsal, tmp_path).read_text())["markups"][0]
    points = np.array([point["position"] for point in curve["controlPoints"]])
    assert curve["type"] == "ClosedCurve" and curve["coordinateSystem"] == "LPS"
    assert np.abs(signed_distance_from(anatomy.organ, points)).max() < 0.3
    rehearsal.reset()
    live = UserInput(Session(rehearsal), resection_plan=plan)
    set_marks(live.session, marks[:3])
    moved(live, score_planned=True)
    assert np.abs(rehearsal.score.points + rehearsal.origin - np.array(plan.best.line_mm)).max() < 0.05
    assert "for enucleoresection with a margin of 5 mm" in live.notices.present()[0]
    live = UserInput(Session(rehearsal))
    moved(live, score_planned=True)
    assert "no planned line; make a plan" in live.notices.present()[0]
    whole = path.read_text()
    path.write_text(whole.replace('"margin_min_mm"', '"margin_minimum_mm"'))
    with pytest.raises(ResectionPlanError, match="margin_min_mm is no number"):
        read_resection_plan(path)
    path.write_text(whole.replace('"margin_mm": 5.0', '"margin_mm": -5.0'))
    with pytest.raises(ResectionPlanError, match="margin_mm"):
        read_resection_plan(path)


def test_the_example_script_scores_and_cuts():
    track = load_timed_poses(ROOT / "docs" / "resection.json")
    assert [action.cut is None for action in track.actions] == [True] * 12 + [False]
    assert all(action.score == "image" for action in track.actions[:-1])


@pytest.mark.parametrize(
    ("entry", "text"),
    [
        ({"score": "picture"}, "score"),
        ({"score": []}, "score"),
        ({"cut": {"technique": "saw"}}, "technique"),
        ({"cut": {"depth_mm": -1.0}}, "depth_mm"),
        ({"cut": {"depht_mm": 5.0}}, "depht_mm"),
    ],
)
def test_a_script_with_a_mistake_is_refused_with_its_place(tmp_path: Path, entry, text):
    path = tmp_path / "track.json"
    path.write_text(json.dumps([{"time_s": 0.0, "probe_to_patient": np.eye(4).tolist()} | entry]))
    with pytest.raises(PoseError, match=f"pose 1, .*{text}"):
        load_timed_poses(path)


def test_the_paper_model_cannot_be_cut_and_says_so(rehearsal, marks):
    class Particles:
        """A model without elements."""

    elements, scene = rehearsal.model, rehearsal.scene
    set_marks(Session(rehearsal), marks)
    try:
        rehearsal.model = Particles()
        live = acting(rehearsal, ScriptedAction(0.0, cut=CutSettings()))
        live._operate(Controls(Settings()))
    finally:
        rehearsal.model = elements
    assert "cannot be cut; choose --model neo-hookean" in live.notices.present(lambda words: words)[0]
    assert rehearsal.cut is None and rehearsal.scene is scene


def test_a_resection_is_a_value():
    one = Resection().with_marks(np.ones((2, 3)))
    assert one == Resection().with_marks(np.ones((2, 3))) and hash(one) == hash(replace(one))
    with pytest.raises(ResectionError, match="at most"):
        one.with_marks(np.zeros((200, 3)))
