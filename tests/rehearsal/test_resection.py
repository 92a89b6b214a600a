"""A resection in a rehearsal: marks, cut, judgement, undo, record and replay; files and refusals."""

import gc
import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from coarse_patient import coarse_patient
from conftest import ROOT
from settings_at_start import settings_with

from rehearsal.announcements import Announcements
from rehearsal.case import case_of
from rehearsal.commands.command_line import CommandError
from rehearsal.commands.rehearse_options import RehearseOptions
from rehearsal.drawn_geometry import drawn_geometry
from rehearsal.input_files import read_files
from rehearsal.loop.command import BeginAction, Bookmark, Checkpoint, Command, Load, Mark, Move, Redo, Undo
from rehearsal.loop.frame import Frame
from rehearsal.loop.timeline import Timeline
from rehearsal.measurements.live_measurements import LiveMeasurements
from rehearsal.notices import Notices
from rehearsal.phase_hints import hint
from rehearsal.planning.plan_file import write_plan
from rehearsal.pressed_organ import PressedOrgan
from rehearsal.rehearsal import Rehearsal
from rehearsal.resection import proposal
from rehearsal.resection.cut import CutSettings
from rehearsal.resection.judgement import findings_of
from rehearsal.resection.operation import (
    cut_command,
    distance_to_tumour,
    mark_under,
    marks_of_image,
    places_at_rest,
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
)
from rehearsal.resection.resection_state import NO_RESECTION, ResectionScript, ScriptedAction
from rehearsal.resection.resection_view import ResectionView, cut_settings
from rehearsal.resection.score_line import ResectionError, save_score
from rehearsal.sessions.packed_arrays import pack_state, unpack_state
from rehearsal.sessions.recorder import SessionRecorder, header_of
from rehearsal.sessions.replay import Replay, ReplayCheck
from rehearsal.sessions.session_file import Log, read_log
from rehearsal.sources.user import UserSource
from rehearsal.tracking.pose_file import PoseError, load_timed_poses
from render.viewer import Controls, Phase
from scenes.scene import with_options
from scenes.surfaces import signed_distance_from
from sim.fields import Field
from ultrasound.probe_manipulator import advanced, pose_at, touching

pytestmark = pytest.mark.usefixtures("arrays_stored")

MARGIN_MM = 5.0
CUT = CutSettings("enucleoresection", MARGIN_MM)
# What readers of a report look for.
KEYS = (
    *("margin_min_mm", "margin_mean_mm", "positive_margin_mm2", "parenchyma_removed_ml", "specimen_ml"),
    *("collecting_system_opened_mm2", "volume_change_percent", "vessels"),
)


@pytest.fixture(scope="module")
def patient(one_device):
    return coarse_patient()


@pytest.fixture
def rehearsal(patient) -> Rehearsal:
    patient[0].reset()
    return patient[0]


@pytest.fixture(scope="module")
def marks(patient) -> np.ndarray:
    """Marks of a line around tumour and margin."""
    case = patient[0].case
    return line_around(case.organ, case.tumour, MARGIN_MM, np.array([0.65, -0.75, 0.12])).marks


def scored(rehearsal: Rehearsal, marks: np.ndarray) -> None:
    assert not rehearsal.do(Mark(places_mm=marks.tolist())).notices


def applied(rehearsal: Rehearsal, *commands: Command) -> Frame:
    """The frame after commands, of which some may be refused."""
    for command in commands:
        rehearsal.timeline.submit(command)
    return rehearsal.do()


def cut(rehearsal: Rehearsal, settings: CutSettings = CUT, is_seen=None) -> list[str]:
    """Cut along the score; return the notices."""
    return applied(rehearsal, cut_command(rehearsal.anatomy, settings, is_seen)).notices


def resected(rehearsal: Rehearsal, marks: np.ndarray, settings: CutSettings = CUT) -> None:
    scored(rehearsal, marks)
    assert cut(rehearsal, settings) == []


def stayed(rehearsal: Rehearsal, steps: int) -> list[Move]:
    return [Move(pose=rehearsal.frame.pose)] * steps


def moved_to(rehearsal: Rehearsal, pose: np.ndarray) -> None:
    rehearsal.organ.pose = pose
    rehearsal.show()


def images(rehearsal: Rehearsal, *look) -> dict[str, np.ndarray]:
    anatomy = rehearsal.anatomy
    return anatomy.scanner.images(anatomy.image_plane(), rehearsal.case.probe, *look).by_name


def test_a_cut_keeps_the_margin_and_undo_brings_all_back_bit_for_bit(rehearsal, marks):
    anatomy, organ, whole = rehearsal.anatomy, rehearsal.organ, rehearsal.case.organ
    rehearsal.do(*stayed(rehearsal, 3))
    look = "both", "speckle", 350, 40
    image, before, vertices = images(rehearsal, *look), organ.digest(), anatomy.vertices
    resected(rehearsal, marks)
    made, judged, report = anatomy.cut, anatomy.judgement, report_of(anatomy)
    assert set(KEYS) <= set(report)
    # The line is half a millimetre wider, and distances of the hull of the tumour's vertices are shorter by
    # their chords.
    assert MARGIN_MM - 0.1 < report["margin_min_mm"] <= report["margin_mean_mm"] < MARGIN_MM + 0.6
    assert report["positive_margin_mm2"] == report["tumour_left_ml"] == 0.0 and anatomy.tumour is None
    assert abs(report["margin_min_as_cut_mm"] - report["margin_min_mm"]) < 0.5
    assert abs(report["volume_change_percent"]) < 0.5
    assert made.specimen.volume + made.remnant.volume == pytest.approx(whole.volume, rel=1e-9)
    assert anatomy.organ is made.remnant and {"artery", "vein"} >= {v.tissue for v in judged.vessels}
    frame = rehearsal.do(*stayed(rehearsal, 20))
    assert not frame.notices and np.isfinite(frame.positions).all()
    assert anatomy.volume_ratio() == pytest.approx(1.0, abs=0.01)
    assert findings_of(judged)["specimen"].endswith("ml")
    drawn = drawn_geometry(anatomy)
    # The faces of the cut are divided in four.
    assert len(drawn.bed[1]) == 4 * made.on_remnant.sum() > 400
    # All of the tumour is in the specimen, as large as it was.
    in_specimen = anatomy.tumour_in_specimen
    assert in_specimen.volume == pytest.approx(rehearsal.case.tumour.volume, rel=0.02)
    assert len(drawn.tumour_cut_out[0]) == len(in_specimen.vertices)
    frame = rehearsal.do(Undo())
    assert anatomy.cut is drawn_geometry(anatomy).bed is None and len(frame.resection.marks) == len(marks)
    frame = rehearsal.do(Undo())
    assert frame.resection == NO_RESECTION and anatomy.cut is anatomy.judgement is None
    assert organ.digest() == before and anatomy.organ is whole
    assert np.array_equal(anatomy.vertices, vertices)
    again = images(rehearsal, *look)
    assert all(np.array_equal(image[name], again[name]) for name in image)
    # The same cut again, with other surfaces: their version shows it to what draws them.
    rehearsal.do(Redo(), Redo())
    drawn = anatomy.drawn_organ
    assert anatomy.cut is made and anatomy.geometry.version > 0
    rehearsal.do(Undo())
    assert anatomy.geometry.version == 0 and anatomy.drawn_organ is not drawn


def test_the_images_show_the_crater(rehearsal, marks):
    moved_to(rehearsal, touching_at(rehearsal, rehearsal.case.tumour.center_mass))
    look = "ct", "speckle", 2000, 0
    before = images(rehearsal, *look)["CT"]
    resected(rehearsal, marks, replace(CUT, filling="air"))
    after = images(rehearsal, *look)["CT"]
    # Air is black, and fills more of the image than the tumour did.
    assert ((after == 0) & (before > 100)).sum() > 0.2 * before.size


def touching_at(rehearsal: Rehearsal, target: np.ndarray) -> np.ndarray:
    """A pose over a point, from the direction of the tumour."""
    case = rehearsal.case
    direction = np.array([0.65, -0.75, 0.12])
    start = pose_at(target, -direction, np.array([0.0, 0.0, 1.0]), case.size_mm[2])
    return touching(advanced(start, -80.0), case.size_mm, rehearsal.manipulator.samples, case.probe.radius_mm)


def test_marks_of_the_image_are_a_margin_beside_the_tumour_on_the_capsule(rehearsal):
    anatomy, tumour = rehearsal.anatomy, rehearsal.case.tumour
    moved_to(rehearsal, touching_at(rehearsal, tumour.center_mass + np.array([0.0, 0.0, 40.0])))
    with pytest.raises(ResectionError, match="no lateral edge"):
        # The tumour is beside the image.
        marks_of_image(anatomy, MARGIN_MM)
    moved_to(rehearsal, touching_at(rehearsal, tumour.center_mass + np.array([0.0, 0.0, 12.0])))
    plane = anatomy.image_plane().world_from_plane
    places = marks_of_image(anatomy, MARGIN_MM)
    assert len(places) == 1 and abs(signed_distance_from(rehearsal.case.organ, places)[0]) < 1e-3
    now = anatomy.geometry.whole.carried(places, rehearsal.frame.positions)
    across = ((now - plane[:3, 3]) @ plane[:3, :3])[0]
    outline = anatomy.tumour_outline()
    edges = outline[..., 0].min() - MARGIN_MM, outline[..., 0].max() + MARGIN_MM
    # float32 of the skin.
    assert min(abs(across[0] - edge) for edge in edges) < 1e-2 and abs(across[2]) < 1e-2


def test_a_mark_under_the_mouse_is_where_the_ray_first_meets_the_organ(rehearsal):
    anatomy, rest = rehearsal.anatomy, rehearsal.case.organ.vertices
    farthest = np.argmax(rest[:, 0])
    start = anatomy.vertices[farthest] + [50.0, 0, 0]
    assert np.linalg.norm(mark_under(anatomy, start, np.array([-1.0, 0, 0]))[0] - rest[farthest]) < 0.1
    with pytest.raises(ResectionError, match="not on the organ"):
        mark_under(anatomy, start, np.array([1.0, 0, 0]))


def around_hilum(rehearsal: Rehearsal, marks: np.ndarray) -> np.ndarray:
    hilum = np.array(rehearsal.case.scene.attachment.at_mm)
    angles = np.linspace(0, 2 * np.pi, 9)[:-1]
    ring = np.column_stack([np.zeros(8), np.cos(angles), np.sin(angles)])
    return places_at_rest(rehearsal.case, hilum + 14 * ring)


def scaled(factor: float):
    """Marks so many times as far from their middle, on the capsule."""

    def made(rehearsal: Rehearsal, marks: np.ndarray) -> np.ndarray:
        middle = marks.mean(axis=0)
        middle = places_at_rest(rehearsal.case, middle[None] + rehearsal.case.origin)
        wide = middle + factor * (marks - marks.mean(axis=0))
        return places_at_rest(rehearsal.case, wide + rehearsal.case.origin)

    return made


@pytest.mark.parametrize(
    ("line", "settings", "words"),
    [
        (lambda rehearsal, marks: marks[:0], CUT, "the score has 0 marks"),
        (scaled(4.0), replace(CUT, depth_mm=60.0, technique="wedge"), "of the organ, expected at most"),
        (scaled(0.1), replace(CUT, depth_mm=0.01), "removes only"),
        (around_hilum, replace(CUT, depth_mm=25.0), "hilum"),
    ],
)
def test_cuts_that_nobody_would_make_are_refused_in_words_and_change_nothing(
    rehearsal, marks, line, settings, words
):
    if len(places := line(rehearsal, marks)):
        scored(rehearsal, places)
    before = rehearsal.frame
    (notice,) = cut(rehearsal, settings)
    assert words in notice and rehearsal.anatomy.cut is None
    assert rehearsal.frame.resection == before.resection and rehearsal.frame.number == before.number


def test_a_cut_needs_to_have_seen_the_tumour_and_warns_where_it_saw_little(rehearsal, marks):
    scored(rehearsal, marks)
    coverage = LiveMeasurements(rehearsal.anatomy, rehearsal.manipulator).coverage
    (notice,) = cut(rehearsal, is_seen=coverage.is_seen)
    assert "no part of the tumour was seen" in notice and rehearsal.anatomy.cut is None
    assert cut(rehearsal, is_seen=lambda points: np.arange(len(points)) % 2 == 0) == []
    notices = Notices()
    Announcements(rehearsal.anatomy, notices).observe(rehearsal.frame, rehearsal.case.probe)
    assert any("tumour surface seen 50 %" in notice for notice in notices.present())


def test_a_part_that_cannot_be_cut_refuses_the_cut_before_anything_changes(rehearsal, marks, monkeypatch):
    scored(rehearsal, marks)
    vessels, lattice = rehearsal.case.parts["vessel"], rehearsal.organ.model.lattice
    monkeypatch.setattr(vessels, "faces", np.vstack([vessels.faces[0][::-1], vessels.faces[1:]]))
    (notice,) = cut(rehearsal)
    assert "cannot be cut" in notice and rehearsal.anatomy.cut is None
    assert rehearsal.organ.model.lattice is lattice and rehearsal.frame.resection.cut is None


def test_the_papers_model_cannot_be_cut_and_says_so(patient, rehearsal, marks):
    scene, loaded = rehearsal.case.scene, patient[1]
    particles = with_options(scene, {"tissue.model": "shape-matching", "tissue.radius_mm": 8.0})
    timeline = Timeline(PressedOrgan(case_of(particles, loaded)))
    timeline.submit(Mark(places_mm=marks.tolist()))
    timeline.submit(cut_command(rehearsal.anatomy, CUT, None))
    (notice,) = timeline.newest().notices
    assert "cannot be cut; choose --model neo-hookean" in notice and timeline.geometry.cut is None


def replayed(rehearsal: Rehearsal, log: Log, at_s: float) -> tuple[int, ReplayCheck]:
    """Replay from the last whole state before a time [s]; the place of the first command, the comparison."""
    rehearsal.reset()
    replay, check = Replay(log, one_by_one=True), ReplayCheck(log, Notices())
    rehearsal.do(*replay.begin(rehearsal.frame.positions, at_s))
    begun = replay.place
    while not replay.is_over:
        rehearsal.do(*replay.commands(rehearsal.frame, Controls(settings_with()), 1.0))
        check.observe(rehearsal.frame, rehearsal.case.probe)
    return begun, check


def test_a_session_with_a_cut_replays_bit_for_bit_from_everywhere(patient, rehearsal, marks, tmp_path):
    case, organ, anatomy = rehearsal.case, rehearsal.organ, rehearsal.anatomy
    far = places_at_rest(case, (2 * marks[0] - 3 * marks.mean(axis=0) + case.origin)[None])
    step_s = case.scene.solver.time_step_s
    header = header_of(case, patient[1], "x64", organ.model.serial, step_s, None)
    recorder = SessionRecorder(tmp_path / "session", header, Notices())

    def done(*commands, steps: int = 4) -> None:
        recorder.observe(rehearsal.do(*commands, *stayed(rehearsal, steps)))

    done(Mark(places_mm=marks[:8].tolist()))
    done(Mark(places_mm=marks[8:].tolist()))
    # A line with the far mark could not be cut.
    done(Mark(places_mm=far.tolist()), Undo())
    done(cut_command(anatomy, CUT, None))
    assert anatomy.cut is not None and len(rehearsal.frame.resection.marks) == len(marks)
    done(Bookmark())
    done(Undo())
    assert anatomy.cut is None
    done(Redo())
    done(Bookmark(), Checkpoint())
    report, digest = report_of(anatomy), organ.digest()
    recorder.close({})
    log = read_log(recorder.path)
    for at_s in (0.0, log.length_s - step_s):
        begun, check = replayed(rehearsal, log, at_s)
        assert (begun > 0) == (at_s > 0) and check.differs_s is None
        assert organ.digest() == digest and report_of(anatomy) == report


def test_undo_of_a_cut_restores_friction_under_a_pressing_probe(rehearsal, marks):
    start = touching_at(rehearsal, rehearsal.case.tumour.center_mass)
    scored(rehearsal, marks)
    rehearsal.organ.pose = start
    rehearsal.do(*(Move(pose=advanced(start, 0.5 * number)) for number in range(12)))
    assert rehearsal.organ.contacts.has_friction

    def dragged() -> str:
        aside, pressed = np.cross([0.65, -0.75, 0.12], [1.0, 0, 0]), rehearsal.frame.pose
        for number in range(1, 5):
            pose = pressed.copy()
            pose[:3, 3] += 0.3 * number * aside
            rehearsal.do(Move(pose=pose))
        return rehearsal.organ.digest()

    rehearsal.do(BeginAction())
    digest = dragged()
    rehearsal.do(Undo())
    assert cut(rehearsal) == []
    rehearsal.do(Undo())
    assert dragged() == digest


def test_cuts_that_are_undone_leave_no_fields_and_a_cut_survives_as_text(rehearsal, marks):
    timeline, anatomy = rehearsal.timeline, rehearsal.anatomy
    scored(rehearsal, marks)
    uncut = timeline.whole_state()
    assert cut(rehearsal) == []
    cut_out = timeline.whole_state()
    from_text = unpack_state(pack_state(cut_out), rehearsal.frame.positions)
    assert from_text.resection == cut_out.resection
    fields = []
    for _ in range(4):
        rehearsal.do(Load(state=uncut))
        assert anatomy.cut is None
        rehearsal.do(Load(state=from_text))
        assert anatomy.cut is not None
        gc.collect()
        fields.append(sum(isinstance(thing, Field) for thing in gc.get_objects()))
    assert fields[1] == fields[3]


def test_the_distance_of_a_line_to_the_tumour_is_negative_over_it():
    """Along the line's direction, z: points over the middle and the edge of a cube, and two beside it."""
    line = SimpleNamespace(
        frame=lambda: np.eye(3), points=np.array([[0.0, 0, 9], [5, 0, 9], [8, 0, 9], [8, 9, 9]])
    )
    tumour = trimesh.creation.box([10.0, 10.0, 10.0])
    distances = distance_to_tumour(line, tumour)
    assert distances == pytest.approx([-5.0, 0.0, 3.0, 5.0], abs=1e-12)
    assert len(distance_to_tumour(line, None)) == 0


def test_the_view_warns_of_a_line_that_is_too_near_and_shows_the_coming_cut(rehearsal, marks):
    anatomy = rehearsal.anatomy
    measurements = LiveMeasurements(anatomy, rehearsal.manipulator)
    shown, seen = ResectionView(anatomy), measurements.coverage

    def hint_of(phase: Phase, **settings) -> str:
        return hint(phase, anatomy, measurements, shown, CutSettings(**settings))

    def look(time_s: float, is_seen: bool) -> None:
        """Update at a time, after images that have shown all or nothing."""
        seen.seen[:] = is_seen
        anatomy.show(replace(rehearsal.frame, time_s=time_s))
        shown.update(CutSettings(), seen.is_seen)

    look(0.0, True)
    assert shown.score(MARGIN_MM) is None and shown.figures(CutSettings())["marks"] == "0"
    assert "Mark the line" in hint_of("Score") and "Score comes first" in hint_of("Excise")
    scored(rehearsal, marks)
    look(0.0, True)
    assert not shown.score(MARGIN_MM).is_near.any() and "Next: Excise" in hint_of("Score")
    assert "{cut_out} cuts along the line: enucleoresection, 5 mm of margin, as deep as seen" in hint_of(
        "Excise"
    )
    assert "Nothing was cut yet" in hint_of("Inspect")
    # Between marks a geodesic may be nearer than they are, by the sagitta of their arc.
    assert shown.tumour_mm.min() > MARGIN_MM - 0.5
    assert shown.score(MARGIN_MM + 2.0).is_near.all()
    assert "mm from the tumour where it is red, 7 mm are asked" in hint_of("Score", margin_mm=7.0)
    assert float(shown.figures(CutSettings())["line to tumour"].split()[0]) == pytest.approx(
        shown.tumour_mm.min(), abs=0.06
    )
    look(1.0, False)
    assert "no part of the tumour was seen" in hint_of("Excise")
    assert shown.figures(CutSettings())["tumour surface seen"] == "0 %"
    assert "12 mm deep" in hint_of("Excise", depth_mm=12.0) or shown.fault
    assert shown.section() is None
    moved_to(rehearsal, touching_at(rehearsal, rehearsal.case.tumour.center_mass))
    look(2.0, True)
    depth = shown.section()[..., 1].max() - anatomy.tumour_outline()[..., 1].max()
    assert MARGIN_MM - 1.0 < depth < MARGIN_MM + 1.0
    wedge = dict(cut_depth_mm=12.0, air_in_crater=True, technique="wedge")
    settings = settings_with({f"resection.{name}": value for name, value in wedge.items()})
    assert asdict(cut_settings(settings)) == dict(
        technique="wedge", margin_mm=5.0, depth_mm=12.0, filling="air"
    )


def source_of(
    rehearsal: Rehearsal, *actions: ScriptedAction, plan: ResectionPlan | None = None
) -> UserSource:
    """A user whose script acts."""
    script = ResectionScript(list(actions))
    return UserSource(rehearsal.anatomy, rehearsal.manipulator, Notices(), script=script, resection_plan=plan)


def acted(rehearsal: Rehearsal, source: UserSource, **controls) -> list[str]:
    """The frame after a user's controls; return the notices."""
    given = Controls(settings_with(), **controls)
    frame = applied(rehearsal, *source.commands(rehearsal.frame, given, 1 / 60))
    return [*frame.notices, *source.notices.present()]


def in_patient(rehearsal: Rehearsal, marks: np.ndarray) -> Sequence[tuple[float, float, float]]:
    return [tuple(map(float, mark + rehearsal.case.origin)) for mark in marks]


def test_a_script_acts_at_its_times_and_cuts_but_once(rehearsal, marks):
    score, again = in_patient(rehearsal, marks), ScriptedAction(0.09, score=[(0.0, 0.0, 0.0)])
    actions = ScriptedAction(0.03, score=score), ScriptedAction(0.06, cut=CUT), ScriptedAction(0.08, cut=CUT)
    source, notices, made = source_of(rehearsal, *actions, again), [], []
    for _ in range(8):
        notices += acted(rehearsal, source)
        frame = rehearsal.frame
        made.append((round(60 * frame.time_s), len(frame.resection.marks), frame.geometry.cut is not None))
    is_scored, is_cut = ([at for at, *done in made if done[which]] for which in (0, 1))
    # A frame of 1/60 s after it is due.
    assert (is_scored[0], is_cut[0]) == (3, 5) and made[-1][1] == len(marks)
    assert len(notices) == 2 and all("cut out already" in notice for notice in notices)


def test_page_score_and_plan_are_written_and_compared(patient, rehearsal, marks, tmp_path, monkeypatch):
    case, anatomy = patient[1], rehearsal.anatomy
    resected(rehearsal, marks)
    # A line takes half a second: from fewer directions.
    few = SimpleNamespace(vertices=trimesh.creation.icosahedron().vertices[::4])
    creation = SimpleNamespace(icosahedron=lambda: few)
    monkeypatch.setattr(proposal, "trimesh", SimpleNamespace(creation=creation))
    about = case.organ, case.tumour, case.parts, MARGIN_MM, case.labels, case.tissues
    proposals = propose(*about)
    # What is refused when it is cut is not proposed.
    monkeypatch.setattr(proposal, "_lines", lambda *_: [proposals[0].cut.line])
    with pytest.raises(ResectionError, match="hilum"):
        propose(*about, trimesh.creation.icosphere().apply_translation(case.tumour.center_mass))
    costs = [candidate.cost_ml for candidate in proposals]
    assert len(costs) > 1 and costs == sorted(costs) and proposals[0].settings.technique == "enucleoresection"
    assert proposals[0].judgement.margin.margin_mm.min() > MARGIN_MM - 0.1
    why = why_first(proposals)
    assert why.startswith(
        f"The first, enucleoresection, costs {costs[1] - costs[0]:.1f} points less than the next: "
    )
    assert why_first(proposals[:1]) == "" and "None" not in why
    best = proposals[0]
    figures = figures_of(best.cut, best.judgement, case.tumour)
    assert (
        "tumour surface seen" not in dict(rows_of(figures))
        and figures["score_to_tumour_mm"] > MARGIN_MM - 0.5
    )
    draw_page(best.cut, best.judgement, case.tumour, figures, tmp_path / "plan.png", "Planned resection")
    assert (tmp_path / "plan.png").stat().st_size > 10_000
    cuts = [planned_cut(candidate, np.zeros(3)) for candidate in proposals]
    plan, path = ResectionPlan(anatomy="a", margin_mm=MARGIN_MM, cuts=cuts), tmp_path / "plan.json"
    write_plan(plan, path)
    assert is_resection_plan(path) and read_resection_plan(path) == plan
    with pytest.raises(CommandError, match="the scripted press cuts nothing; open it in a window, or add"):
        read_files(RehearseOptions(headless=True, plan=path))
    assert read_files(RehearseOptions(plan=path)).resection_plan == plan
    report = report_of(anatomy, plan)
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
    page, figures = save_page(anatomy, report, tmp_path, 12)
    assert (page.name, figures.name) == ("resection-012.png", "resection-012.json")
    assert page.stat().st_size > 10_000 and json.loads(figures.read_text()) == report
    assert dict(rows_of(report))["positive margin"].startswith("0 mm2")
    assert why_less(report) == []
    less = report | dict(margin_min_mm=3.9, score_to_tumour_mm=4.8)
    assert why_less(less) == [("less than asked", "the score is 4.8 mm from the tumour")]
    assert (
        "surface seen; the score" in dict(rows_of(less | dict(tumour_seen_percent=53.4)))["less than asked"]
    )
    curve = json.loads(save_score(rehearsal.case, anatomy.cut.line, tmp_path).read_text())["markups"][0]
    points = np.array([point["position"] for point in curve["controlPoints"]])
    assert curve["type"] == "ClosedCurve" and curve["coordinateSystem"] == "LPS"
    assert np.abs(signed_distance_from(case.organ, points)).max() < 0.3
    rehearsal.reset()
    scored(rehearsal, marks[:3])
    notices = acted(rehearsal, source_of(rehearsal, plan=plan), score_planned=True)
    planned = rehearsal.frame.resection.points() + rehearsal.case.origin
    assert np.abs(planned - np.array(plan.best.marks_mm)).max() < 0.05
    assert "for enucleoresection with a margin of 5 mm" in notices[0]
    notices = acted(rehearsal, source_of(rehearsal), score_planned=True)
    assert "no planned line; make a plan" in notices[0]
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


def test_a_script_has_marks_at_places(tmp_path: Path):
    path, places = tmp_path / "track.json", [[1.0, 2.5, -3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]]
    entry = {"time_s": 1.5, "probe_to_patient": np.eye(4).tolist(), "score": places}
    path.write_text(json.dumps([entry | {"time_s": 0.0, "score": None}, entry]))
    (action,) = load_timed_poses(path).actions
    assert action.time_s == 1.5 and np.array_equal(action.score, places)


@pytest.mark.parametrize(
    ("entry", "text"),
    [
        ({"score": "picture"}, "score"),
        ({"score": [[1.0, 2.0]]}, "score"),
        ({"score": [[1.0, 2.0, "3"]]}, "score"),
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
