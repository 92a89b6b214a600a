"""A plan made by the command on a coarse ball, tried, and followed: reproducible, and true to compression."""

import io
import re
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from ball_patient import MIDDLE, R, folder_of_ball

import app
from rehearsal import headless, worker_processes
from rehearsal.planning import plan_search
from rehearsal.planning.plan_file import Plan, read_plan
from rehearsal.planning.sweep_path import frame_towards, sliding
from rehearsal.planning.sweep_score import MEANS, ScoreTerms
from rehearsal.planning.sweep_trial import Trial
from scenes.scene import with_options
from studies.planning.baseline_sweeps import planned
from ultrasound.probe_manipulator import advanced, indentation
from version import VERSION

TRIALS, SPEED_MM_S = 4, 60.0


class Here:
    """Instead of processes this one, where what they build stays."""

    def __init__(self, jobs: int, **_: object) -> None: ...

    def submit(self, function: Callable, *arguments: object) -> Future:
        done: Future = Future()
        done.set_result(function(*arguments))
        return done

    def shutdown(self, **_: bool) -> None: ...


@dataclass
class Made:
    """A patient's folder with ``plan.json``, what its commands said, and a trial of its problem."""

    folder: Path
    plan: Plan
    said: list[str]
    followed: list[str]
    trial: Trial


@pytest.fixture(scope="module")
def made(tmp_path_factory, cluster) -> Iterator[Made]:
    folder = folder_of_ball(tmp_path_factory.mktemp("ball"))
    with pytest.MonkeyPatch.context() as patch:
        for name, few in dict(BEGINNING=24, ROUNDS=1, VARIATIONS=4).items():
            patch.setattr(plan_search, name, few)
        patch.setattr(worker_processes, "ProcessPoolExecutor", Here)
        patch.setattr(headless, "open_viewer", lambda *_, **__: None)
        said = planned_into(folder / "plan.json", "--dask", cluster)
        follow = ["--track", folder / "plan.json", "--plan", folder / "plan.json"]
        followed = told("rehearse", folder, "--headless", "--arch", "cpu", *follow, "--out", folder / "out")
        # The last starts Taichi for the trial, which stays.
        planned_into(folder / "again.json")
    (trial,) = worker_processes._built.values()
    yield Made(folder, read_plan(folder / "plan.json"), said, followed, trial)
    worker_processes._built.clear()


def planned_into(path: Path, *options: str) -> list[str]:
    """What the command says. Each begins with nothing built, as in a process of its own."""
    worker_processes._built.clear()
    few = ["--trials", TRIALS, "--speed-mm-s", SPEED_MM_S, "--jobs", 1]
    return told("plan", path.parent, "--out", path, *few, *options)


def told(*line: object) -> list[str]:
    """The lines that a command prints."""
    with redirect_stdout(io.StringIO()) as printed:
        assert app.main([str(each) for each in line]) == 0
    return printed.getvalue().splitlines()


def test_processes_and_a_cluster_write_the_same_bytes(made):
    assert (made.folder / "plan.json").read_bytes() == (made.folder / "again.json").read_bytes()
    assert sum(sweep.trials for sweep in made.plan.sweeps) == TRIALS
    _, *why, wrote = made.said
    assert why == made.plan.why and wrote.startswith(f"Wrote {len(made.plan.sweeps)} sweeps to ")
    assert made.plan.trocar.at_mm == (0.0, -150.0, 200.0)
    assert made.plan.model["cell_mm"] == 8.0 and (made.plan.target, made.plan.margin_mm) == ("margin", 5.0)


def test_the_score_terms_of_a_plan_are_those_of_its_sweep_tried_again(made):
    """Of the poses in the file, which are rounded to six digits."""
    sweep = made.plan.sweeps[0]
    terms = vars(made.trial.run(planned(made.trial, sweep), made.plan.speed_mm_s))
    # Not one step more or less, but on the way from one pass to the next, which depends on the last digits.
    steps = len(sweep.passes) - 1 + 1e-3
    step_s = made.trial.case.scene.solver.time_step_s
    assert terms.pop("time_s") == pytest.approx(sweep.parts["time_s"], abs=steps * step_s)
    assert terms == pytest.approx({name: sweep.parts[name] for name in terms}, abs=1e-2)
    assert sweep.parts["reachable"] == 1.0 and sweep.parts["seen"] > 0
    assert made.plan.version == VERSION


def test_the_poses_of_a_plan_are_on_the_organ_in_the_patient(made):
    for pose in np.concatenate(made.plan.sweeps[0].poses()):
        # Their y looks into the organ from its surface.
        assert R - 8 < np.linalg.norm(pose[:3, 3] - MIDDLE) < R + 4
        assert pose[:3, 1] @ (MIDDLE - pose[:3, 3]) > 0


# Trials


def path_at(trial: Trial, depth_mm: float, passes: int = 1) -> list[np.ndarray]:
    """Over the tumour, along y."""
    frame = frame_towards(np.array([0.0, 4.0, 0.0]), np.array([0.0, 0, 1]), np.array([1.0, 0, 0]))
    aside = np.linspace(-3.0, 3.0, passes) if passes > 1 else np.zeros(1)
    return sliding(trial.manipulator, frame, aside, -5.0, 5.0, depth_mm, 0.5)


@pytest.fixture
def trial(made) -> Trial:
    return made.trial


def run(trial: Trial, path: list[np.ndarray], speed_mm_s: float = SPEED_MM_S) -> ScoreTerms:
    return trial.run(path, speed_mm_s)


@pytest.mark.parametrize("count", [1, 3, 40])
def test_a_whole_number_of_steps_stays_one_where_poses_were_rounded(trial, count):
    start, end = trial.manipulator.home, trial.manipulator.home.copy()
    step_mm = SPEED_MM_S * trial.case.scene.solver.time_step_s
    for off_mm, steps in ((-1e-6, count), (0.0, count), (1e-6, count), (0.01 * step_mm, count + 1)):
        end[:3, 3] = start[:3, 3] + [0.0, 0.0, count * step_mm + off_mm]
        assert trial._steps(start, end, SPEED_MM_S) == steps


def test_a_trial_gives_the_same_figures_twice_whatever_was_tried_between(trial):
    path = path_at(trial, 2.0, 2)
    first = run(trial, path)
    run(trial, path_at(trial, 6.0))
    assert run(trial, path) == first


def test_a_pass_tried_alone_has_the_terms_of_a_sweep_of_it(trial):
    (poses,) = path_at(trial, 2.0)
    alone, terms = trial.try_pass(np.zeros(1), poses), run(trial, [poses])
    # It begins nearer to the organ, so that the first pose finds tissue that moves less.
    assert alone.seen.mean() == pytest.approx(terms.seen, abs=0.02) and alone.poses == len(poses)
    means = dict(zip(MEANS, alone.sums / alone.poses, strict=True))
    assert means == pytest.approx({name: getattr(terms, name) for name in MEANS}, rel=0.05, abs=0.02)
    assert alone.path_mm < terms.path_mm < alone.path_mm + 7.0
    again = trial.try_pass(np.zeros(1), poses)
    assert np.array_equal(again.seen, alone.seen) and np.array_equal(again.sums, alone.sums)


def test_a_deeper_path_has_more_compression_and_contact(trial, monkeypatch):
    shallow, middle, deep = (run(trial, path_at(trial, depth)) for depth in (0.5, 3.0, 6.0))
    for name in ("compression_mean_mm", "compression_max_mm"):
        assert getattr(shallow, name) < getattr(middle, name) < getattr(deep, name)
    # Under the face the tissue gives way by what it is pressed deeper, but for what goes aside and down.
    assert deep.compression_mean_mm - shallow.compression_mean_mm == pytest.approx(5.5, rel=0.3)
    assert shallow.contact <= deep.contact
    limit = {"transducer.compression_warning_mm": middle.compression_mean_mm}
    monkeypatch.setattr(trial, "case", replace(trial.case, scene=with_options(trial.case.scene, limit)))
    assert [run(trial, path_at(trial, depth)).over_limit for depth in (0.5, 6.0)] == [0.0, 1.0]


def test_a_lifted_path_has_no_coverage_and_no_compression(trial):
    path = path_at(trial, 1.0)
    lifted = run(trial, [np.stack([advanced(pose, -6.0) for pose in each]) for each in path])
    assert (lifted.seen, lifted.contact, lifted.compression_max_mm) == (0.0, 0.0, 0.0)
    assert run(trial, path).seen > 0.05
    assert run(trial, []) == ScoreTerms()


def test_a_path_that_starts_in_the_organ_cannot_be_reached(trial, monkeypatch):
    monkeypatch.setattr(trial, "reach", lambda poses: np.ones(len(poses), bool))
    path = path_at(trial, 2.0)
    assert trial.terms(path, [0.0], [1.0]).reachable == 1.0
    # The housing is 6 mm high: lifted by as much, it is still half in the surface.
    deep = [np.stack([advanced(pose, 7.0) for pose in each]) for each in path]
    assert trial.terms(deep, [0.0], [1.0]).reachable < 1.0


def test_two_passes_cover_more_than_either_and_the_probe_is_lifted_between(trial, monkeypatch):
    both = path_at(trial, 2.0, 2)
    depths: list[float] = []
    advance = trial.rehearsal.advance

    def noted(pose: np.ndarray) -> None:
        depths.append(indentation(pose, trial.case.size_mm, trial.manipulator.samples, 0.0))
        advance(pose)

    one, other = (run(trial, [each]) for each in both)
    monkeypatch.setattr(trial.rehearsal, "advance", noted)
    together = run(trial, both)
    assert max(one.seen, other.seen) < together.seen
    # From above, along a pass, up, over, down, along the other: never deeper than the passes, and up in
    # between. The first step ends 3 mm above.
    assert max(depths) < 2.0 + 0.5 and depths[0] == pytest.approx(-3.0, abs=1e-9)
    middle = depths[len(depths) // 3 : 2 * len(depths) // 3]
    assert min(middle) < -3.0
    assert together.path_mm > one.path_mm + other.path_mm
    assert together.time_s == pytest.approx(len(depths) * trial.case.scene.solver.time_step_s)


def test_a_slower_sweep_takes_longer_on_the_same_path(trial):
    path = path_at(trial, 2.0)
    fast = run(trial, path)
    slow = run(trial, path, 20.0)
    assert slow.time_s == pytest.approx(3 * fast.time_s, rel=0.15)
    assert slow.path_mm == pytest.approx(fast.path_mm, rel=1e-6) and slow.incidence_deg == fast.incidence_deg
    assert 20.0 * slow.time_s == pytest.approx(slow.path_mm, rel=0.15)


def test_a_restored_state_counts_as_over_the_limit_at_its_pose(trial, monkeypatch):
    path, advance = path_at(trial, 2.0), trial.rehearsal.advance

    def troubled(pose: np.ndarray) -> None:
        advance(pose)
        trial.rehearsal.organ.notice = "state restored" if np.allclose(pose, path[0][3]) else ""

    monkeypatch.setattr(trial.rehearsal, "advance", troubled)
    terms = run(trial, path)
    assert terms.over_limit == pytest.approx(1 / len(np.concatenate(path)))


def test_a_plan_is_followed_exactly_without_a_window_and_says_so(made):
    begin = f"plan      {made.plan.sweeps[0].name}: 100 % completed, mean deviation "
    (line,) = [each for each in made.followed if each.startswith(begin)]
    mm, degrees = re.fullmatch(r"([0-9.]+) mm and ([0-9]+) degrees", line.removeprefix(begin)).groups()
    # No pose is farther than half a step of the rehearsal from where the probe was: 1 mm or 1.5 degrees at
    # this speed.
    assert float(mm) <= 0.5 and float(degrees) <= 1
