"""The search for a plan: candidate_search, who has how many trials, and what a plan is made of; with processes that only count."""

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from plan_ball import GOOD, big_ball, from_above, manipulator_on, straight_pass

from rehearsal.planning import plan_search
from rehearsal.planning.plan_file import PlanError, read_plan, write_plan
from rehearsal.planning.plan_search import (
    GENERATION,
    SURROGATE_TRIALS,
    TRIAL_MM_S,
    TRIAL_SIGMA,
    CandidateSearch,
    TriedPath,
    make_plan,
    ranked,
    search,
    search_space,
    surrogate_optimum,
    total_work,
    try_candidate,
    try_path,
)
from rehearsal.planning.sweep_candidates import SweepCandidate
from rehearsal.planning.sweep_score import ScoreTerms, score
from rehearsal.planning.sweep_trial import PlanningProblem, Trial
from scenes.anatomy import LoadedAnatomy, fingerprint
from scenes.scene import Scene, Trocar
from studies.planning import plan_comparison
from studies.planning.plan_comparison import table
from ultrasound.probe import load_probe

BEST = dict(a_mm=-3.0, b_mm=7.0, c_deg=20.0)
RANGES = dict(a_mm=(-10, 10, 0), b_mm=(0, 8, 2), c_deg=(-45, 45, -30))


def candidate(name: str, handicap: float = 0.0) -> SweepCandidate:
    """One that is worth less by a handicap, which its count carries."""
    return SweepCandidate(name, "slide", int(100 * handicap), from_above(), RANGES)


def worth(values: dict[str, float], handicap: float = 0.0) -> ScoreTerms:
    """Best in one place, and known how good there: how much is seen falls with the square of the distance."""
    off = sum(((values[name] - BEST[name]) / np.ptp(RANGES[name][:2])) ** 2 for name in BEST)
    return replace(GOOD, seen=1.0 - handicap - off)


class Counting:
    """No processes: a way is worth what its numbers say, and every task is written down."""

    def __init__(self, candidates: list[SweepCandidate], reachable: float = 1.0, ways: int = 1) -> None:
        self.candidates, self.reachable, self.ways = candidates, reachable, ways
        self.problem = problem_of()
        self.tasks: list[tuple[SweepCandidate, dict[str, float], float]] = []
        self.surrogate_optima = 0

    def map(self, function, tasks) -> Iterator:
        stand_ins = {search_space: self.space, surrogate_optimum: self.optimum, try_candidate: self.tried}
        for number, task in enumerate(tasks):
            if function is try_path:
                yield replace(GOOD, seen=0.1 * number), [straight_pass(4)]
            else:
                yield stand_ins[function](*task)

    def space(self) -> tuple[list[SweepCandidate], dict]:
        return self.candidates, dict(model="neo-hookean", cell_mm=8.0)

    def optimum(self, candidate: SweepCandidate) -> np.ndarray:
        self.surrogate_optima += 1
        return candidate.start()

    def tried(self, candidate: SweepCandidate, values: dict[str, float], speed: float) -> TriedPath:
        self.tasks.append((candidate, values, speed))
        terms = replace(worth(values, candidate.count / 100), reachable=self.reachable)
        return terms, [straight_pass(4)] * self.ways


def four() -> list[SweepCandidate]:
    return [candidate(f"sweep {n}", handicap) for n, handicap in enumerate((0.3, 0.0, 0.2, 0.1))]


def problem_of(**changes) -> PlanningProblem:
    anatomy = LoadedAnatomy(big_ball(), None, None, ())
    values = dict(scene=Scene(anatomy={}), anatomy=anatomy, probe=load_probe("linear"), target="organ")
    return PlanningProblem(**(values | dict(margin_mm=5.0, trocar=Trocar()) | changes))


def with_tumour(**changes) -> PlanningProblem:
    return problem_of(anatomy=LoadedAnatomy(big_ball(), big_ball(), None, ()), **changes)


# CMA-ES


def evolved(generations: int, beside: bool = False) -> CandidateSearch:
    found, other = (
        CandidateSearch(candidate("one"), candidate("one").start(), TRIAL_SIGMA) for _ in range(2)
    )
    for _ in range(generations):
        asked = found.ask()
        if beside:
            other.tell(other.ask(), [0.0] * GENERATION)
            np.random.default_rng(0).normal(size=7)
        found.tell(asked, [score(worth(found.candidate.values(each))) for each in asked])
    return found


def test_the_search_finds_the_best_parameters():
    found = evolved(40)
    for name, best in BEST.items():
        assert found.values[name] == pytest.approx(best, abs=0.01 * np.ptp(RANGES[name][:2]))
    assert found.score == pytest.approx(score(replace(GOOD, seen=1.0)), abs=0.05)
    assert found.candidate.values(found.best) == found.values and found.trials == 40 * GENERATION


def test_a_search_is_deterministic_and_independent_of_other_generators():
    np.random.seed(5)  # noqa: NPY002 the one that all share
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    alone = evolved(5)
    assert np.array_equal(np.random.get_state()[1], before)  # noqa: NPY002
    np.random.seed(6)  # noqa: NPY002
    assert np.array_equal(evolved(5, beside=True).best, alone.best)


def test_the_first_generation_has_the_start_and_all_stay_in_range():
    start = np.array([0.0, 1.0, 0.5])
    found = CandidateSearch(candidate("one"), start, 0.5)
    for generation in range(6):
        asked = found.ask()
        assert len(asked) == GENERATION and np.array_equal(asked[0], start) == (generation == 0)
        assert all(((each >= 0) & (each <= 1)).all() for each in asked)
        found.tell(asked, [each[0] for each in asked])
    assert found.best[0] > 0.9 and found.score == found.best[0]


@pytest.mark.parametrize("better", [True, False])
def test_a_search_restarts_at_the_default_if_that_is_better(better):
    """Than the optimum of the surrogate."""
    one, start = candidate("one"), np.array([0.9, 0.9, 0.9])
    found = CandidateSearch(one, start, TRIAL_SIGMA)
    asked = found.ask()
    assert np.array_equal(asked[:2], [start, one.start()])
    found.tell(asked, [1.0, 2.0 if better else 0.0, *[0.5] * (GENERATION - 2)])
    wanted = one.start() if better else start
    away = np.linalg.norm(found.ask() - wanted, axis=1)
    # Steps of TRIAL_SIGMA along each of three axes; what lies there is farther off.
    assert away.max() < 5 * TRIAL_SIGMA < np.linalg.norm(start - one.start())
    assert np.array_equal(found.best, wanted)


def test_part_of_a_generation_counts_and_the_best_so_far_stays():
    found = CandidateSearch(candidate("one"), candidate("one").start(), TRIAL_SIGMA)
    asked = found.ask()
    found.tell(asked[:3], [1.0, 5.0, 2.0])
    assert (found.trials, found.score) == (3, 5.0) and np.array_equal(found.best, asked[1])
    found.tell(found.ask(), [4.0] * GENERATION)
    assert (found.trials, found.score) == (3 + GENERATION, 5.0) and np.array_equal(found.best, asked[1])


def test_the_surrogate_optimum_is_no_worse_than_the_default(monkeypatch):
    asked: list[dict[str, float]] = []

    class Surrogate:
        """Its path is the parameters."""

        manipulator = None

        def __init__(self, trial) -> None: ...

        def evaluate(self, values: dict[str, float]) -> ScoreTerms:
            asked.append(values)
            return worth(values)

    monkeypatch.setattr(plan_search, "RigidSurrogate", Surrogate)
    monkeypatch.setattr(SweepCandidate, "path", lambda self, manipulator, values: values)
    one = candidate("one")
    best = surrogate_optimum(SimpleNamespace(rehearsal=SimpleNamespace(reset=lambda: None)), one)
    assert len(asked) == -(-plan_search.SURROGATE_EVALUATIONS // GENERATION) * GENERATION
    assert asked[0] == pytest.approx(one.values(one.start()))
    assert worth(one.values(best)).seen == max(worth(values).seen for values in asked) > 0.99


# Distribution of trials


@pytest.mark.parametrize("trials", [4, 5, 37, 64, 96, 101])
def test_all_trials_are_made_and_counted(trials):
    workers, done = Counting(four()), []
    searches = search(workers.candidates, workers, trials, done.append)
    made = Counter(each.side for each, _, _ in workers.tasks)
    assert sum(made.values()) == len(workers.tasks) == trials and Counter(done) == {
        1: trials,
        SURROGATE_TRIALS: 4,
    }
    assert {one.candidate.side: one.trials for one in searches} == made
    assert {speed for _, _, speed in workers.tasks} == {TRIAL_MM_S} and workers.surrogate_optima == 4


def test_the_better_half_has_the_rest():
    workers = Counting(four())
    searches = search(workers.candidates, workers, 96, lambda _: None)
    trials = {one.candidate.side: one.trials for one in searches}
    half = (96 - 2 * GENERATION) // 2
    assert trials == {"sweep 0": GENERATION, "sweep 2": GENERATION, "sweep 1": half, "sweep 3": half}
    of_three = search(four()[:3], Counting(four()[:3]), 96, lambda _: None)
    assert sum(one.trials == max(each.trials for each in of_three) for one in of_three) == 2


def test_every_answer_goes_to_the_candidate_that_asked():
    workers = Counting(four())
    for one in search(workers.candidates, workers, 45, lambda _: None):
        tried = [values for each, values, _ in workers.tasks if each is one.candidate]
        scores = [score(worth(values, one.candidate.count / 100)) for values in tried]
        assert one.score == max(scores) and one.values == tried[int(np.argmax(scores))]
        assert tried[0] == pytest.approx(one.candidate.values(one.candidate.start()))


def test_two_searches_try_the_same():
    one, two = Counting(four()), Counting(four())
    for workers in (one, two):
        search(workers.candidates, workers, 70, lambda _: None)
    assert [(each.side, values) for each, values, _ in one.tasks] == [
        (each.side, values) for each, values, _ in two.tasks
    ]


def test_the_best_of_each_is_tried_once_more_and_ranked():
    workers, done = Counting(four()), []
    searches = search(workers.candidates, workers, 48, lambda _: None)
    workers.tasks.clear()
    rows = ranked(searches, workers, 12.0, done.append)
    assert [one.candidate.side for one, _, _ in rows] == ["sweep 1", "sweep 3", "sweep 2", "sweep 0"]
    assert done == [3] * 4 and {speed for _, _, speed in workers.tasks} == {12.0}
    assert all(terms == worth(one.values, one.candidate.count / 100) for one, terms, _ in rows)
    # A candidate without trials has no parameters to try.
    untried = CandidateSearch(candidate("untried"), np.zeros(3), TRIAL_SIGMA)
    assert len(ranked([*searches, untried], workers, 12.0, lambda _: None)) == 4


# A plan made


def test_a_plan_contains_the_ranked_sweeps(tmp_path):
    problem, done, plans = problem_of(trocar=Trocar(cone_deg=33)), [], []
    for _ in range(2):
        workers = Counting(four())
        workers.problem = problem
        plans.append(make_plan(workers, 12.0, 96, done.append))
    assert sum(done) == 2 * total_work(96, 12.0), "what the command's progress bar expects"
    assert done[0] == 0 and done.count(0) == 2
    plan = plans[0]
    assert [each.name.split("passes ")[-1].removeprefix("one pass ") for each in plan.sweeps] == [
        *("sweep 1", "sweep 3", "sweep 2", "sweep 0")
    ]
    scores = [each.score for each in plan.sweeps]
    assert scores == sorted(scores, reverse=True) and sum(each.trials for each in plan.sweeps) == 96
    for each in plan.sweeps:
        assert each.score == pytest.approx(sum(each.points.values()), abs=1e-5)
        assert each.score == pytest.approx(score(ScoreTerms(**each.parts)), abs=1e-3)
        assert np.array(each.passes[0]) == pytest.approx(straight_pass(4), abs=1e-6)
    assert plan.anatomy == fingerprint(problem.anatomy) and plan.trocar.cone_deg == 33
    assert (plan.target, plan.margin_mm, plan.speed_mm_s) == ("organ", 5.0, 12.0)
    named = [
        re.match(r"(The first sweep is|It comes before) .*sweep (\d), with -?[\d.]+ points: it .*\.$", line)
        for line in plan.why
    ]
    assert [one[2] for one in named] == ["1", "3", "2", "0"]
    for name, each in zip("ab", plans, strict=True):
        write_plan(each, tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert read_plan(tmp_path / "a") == plan


@pytest.mark.parametrize(
    "workers", [Counting(four(), reachable=0.95), Counting(four(), ways=0), Counting([])]
)
def test_without_a_reachable_sweep_there_is_an_error(workers):
    with pytest.raises(PlanError, match="no sweep was found.*move the trocar, widen its cone") as error:
        make_plan(workers, 10.0, 4 if workers.candidates else 0, lambda _: None)
    assert "\n" not in str(error.value)


def test_a_comparison_reports_its_progress_and_averages_the_random_sweeps(monkeypatch):
    shared: list[object] = []
    workers = object()

    class Crew(Counting):
        def __init__(self, problem: PlanningProblem, workers: object) -> None:
            super().__init__(four())
            shared.append(workers)

    monkeypatch.setattr(plan_comparison, "TrialWorkers", Crew)
    done: list[int] = []
    run = plan_comparison.compare(Scene(anatomy={}), with_tumour().anatomy, 40, workers, done.append)
    assert sum(done) == plan_comparison.count_of(40) and shared == [workers, workers]
    rows = {row["sweep"]: row for row in run["rows"]}
    assert list(rows) == ["planned", "straight", "row by row", "random"]
    assert [row["count"] for row in rows.values()] == [1, 1, 1, len(plan_comparison.SEEDS)]
    assert rows["random"]["seen"] == pytest.approx(0.1 * np.mean(3 + np.arange(len(plan_comparison.SEEDS))))
    assert rows["straight"]["score"] == pytest.approx(score(replace(GOOD, seen=0.1)))
    lines = table(dict(run, patient="patient 1")).splitlines()
    assert len(lines) == 6
    assert lines[-1].startswith(f"random ({len(plan_comparison.SEEDS)})") and lines[-1].split()[2] == "40"


# Problems


@pytest.mark.parametrize("target", ["tumour", "margin"])
def test_a_tumour_target_needs_a_tumour(target):
    with pytest.raises(PlanError, match=f"--target {target}: this scene has no tumour; expected organ"):
        problem_of(target=target)


@pytest.mark.usefixtures("one_device")
@pytest.mark.parametrize(("target", "margin"), [("tumour", 5.0), ("margin", 0.0)])
def test_a_target_without_a_voxel_is_refused(monkeypatch, target, margin):
    speck = trimesh.creation.icosphere(subdivisions=1, radius=0.3).apply_translation([0.7, 0.7, 0.7])
    built = SimpleNamespace(
        whole_organ=big_ball(), whole_tumour=speck, manipulator=manipulator_on(big_ball()), origin=np.zeros(3)
    )
    monkeypatch.setattr("rehearsal.planning.sweep_trial.Rehearsal", lambda *_: built)
    anatomy = replace(problem_of().anatomy, tumour=speck)
    # Not in a process of its own, which would build a rehearsal.
    with pytest.raises(PlanError, match=f"--target {target}: it is smaller than a voxel of 1.5 mm"):
        Trial(problem_of(anatomy=anatomy, target=target, margin_mm=margin))


def test_no_images_are_sent_to_the_processes():
    grid = SimpleNamespace(voxels=np.zeros((2, 2, 2)))
    anatomy = replace(problem_of().anatomy, ct=grid, labels=grid, parts=dict(vessel=big_ball()))
    bare = problem_of(anatomy=anatomy).without_images
    assert bare.anatomy.ct is None and bare.anatomy.labels is None and bare.anatomy.parts == {}
    assert bare.anatomy.organ is anatomy.organ
    # Parts with their own material are of the tissue.
    stiff = Scene(anatomy=dict(parts=dict(vessel="vessel.stl")), tissue=dict(parts=dict(vessel={})))
    parts = problem_of(anatomy=anatomy, scene=stiff).without_images.anatomy.parts
    assert parts == anatomy.parts
