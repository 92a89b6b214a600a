"""Start Taichi on one backend, quietly. Fields of an earlier start are gone afterwards."""

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
# Taichi drops compiled kernels from 100 MB on. A rehearsal leaves 4 MB for each patient and each choice of settings.
CACHE_BYTES = 1 << 30
COUNTS = 64
TEMPORARY = Path(tempfile.gettempdir()) / "nephron" / "kernels"


def _place(context: ASTTransformerContext, node) -> str:
    """Where an expression stands, for the case of an error in it."""
    line = context.src[node.lineno - 1]
    return f'File "{context.file}", line {node.lineno + context.lineno_offset}, in {context.func.func.__name__}:\n{line}\n'


# To build a kernel Taichi reads the source of a function at each call of it and wraps each of its lines, draws each
# expression's place with a caret, and writes the whole stack down for each field, whether there is an error or not:
# together more than half of the time.
ASTTransformerContext.get_pos_info = _place
kernel_impl.getsourcelines = functools.cache(kernel_impl.getsourcelines)
kernel_impl.getsourcefile = functools.cache(kernel_impl.getsourcefile)
kernel_impl.textwrap = SimpleNamespace(
    fill=functools.cache(textwrap.fill), dedent=functools.cache(textwrap.dedent)
)
impl.get_traceback = snode.get_traceback = lambda stacklevel=1: ""
# And to learn whether a function stands in a class it reads the file that holds it.
kernel_impl._inside_class = lambda level_of_class_stackframe: (
    "__qualname__" in sys._getframe(level_of_class_stackframe - 1).f_locals
)


class NoDevice(RuntimeError):
    """The backend that was asked for is not there; the message is one line."""


def start(arch: str = "cpu", **options) -> str:
    """Initialise Taichi on ``auto`` (CUDA where there is one, else the CPU) or a named backend; the one it is.

    ``options`` go to ``ti.init``. Raises NoDevice.
    """
    ti.set_logging_level(ti.ERROR)
    if arch == "auto":
        arch = "cuda" if ti.lang.misc.is_arch_supported(ti.cuda) else "cpu"
    elif arch != "cpu" and not is_available(arch):
        raise NoDevice(f"this machine has no {arch} device or driver; use --arch cpu or --arch auto")
    if arch != "vulkan":
        # LLVM does it again: kernels run as fast, and large ones compile in a tenth of the time.
        options = {"advanced_optimization": False, **options}
    options = {
        "offline_cache_file_path": str(_kernel_folder()),
        "offline_cache_max_size_of_files": CACHE_BYTES,
        **options,
    }
    with contextlib.redirect_stdout(io.StringIO()):
        ti.init(arch=BACKENDS[arch], log_level=ti.ERROR, **options)
    if arch == "vulkan" and not counts_right():
        ti.reset()
        raise NoDevice(
            "the Vulkan driver of this machine computes wrongly, as Mesa 22's software driver does; use --arch cpu, or a newer driver"
        )
    return arch


def counts_right() -> bool:
    """Whether a loop in a loop runs to its end with an atomic minimum in it, as the image plane's does."""
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


def is_available(arch: str) -> bool:
    """Whether ``cuda`` or ``vulkan`` has a device and a driver; what a driver that is missing prints goes nowhere."""
    told, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        return bool(ti.lang.misc.is_arch_supported(BACKENDS[arch]))
    finally:
        os.dup2(told, 2)
        os.close(told)
        os.close(nowhere)


def _kernel_folder() -> Path:
    """Where compiled kernels are kept for the next run: where Taichi keeps them, or else a temporary folder.

    Of a folder that cannot be made or written Taichi crashes as the process ends, even when it is told to keep nothing.
    """
    usual = Path(os.environ.get("TI_OFFLINE_CACHE_FILE_PATH") or impl.default_cfg().offline_cache_file_path)
    try:
        usual.mkdir(parents=True, exist_ok=True)
    except OSError:
        return TEMPORARY
    return usual if os.access(usual, os.W_OK) else TEMPORARY


def on_cpu() -> bool:
    """Whether Taichi was started on the CPU."""
    return ti.cfg.arch in (ti.x64, ti.arm64)


def is_too_small(count: int, parallel_from: int) -> bool:
    """Whether a body of so many particles or nodes steps faster on one core of a CPU than on all of them.

    Of few cores the second never paid: what one has computed the other must fetch. The machine decides, not how many
    threads Taichi was given, on which no bit of a result may depend.
    """
    return on_cpu() and ((os.cpu_count() or 1) < FEW_CORES or count < parallel_from)
