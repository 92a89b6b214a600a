"""States of an organ in memory that two processes share: one writes them in turn to a few slots, the other reads the newest whole.

Without a lock, which a process that is killed would keep: a slot is written again only SLOTS states later, and the reader sees whether it was.
"""

from collections.abc import Mapping
from multiprocessing.shared_memory import SharedMemory

import numpy as np

from rehearsal.pressed_organ import OrganState
from sim.body import BodyState
from sim.divergence_check import DivergenceState
from sim.solver import SolverState

Arrays = dict[str, np.ndarray]
# A copy takes less time than as many steps.
SLOTS = 3
# Of each state: the number of the good state in it, and the counts of organ and divergence check.
NUMBERS = 5


class SharedState:
    """Memory for the states of one organ, of the sizes of ``like``; ``name`` is that of memory that another process has made.

    Each state has a number, which the writer gives: one more than the one before.
    """

    def __init__(self, like: OrganState, name: str | None = None) -> None:
        self._is_owner = name is None
        slot = (
            dict(numbers=np.zeros(NUMBERS, np.int64), since_good_s=np.zeros(1), pose=np.zeros((4, 4))),
            _arrays_of(like.solver),
            _arrays_of(like.divergence.good),
        )
        parts = dict(begun=np.zeros(1, np.int64)), *(SLOTS * slot)
        size = sum(each.nbytes for part in parts for each in part.values())
        self._memory = SharedMemory(name, create=self._is_owner, size=size)
        (head, *slots) = self._views(parts)
        self._begun = head["begun"]
        self._slots = [slots[n : n + len(slot)] for n in range(0, len(slots), len(slot))]
        # The good state that was written or read last, and the number of that in each slot.
        self._last_good, self._good_number = like.divergence.good, 0
        self._written_good = [-1] * SLOTS

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
        """Write a state; send its number to the reader afterwards."""
        self._begun[0] = number
        head, now, good = self._slots[number % SLOTS]
        check = state.divergence
        _copy(_arrays_of(state.solver), now)
        if check.good is not self._last_good:
            self._last_good, self._good_number = check.good, self._good_number + 1
        if self._written_good[number % SLOTS] != self._good_number:
            self._written_good[number % SLOTS] = self._good_number
            _copy(_arrays_of(check.good), good)
        counts = state.steps, check.steps_since_good, check.steps_tangled, check.is_restored
        head["numbers"][:] = self._good_number, *counts
        head["since_good_s"][0], head["pose"][:] = check.since_good_s, state.pose

    def read(self, number: int) -> OrganState | None:
        """Return a copy of the state of a number that the writer has sent; None where a newer one has taken its slot."""
        head, now, good = self._slots[number % SLOTS]
        solver, pose, since_good_s = _solver_state(now), head["pose"].copy(), float(head["since_good_s"][0])
        good_number, steps, since_good, tangled, restored = map(int, head["numbers"])
        last_good = self._last_good if good_number == self._good_number else _solver_state(good)
        if self._begun[0] >= number + SLOTS:
            return None
        self._last_good, self._good_number = last_good, good_number
        check = DivergenceState(last_good, since_good, tangled, bool(restored), since_good_s)
        return OrganState(solver, check, pose, steps)

    def close(self) -> None:
        """Release the memory; its arrays must not be used any more."""
        self._begun, self._slots = np.zeros(1, np.int64), []
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
