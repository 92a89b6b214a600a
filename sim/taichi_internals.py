"""All that depends on the internals of Taichi 1.7.4. Other files use Taichi's public interface, or this file.

For each piece: what it does, why it is needed, what breaks with another Taichi, and how one notices.
``tests/sim/test_taichi_internals.py`` compares the version with ``requirements.txt``;
``tests/test_architecture.py`` keeps the internals in this file. A name that this file imports and that is
gone is an ImportError at the start.

Start
    ``program``, ``is_supported``: the program that Taichi runs, and whether a backend has a device. Neither
    has a public name. Where one is gone: AttributeError in ``sim.device.start``.

    ``kernel_folder``: Taichi removes from the folder of its cache what exceeds its limit, so Nephron has one
    of its own. With a folder that is not writable Taichi crashes at the end of the process. Where Taichi has
    another default, kernels are compiled once more, into that folder's neighbour.

    ``sim/__init__.py`` sets Taichi's environment before it is imported, which importing this file would be
    too late for. Where a variable has another name, each start prints a line of Taichi's.

    ``TASK``: fewest iterations of a thread. Where it differs, such loops take longer; ``study timing`` shows
    it.

Patches
    While Taichi builds a kernel, it reads and wraps the source of a function at each call of it, formats the
    position of each expression, and formats the call stack for each field, even without an error. This takes
    more than half of the time, so it is cached or left out, from the import of this file on. Where what a
    patch replaces is gone: AttributeError at import. Where it is no longer used, kernels are built more
    slowly.

Compilation
    ``kernel_of``, ``parameters_of``, ``compiled``: a kernel read with stand-ins in place of its parameters,
    which add arguments. Publicly Taichi compiles the fields and numbers of an object into the kernel, so that
    each patient would compile all of them anew.

    ``function_of``, ``add_function``, ``call_function``, ``callable_in_kernels``: functions of the compiled
    code whose arguments are what they read of an object. Of Taichi's own (``ti.real_func``) they would have
    to be written out.

    Where Taichi reads kernels in another order or with other names: TypeError or AttributeError at the first
    call of a kernel, in all of ``tests/sim/test_kernels.py``. A false ``callable_in_kernels`` is a
    SyntaxWarning.

Arguments
    ``declared``, ``declared_in_function``, ``in_function``: arguments while Taichi reads a kernel or
    function. ``new_arguments``, ``set_argument``, ``set_array``, ``launch``: arguments that are kept from
    call to call, so that only those that have changed are set. Publicly all are, at each call. Where
    arguments are in another order or their setters take others: wrong numbers or TypeError in
    ``tests/sim/test_kernels.py``.

    ``element_at``: a vector or matrix of an array that is assigned as a whole. Of Taichi's own LLVM loads the
    address anew after each number. Where this differs, ``study timing`` has longer steps, or the elements are
    wrong in ``test_kernels.py``.

Profiler
    ``launched_kernels``: the launches one by one; public are sums by name. Where it differs: AttributeError
    in ``study features``, and in ``tests/studies/test_features.py``.

Window
    ``set_image``, ``add_mesh``, ``add_lines``: GGUI with NumPy arrays. Its own methods take fields, compile a
    kernel for each to copy it, and need 10 ms to pack the pixels of an image. Where they differ: TypeError at
    the first picture, or wrong pictures, in ``tests/render``.
"""

import functools
import itertools
import os
import sys
import tempfile
import textwrap
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import taichi as ti
from taichi._lib import core
from taichi.lang import impl, kernel_arguments, kernel_impl, misc, ops, snode
from taichi.lang.any_array import AnyArray
from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext
from taichi.lang.enums import AutodiffMode
from taichi.lang.expr import Expr, make_expr_group
from taichi.lang.kernel_impl import Func, Kernel
from taichi.lang.matrix import MatrixType, make_matrix
from taichi.lang.util import to_numpy_type
from taichi.profiler.kernel_profiler import get_default_kernel_profiler
from taichi.types.ndarray_type import NdarrayType
from taichi.ui.utils import get_field_info

VERSION = (1, 7, 4)

# Start

# Taichi gives a thread of a CPU at least so many iterations of a loop. A loop of fewer and longer ones runs
# over TASK times as many, and does something in every TASK-th.
TASK = 512
TEMPORARY = Path(tempfile.gettempdir()) / "nephron" / "kernels"


def program() -> Any:
    """The program that Taichi runs, another after each start; None before the first."""
    return impl.get_runtime().prog


def is_supported(backend: Any) -> bool:
    """Whether a backend such as ``ti.cuda`` has device and driver; without, Taichi may write to stderr."""
    return bool(misc.is_arch_supported(backend))


def kernel_folder() -> Path:
    """Folder of the kernel cache: beside Taichi's default, or a temporary folder if that is not writable.

    In the default folder any other program with Taichi would remove kernels beyond its own limit. With a
    folder that is not writable Taichi crashes at the end of the process, even with the cache off.
    """
    default = Path(impl.default_cfg().offline_cache_file_path)
    usual = Path(os.environ.get("TI_OFFLINE_CACHE_FILE_PATH") or default.with_name("nephron"))
    try:
        usual.mkdir(parents=True, exist_ok=True)
    except OSError:
        return TEMPORARY
    return usual if os.access(usual, os.W_OK) else TEMPORARY


# Patches


def _patch(owner: Any, name: str, replacement: Any) -> None:
    """Replace what Taichi has under a name. Raises AttributeError where it has nothing to replace."""
    getattr(owner, name)
    setattr(owner, name, replacement)


def _source_position(context: ASTTransformerContext, node: Any) -> str:
    """File, line and function of an expression, for error messages."""
    line = context.src[node.lineno - 1]
    number, function = node.lineno + context.lineno_offset, context.func.func.__name__
    return f'File "{context.file}", line {number}, in {function}:\n{line}\n'


def _is_in_class(level_of_class_stackframe: int) -> bool:
    """Whether a decorated function is in a class, as its frame shows. Taichi reads the source file."""
    return "__qualname__" in sys._getframe(level_of_class_stackframe - 1).f_locals


_patch(ASTTransformerContext, "get_pos_info", _source_position)
_patch(kernel_impl, "getsourcelines", functools.cache(kernel_impl.getsourcelines))
_patch(kernel_impl, "getsourcefile", functools.cache(kernel_impl.getsourcefile))
_patch(
    kernel_impl,
    "textwrap",
    SimpleNamespace(fill=functools.cache(textwrap.fill), dedent=functools.cache(textwrap.dedent)),
)
_patch(kernel_impl, "_inside_class", _is_in_class)
_patch(impl, "get_traceback", lambda stacklevel=1: "")
_patch(snode, "get_traceback", lambda stacklevel=1: "")

# Arguments


class ArrayKind(NamedTuple):
    """An array: Taichi's type of its numbers, the shape of an element, and how many other axes it has."""

    number: Any
    element: tuple[int, ...]
    axes: int

    @property
    def numpy_type(self) -> type:
        """NumPy's type of the numbers."""
        return _numpy_type(self.number)


class MatrixKind(NamedTuple):
    """A vector or matrix of float32, of a shape."""

    shape: tuple[int, ...]


# What an argument is compiled for; numbers are int32 and float32.
Kind: TypeAlias = ArrayKind | MatrixKind | type[int] | type[float]


@functools.cache
def _numpy_type(number: Any) -> type:
    return to_numpy_type(number)


@functools.cache
def _matrix_type(shape: tuple[int, ...]) -> Any:
    return ti.types.vector(*shape, ti.f32) if len(shape) == 1 else ti.types.matrix(*shape, ti.f32)


def _kind_of(annotation: Any) -> Kind:
    """What a parameter with an annotation is compiled for. Raises TypeError for what can be no argument."""
    if isinstance(annotation, NdarrayType):
        is_compound = isinstance(annotation.dtype, MatrixType)
        element = annotation.dtype.get_shape() if is_compound else ()
        return ArrayKind(
            annotation.dtype.dtype if is_compound else annotation.dtype, element, annotation.ndim
        )
    if isinstance(annotation, MatrixType) and annotation.dtype == ti.f32:
        return MatrixKind(annotation.get_shape())
    for kind, number in ((int, ti.i32), (float, ti.f32)):
        if annotation is kind or annotation is number:
            return kind
    raise TypeError(f"a parameter of type {annotation}: expected numbers, vectors, matrices or arrays")


def declared(kind: Kind, name: str) -> Any:
    """Make a value an argument of the kernel or function that Taichi reads; what stands for it there."""
    if isinstance(kind, ArrayKind):
        number = kind.number
        if kind.element:
            number = core.get_type_factory_instance().get_tensor_type(list(kind.element), number)
        return kernel_arguments.decl_ndarray_arg(number, kind.axes, name, False, core.BoundaryMode.UNSAFE)
    if isinstance(kind, MatrixKind):
        return kernel_arguments.decl_matrix_arg(_matrix_type(kind.shape), name, 0)
    return kernel_arguments.decl_scalar_arg(ti.i32 if kind is int else ti.f32, name, 0)


def declared_in_function(kind: Kind, name: str) -> Any:
    """As ``declared``, but of a matrix its numbers: a function takes no matrix."""
    if not isinstance(kind, MatrixKind):
        return declared(kind, name)
    numbers = np.empty(kind.shape, object)
    for index in np.ndindex(kind.shape):
        numbers[index] = declared(float, name)
    return make_matrix(numbers.tolist())


def in_function(value: Any) -> Any:
    """What stands in a function for a value of its call: for a number an argument, for a constant itself."""
    if isinstance(value, Expr):
        return kernel_arguments.decl_scalar_arg(value.ptr.get_rvalue_type(), "", 0)
    return value


def set_argument(context: Any, at: int, kind: Kind, value: Any) -> None:
    """Set a number, vector or matrix among the arguments of a kernel."""
    if kind is float:
        context.set_arg_float((at,), float(value))
    elif kind is int:
        context.set_arg_int((at,), int(value))
    else:
        matrix = _matrix_type(kind.shape)  # type: ignore[union-attr]
        numbers = np.array(value.to_list(), float).ravel().tolist()
        matrix.set_kernel_struct_args(matrix(*numbers), context, (at,))


def set_array(context: Any, at: int, memory: Any, lengths: tuple[int, ...]) -> None:
    """Set an array among the arguments of a kernel: a contiguous NumPy array or a Taichi ndarray.

    ``lengths`` are those of its axes, without the axes of an element.
    """
    if isinstance(memory, np.ndarray):
        context.set_arg_external_array_with_shape((at,), memory.ctypes.data, memory.nbytes, lengths, 0)
    else:
        context.set_arg_ndarray((at,), memory.arr)


# Compilation


class Parameter(NamedTuple):
    """A parameter of a kernel; ``kind`` is None for a template, which is no argument."""

    name: str
    kind: Kind | None


class CompiledKernel(NamedTuple):
    """A kernel that Taichi has compiled for a program; ``result`` is the type of its result, or None."""

    taichi: Kernel
    program: Any
    kernel: Any
    code: Any
    result: Any


def kernel_of(method: Callable) -> Kernel:
    """A method as a kernel whose first parameter is a template."""
    return Kernel(method, AutodiffMode.NONE, _classkernel=True)


def parameters_of(kernel: Kernel) -> list[Parameter]:
    """The parameters of a kernel. Raises TypeError for one that can be no argument."""
    return [
        Parameter(
            argument.name, None if at in kernel.template_slot_locations else _kind_of(argument.annotation)
        )
        for at, argument in enumerate(kernel.arguments)
    ]


def compiled(kernel: Kernel, number: int, values: list) -> CompiledKernel:
    """Compile a kernel with values of its parameters; of templates they may be stand-ins that add arguments.

    ``number`` tells what is compiled of the same kernel apart. Raises what Taichi raises for wrong code.
    """
    features = [
        None
        if at in kernel.template_slot_locations
        else kernel.mapper.extract_arg(value, argument.annotation, argument.name)
        for at, (value, argument) in enumerate(zip(values, kernel.arguments, strict=True))
    ]
    key = kernel.func, number, AutodiffMode.NONE
    kernel.materialize(key=key, args=values, arg_features=features)
    read = kernel.compiled_kernels[key]
    # Taichi has done so before the stand-ins added theirs.
    read.finalize_params()
    running = program()
    code = running.compile_kernel(running.config(), running.get_device_caps(), read)
    return CompiledKernel(kernel, running, read, code, kernel.return_type and kernel.return_type[0])


def new_arguments(compiled: CompiledKernel) -> Any:
    """Arguments of a compiled kernel, none of them set."""
    return compiled.kernel.make_launch_context()


def launch(compiled: CompiledKernel, arguments: Any) -> Any:
    """Run a compiled kernel; its result, for which it is waited."""
    compiled.program.launch_kernel(compiled.code, arguments)
    if compiled.result is None:
        return None
    ti.sync()
    return compiled.taichi.construct_kernel_ret(arguments, compiled.result, (0,))


def callable_in_kernels(decorated: type) -> type:
    """Class decorator: kernels may call its objects. Else Taichi warns that it does not read their code."""
    decorated._is_wrapped_kernel = True  # type: ignore[attr-defined]
    return decorated


def function_of(method: Callable) -> Func:
    """A method as a function that is read as a part of the kernel that calls it."""
    return Func(method, _classfunc=True)


# A function of the compiled code needs a number of its own.
_function_numbers = itertools.count()


def add_function(function: Func, read: Callable[[], None]) -> Any:
    """Add a function to the compiled code; ``read`` has Taichi read it, and declares its arguments."""
    runtime = impl.get_runtime()
    caller = runtime.compiling_callable
    key = core.FunctionKey(function.func.__name__, function.func_id, next(_function_numbers))
    added = runtime.prog.create_function(key)

    def body() -> None:
        runtime.compiling_callable = runtime.current_kernel.kernel_cpp = added
        read()
        added.finalize_params()

    added.set_function_body(body)
    runtime.compiling_callable = runtime.current_kernel.kernel_cpp = caller
    return added


def call_function(function: Any, values: tuple, arguments: list) -> None:
    """Call an added function with the numbers among ``values``, and then ``arguments`` of the caller."""
    passed = [value for value in values if isinstance(value, Expr)]
    for argument in arguments:
        passed += _passed(argument)
    builder = impl.get_runtime().compiling_callable.ast_builder()
    builder.insert_func_call(function, make_expr_group(passed), core.DebugInfo(""))


def _passed(argument: Any) -> list[Any]:
    """What passes on a caller's argument: of an array lengths and address, of a matrix the numbers."""
    if isinstance(argument, AnyArray):
        return core.get_external_tensor_real_func_args(argument.ptr, core.DebugInfo(""))
    return impl.get_runtime().compiling_callable.ast_builder().expand_exprs([argument.ptr])


class _Element(Expr):
    """A vector or matrix of an array, while Taichi reads the code of a kernel."""

    def __init__(self, pointer: Any, shape: tuple[int, ...]) -> None:
        super().__init__(pointer)
        self._shape = shape

    def _assign(self, value: Any) -> Any:
        # All addresses before the first number: LLVM would load each anew after each number, and use no
        # vectors.
        places = [make_expr_group(*index) for index in np.ndindex(*self._shape)]
        whole = core.subscript_with_multiple_indices(self.ptr, places, self._shape, core.DebugInfo(""))
        return ops.assign(Expr(whole), value)


def element_at(array: Any, index: tuple, shape: tuple[int, ...]) -> Expr:
    """The number, vector or matrix of a shape at an index of a declared array."""
    element = impl.subscript(None, array, *index)
    return _Element(element.ptr, shape) if shape else element


# Profiler


def launched_kernels() -> list[str]:
    """Names of the parallel kernels that ran since the profiler was cleared, one for each launch."""
    profiler = get_default_kernel_profiler()
    profiler._update_records()
    return [record.name for record in profiler._traced_records]


# Window

# Numbers of a vertex: place (3), normal (3), place in a texture (2), colour (4).
VERTEX = 12


def set_image(canvas: Any, pixels: np.ndarray) -> None:
    """Show pixels (width, height) uint32 on a canvas of GGUI: bytes red first, columns bottom up."""
    canvas.canvas.set_image(get_field_info(pixels))


def add_mesh(scene: Any, vertices: np.ndarray, indices: np.ndarray, two_sided: bool) -> None:
    """Add triangles of vertex ``indices`` (3 m,), int32, to a scene of GGUI.

    ``vertices`` are (n, VERTEX) float32.
    """
    colour, counts = (0.5, 0.5, 0.5), (len(indices), 0, len(vertices), 0)
    scene.scene.mesh(
        get_field_info(vertices), True, get_field_info(indices), colour, two_sided, *counts, False
    )


def add_lines(scene: Any, vertices: np.ndarray, width: float, colour: tuple | None) -> None:
    """Add line segments between ``vertices`` (2 n, VERTEX) float32 to a scene of GGUI.

    They have a width [pixels], and one colour, or those of the vertices.
    """
    has_own = colour is None
    counts = len(vertices), 0, len(vertices), 0
    scene.scene.lines(
        get_field_info(vertices), get_field_info(None), has_own, colour or (0.5, 0.5, 0.5), width, *counts
    )
