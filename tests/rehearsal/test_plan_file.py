"""A plan's file, and what is refused of plans and of the command lines that make and follow them."""

import json

import numpy as np
import pytest
import trimesh
from conftest import rotation_about
from plan_ball import ORIGIN, plan_of, straight_pass, sweep_of
from pydantic import ValidationError

import app
from rehearsal.commands.plan_command import over_limit_warning
from rehearsal.input_files import check_plan, check_reach
from rehearsal.planning import sweep_trial
from rehearsal.planning.plan_file import (
    APPROACH_S,
    LIFT_MM,
    LIFTED_MM_S,
    PlanError,
    is_plan,
    next_plan_path,
    read_plan,
    timed_poses,
    write_plan,
)
from rehearsal.planning.sweep_trial import PlanningProblem
from rehearsal.tracking.track_file import load_track
from scenes.scene import AnatomyFiles, Scene, Trocar, with_options
from ultrasound.probe import load_probe

BALL = """
[anatomy]
organ = "organ.stl"
[[shape]]
kind = "plane"
normal = [0.0, 0.0, 1.0]
offset_mm = -20.0
"""


def test_a_plan_read_is_the_one_written_and_two_are_the_same_bytes(tmp_path):
    plan = plan_of(sweep_of(straight_pass(5), straight_pass(3, 9.0)), sweep_of(straight_pass(2)))
    for name in "ab":
        write_plan(plan, tmp_path / name)
    read = read_plan(tmp_path / "a")
    assert read == plan and (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert is_plan(tmp_path / "a") and not is_plan(tmp_path / "none") and not is_plan(tmp_path)
    first, second = read.sweeps[0].poses()
    assert first.shape == (5, 4, 4) and second.shape == (3, 4, 4)
    assert second[2, :3, 3] == pytest.approx(ORIGIN + [9, 2, 0])


def test_plans_are_numbered_on(tmp_path):
    assert next_plan_path(tmp_path).name == "plan-001.json"
    for name in ("plan-002.json", "plan-010.json", "plan-x.json", "plan-099.txt", "my-plan-500.json"):
        (tmp_path / name).touch()
    assert next_plan_path(tmp_path) == tmp_path / "plan-011.json"
    (tmp_path / "plan-999.json").touch()
    assert next_plan_path(tmp_path).name == "plan-1000.json"


def changed(values: dict, where: str, value) -> None:
    *path, last = [int(part) if part.isdigit() else part for part in where.split(".")]
    for part in path:
        values = values[part]
    values[last] = value


SHEARED = np.eye(4) + 0.01 * np.eye(4)[[1, 0, 2, 3]]
TURNED = np.eye(4)
TURNED[:3, :3] = rotation_about([1, 2, 3], 40)
ODD = np.eye(4)
ODD[3] = [0, 0, 0, 2.0]


@pytest.mark.parametrize(
    ("where", "value", "words"),
    [
        ("nephron_plan", 1, "nephron_plan = 1: written by Nephron 1, and this is Nephron 2"),
        ("target", "liver", "input should be 'margin', 'tumour' or 'organ'"),
        ("margin_mm", "5", "margin_mm = '5': input should be a valid number"),
        ("margin_mm", -5.0, "input should be greater than or equal to 0"),
        ("margin_mm", 1e9, "input should be less"),
        ("speed_mm_s", 0.0, "input should be greater"),
        ("speed_mm_s", float("inf"), "input should be"),
        ("trocar.cone_deg", 120, "input should be less than or equal to 90"),
        ("sweeps", [], "list should have at least 1 item"),
        ("sweeps.0.passes", [], "list should have at least 1 item"),
        ("sweeps.0.passes.0", [], "list should have at least 2 items"),
        ("sweeps.0.passes.0", [np.eye(4).tolist()], "list should have at least 2 items"),
        ("sweeps.0.passes.0.1", np.diag([1.0, 1, 1.01, 1]).tolist(), "not rigid"),
        ("sweeps.0.passes.0.1", SHEARED.tolist(), "not rigid"),
        ("sweeps.0.passes.0.1", np.diag([1.0, 1, -1, 1]).tolist(), "three right-handed unit axes"),
        ("sweeps.0.passes.0.1", ODD.tolist(), "a last row of 0 0 0 1"),
        ("sweeps.0.passes.0.1", np.eye(3).tolist(), "list should have at least 4 items"),
        ("sweeps.0.passes.0.1.0.3", float("nan"), "input should be a finite number"),
        ("sweeps.0.passes.0.1.0.3", "far", "input should be a valid number"),
        ("sweeps.0.parts", dict(path_mm=3.0), "seen is missing"),
        ("sweeps.0.transfers", [[np.eye(4).tolist()]], "expected poses from each pass to the next, 0 lists"),
        ("sweeps.0.parts.seen", float("nan"), "input should be a finite number"),
        ("sweeps.0.colour", "red", "unknown key"),
    ],
)
def test_a_plan_that_cannot_be_used_is_refused_in_one_line(tmp_path, where, value, words):
    values = plan_of().model_dump(mode="json")
    changed(values, where, value)
    refusal = refused_file(tmp_path, json.dumps(values).encode())
    assert where in refusal and words in refusal


@pytest.mark.parametrize(
    "content", [b"", b"{", b"[1, 2]", b"\xff\xfe\x00", b"null", b'{"nephron_plan": 1}', b"[" * 100_000]
)
def test_what_is_no_plan_is_refused_in_one_line(tmp_path, content):
    assert "expected a file that app.py plan wrote" in refused_file(tmp_path, content)


def refused_file(tmp_path, content: bytes) -> str:
    path = tmp_path / "plan.json"
    path.write_bytes(content)
    with pytest.raises(PlanError) as error:
        read_plan(path)
    refusal = str(error.value)
    assert refusal.startswith(f"{path}: ") and "\n" not in refusal and len(refusal) < 450
    return refusal


def test_a_turned_pose_is_taken_and_no_file_or_a_folder_refused(tmp_path):
    values = plan_of().model_dump(mode="json")
    changed(values, "sweeps.0.passes.0.1", np.round(TURNED, 6).tolist())
    (tmp_path / "plan.json").write_text(json.dumps(values))
    assert read_plan(tmp_path / "plan.json").sweeps[0].poses()[0][1] == pytest.approx(TURNED, abs=1e-6)
    with pytest.raises(PlanError, match="no such plan; make one with: app.py plan SCENE --out none.json"):
        read_plan(tmp_path / "none.json")
    (tmp_path / "a.png").write_bytes(b"\x89PNG")
    with pytest.raises(PlanError, match=r"not text in UTF-8\); expected a file that app.py plan wrote"):
        read_plan(tmp_path / "a.png")
    with pytest.raises(PlanError, match="cannot be read as a plan"):
        read_plan(tmp_path)


def test_a_plan_is_followed_only_on_its_anatomy_with_its_probe():
    plan, probe = plan_of(), load_probe("linear")
    check_plan(plan, plan.anatomy, probe)
    with pytest.raises(PlanError, match="the plan is for other anatomy"):
        check_plan(plan, "b" * 16, probe)
    with pytest.raises(PlanError, match="for the probe 'Linear.*found 'Drop-in.*choose it with --probe"):
        check_plan(plan, plan.anatomy, load_probe("drop-in"))
    with pytest.raises(PlanError, match="for the probe"):
        check_plan(plan, plan.anatomy, probe.model_copy(update=dict(housing_mm=(40.0, 10.0, 21.0))))
    with pytest.raises(PlanError, match="for the probe None"):
        check_plan(plan_of(probe={}), plan.anatomy, probe)


def test_a_pose_far_from_the_organ_is_refused_by_its_number():
    near, far, farther = straight_pass(3), straight_pass(3), straight_pass(3)
    far[1, 2, 3] += 900.0
    farther[1, 2, 3] += 2000.0
    check_reach(plan_of(sweep_of(near, far)), ORIGIN[None])
    with pytest.raises(PlanError, match=r"sweep 2, pass 2, pose 2 is 2000 mm"):
        check_reach(plan_of(sweep_of(near), sweep_of(near, farther)), ORIGIN[None])


# As a track


def test_a_sweep_as_a_track_goes_at_its_speed_and_is_lifted_between_passes(tmp_path):
    plan = plan_of(sweep_of(straight_pass(3, step_mm=1.5), straight_pass(2, 9.0, 1.0)), speed_mm_s=5.0)
    write_plan(plan, tmp_path / "plan.json")
    track = load_track(tmp_path / "plan.json")
    places = np.array([pose[:3, 3] for pose in track.poses]) - ORIGIN
    up = [0, 0, LIFT_MM]
    expected = [up, up, [0, 0, 0], [0, 1.5, 0], [0, 3, 0], [0, 3, LIFT_MM]]
    expected += [[9, 0, LIFT_MM], [9, 0, 0], [9, 1, 0], [9, 1, LIFT_MM]]
    assert places == pytest.approx(np.array(expected, float))
    way = np.linalg.norm(np.diff(places, axis=0), axis=1)
    speeds = way / np.diff(track.times_s)
    assert speeds[[1, 2, 3, 6, 7]] == pytest.approx(5.0) and speeds[[4, 5, 8]] == pytest.approx(LIFTED_MM_S)
    assert track.times_s[:2].tolist() == [0.0, APPROACH_S]
    turned = sweep_of(straight_pass(2, step_mm=0.0))
    turned.passes[0][1] = (np.array(turned.passes[0][1]) @ TURNED).tolist()
    assert np.diff(timed_poses(turned, 5.0).times_s)[2] == pytest.approx(40 / 1.5 / 5.0)


# The trocar, and the command line


OUT_OF_RANGE = dict(
    axis=[(0, 0, 0)],
    cone_deg=[0, 91],
    wrist_deg=[-1, 181],
    longest_mm=[0],
    at_mm=[(float("nan"), 0, 0), (0, 0)],
    port=[(0, 0, 0)],
)


@pytest.mark.parametrize(("name", "values"), OUT_OF_RANGE.items(), ids=OUT_OF_RANGE)
def test_a_trocar_out_of_range_is_refused(name, values):
    for value in values:
        with pytest.raises(ValidationError):
            Trocar.model_validate({name: value})


def test_the_command_line_changes_the_scenes_trocar():
    trocar = Trocar(at_mm=(1, 2, 3), axis=(0, 0, 2), cone_deg=40, wrist_deg=60, longest_mm=200)
    scene = Scene(anatomy=AnatomyFiles(), trocar=trocar)
    options = {"trocar.at_mm": (4.0, 5.0, 6.0), "trocar.cone_deg": 30.0, "trocar.wrist_deg": 0.0}
    changed = with_options(scene, options).trocar
    assert changed == Trocar(at_mm=(4, 5, 6), axis=(0, 0, 2), cone_deg=30, wrist_deg=0, longest_mm=200)


@pytest.fixture
def ball_scene(tmp_path):
    trimesh.creation.icosphere(subdivisions=2, radius=20.0).export(tmp_path / "organ.stl")
    (tmp_path / "scene.toml").write_text(BALL)
    (tmp_path / "taken").touch()
    return tmp_path


def test_a_sweep_above_the_compression_limit_is_warned_of():
    parts = {"compression_max_mm": 11.6, "over_limit": 0.052}
    (warning,) = over_limit_warning(parts, 8.0)
    assert "up to 11.6 mm, the limit is 8 mm (exceeded at 5 % of its poses)" in warning
    assert over_limit_warning(parts, 11.6) == []


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--target", "tumour"), "--target tumour: this scene has no tumour; expected organ"),
        (("--target", "margin"), "--target margin: this scene has no tumour"),
        (("--target", "liver"), "'liver' is not one of 'margin', 'tumour', 'organ'"),
        (("--trocar", "nan", "0", "0"), "--trocar = nan: input should be a finite number"),
        (("--trocar", "1", "2"), "'--trocar' requires 3 arguments"),
        (("--cone-deg", "100"), "--cone-deg = 100.0: input should be less than or equal to 90"),
        (("--cone-deg", "0"), "--cone-deg = 0.0: input should be greater than 0"),
        (("--wrist-deg", "-1"), "--wrist-deg = -1.0: input should be greater than or equal to 0"),
        (("--margin-mm", "nan"), "nan is no number"),
        (("--margin-mm", "31"), "31.0 is not in the range"),
        (("--speed-mm-s", "nan"), "nan is no number"),
        (("--trials", "1"), "1 is not in the range"),
        (("--probe", "none"), "known by name are"),
        (("--out", "{}"), "is a folder; name a file after --out"),
        (("--out", "{}/taken/plan.json"), "cannot be created"),
    ],
)
def test_the_plan_command_refuses_in_one_line(ball_scene, capsys, options, words):
    line = ["plan", ball_scene, "--out", ball_scene / "plan.json", "--jobs", 1]
    assert app.main([str(argument).format(ball_scene) for argument in [*line, *options]]) == 2
    printed = capsys.readouterr().err
    # Before it begins: without a bar.
    assert printed.startswith("nephron: ") and words in printed and printed.count("\n") == 1
    assert not (ball_scene / "plan.json").exists()


def test_a_plan_is_made_on_the_tissue_of_the_quality(ball_scene, monkeypatch, capsys):
    cells_mm: list[float] = []

    def nobody(problem: PlanningProblem, workers: object) -> None:
        cells_mm.append(problem.scene.tissue.cell_mm)
        raise PlanError("no workers")

    monkeypatch.setattr(sweep_trial, "TrialWorkers", nobody)
    for quality in ((), ("--quality", "fast"), ("--quality", "accurate")):
        assert app.main(["plan", str(ball_scene), "--out", str(ball_scene / "plan.json"), *quality]) == 2
        assert "nephron: no workers" in capsys.readouterr().err
    assert cells_mm == [3.5, 5.0, 2.0]


def test_rehearse_refuses_a_plan_of_another_patient_before_it_builds_anything(ball_scene, capsys):
    write_plan(plan_of(), ball_scene / "plan.json")
    assert app.main(["rehearse", str(ball_scene), "--plan", str(ball_scene / "plan.json")]) == 2
    assert "the plan is for other anatomy" in capsys.readouterr().err
    (ball_scene / "plan.json").write_text("{}")
    assert app.main(["rehearse", str(ball_scene), "--plan", str(ball_scene / "plan.json")]) == 2
    printed = capsys.readouterr().err
    assert "not a plan" in printed and printed.count("\n") == 1
