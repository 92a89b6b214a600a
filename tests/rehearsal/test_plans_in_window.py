"""Plans asked for in the window: made in a thread, with processes that do nothing."""

import threading
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest
from plan_ball import over_ball, plan_of, straight_pass, sweep_of

from rehearsal.frame_view import probe_with_settings
from rehearsal.planning import plans_in_window
from rehearsal.planning.plan_file import PlanError, read_plan
from rehearsal.planning.plan_guidance import PlanGuidance
from rehearsal.planning.plans_in_window import SPEED_MM_S, TRIALS, Plans, in_words
from rehearsal.planning.search import length_of
from render.viewer import Controls, Settings
from scenes.scene import Scene
from ultrasound.probe import load_probe

LONGEST_S = 10.0
PROBE = load_probe("drop-in")


class Search:
    """Stands for ``make_plan``: it makes as many trials as it is let, and then what it is told."""

    def __init__(self, monkeypatch) -> None:
        self.let, self.problems, self.jobs = threading.Semaphore(0), [], []
        self.begun = threading.Event()
        self.end: Exception | None = None
        self.is_stopped = False
        self.counted = threading.Semaphore(0)
        monkeypatch.setattr(plans_in_window, "make_plan", self.make)
        monkeypatch.setattr(plans_in_window, "workers", self.workers)

    @contextmanager
    def workers(self, problem, jobs):
        self.jobs.append(jobs)
        yield self

    def make(self, problem, crew, speed_mm_s, trials, done):
        assert crew is self and trials == TRIALS
        self.problems.append(problem)
        done(0)
        self.begun.set()
        for _ in range(4):
            assert self.let.acquire(timeout=LONGEST_S)
            done(1)
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
    return Plans(held, SimpleNamespace(tumour=held.tumour), followed, tmp_path)


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
    assert said(plans) == "" and plans.status == "PLANNING   0 %; {next_plan} stops"
    searching.go(3)
    assert plans.status.startswith(f"PLANNING   {300 / length_of(TRIALS, SPEED_MM_S):.0f} %, ")
    assert said(plans, plan=True) == "A plan is being made"
    searching.go(1)
    assert ended(plans) == "Plan 1: two passes, sees 75 % (plan-001.json)"
    assert plans.status == "" and said(plans) == "" and len(searching.problems) == 1
    guide = plans.instruments.guide
    assert isinstance(guide, PlanGuidance) and read_plan(tmp_path / "plan-001.json") == guide.plan
    (problem,) = searching.problems
    assert (problem.target, problem.margin_mm, problem.anatomy, problem.probe) == (
        "margin",
        7.0,
        plans.anatomy,
        probe_with_settings(PROBE, Settings(margin_mm=7)),
    )
    assert problem.scene.solver.iterations == Settings().iterations
    assert said(plans, plan=True) == "Planning for the tumour and its margin"
    searching.go(4)
    ended(plans)
    assert (tmp_path / "plan-002.json").is_file() and plans.instruments.guide is not guide


def test_how_long_it_will_take_is_said_once_there_is_a_pace(monkeypatch, searching, plans):
    clock = [100.0]
    monkeypatch.setattr(plans_in_window, "perf_counter", lambda: clock[0])
    said(plans, plan=True)
    assert searching.begun.wait(LONGEST_S)
    clock[0] += 30.0
    assert plans.status == "PLANNING   0 %; {next_plan} stops"
    searching.go(2)
    # So long for two, and then as long again for nothing.
    for clock[0] in (130.0, 160.0):
        left_s = (clock[0] - 100.0) * (length_of(TRIALS, SPEED_MM_S) - 2) / 2
        assert plans._planning.left_s == pytest.approx(left_s)
        assert plans.status.endswith(f" %, some {left_s / 60:.0f} min left; {{next_plan}} stops")
    searching.go(2)
    ended(plans)


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (0, "under a minute"),
        (29, "under a minute"),
        (31, "some 1 min"),
        (89, "some 1 min"),
        (480, "some 8 min"),
    ],
)
def test_a_time_that_is_not_known_well_is_in_whole_minutes(seconds, words):
    assert in_words(seconds) == words


@pytest.mark.parametrize("began", [True, False])
def test_a_key_stops_it_and_shows_the_next_sweep_otherwise(monkeypatch, searching, plans, tmp_path, began):
    """Also before it has processes that could be stopped."""
    made = threading.Event()
    if not began:
        crew = searching.workers

        @contextmanager
        def late(*given):
            assert made.wait(LONGEST_S)
            with crew(*given) as each:
                yield each

        monkeypatch.setattr(plans_in_window, "workers", late)
    plans.instruments.guide = guide = PlanGuidance(plans.rehearsal, plan_of(sweep_of(straight_pass(3))))
    said(plans, plan=True)
    search = plans._planning
    if began:
        assert searching.begun.wait(LONGEST_S)
    threading.Timer(0.1, lambda: (made.set(), searching.let.release())).start()
    assert said(plans, next_plan=True) == "Planning stopped" and plans.status == "" and said(plans) == ""
    assert search.is_over and searching.is_stopped == began and list(tmp_path.iterdir()) == []
    assert len(searching.problems) == began and guide.number == 0
    assert said(plans, next_plan=True) == "Plan hidden" and guide.number == 1


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
    search = plans._planning
    plans.stop()
    assert searching.is_stopped and search.is_over and search.fault == "No plan: it was stopped"
    assert list(tmp_path.iterdir()) == [] and plans.instruments.guide is None


@pytest.mark.parametrize(("processors", "jobs"), [(1, 1), (2, 1), (8, 7)])
def test_one_processor_is_left_to_the_rehearsal(monkeypatch, searching, plans, processors, jobs):
    monkeypatch.setattr(plans_in_window, "cpu_count", lambda: processors)
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


def test_sweeps_are_shown_in_turn(plans):
    assert said(plans, next_plan=True) == "No plan: {plan} makes one"
    first, second = straight_pass(3), straight_pass(2)
    plans.instruments.guide = guide = PlanGuidance(
        plans.rehearsal, plan_of(sweep_of(first), sweep_of(second, name="b", seen=0.5))
    )
    guide.watch(first[0])
    assert guide.at == 1 and np.array_equal(guide.guidance().done, [False, False])
    assert said(plans, next_plan=True) == "Plan 2: b, sees 50 %"
    assert said(plans, next_plan=True) == "Plan hidden"
