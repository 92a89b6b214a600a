"""Start Taichi on one backend, without its console output."""

import contextlib
import functools
import io
import os
import sys
import tempfile
import textwrap
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import taichi as ti
from taichi.lang import impl, kernel_impl, snode
from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext

BACKENDS = {"cuda": ti.cuda, "vulkan": ti.vulkan, "cpu": ti.cpu}
FEW_CORES = 4
# By default Taichi keeps 100 MB of compiled kernels. A choice of settings adds 4 MB.
CACHE_BYTES = 1 << 30
COUNTS = 64
# Taichi gives a thread of a CPU at least so many iterations of a loop. A loop of fewer and longer ones runs over TASK times as many,
# and does something in every TASK-th.
TASK = 512
# The program that Taichi runs, and the backend and options that it was asked for.
_started: tuple = (None, "", {})
TEMPORARY = Path(tempfile.gettempdir()) / "nephron" / "kernels"


def _source_position(context: ASTTransformerContext, node) -> str:
    """File, line and function of an expression, for error messages."""
    line = context.src[node.lineno - 1]
    return f'File "{context.file}", line {node.lineno + context.lineno_offset}, in {context.func.func.__name__}:\n{line}\n'


# While Taichi builds a kernel, it reads and wraps the source of a function at each call of it, formats the position of each
# expression, and formats the call stack for each field, even without an error. This takes more than half of the time, so
# it is cached or left out here.
ASTTransformerContext.get_pos_info = _source_position
kernel_impl.getsourcelines = functools.cache(kernel_impl.getsourcelines)
kernel_impl.getsourcefile = functools.cache(kernel_impl.getsourcefile)
kernel_impl.textwrap = SimpleNamespace(
    fill=functools.cache(textwrap.fill), dedent=functools.cache(textwrap.dedent)
)
impl.get_traceback = snode.get_traceback = lambda stacklevel=1: ""
# Taichi reads the source file to find out whether a function is in a class; the calling frame shows it too.
kernel_impl._inside_class = lambda level_of_class_stackframe: (
    "__qualname__" in sys._getframe(level_of_class_stackframe - 1).f_locals
)


class NoDevice(RuntimeError):
    """The requested backend is not available; the message is one line."""


def start(arch: str = "cpu", accepts_wrong_results: bool = False, **options) -> str:
    """Initialise Taichi on a named backend or ``auto`` (CUDA if available, else the CPU); return the backend's name.

    ``options`` are passed to ``ti.init``. Where Taichi already runs so, it goes on, with its compiled kernels; another start invalidates
    all fields that are not in a CPU's memory. Raises NoDevice, also for a driver whose results are wrong, unless it is asked for all the same.
    """
    global _started
    if arch == "auto":
        arch = "cuda" if ti.lang.misc.is_arch_supported(ti.cuda) else "cpu"
    asked = arch, options
    if _started == (impl.get_runtime().prog, *asked):
        return arch
    ti.set_logging_level(ti.ERROR)
    if arch != "cpu" and not is_available(arch):
        raise NoDevice(f"this machine has no {arch} device or driver; use --arch cpu or --arch auto")
    options = {
        # LLVM and the graphics drivers optimise too: without Taichi's own pass large kernels compile four to ten times as fast.
        "advanced_optimization": False,
        "offline_cache_file_path": str(_kernel_folder()),
        "offline_cache_max_size_of_files": CACHE_BYTES,
        **options,
    }
    with contextlib.redirect_stdout(io.StringIO()):
        ti.init(arch=BACKENDS[arch], log_level=ti.ERROR, **options)
    if arch == "vulkan" and not accepts_wrong_results and not counts_correctly():
        ti.reset()
        raise NoDevice(
            "the Vulkan driver of this machine gives wrong results, as Mesa 22's software driver does; use --arch cpu, or a newer driver"
        )
    _started = impl.get_runtime().prog, *asked
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
        return bool(ti.lang.misc.is_arch_supported(BACKENDS[arch]))
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)
        os.close(null)


def _kernel_folder() -> Path:
    """Folder of the kernel cache: beside Taichi's default, or a temporary folder if that is not writable.

    In the default folder any other program with Taichi would remove kernels beyond its own limit. With a folder that is not writable
    Taichi crashes at the end of the process, even with the cache off.
    """
    default = Path(impl.default_cfg().offline_cache_file_path)
    usual = Path(os.environ.get("TI_OFFLINE_CACHE_FILE_PATH") or default.with_name("nephron"))
    try:
        usual.mkdir(parents=True, exist_ok=True)
    except OSError:
        return TEMPORARY
    return usual if os.access(usual, os.W_OK) else TEMPORARY


def on_cpu() -> bool:
    """Whether Taichi was started on the CPU."""
    return ti.cfg.arch in (ti.x64, ti.arm64)


def is_too_small(count: int, parallel_from: int) -> bool:
    """Whether a body of ``count`` particles or nodes steps faster on one core of a CPU than on all cores.

    With few cores, exchanging data between them takes longer than they save. This depends on the machine and not on the
    number of threads that Taichi uses, because results must not depend on that.
    """
    return on_cpu() and ((os.cpu_count() or 1) < FEW_CORES or count < parallel_from)
