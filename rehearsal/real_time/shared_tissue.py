"""Positions of a tissue in memory that two processes share: one writes them in turn to a few slots, the other
reads the newest whole.

Without a lock, which a process that is killed would keep: a slot is written again only SLOTS writes later,
and the reader sees whether it was.
"""

from multiprocessing.shared_memory import SharedMemory

import numpy as np

# A copy takes less time than as many steps.
SLOTS = 3


class SharedTissue:
    """Memory for the arrays of a tissue, of the shapes of ``like``; ``name`` is that of memory that another
    process has made.

    Each write has a number, which the writer gives: one more than the one before.
    """

    def __init__(self, like: list[np.ndarray], name: str | None = None) -> None:
        self._is_owner = name is None
        parts = [np.zeros(1, np.int64), *(array for _ in range(SLOTS) for array in like)]
        self._memory = SharedMemory(name, create=self._is_owner, size=sum(part.nbytes for part in parts))
        views, offset = [], 0
        for part in parts:
            views.append(np.ndarray(part.shape, part.dtype, self._memory.buf, offset))
            offset += part.nbytes
        self._begun, arrays = views[0], views[1:]
        self._slots = [arrays[n : n + len(like)] for n in range(0, len(arrays), len(like))]

    @property
    def name(self) -> str:
        """The name by which another process finds the memory."""
        return self._memory.name

    def write(self, arrays: list[np.ndarray], number: int) -> None:
        """Write arrays; send their number to the reader afterwards."""
        self._begun[0] = number
        for array, slot in zip(arrays, self._slots[number % SLOTS], strict=True):
            slot[...] = array

    def read(self, number: int) -> list[np.ndarray] | None:
        """Copies of the arrays of a number that the writer has sent; None where newer ones have
        taken their slot.
        """
        arrays = [slot.copy() for slot in self._slots[number % SLOTS]]
        return None if self._begun[0] >= number + SLOTS else arrays

    def close(self) -> None:
        """Release the memory; its arrays must not be used any more."""
        self._begun, self._slots = np.zeros(1, np.int64), []
        self._memory.close()
        if self._is_owner:
            self._memory.unlink()
