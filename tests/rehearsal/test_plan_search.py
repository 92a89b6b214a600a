"""The search for a plan: variations, trials of each search, what a plan is made of; processes only count."""

import re
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from plan_ball import GOOD, big_ball, from_above, manipulator_on, straight_pass

from rehearsal.planning import plan_search
from rehearsal.planning.pass_kinds import RANGES, PassKind
from rehearsal.planning.pass_selection import best_selection, score_of
from rehearsal.planning.plan_file import MOST_SWEEPS, PlanError
from rehearsal.planning.plan_search import (
    ROUND_TRIALS,
    SURROGATE_TRIALS,
    TRIAL_SIGMA,
    PassSearch,
    TriedPath,
    make_plan,
    ranked,
    search,
    search_space,
    surrogate_search,
    total_work,
    try_pass,
    try_path,
    try_sweep,
)
from rehearsal.planning.sweep_score import ScoreTerms, TriedPass, score
from rehearsal.planning.sweep_trial import PlanningProblem, Trial
from scenes.anatomy import LoadedAnatomy, fingerprint
from scenes.scene import Scene, Trocar
from studies.planning import plan_comparison
from studies.planning.plan_comparison import table
from ultrasound.probe import load_probe

PLACES = np.linspace(-1.0, 1.0, 201)


def kind(side: str, motion: str = "slide") -> PassKind:
    return PassKind(side, motion, from_above(), np.array([10.0, 8.0]), 9.0)


def trial_of(kind: PassKind, parameters: np.ndarray, handicap: float = 0.0) -> TriedPass:
    """A pass sees the places around its own, the more of them the less it leans."""
    values = kind.values(parameters)
    reach = (0.3 - handicap) * (1 - abs(values["lean_deg"]) / 80)
    seen = np.abs(PLACES - values["aside"]) < reach
    return TriedPass(parameters, seen, 20 * np.array([1.0, 0.0, 0.8, 10.0]), 20, 16.0)


class Counting:
    """No processes: a pass is worth what its numbers say; tasks are written down. Sides have handicaps."""

    def __init__(self, handicaps: dict[str, float], reachable: bool = True) -> None:
        self.kinds = [kind(side) for side in handicaps]
        self.handicaps, self.reachable = handicaps, reachable
        self.problem = problem_of()
        self.passes: list[tuple[str, np.ndarray]] = []
        self.sweeps: list[tuple[str, list[np.ndarray], float]] = []

    def map(self, function, tasks) -> Iterator:
        stand_ins = {
            search_space: self.space,
            surrogate_search: self.on_surrogate,
            try_pass: self.tried,
            try_sweep: self.swept,
        }
        for number, task in enumerate(tasks):
            if function is try_path:
                yield replace(GOOD, seen=0.1 * number), [straight_pass(4)], []
            else:
                yield stand_ins[function](*task)

    def space(self) -> tuple[list[PassKind], dict]:
        return self.kinds, dict(model="neo-hookean", cell_mm=8.0)

    def trial(self, kind: PassKind, parameters: np.ndarray) -> TriedPass:
        return trial_of(kind, parameters, self.handicaps[kind.side])

    def on_surrogate(self, kind: PassKind) -> list[TriedPass]:
        rows = [self.trial(kind, parameters) for parameters in kind.rows()]
        return best_selection(rows, kind.most_passes) if self.reachable else []

    def tried(self, kind: PassKind, parameters: np.ndarray) -> TriedPass:
        self.passes.append((kind.side, parameters))
        return self.trial(kind, parameters)

    def swept(self, kind: PassKind, passes: list[np.ndarray], speed: float) -> TriedPath:
        self.sweeps.append((kind.side, passes, speed))
        seen = np.any([self.trial(kind, parameters).seen for parameters in passes], axis=0)
        terms = replace(GOOD, seen=float(seen.mean()))
        return terms, [straight_pass(4)] * len(passes), [straight_pass(2)] * (len(passes) - 1)


def three(**changes) -> Counting:
    return Counting({"side 0": 0.1, "side 1": 0.0, "side 2": 0.05}, **changes)


def problem_of(**changes) -> PlanningProblem:
    anatomy = LoadedAnatomy(big_ball(), None, None, ())
    values = dict(scene=Scene(anatomy={}), anatomy=anatomy, probe=load_probe("linear"), target="organ")
    return PlanningProblem(**(values | dict(margin_mm=5.0, trocar=Trocar()) | changes))


# Variations


def searched(rounds: int, beside: bool = False) -> PassSearch:
    one_search, other = (PassSearch(kind("one"), TRIAL_SIGMA) for _ in range(2))
    # Without the rows, which show all of this target.
    one_search.add([trial_of(one_search.kind, parameters) for parameters in one_search.first(16)[-6:]])
    for _ in range(rounds):
        if beside:
            other.first(16)
            np.random.default_rng(0).normal(size=7)
        one_search.add([trial_of(one_search.kind, parameters) for parameters in one_search.variations(10)])
    return one_search


def test_variations_find_passes_that_show_all_of_the_target():
    one_search = searched(30)
    assert np.any([tried.seen for tried in one_search.best], axis=0).mean() > 0.99
    # Four upright passes of 0.3 to each side are enough for a width of 2.
    assert len(one_search.best) == 4 and one_search.score == score_of(one_search.best) > searched(0).score
    assert len(one_search.tried) == 6 + 30 * 10


def test_a_search_is_deterministic_and_independent_of_other_generators():
    alone, beside = searched(5), searched(5, beside=True)
    assert np.array_equal(
        [tried.parameters for tried in alone.tried], [tried.parameters for tried in beside.tried]
    )


def test_variations_are_of_the_best_passes_and_in_range():
    one_search = PassSearch(kind("one"), TRIAL_SIGMA)
    assert one_search.variations(8) == [] and one_search.score == -np.inf
    one_search.add([trial_of(one_search.kind, parameters) for parameters in one_search.first(20)])
    best = [tried.parameters for tried in one_search.best]
    many = np.array(one_search.variations(200 * len(best)))
    assert many.min() >= 0 and many.max() <= 1
    for which, parameters in enumerate(best):
        inner = (parameters > 0.2) & (parameters < 0.8)
        for time, sigma in ((0, TRIAL_SIGMA), (1, TRIAL_SIGMA / 2)):
            some = many[which :: len(best)][time::2][:, inner] - parameters[inner]
            assert some.std() == pytest.approx(sigma, rel=0.15) and abs(some.mean()) < 0.2 * sigma


def test_a_pass_that_cannot_be_held_is_not_one_of_the_tried():
    one_search = PassSearch(kind("one"), TRIAL_SIGMA)
    one_search.add([None, None])
    assert one_search.tried == one_search.best == []
    one_search.add([None, trial_of(one_search.kind, one_search.first(11)[0])])
    assert len(one_search.tried) == len(one_search.best) == 1


def test_the_surrogate_tries_rows_and_random_passes_and_varies_the_best(monkeypatch):
    parameters_tried: list[np.ndarray] = []

    class Surrogate:
        def __init__(self, trial) -> None: ...

        def try_pass(self, kind: PassKind, parameters: np.ndarray) -> TriedPass | None:
            parameters_tried.append(parameters)
            return None if len(parameters_tried) % 5 == 0 else trial_of(kind, parameters)

    monkeypatch.setattr(plan_search, "RigidSurrogate", Surrogate)
    one = kind("one")
    best = surrogate_search(None, one)
    assert len(parameters_tried) == plan_search.BEGINNING + plan_search.ROUNDS * plan_search.VARIATIONS
    assert np.array_equal(parameters_tried[: len(one.rows())], one.rows())
    tried = [trial_of(one, parameters) for number, parameters in enumerate(parameters_tried, 1) if number % 5]
    assert score_of(best) == score_of(best_selection(tried, 4))


@pytest.mark.usefixtures("one_device")
def test_passes_are_in_the_order_of_their_ends():
    manipulator = manipulator_on(big_ball())
    one = kind("one")
    values = dict.fromkeys(RANGES["slide"], 0.0) | dict(start=-1.0, end=1.0)
    aside = [one.scaled(values | dict(aside=at)) for at in (-1.0, 1.0, 0.0)]
    backwards = [one.scaled(values | dict(aside=0.5, start=1.0, end=-1.0))]
    ordered = plan_search._in_order(SimpleNamespace(manipulator=manipulator), one, aside + backwards)
    # From -10 mm to the end of the one that runs back at 5 mm, then from where that ends to the nearest.
    assert [round(float(poses[0, 0, 3])) for poses in ordered] == [-10, 5, 0, 10]


# Distribution of trials


@pytest.mark.parametrize("trials", [2, 5, 37, 64])
def test_all_trials_are_made_and_counted_and_each_goes_to_the_search_of_its_kind(trials):
    workers, done = three(), []
    searches = search(workers.kinds, workers, trials, done.append)
    assert len(workers.passes) == trials and done == [SURROGATE_TRIALS] * 3 + [1] * trials
    for one in searches:
        tried_for_it = [parameters for side, parameters in workers.passes if side == one.kind.side]
        wanted = [workers.trial(one.kind, parameters) for parameters in tried_for_it]
        for tried, expected in zip(one.tried, wanted, strict=True):
            assert np.array_equal(tried.parameters, expected.parameters)
            assert np.array_equal(tried.seen, expected.seen)


def test_the_best_two_on_the_surrogate_are_tried_and_the_better_one_has_the_rest():
    workers = three()
    searches = search(workers.kinds, workers, 60, lambda _: None)
    assert [one.kind.side for one in searches] == ["side 1", "side 2"] and MOST_SWEEPS == 2
    begun = {side: len(workers.on_surrogate(kind(side))) for side in ("side 1", "side 2")}
    assert len(searches[1].tried) == begun["side 2"] and len(searches[0].tried) == 60 - begun["side 2"]
    # Rounds of trials, each of variations of the best so far.
    first = workers.passes[sum(begun.values()) :][:ROUND_TRIALS]
    assert {side for side, _ in first} == {"side 1"}


def test_the_best_sets_are_tried_as_sweeps_and_ranked():
    workers, done = three(), []
    searches = search(workers.kinds, workers, 30, lambda _: None)
    rows = ranked(searches[::-1], workers, 12.0, done.append)
    assert [one.kind.side for one, *_ in rows] == ["side 1", "side 2"]
    assert done == [plan_search.work_at(12.0)] * 2 and {speed for _, _, speed in workers.sweeps} == {12.0}
    for one, _, passes, transfers in rows:
        (parameters,) = [of_side for side, of_side, _ in workers.sweeps if side == one.kind.side]
        assert np.array_equal(parameters, [tried.parameters for tried in one.best])
        assert len(passes) == len(one.best) == len(transfers) + 1


# A plan made


def test_a_plan_contains_the_ranked_sweeps():
    problem, done, workers = problem_of(trocar=Trocar(cone_deg=33)), [], three()
    workers.problem = problem
    plan = make_plan(workers, 12.0, 40, done.append)
    assert sum(done) == total_work(40, 12.0), "what the command's progress bar expects"
    assert done[0] == 0 and done.count(0) == 1
    assert [sweep.name[-6:] for sweep in plan.sweeps] == ["side 1", "side 2"]
    scores = [sweep.score for sweep in plan.sweeps]
    assert scores == sorted(scores, reverse=True) and sum(sweep.trials for sweep in plan.sweeps) == 40
    for sweep in plan.sweeps:
        assert sweep.score == pytest.approx(sum(sweep.points.values()), abs=1e-5)
        assert sweep.score == pytest.approx(score(ScoreTerms(**sweep.parts)), abs=1e-3)
        assert np.array(sweep.passes[0]) == pytest.approx(straight_pass(4), abs=1e-6)
    assert plan.anatomy == fingerprint(problem.anatomy) and plan.trocar.cone_deg == 33
    assert (plan.target, plan.margin_mm, plan.speed_mm_s) == ("organ", 5.0, 12.0)
    named = [
        re.match(r"(The first sweep is|It comes before) .*side (\d), with -?[\d.]+ points: it .*\.$", line)
        for line in plan.why
    ]
    assert [one[2] for one in named] == ["1", "2"]


@pytest.mark.parametrize("workers", [three(reachable=False), Counting({})])
def test_without_a_reachable_sweep_there_is_an_error(workers):
    with pytest.raises(PlanError, match="no sweep was found.*move the trocar, widen its cone") as error:
        make_plan(workers, 10.0, 4, lambda _: None)
    assert "\n" not in str(error.value)


def test_a_comparison_reports_its_progress_and_averages_the_random_sweeps(monkeypatch):
    shared: list[object] = []
    workers = object()

    class Crew(Counting):
        def __init__(self, problem: PlanningProblem, workers: object) -> None:
            super().__init__({"side 0": 0.1, "side 1": 0.0, "side 2": 0.05})
            shared.append(workers)

    monkeypatch.setattr(plan_comparison, "TrialWorkers", Crew)
    done, anatomy = [], LoadedAnatomy(big_ball(), big_ball(), None, ())
    run = plan_comparison.compare(Scene(anatomy={}), anatomy, 40, workers, done.append)
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
    built = SimpleNamespace(manipulator=manipulator_on(big_ball()))
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
