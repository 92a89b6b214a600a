"""Planning in the window, with a search that is stepped by the test."""

import threading
from concurrent.futures import wait
from contextlib import contextmanager
from types import SimpleNamespace

import pytest
import trimesh
from plan_ball import (
    big_ball,
    case_of_ball,
    guide_over_ball,
    manipulator_on,
    plan_of,
    straight_pass,
    sweep_of,
)
from settings_at_start import settings_with

from rehearsal.notices import Notices
from rehearsal.planning import plans_in_window
from rehearsal.planning.plan_file import PlanError, read_plan
from rehearsal.planning.plan_guidance import PlanGuidance
from rehearsal.planning.plan_search import total_work
from rehearsal.planning.plans_in_window import SPEED_MM_S, TRIALS, PlanControl, minutes_in_words
from rehearsal.worker_processes import WorkerError
from render.viewer import Controls
from scenes.anatomy import LoadedAnatomy
from ultrasound.probe import load_probe

LONGEST_S = 10.0
PROBE = load_probe("drop-in")


class SteppedSearch:
    """Replaces ``make_plan``: it waits before each trial, then returns a plan or raises ``end``."""

    def __init__(self, monkeypatch) -> None:
        self.allowed, self.problems, self.jobs = threading.Semaphore(0), [], []
        self.begun = threading.Event()
        self.end: Exception | None = None
        self.is_stopped = False
        self.counted = threading.Semaphore(0)
        monkeypatch.setattr(plans_in_window, "make_plan", self.make)
        monkeypatch.setattr(plans_in_window, "Workers", self.workers)
        monkeypatch.setattr(plans_in_window, "TrialWorkers", self.trials)

    @contextmanager
    def workers(self, jobs):
        self.jobs.append(jobs)
        yield self

    def trials(self, problem, workers):
        assert workers is self
        self.problem = problem
        return self

    def make(self, workers, speed_mm_s, trials, done):
        assert workers is self and trials == TRIALS
        problem = self.problem
        self.problems.append(problem)
        done(0)
        self.begun.set()
        for _ in range(4):
            assert self.allowed.acquire(timeout=LONGEST_S)
            done(1)
            self.counted.release()
        if self.end is not None:
            raise self.end
        return plan_of(sweep_of(straight_pass(4)), sweep_of(straight_pass(3)), margin_mm=problem.margin_mm)

    def stop(self) -> None:
        self.is_stopped = True

    def run_trials(self, trials: int) -> None:
        """Let it make some trials, and wait until they are counted."""
        for _ in range(trials):
            self.allowed.release()
            assert self.counted.acquire(timeout=LONGEST_S)


@pytest.fixture
def searching(monkeypatch) -> SteppedSearch:
    return SteppedSearch(monkeypatch)


def plans_for(tumour, out) -> PlanControl:
    """The control of a rehearsal that follows no plan."""
    followed = SimpleNamespace(guide=None, manipulator=manipulator_on(big_ball()))
    followed.follow = lambda guide: setattr(followed, "guide", guide)
    case = case_of_ball(probe=PROBE, tumour=tumour)
    return PlanControl(case, LoadedAnatomy(case.organ, tumour, None, ()), followed, out, Notices())


WIDER = settings_with({"plan.margin_mm": 7.0})


@pytest.fixture
def plans(tmp_path) -> PlanControl:
    return plans_for(trimesh.creation.icosphere(radius=7.0), tmp_path)


def message(plans: PlanControl, **controls) -> str:
    settings = controls.pop("settings", None) or settings_with()
    plans.control(Controls(settings, **controls))
    return "".join(plans.notices.present())


def ended(plans: PlanControl) -> str:
    """The message at the end of the search."""
    wait([plans._job.result], LONGEST_S)
    return message(plans)


def test_a_plan_is_made_during_the_rehearsal_and_then_followed(searching, plans, tmp_path):
    assert plans.status == ""
    assert message(plans, plan=True, settings=WIDER) == "Planning for the tumour and its margin"
    assert message(plans) == "" and plans.status == "Planning 0 %"
    searching.run_trials(3)
    assert plans.status.startswith(f"Planning {300 / total_work(TRIALS, SPEED_MM_S):.0f} %, ")
    assert message(plans, plan=True) == "A plan is being made"
    searching.run_trials(1)
    assert ended(plans) == "Plan 1: two passes, covers 75 % (plan-001.json)"
    assert plans.status == "" and message(plans) == "" and len(searching.problems) == 1
    guide = plans.measurements.guide
    assert isinstance(guide, PlanGuidance) and read_plan(tmp_path / "plan-001.json") == guide.plan
    (problem,) = searching.problems
    assert (problem.target, problem.margin_mm, problem.anatomy, problem.probe) == (
        "margin",
        7.0,
        plans.anatomy,
        WIDER.probe,
    )
    assert problem.scene.solver.iterations == WIDER.solver.iterations
    assert message(plans, plan=True) == "Planning for the tumour and its margin"
    searching.run_trials(4)
    ended(plans)
    assert (tmp_path / "plan-002.json").is_file() and plans.measurements.guide is not guide


def test_the_remaining_time_is_shown_once_there_is_a_pace(monkeypatch, searching, plans):
    clock = [100.0]
    monkeypatch.setattr(plans_in_window, "perf_counter", lambda: clock[0])
    message(plans, plan=True)
    assert searching.begun.wait(LONGEST_S)
    clock[0] += 30.0
    assert plans.status == "Planning 0 %"
    searching.run_trials(2)
    # 30 s for two trials, then 30 s more without one.
    for clock[0] in (130.0, 160.0):
        left_s = (clock[0] - 100.0) * (total_work(TRIALS, SPEED_MM_S) - 2) / 2
        assert plans.status.endswith(f" %, about {left_s / 60:.0f} min left")
    searching.run_trials(2)
    ended(plans)


def test_a_rough_time_is_in_whole_minutes():
    words = [minutes_in_words(seconds) for seconds in (0, 29, 31, 89, 480)]
    assert words == ["under a minute"] * 2 + ["about 1 min"] * 2 + ["about 8 min"]


@pytest.mark.parametrize("began", [True, False])
def test_the_key_stops_a_search_and_otherwise_shows_the_next_sweep(
    monkeypatch, searching, plans, tmp_path, began
):
    """Also before it has processes."""
    made = threading.Event()
    if not began:
        workers = searching.workers

        @contextmanager
        def late(*arguments):
            assert made.wait(LONGEST_S)
            with workers(*arguments) as crew:
                yield crew

        monkeypatch.setattr(plans_in_window, "Workers", late)
    assert message(plans, next_plan=True) == "No plan: {plan} makes one"
    plans.measurements.guide = guide = guide_over_ball(plan_of(sweep_of(straight_pass(3))))
    message(plans, plan=True)
    search = plans._job
    if began:
        assert searching.begun.wait(LONGEST_S)
    threading.Timer(0.1, lambda: (made.set(), searching.allowed.release())).start()
    assert (
        message(plans, next_plan=True) == "Planning stopped" and plans.status == "" and message(plans) == ""
    )
    assert search.result.done() and searching.is_stopped == began and list(tmp_path.iterdir()) == []
    assert len(searching.problems) == began and guide.number == 0
    assert message(plans, next_plan=True) == "Plan hidden" and guide.number == 1


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (PlanError("no sweep was found"), "no sweep was found"),
        (WorkerError("a worker process was ended"), "a worker process was ended"),
        (OSError(28, "No space left on device"), "plan-001.json cannot be written: No space left on device"),
    ],
)
def test_an_error_is_shown_and_another_plan_can_be_made(searching, plans, tmp_path, error, words):
    searching.end = error
    message(plans, plan=True)
    searching.run_trials(4)
    assert ended(plans) == words and plans.measurements.guide is None and plans.status == ""
    searching.end = None
    message(plans, plan=True)
    searching.run_trials(4)
    assert ended(plans).startswith("Plan 1") and (tmp_path / "plan-001.json").is_file()


def test_a_search_is_cancelled_when_the_window_closes(searching, plans, tmp_path):
    plans.stop()
    message(plans, plan=True)
    searching.run_trials(2)
    threading.Timer(0.2, searching.allowed.release).start()
    search = plans._job
    plans.stop()
    assert searching.is_stopped and str(search.result.exception()) == "No plan: it was stopped"
    assert list(tmp_path.iterdir()) == [] and plans.measurements.guide is None


@pytest.mark.parametrize(("processors", "jobs"), [(1, 1), (2, 1), (8, 7)])
def test_one_processor_is_left_to_the_rehearsal(monkeypatch, searching, plans, processors, jobs):
    monkeypatch.setattr(plans_in_window, "cpu_count", lambda: processors)
    message(plans, plan=True)
    searching.run_trials(4)
    ended(plans)
    assert searching.jobs == [jobs]


def test_the_target_is_shown_and_without_a_tumour_it_is_the_organ(searching, plans, tmp_path):
    for target, words in (("tumour", "the tumour"), ("organ", "the whole kidney")):
        settings = settings_with({"plan.plan_for": target})
        assert message(plans, settings=settings) == f"A plan for {words}: {{plan}}"
        assert message(plans, settings=settings) == ""
    plans, settings = plans_for(None, tmp_path), settings_with({"plan.plan_for": "tumour"})
    assert message(plans, settings=settings) == "No tumour here. A plan for the whole kidney: {plan}"
    assert message(plans, settings=settings, plan=True) == "Planning for the whole kidney"
    searching.run_trials(4)
    ended(plans)
    assert searching.problems[0].target == "organ"
