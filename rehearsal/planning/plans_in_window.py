"""Planning in the window: a plan is searched while the rehearsal continues; then its sweeps are shown one
by one.
"""

from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from time import perf_counter

from joblib import cpu_count

from rehearsal.case import Case
from rehearsal.live_settings import LiveSettings, PlanSettings
from rehearsal.measurements.live_measurements import LiveMeasurements
from rehearsal.notices import Notices
from rehearsal.planning.plan_file import Plan, PlanError, next_plan_path, write_plan
from rehearsal.planning.plan_guidance import PlanGuidance
from rehearsal.planning.plan_search import make_plan, total_work
from rehearsal.planning.sweep_trial import PlanningProblem, TrialWorkers
from rehearsal.worker_processes import WorkerError, Workers
from render.viewer import Controls
from scenes.anatomy import LoadedAnatomy
from ultrasound.target import Target

TRIALS, SPEED_MM_S = 24, 10.0
TARGET_NAMES: dict[Target, str] = {
    "margin": "the tumour and its margin",
    "tumour": "the tumour",
    "organ": "the whole kidney",
}


class PlanJob:
    """One search for a plan, in processes of its own; a thread waits for them, and writes ``result``, the
    plan, to a file.
    """

    def __init__(self, problem: PlanningProblem, path: Path) -> None:
        self.path, self._problem = path, problem
        self._work_done, self._began_s = 0, 0.0
        self._workers: Workers | None = None
        self._is_stopped = False
        self.result = ThreadPoolExecutor(1, "plan").submit(self._run)

    @property
    def status(self) -> str:
        """The completed share, and the remaining time at the pace so far, if there is one."""
        fraction = min(self._work_done / total_work(TRIALS, SPEED_MM_S), 1.0)
        text = f"Planning {100 * fraction:.0f} %"
        if self._work_done > 0:
            left_s = (perf_counter() - self._began_s) * (1.0 - fraction) / fraction
            text += f", {minutes_in_words(left_s)} left"
        return text

    def stop(self) -> None:
        """Cancel the search; its results are lost."""
        self._is_stopped = True
        if self._workers is not None:
            self._workers.stop()
        wait([self.result])

    def _run(self) -> Plan:
        # One processor is left to the rehearsal.
        with Workers(max(1, cpu_count() - 1)) as self._workers:
            # Either stop() has seen these workers, or this sees that it was called.
            self._count(0)
            plan = make_plan(TrialWorkers(self._problem, self._workers), SPEED_MM_S, TRIALS, self._count)
        write_plan(plan, self.path)
        return plan

    def _count(self, work: int) -> None:
        if self._is_stopped:
            raise PlanError("No plan: it was stopped")
        if work == 0:
            self._began_s = perf_counter()
        self._work_done += work


class PlanControl:
    """The plan keys of the window. The plan that is followed is ``measurements.guide``."""

    def __init__(
        self,
        case: Case,
        anatomy: LoadedAnatomy,
        measurements: LiveMeasurements,
        out: Path,
        notices: Notices,
    ) -> None:
        self.case, self.anatomy, self.measurements, self.out = case, anatomy, measurements, out
        self.notices = notices
        self._job: PlanJob | None = None
        self._plan_for: Target = PlanSettings().plan_for

    @property
    def status(self) -> str:
        """For the window while a plan is made."""
        return "" if self._job is None else self._job.status

    def control(self, controls: Controls[LiveSettings]) -> None:
        """Take a frame's controls, and a search that has ended."""
        if controls.next_plan:
            self._stop_or_next_sweep()
        elif controls.plan:
            self._begin(controls.settings)
        elif controls.settings.plan.plan_for != self._plan_for:
            self._plan_for = controls.settings.plan.plan_for
            no_tumour = "" if self.case.tumour is not None else "No tumour here. "
            target = TARGET_NAMES[self._target(controls.settings)]
            self.notices.post(f"{no_tumour}A plan for {target}: {{plan}}")
        elif self._job is not None and self._job.result.done():
            job, self._job = self._job, None
            self._follow(job)

    def stop(self) -> None:
        """Cancel a search."""
        job, self._job = self._job, None
        if job is not None:
            job.stop()

    def _stop_or_next_sweep(self) -> None:
        guide = self.measurements.guide
        if self._job is not None:
            self.stop()
            self.notices.post("Planning stopped")
        else:
            self.notices.post(guide.next_sweep() if guide is not None else "No plan: {plan} makes one")

    def _target(self, settings: LiveSettings) -> Target:
        return settings.plan.plan_for if self.case.tumour is not None else "organ"

    def _begin(self, settings: LiveSettings) -> None:
        if self._job is not None:
            self.notices.post("A plan is being made")
            return
        target = self._target(settings)
        scene = self.case.scene.model_copy(
            update=dict(tissue=settings.tissue, solver=settings.solver, gravity=settings.gravity)
        )
        margin_mm = settings.plan.margin_mm
        problem = PlanningProblem(scene, self.anatomy, settings.probe, target, margin_mm, scene.trocar)
        self._job = PlanJob(problem, next_plan_path(self.out))
        self.notices.post(f"Planning for {TARGET_NAMES[target]}")

    def _follow(self, job: PlanJob) -> None:
        try:
            guide = PlanGuidance(self.case, self.measurements.manipulator, job.result.result())
        except (PlanError, WorkerError) as error:
            self.notices.post(str(error))
        except OSError as error:
            self.notices.post(f"{job.path.name} cannot be written: {error.strerror}")
        except Exception as error:  # anything from a process: the rehearsal continues
            self.notices.post(f"No plan: the search failed ({error})")
        else:
            self.measurements.follow(guide)
            self.notices.post(f"{guide.title()} ({job.path.name})")


def minutes_in_words(seconds: float) -> str:
    """A rough time."""
    minutes = round(seconds / 60)
    return f"about {minutes} min" if minutes > 0 else "under a minute"
