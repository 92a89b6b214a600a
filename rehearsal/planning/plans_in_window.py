"""Planning in the window: a plan is searched while the rehearsal continues; then its sweeps are shown one by one."""

import threading
from pathlib import Path
from time import perf_counter

from joblib import cpu_count

from rehearsal.frame_view import probe_with_settings
from rehearsal.measurements.live_measurements import LiveMeasurements
from rehearsal.planning.plan_file import Plan, PlanError, next_plan_path, write_plan
from rehearsal.planning.plan_guidance import PlanGuidance
from rehearsal.planning.plan_search import make_plan, total_work
from rehearsal.planning.trial_workers import PlanningProblem, TrialWorkers
from rehearsal.rehearsal import Rehearsal
from render.viewer import Controls, Settings
from scenes.anatomy import LoadedAnatomy
from scenes.scene import Scene, with_options
from ultrasound.target import Target

TRIALS, SPEED_MM_S = 96, 10.0
TARGET_NAMES: dict[Target, str] = {
    "margin": "the tumour and its margin",
    "tumour": "the tumour",
    "organ": "the whole kidney",
}


class PlanJob:
    """One search for a plan, in processes of its own; a thread waits for them.

    Once it ``is_over``, ``plan`` is there, or ``error`` is the reason.
    """

    def __init__(self, problem: PlanningProblem, path: Path, trials: int = TRIALS) -> None:
        self.path, self.error = path, ""
        self.plan: Plan | None = None
        self._problem, self._trials = problem, trials
        self._work_done, self._began_s = 0, 0.0
        self._workers: TrialWorkers | None = None
        self._is_stopped = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def is_over(self) -> bool:
        """Whether the search has ended, with a plan or without one."""
        return not self._thread.is_alive()

    @property
    def fraction(self) -> float:
        """The completed fraction, 0 to 1."""
        return min(self._work_done / total_work(self._trials, SPEED_MM_S), 1.0)

    @property
    def left_s(self) -> float | None:
        """The remaining time at the pace so far; None before there is one."""
        if self._work_done == 0:
            return None
        return (perf_counter() - self._began_s) * (1.0 - self.fraction) / self.fraction

    def stop(self) -> None:
        """Cancel the search; its results are lost."""
        self._is_stopped = True
        if self._workers is not None:
            self._workers.stop()
        self._thread.join()

    def _run(self) -> None:
        try:
            # One processor is left to the rehearsal.
            with TrialWorkers(self._problem, max(1, cpu_count() - 1)) as self._workers:
                # Either stop() has seen these workers, or this sees that it was called.
                self._count(0)
                plan = make_plan(self._problem, self._workers, SPEED_MM_S, self._trials, self._count)
            write_plan(plan, self.path)
            self.plan = plan
        except PlanError as error:
            self.error = str(error)
        except OSError as error:
            self.error = f"{self.path.name} cannot be written: {error.strerror}"
        except Exception as error:  # anything from a process: the rehearsal continues
            self.error = f"No plan: the search failed ({error})"

    def _count(self, work: int) -> None:
        if self._is_stopped:
            raise PlanError("No plan: it was stopped")
        if work == 0:
            self._began_s = perf_counter()
        self._work_done += work


class PlanControl:
    """The plan keys of the window. The plan that is followed is ``measurements.guide``."""

    def __init__(
        self, rehearsal: Rehearsal, anatomy: LoadedAnatomy, measurements: LiveMeasurements, out: Path
    ) -> None:
        self.rehearsal, self.anatomy, self.measurements, self.out = rehearsal, anatomy, measurements, out
        self._job: PlanJob | None = None
        self._plan_for: Target = Settings().plan_for

    @property
    def status(self) -> str:
        """A line for the panel while a plan is made."""
        if self._job is None:
            return ""
        left_s = self._job.left_s
        left = "" if left_s is None else f", {minutes_in_words(left_s)} left"
        return f"PLANNING   {100 * self._job.fraction:.0f} %{left}; {{next_plan}} stops"

    def watch(self, controls: Controls) -> str:
        """Take a frame's controls, and a search that has ended; return a message for the user, or nothing."""
        if controls.next_plan:
            return self.stop() or self._next_sweep()
        if controls.plan:
            return self._begin(controls.settings)
        return self._target_changed(controls.settings) or self._take_result()

    def stop(self) -> str:
        """Cancel a search; return a message for the user, or nothing."""
        job, self._job = self._job, None
        if job is None:
            return ""
        job.stop()
        return "Planning stopped"

    def _next_sweep(self) -> str:
        guide = self.measurements.guide
        return guide.next_sweep() if guide is not None else "No plan: {plan} makes one"

    def _target_changed(self, settings: Settings) -> str:
        before, self._plan_for = self._plan_for, settings.plan_for
        if settings.plan_for == before:
            return ""
        no_tumour = "" if self.rehearsal.tumour is not None else "No tumour here. "
        return f"{no_tumour}A plan for {TARGET_NAMES[self._target(settings)]}: {{plan}}"

    def _target(self, settings: Settings) -> Target:
        return settings.plan_for if self.rehearsal.tumour is not None else "organ"

    def _begin(self, settings: Settings) -> str:
        if self._job is not None:
            return "A plan is being made"
        target = self._target(settings)
        scene = _with_settings(self.rehearsal.scene, settings)
        probe = probe_with_settings(self.rehearsal.probe, settings)
        margin_mm = float(settings.margin_mm)
        problem = PlanningProblem(scene, self.anatomy, probe, target, margin_mm, scene.trocar)
        self._job = PlanJob(problem, next_plan_path(self.out))
        return f"Planning for {TARGET_NAMES[target]}"

    def _take_result(self) -> str:
        job = self._job
        if job is None or not job.is_over:
            return ""
        self._job = None
        if job.plan is None:
            return job.error
        guide = PlanGuidance(self.rehearsal, job.plan)
        self.measurements.follow(guide)
        return f"{guide.title()} ({job.path.name})"


def minutes_in_words(seconds: float) -> str:
    """A rough time."""
    minutes = round(seconds / 60)
    return f"about {minutes} min" if minutes > 0 else "under a minute"


def _with_settings(scene: Scene, settings: Settings) -> Scene:
    """A scene with the tissue, solver settings and gravity of the sliders."""
    values = {
        "tissue.young_kpa": settings.young_kpa,
        "tissue.stiffness": settings.stiffness,
        "solver.iterations": settings.iterations,
        "solver.substeps": settings.substeps,
        "gravity.acceleration_m_s2": settings.gravity_m_s2,
    }
    return with_options(scene, values)
