"""Start Taichi on one backend, without its console output."""

import contextlib
import io
import os

import numpy as np
import taichi as ti

from sim import taichi_internals

BACKENDS = {"cuda": ti.cuda, "vulkan": ti.vulkan, "cpu": ti.cpu}
FEW_CORES = 4
# By default Taichi keeps 100 MB of compiled kernels. A choice of settings adds 4 MB.
CACHE_BYTES = 1 << 30
COUNTS = 64
# The program that Taichi runs, and the backend and options that it was asked for.
_started: tuple = (None, "", {})


class NoDevice(RuntimeError):
    """The requested backend is not available; the message is one line."""


def start(arch: str = "cpu", accepts_wrong_results: bool = False, **options) -> str:
    """Initialise Taichi on a named backend or ``auto`` (CUDA if available, else the CPU); return the
    backend's name.

    ``options`` are passed to ``ti.init``. Where Taichi already runs so, it goes on, with its compiled
    kernels; another start invalidates all fields that are not in a CPU's memory. Raises NoDevice, also for a
    driver whose results are wrong, unless it is asked for all the same.
    """
    global _started
    if arch == "auto":
        arch = "cuda" if taichi_internals.is_supported(ti.cuda) else "cpu"
    configuration = arch, options
    if _started == (taichi_internals.program(), *configuration):
        return arch
    ti.set_logging_level(ti.ERROR)
    if arch != "cpu" and not is_available(arch):
        raise NoDevice(f"this machine has no {arch} device or driver; use --arch cpu or --arch auto")
    options = {
        # LLVM and the graphics drivers optimise too: without Taichi's own pass large kernels compile four to
        # ten times as fast.
        "advanced_optimization": False,
        "offline_cache_file_path": str(taichi_internals.kernel_folder()),
        "offline_cache_max_size_of_files": CACHE_BYTES,
        **options,
    }
    with contextlib.redirect_stdout(io.StringIO()):
        ti.init(arch=BACKENDS[arch], log_level=ti.ERROR, **options)
    if arch == "vulkan" and not accepts_wrong_results and not counts_correctly():
        ti.reset()
        raise NoDevice(
            "the Vulkan driver of this machine gives wrong results, as Mesa 22's software driver does; use "
            "--arch cpu, or a newer driver"
        )
    _started = taichi_internals.program(), *configuration
    return arch


def counts_correctly() -> bool:
    """Whether a nested loop with an atomic minimum, as in the image plane, runs to its end."""
    count, least = np.zeros(COUNTS, np.int32), np.full(8, COUNTS, np.int32)
    _count(count, least)
    expected = [sum(max(min(r, 8) - max(r - 5, 0), 0) for r in range(t % 7, 12)) for t in range(COUNTS)]
    return count.tolist() == expected and not least.any()


@ti.kernel
def _count(count: ti.types.ndarray(ndim=1), least: ti.types.ndarray(ndim=1)):
    for t in range(count.shape[0]):
        counted = 0
        for r in range(t % 7, 12):
            for q in range(ti.max(r - 5, 0), ti.min(r, 8)):
                ti.atomic_min(least[q], t)
                counted += 1
        count[t] = counted


def backend() -> str:
    """The name of the backend that Taichi was started on, with the kind of processor."""
    return str(ti.cfg.arch)


def is_available(arch: str) -> bool:
    """Whether ``cuda`` or ``vulkan`` has a device and a driver; output of a missing driver is discarded."""
    stderr, null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)
    try:
        return taichi_internals.is_supported(BACKENDS[arch])
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)
        os.close(null)


def on_cpu() -> bool:
    """Whether Taichi was started on the CPU."""
    return ti.cfg.arch in (ti.x64, ti.arm64)


def is_too_small(count: int, parallel_from: int) -> bool:
    """Whether a body of ``count`` particles or nodes steps faster on one core of a CPU than on all cores.

    With few cores, exchanging data between them takes longer than they save. This depends on the machine and
    not on the number of threads that Taichi uses, because results must not depend on that.
    """
    return on_cpu() and ((os.cpu_count() or 1) < FEW_CORES or count < parallel_from)
