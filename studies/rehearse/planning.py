"""A plan made while the rehearsal goes on: the search runs in processes of its own, this thread only waits for them."""

import threading
from pathlib import Path

from joblib import cpu_count

from studies.plan.file import Plan, PlanError, write_plan
from studies.plan.workers import Ground, workers

TRIALS, SPEED_MM_S = 160, 10.0


class _Stopped(Exception):
    """The window was closed."""


class Planning:
    """One search for a plan. ``plan`` is there when it is found, ``fault`` where there was none to find."""

    def __init__(self, ground: Ground, path: Path, trials: int = TRIALS) -> None:
        self.path, self.plan, self.fault = path, None, ""
        self._ground, self._trials, self._done, self._ends = ground, trials, 0, False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def status(self) -> str:
        """What stands in the panel meanwhile."""
        return (
            f"PLANNING   {100 * min(self._done / self._trials, 1.0):.0f} %" if self._thread.is_alive() else ""
        )

    @property
    def is_over(self) -> bool:
        return not self._thread.is_alive()

    def stop(self) -> None:
        """Let go of the search; what was found is lost."""
        self._ends = True

    def _run(self) -> None:
        from studies.plan.make import make_plan

        try:
            # One processor is left to the rehearsal.
            with workers(self._ground, max(1, cpu_count() - 1)) as crew:
                self.plan: Plan | None = make_plan(self._ground, crew, SPEED_MM_S, self._trials, self._count)
            write_plan(self.plan, self.path)
        except PlanError as error:
            self.fault = str(error)
        except OSError as error:
            self.fault = f"{self.path.name} cannot be written: {error.strerror}"
        except _Stopped:
            pass

    def _count(self) -> None:
        if self._ends:
            raise _Stopped
        self._done += 1
