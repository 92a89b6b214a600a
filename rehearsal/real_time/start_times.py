"""How long each stage of the start takes, from the begin of the process on."""

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from time import time

import psutil


class StartTimes:
    """The stages of the start, each with the time [s] after the begin of the process at which it begins."""

    def __init__(self) -> None:
        self._created_s = psutil.Process().create_time()
        self._begins: list[tuple[str, float]] = [("Start of Python", 0.0)]

    @property
    def now_s(self) -> float:
        """Time since the process began."""
        return time() - self._created_s

    def begin(self, stage: str) -> None:
        """The next stage begins."""
        self._begins.append((stage, self.now_s))

    @contextmanager
    def paused(self) -> Iterator[None]:
        """The time that the user takes in this context is not counted."""
        before = time()
        try:
            yield
        finally:
            self._created_s += time() - before

    def seconds(self) -> dict[str, float]:
        """How long each stage but the last has lasted."""
        return {name: round(end - begin, 2) for (name, begin), (_, end) in pairwise(self._begins)}
