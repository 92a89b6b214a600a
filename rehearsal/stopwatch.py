"""How long work on the device takes."""

from collections.abc import Callable
from time import perf_counter
from typing import TypeVar

import taichi as ti

Result = TypeVar("Result")


def timed(work: Callable[[], Result], into_ms: list[float]) -> Result:
    """Do some work, wait for the device, and add the milliseconds that it took."""
    start = perf_counter()
    result = work()
    ti.sync()
    into_ms.append(1000 * (perf_counter() - start))
    return result
