"""What the solver's process does: requests of the other process, and steps in between."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from time import perf_counter

import numpy as np

import sim.device
from rehearsal.pressed_organ import OrganState, PressedOrgan, Step
from rehearsal.real_time.pace import MOST_WAIT_S, Pace
from rehearsal.real_time.pose_path import PosePath
from rehearsal.real_time.shared_state import SharedState
from rehearsal.resection.cut import Cut
from rehearsal.worker_processes import end_with_parent
from scenes.anatomy import LoadedAnatomy
from scenes.scene import Scene
from sim.solver import StepSettings
from ultrasound.probe import Probe

# Time by which the simulation may be behind the clock and still catch up; more is lost: slow motion.
MOST_BEHIND_S = 0.1
PAUSED = "paused"


@dataclass(frozen=True)
class SolverSetup:
    """What the solver is built of, and the backend; ``pace`` chooses its steps by the clock, ``serial`` is as for ``PressedOrgan``."""

    scene: Scene
    anatomy: LoadedAnatomy
    probe: Probe
    arch: str
    pace: Pace
    serial: bool | None = None


def compute(connection: Connection, parent: int) -> None:
    """Serve requests until ``stop``. The parent is a process id."""
    end_with_parent(parent)
    SolverLoop(connection).serve()


class SolverLoop:
    """Serves requests, each the name of a public method and its arguments, and makes the steps that are due."""

    organ: PressedOrgan
    pace: Pace
    _memory: SharedState

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._path = PosePath(np.eye(4))
        self._played: deque[tuple[np.ndarray, float]] = deque()
        self._runs = self._is_stopped = False
        # The clock's times: up to which steps were made, and at which the newest input came.
        self._simulated_s = self._input_at_s = 0.0
        # Those of the steps that are due now.
        self._lengths_s: deque[float] = deque()
        self._made = 0

    def serve(self) -> None:
        """Serve until ``stop``."""
        while not self._is_stopped:
            for request, values in self._requests():
                getattr(self, request)(*values)
            if self._played:
                self._hand_on(self.organ.timed_step(*self._played.popleft()))
            elif self._runs and perf_counter() >= self._due_s:
                self._keep_pace()

    def build(self, setup: SolverSetup) -> None:
        """Build the solver of a scene, and send the organ at rest."""
        sim.device.start(setup.arch)
        self.organ = PressedOrgan(setup.scene, setup.anatomy, setup.probe, setup.serial)
        self.pace = setup.pace
        at_rest = self.organ.settle()
        # A step and back loads the kernels, also where the state at rest was stored. The other process is not ready yet.
        self.organ.advance(self.organ.pose)
        self.organ.restore_organ(at_rest)
        self._connection.send(at_rest)

    def share(self, memory: str) -> None:
        """Write all states to a memory from now on."""
        self._memory = SharedState(self.organ.snapshot_of_organ(), memory)

    def take_over(self, state: OrganState, settings: StepSettings, young_kpa: float | None) -> None:
        """Continue from a state, with settings."""
        self.organ.restore_organ(state)
        self.organ.settings = replace(settings)
        if young_kpa is not None and young_kpa != self.organ.young_kpa:
            self.organ.set_young(young_kpa)

    def apply_cut(self, cut: Cut | None) -> None:
        """Cut the organ, or with None restore it."""
        self.organ.apply_cut(cut)

    def run(self) -> None:
        """Keep pace with the clock, the transducer at rest."""
        self._runs, self._simulated_s = True, perf_counter()
        self._path.stay(self.organ.pose, self._simulated_s)
        self._lengths_s.clear()

    def go_to(self, pose: np.ndarray, input_s: float, took_s: float) -> None:
        """Move the transducer to an input's pose (4, 4) at a time [s], a time [s] after the last one."""
        self._path.go_to(pose, input_s, took_s)
        self._input_at_s = perf_counter()

    def play(self, poses: np.ndarray, lengths_s: np.ndarray) -> None:
        """Make steps of given poses (n, 4, 4) and lengths (n,) [s]."""
        self._played += zip(poses, map(float, lengths_s), strict=True)

    def pause(self) -> None:
        """Make no more steps by the clock."""
        self._runs = False
        self._connection.send(PAUSED)

    def stop(self) -> None:
        """End the process."""
        self._is_stopped = True

    def _requests(self) -> Iterator[tuple[str, tuple]]:
        """The requests that wait; if nothing else is to be done, wait for one, or until a step is due."""
        wait_s: float | None = 0.0
        if not self._played:
            wait_s = max(self._due_s - perf_counter(), 0.0) if self._runs else None
        while self._connection.poll(wait_s):
            yield self._connection.recv()
            wait_s = 0.0

    @property
    def _due_s(self) -> float:
        """The clock's time at which the next step is due: at its end, so that it follows the input."""
        if self._lengths_s:
            return self._simulated_s
        at_end_s = self._simulated_s + self.pace.length_s
        if not self.pace.waits_for_input:
            return at_end_s
        return max(at_end_s, self._input_at_s if self._path.has_news else self._simulated_s + MOST_WAIT_S)

    def _keep_pace(self) -> None:
        pace, full = self.pace, self.organ.settings.iterations
        late_s = 0.0
        if not self._lengths_s:
            late_s = perf_counter() - self._due_s
            self._plan_steps()
        length_s, text = self._lengths_s.popleft(), pace.text(full)
        self._simulated_s += length_s
        step = self.organ.timed_step(self._path.pose_after(length_s), length_s, pace.iterations(full))
        self._hand_on(
            replace(
                step,
                input_s=self._path.input_s,
                late_ms=1000 * late_s,
                pace=text,
                awaited=pace.waits_for_input,
            )
        )
        pace.watch(step.took_ms, length_s)

    def _plan_steps(self) -> None:
        """Choose the lengths of the steps that are due now."""
        behind_s = perf_counter() - self._simulated_s
        most_s = MOST_BEHIND_S + self.pace.length_s
        self._simulated_s += max(behind_s - most_s, 0.0)
        self._lengths_s += self.pace.lengths_s(min(behind_s, most_s))
        if self.pace.waits_for_input:
            self._path.arrive_in(sum(self._lengths_s))

    def _hand_on(self, step: Step) -> None:
        """Write a step's state, then send the step."""
        self._made += 1
        self._memory.write(self.organ.snapshot_of_organ(), self._made)
        self._connection.send(step)
