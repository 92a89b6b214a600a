"""The state of an organ in memory that two processes share, written and read whole: a picture shows one instant."""

from collections.abc import Mapping
from multiprocessing.shared_memory import SharedMemory
from multiprocessing.synchronize import Lock

import numpy as np

from rehearsal.pressed_organ import OrganState
from sim.body import BodyState
from sim.divergence_check import DivergenceState
from sim.solver import SolverState

Arrays = dict[str, np.ndarray]
# Number of the state and of the good state in it, and the counts of organ and divergence check.
NUMBERS = 6


class SharedState:
    """Memory for the states of one organ, of the sizes of ``like``; ``name`` is that of memory that another process has made.

    Each state has a number, which the writer gives.
    """

    def __init__(self, like: OrganState, lock: Lock, name: str | None = None) -> None:
        self._lock, self._is_owner = lock, name is None
        head = dict(numbers=np.zeros(NUMBERS, np.int64), pose=np.zeros((4, 4)))
        parts = head, _arrays_of(like.solver), _arrays_of(like.divergence.good)
        size = sum(each.nbytes for part in parts for each in part.values())
        self._memory = SharedMemory(name, create=self._is_owner, size=size)
        self._head, self._now, self._good = self._views(parts)
        self._last_good, self._good_number = like.divergence.good, 0

    @property
    def name(self) -> str:
        """The name by which another process finds the memory."""
        return self._memory.name

    def _views(self, parts: tuple[Arrays, ...]) -> list[Arrays]:
        """Arrays in the memory, shaped as others."""
        offset = 0
        views: list[Arrays] = []
        for part in parts:
            views.append({})
            for name, each in part.items():
                views[-1][name] = np.ndarray(each.shape, each.dtype, self._memory.buf, offset)
                offset += each.nbytes
        return views

    def write(self, state: OrganState, number: int) -> None:
        """Write a state."""
        check = state.divergence
        with self._lock:
            _copy(_arrays_of(state.solver), self._now)
            if check.good is not self._last_good:
                self._last_good, self._good_number = check.good, self._good_number + 1
                _copy(_arrays_of(check.good), self._good)
            counts = state.steps, check.steps_since_good, check.steps_tangled, check.is_restored
            self._head["numbers"][:] = number, self._good_number, *counts
            self._head["pose"][:] = state.pose

    def read(self) -> tuple[OrganState, int]:
        """Return a copy of the last state, and its number."""
        with self._lock:
            solver, pose = _solver_state(self._now), self._head["pose"].copy()
            number, good_number, steps, since_good, tangled, restored = map(int, self._head["numbers"])
            if good_number != self._good_number:
                self._last_good, self._good_number = _solver_state(self._good), good_number
        check = DivergenceState(self._last_good, since_good, tangled, bool(restored))
        return OrganState(solver, check, pose, steps), number

    def close(self) -> None:
        """Release the memory; its arrays must not be used any more."""
        self._head, self._now, self._good = {}, {}, {}
        self._memory.close()
        if self._is_owner:
            self._memory.unlink()


def _arrays_of(state: SolverState) -> Arrays:
    return dict(position=state.body.position, velocity=state.body.velocity, **state.history)


def _solver_state(arrays: Mapping[str, np.ndarray]) -> SolverState:
    copies = {name: each.copy() for name, each in arrays.items()}
    return SolverState(BodyState(copies.pop("position"), copies.pop("velocity")), copies)


def _copy(arrays: Arrays, into: Arrays) -> None:
    for name, each in arrays.items():
        into[name][...] = each
