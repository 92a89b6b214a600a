"""Plans in the window: one made while the rehearsal goes on, and which of its sweeps is shown."""

import threading
from pathlib import Path
from time import perf_counter

from joblib import cpu_count

from rehearsal.frame_view import probe_with_settings
from rehearsal.measurements.live_measurements import LiveMeasurements
from rehearsal.planning.make_plan import make_plan
from rehearsal.planning.plan_file import Plan, PlanError, next_free, write_plan
from rehearsal.planning.plan_guidance import PlanGuidance
from rehearsal.planning.search import length_of
from rehearsal.planning.trial_workers import Problem, Workers, workers
from rehearsal.rehearsal import Rehearsal
from render.viewer import Controls, Settings, TissueSettings
from scenes.anatomy import LoadedAnatomy
from scenes.scene import Scene, with_options
from ultrasound.target import Target

TRIALS, SPEED_MM_S = 96, 10.0
NAMED: dict[Target, str] = {
    "margin": "the tumour and its margin",
    "tumour": "the tumour",
    "organ": "the whole kidney",
}


class Planning:
    """One search for a plan. It runs in processes of its own; this thread of it only waits for them.

    Once it ``is_over``, ``plan`` is there, or ``fault`` says why not.
    """

    def __init__(self, problem: Problem, path: Path, trials: int = TRIALS) -> None:
        self.path, self.fault = path, ""
        self.plan: Plan | None = None
        self._problem, self._trials = problem, trials
        # How much is done, and when the first of it was begun.
        self._done, self._began_s = 0, 0.0
        self._workers: Workers | None = None
        self._stops = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def is_over(self) -> bool:
        """Whether the search has ended, with a plan or without one."""
        return not self._thread.is_alive()

    @property
    def share(self) -> float:
        """How much of it is done, 0 to 1."""
        return min(self._done / length_of(self._trials, SPEED_MM_S), 1.0)

    @property
    def left_s(self) -> float | None:
        """How long it will still take at the pace so far; None before there is one."""
        if self._done == 0:
            return None
        return (perf_counter() - self._began_s) * (1.0 - self.share) / self.share

    def stop(self) -> None:
        """Let go of the search; what was found is lost."""
        self._stops = True
        if self._workers is not None:
            self._workers.stop()
        self._thread.join()

    def _run(self) -> None:
        try:
            # One processor is left to the rehearsal.
            with workers(self._problem, max(1, cpu_count() - 1)) as self._workers:
                # Either this is seen here, or these processes by who stops them.
                self._count(0)
                plan = make_plan(self._problem, self._workers, SPEED_MM_S, self._trials, self._count)
            write_plan(plan, self.path)
            self.plan = plan
        except PlanError as error:
            self.fault = str(error)
        except OSError as error:
            self.fault = f"{self.path.name} cannot be written: {error.strerror}"
        except Exception as error:  # whatever a process may send back: the rehearsal goes on
            self.fault = f"No plan: the search failed ({error})"

    def _count(self, trials: int) -> None:
        if self._stops:
            raise PlanError("No plan: it was stopped")
        if trials == 0:
            self._began_s = perf_counter()
        self._done += trials


class Plans:
    """What the user asks of plans; the instruments' guide is the one that is followed."""

    def __init__(
        self, rehearsal: Rehearsal, anatomy: LoadedAnatomy, instruments: LiveMeasurements, out: Path
    ) -> None:
        self.rehearsal, self.anatomy, self.instruments, self.out = rehearsal, anatomy, instruments, out
        self._planning: Planning | None = None
        self._plan_for: Target = Settings().plan_for

    @property
    def status(self) -> str:
        """What stands in the panel while a plan is made."""
        if self._planning is None:
            return ""
        left_s = self._planning.left_s
        left = "" if left_s is None else f", {in_words(left_s)} left"
        return f"PLANNING   {100 * self._planning.share:.0f} %{left}; {{next_plan}} stops"

    def watch(self, controls: Controls) -> str:
        """What the user has asked for, and a search that is over; what there is to say."""
        if controls.next_plan:
            return self._stopped() or self._next_sweep()
        if controls.plan:
            return self._begin(controls.settings)
        return self._chosen(controls.settings) or self._ended()

    def _stopped(self) -> str:
        """Let go of a search that goes on; what there is to say."""
        planning, self._planning = self._planning, None
        if planning is None:
            return ""
        planning.stop()
        return "Planning stopped"

    def _next_sweep(self) -> str:
        guide = self.instruments.guide
        return guide.next_sweep() if guide is not None else "No plan: {plan} makes one"

    def _chosen(self, settings: Settings) -> str:
        before, self._plan_for = self._plan_for, settings.plan_for
        if settings.plan_for == before:
            return ""
        there = "" if self.rehearsal.tumour is not None else "No tumour here. "
        return f"{there}A plan for {NAMED[self._target(settings)]}: {{plan}}"

    def _target(self, settings: Settings) -> Target:
        return settings.plan_for if self.rehearsal.tumour is not None else "organ"

    def stop(self) -> None:
        """Let go of a search that goes on."""
        self._stopped()

    def _begin(self, settings: Settings) -> str:
        if self._planning is not None:
            return "A plan is being made"
        target = self._target(settings)
        scene, probe = (
            as_set(self.rehearsal.scene, settings),
            probe_with_settings(self.rehearsal.probe, settings),
        )
        problem = Problem(scene, self.anatomy, probe, target, float(settings.margin_mm), scene.trocar)
        self._planning = Planning(problem, next_free(self.out))
        return f"Planning for {NAMED[target]}"

    def _ended(self) -> str:
        planning = self._planning
        if planning is None or not planning.is_over:
            return ""
        self._planning = None
        if planning.plan is None:
            return planning.fault
        guide = PlanGuidance(self.rehearsal, planning.plan)
        self.instruments.follow(guide)
        return f"{guide.said()} ({planning.path.name})"


def in_words(seconds: float) -> str:
    """A time that is not known well."""
    minutes = round(seconds / 60)
    return f"some {minutes} min" if minutes > 0 else "under a minute"


def as_set(scene: Scene, settings: TissueSettings) -> Scene:
    """A scene with its tissue, passes and gravity as the sliders are."""
    values = {
        "tissue.young_kpa": settings.young_kpa,
        "tissue.stiffness": settings.stiffness,
        "solver.iterations": settings.iterations,
        "solver.substeps": settings.substeps,
        "gravity.acceleration_m_s2": settings.gravity_m_s2,
    }
    return with_options(scene, values)
