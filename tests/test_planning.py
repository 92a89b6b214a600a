"""Plans asked for in the window: made in a thread, with processes that do nothing."""

import threading
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest
from plan_ball import over_ball, plan_of, straight_pass, sweep_of

from render.viewer import Controls, Settings
from scenes.scene import Scene
from studies.plan.file import PlanError, read_plan, scans_of
from studies.rehearse import planning
from studies.rehearse.guide import Guide
from studies.rehearse.planning import TRIALS, Plans
from studies.rehearse.view import probe_as_set
from ultrasound.probe import load_probe

LONGEST_S = 10.0
PROBE = load_probe("drop-in")


class Search:
    """Stands for ``make_plan``: it makes as many trials as it is let, and then what it is told."""

    def __init__(self, monkeypatch) -> None:
        self.let, self.problems, self.jobs = threading.Semaphore(0), [], []
        self.end: Exception | None = None
        self.is_stopped = False
        self.counted = threading.Semaphore(0)
        monkeypatch.setattr(planning, "make_plan", self.make)
        monkeypatch.setattr(planning, "workers", self.workers)

    @contextmanager
    def workers(self, problem, jobs):
        self.jobs.append(jobs)
        yield self

    def make(self, problem, crew, speed_mm_s, trials, done):
        assert crew is self and trials == TRIALS
        self.problems.append(problem)
        for _ in range(4):
            assert self.let.acquire(timeout=LONGEST_S)
            done()
            self.counted.release()
        if self.end is not None:
            raise self.end
        return plan_of(sweep_of(straight_pass(4)), sweep_of(straight_pass(3)), margin_mm=problem.margin_mm)

    def stop(self) -> None:
        self.is_stopped = True

    def go(self, trials: int) -> None:
        """Let it make some trials, and wait until they are counted."""
        for _ in range(trials):
            self.let.release()
            assert self.counted.acquire(timeout=LONGEST_S)


@pytest.fixture
def searching(monkeypatch) -> Search:
    return Search(monkeypatch)


@pytest.fixture
def plans(tmp_path) -> Plans:
    held = SimpleNamespace(**vars(over_ball()), tumour="a tumour", scene=Scene(anatomy={}), probe=PROBE)
    followed = SimpleNamespace(guide=None)
    followed.follow = lambda guide: setattr(followed, "guide", guide)
    return Plans(held, "anatomy", followed, tmp_path)


def said(plans: Plans, **controls) -> str:
    settings = controls.pop("settings", None) or Settings()
    return plans.watch(Controls(settings, **controls))


def ended(plans: Plans) -> str:
    """What is said once the search is over."""
    plans._planning._thread.join(LONGEST_S)
    return said(plans)


def test_a_plan_is_made_while_the_rehearsal_goes_on_and_then_followed(searching, plans, tmp_path):
    assert plans.status == ""
    assert said(plans, plan=True, settings=Settings(margin_mm=7)) == "Planning for the tumour and its margin"
    assert said(plans) == "" and plans.status == "PLANNING   0 %"
    searching.go(3)
    assert plans.status == f"PLANNING   {300 / scans_of(TRIALS):.0f} %"
    assert said(plans, plan=True) == "A plan is being made"
    searching.go(1)
    assert ended(plans) == "Plan 1: two passes, sees 75 % (plan-001.json)"
    assert plans.status == "" and said(plans) == "" and len(searching.problems) == 1
    guide = plans.instruments.guide
    assert isinstance(guide, Guide) and read_plan(tmp_path / "plan-001.json") == guide.plan
    (problem,) = searching.problems
    assert (problem.target, problem.margin_mm, problem.anatomy, problem.probe) == (
        "margin",
        7.0,
        "anatomy",
        probe_as_set(PROBE, Settings(margin_mm=7)),
    )
    assert problem.scene.solver.iterations == Settings().iterations
    assert said(plans, plan=True) == "Planning for the tumour and its margin"
    searching.go(4)
    ended(plans)
    assert (tmp_path / "plan-002.json").is_file() and plans.instruments.guide is not guide


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (PlanError("no sweep was found"), "no sweep was found"),
        (OSError(28, "No space left on device"), "plan-001.json cannot be written: No space left on device"),
    ],
)
def test_what_goes_wrong_is_said_and_another_can_be_asked_for(searching, plans, tmp_path, error, words):
    searching.end = error
    said(plans, plan=True)
    searching.go(4)
    assert ended(plans) == words and plans.instruments.guide is None and plans.status == ""
    searching.end = None
    said(plans, plan=True)
    searching.go(4)
    assert ended(plans).startswith("Plan 1") and (tmp_path / "plan-001.json").is_file()


def test_a_search_is_let_go_when_the_window_closes(searching, plans, tmp_path):
    plans.stop()
    said(plans, plan=True)
    searching.go(2)
    threading.Timer(0.2, searching.let.release).start()
    plans.stop()
    assert searching.is_stopped and ended(plans) == "No plan: it was stopped"
    assert list(tmp_path.iterdir()) == [] and plans.instruments.guide is None


@pytest.mark.parametrize(("processors", "jobs"), [(1, 1), (2, 1), (8, 7)])
def test_one_processor_is_left_to_the_rehearsal(monkeypatch, searching, plans, processors, jobs):
    monkeypatch.setattr(planning, "cpu_count", lambda: processors)
    said(plans, plan=True)
    searching.go(4)
    ended(plans)
    assert searching.jobs == [jobs]


def test_what_a_plan_is_for_is_said_and_an_organ_without_a_tumour_is_planned_for_itself(searching, plans):
    settings = Settings()
    for target, words in (("tumour", "the tumour"), ("organ", "the whole kidney")):
        settings.plan_for = target
        assert said(plans, settings=settings) == f"A plan for {words}: {{plan}}"
        assert said(plans, settings=settings) == ""
    settings.plan_for = "tumour"
    said(plans, settings=settings)
    plans.rehearsal.tumour = None
    settings.plan_for = "margin"
    assert said(plans, settings=settings) == "No tumour here. A plan for the whole kidney: {plan}"
    assert said(plans, settings=settings, plan=True) == "Planning for the whole kidney"
    searching.go(4)
    ended(plans)
    assert searching.problems[0].target == "organ"


def test_sweeps_are_shown_in_turn_and_begun_anew_with_the_rehearsal(plans):
    assert said(plans, next_plan=True) == "No plan: {plan} makes one"
    said(plans, reset=True)
    first, second = straight_pass(3), straight_pass(2)
    plans.instruments.guide = guide = Guide(
        plans.rehearsal, plan_of(sweep_of(first), sweep_of(second, name="b", seen=0.5))
    )
    guide.watch(first[0])
    assert said(plans, reset=True) == "" and guide.at == 0
    guide.watch(first[0])
    assert guide.at == 1 and np.array_equal(guide.guidance().gone, [False, False])
    assert said(plans, next_plan=True) == "Plan 2: b, sees 50 %"
    assert said(plans, next_plan=True) == "Plan hidden"
