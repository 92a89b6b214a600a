"""Kernels that are compiled for what an object is, not for its sizes: one kernel serves all patients.

Taichi compiles the fields and numbers of ``self`` into a kernel, anew for each object. Of a method with ``@kernel``, fields and numbers are
arguments, read from the object at each call. What else an object has is compiled: its class, flags, texts, and the lengths of lists. Of a
method with ``@function``, which kernels call, the same are arguments. Only this file depends on how Taichi compiles and calls kernels.
"""

import functools
from collections.abc import Callable
from itertools import count
from types import FunctionType, MethodType
from typing import Any

import numpy as np
import taichi as ti
from taichi._lib import core
from taichi.lang import impl, kernel_arguments, ops, runtime_ops
from taichi.lang.enums import AutodiffMode
from taichi.lang.expr import Expr, make_expr_group
from taichi.lang.kernel_impl import Func, Kernel
from taichi.lang.matrix import make_matrix
from taichi.lang.util import to_numpy_type
from taichi.types import ndarray_type

from sim.fields import Field

# What is compiled, wherever it is found.
CONSTANTS = (bool, str, type(None), np.bool_)


class kernel:
    """Decorator of a method: a Taichi kernel. Numbers in parameters annotated with ``ti.template()`` are compiled; fields and objects may be given there too."""

    def __init__(self, function: Callable) -> None:
        functools.update_wrapper(self, function)
        self._taichi = Kernel(function, AutodiffMode.NONE, _classkernel=True)
        self._templates = set(self._taichi.template_slot_locations)
        self._program: Any = None
        self._compiled: list[_Compiled] = []

    def __get__(self, owner: Any, of: type | None = None) -> Callable:
        return self if owner is None else MethodType(self, owner)

    def __call__(self, *given: Any, **named: Any) -> Any:
        if named:
            given += tuple(named.pop(each.name) for each in self._taichi.arguments[len(given) :])
        if self._program is not impl.get_runtime().prog:
            self._program, self._compiled = impl.get_runtime().prog, []
        templates = tuple(given[i] for i in sorted(self._templates))
        calls = templates[0].__dict__.setdefault("_calls", {})
        # A call stays with the object: so its fields are freed with it.
        key = self, *(each if isinstance(each, int | float | str) else id(each) for each in templates[1:])
        call = calls.get(key)
        if call is None or call.program is not self._program or not call.update():
            call = calls[key] = self._bind(given, templates)
        return call(given)

    def _bind(self, given: tuple, templates: tuple) -> "_Call":
        for compiled in self._compiled:
            if compiled.suits(templates):
                return _Call(compiled, templates)
        self._compiled.append(_Compiled(self._taichi, given, templates))
        return _Call(self._compiled[-1], templates)


class function:
    """Decorator of a method that kernels call, without a result.

    Of an object with a flag ``serial`` that is set, it is compiled as a function, whose arguments LLVM keeps in registers: addresses of
    fields among the arguments of a kernel are loaded anew after each write. Otherwise it is a part of the kernel, since only outermost loops
    of kernels run in parallel.
    """

    # Or Taichi would warn of code that it does not read.
    _is_wrapped_kernel = True

    def __init__(self, method: Callable) -> None:
        functools.update_wrapper(self, method)
        self._inline = Func(method, _classfunc=True)
        self._numbers = count()

    def __get__(self, owner: Any, of: type | None = None) -> Callable:
        return self if owner is None else MethodType(self, owner)

    def __call__(self, owner: "_TracedObject", *given: Any) -> None:
        if not owner.serial:
            self._inline(owner, *given)
            return
        runtime = impl.get_runtime()
        within = runtime.compiling_callable
        key = core.FunctionKey(self._inline.func.__name__, self._inline.func_id, next(self._numbers))
        compiled = runtime.prog.create_function(key)
        trace = _Trace(_declared_in_function)
        compiled.set_function_body(lambda: self._read(compiled, trace, owner, given))
        runtime.compiling_callable = runtime.current_kernel.kernel_cpp = within
        passed = [each for each in given if isinstance(each, Expr)]
        callers, _, _ = owner.traced
        callers.constants += trace.constants
        for path, value in trace.arguments:
            passed += _passed(callers.value(path, value))
        within.ast_builder().insert_func_call(compiled, make_expr_group(passed), core.DebugInfo(""))

    def _read(self, compiled: Any, trace: "_Trace", owner: "_TracedObject", given: tuple) -> None:
        """Have Taichi read the code into the compiled function."""
        runtime = impl.get_runtime()
        runtime.compiling_callable = runtime.current_kernel.kernel_cpp = compiled
        _, path, value = owner.traced
        own = [_like(each) if isinstance(each, Expr) else each for each in given]
        self._inline(trace.value(path, value), *own)
        # The trace has added arguments.
        compiled.finalize_params()


class _Compiled:
    """A kernel compiled for objects that are alike: its arguments beyond the method's own, and what it takes as given."""

    def __init__(self, taichi: Kernel, given: tuple, templates: tuple) -> None:
        self.taichi = taichi
        trace = _Trace(_declared)
        places = iter(range(len(templates)))
        traced, features = list(given), []
        for i, (value, argument) in enumerate(zip(given, taichi.arguments, strict=True)):
            is_template = i in taichi.template_slot_locations
            if is_template:
                traced[i] = trace.parameter(f"given[{next(places)}]", value)
            own = (
                None if is_template else taichi.mapper.extract_arg(value, argument.annotation, argument.name)
            )
            features.append(own)
        key = taichi.func, id(self), AutodiffMode.NONE
        taichi.materialize(key=key, args=traced, arg_features=features)
        self.kernel = taichi.compiled_kernels[key]
        # The trace has added arguments.
        self.kernel.finalize_params()
        self.program = impl.get_runtime().prog
        self.code = self.program.compile_kernel(
            self.program.config(), self.program.get_device_caps(), self.kernel
        )
        self.own = [
            each.annotation
            for i, each in enumerate(taichi.arguments)
            if i not in taichi.template_slot_locations
        ]
        self.kinds = [_kind(value) for _, value in trace.arguments]
        self.wanted = tuple(value for _, value in trace.constants)
        self.constants = _reader([path for path, _ in trace.constants])
        self.arguments = _reader([path for path, _ in trace.arguments])

    def suits(self, templates: tuple) -> bool:
        """Whether the kernel is that of these objects too."""
        try:
            alike = self.constants(templates) == self.wanted
            return alike and list(map(_kind, self.arguments(templates))) == self.kinds
        except (AttributeError, IndexError, TypeError):
            return False


class _Call:
    """A compiled kernel with the fields and numbers of its objects as arguments."""

    def __init__(self, compiled: _Compiled, templates: tuple) -> None:
        self.compiled, self.program = compiled, compiled.program
        self._templates = templates
        self._context = compiled.kernel.make_launch_context()
        self._values: tuple = (None,) * len(compiled.kinds)
        self.update()

    def update(self) -> bool:
        """Take the present fields and numbers; whether the kernel still is that of the objects."""
        compiled = self.compiled
        try:
            if compiled.constants(self._templates) != compiled.wanted:
                return False
            values = compiled.arguments(self._templates)
        except (AttributeError, IndexError, TypeError):
            return False
        if values != self._values:
            for at, (value, last) in enumerate(zip(values, self._values, strict=True), len(compiled.own)):
                if value is not last:
                    if _kind(value) != compiled.kinds[at - len(compiled.own)]:
                        return False
                    _set_argument(self._context, (at,), value)
            self._values = values
        return True

    def __call__(self, given: tuple) -> Any:
        compiled, taichi = self.compiled, self.compiled.taichi
        own = (value for i, value in enumerate(given) if i not in taichi.template_slot_locations)
        for at, (value, kind) in enumerate(zip(own, compiled.own, strict=True)):
            _set_parameter(self._context, (at,), value, kind)
        self.program.launch_kernel(compiled.code, self._context)
        if taichi.return_type is None:
            return None
        runtime_ops.sync()
        return taichi.construct_kernel_ret(self._context, taichi.return_type[0], (0,))


class _Trace:
    """What a kernel reads of the objects that it is compiled for, as Python expressions of ``given``; ``declare`` makes a value an argument."""

    def __init__(self, declare: Callable[[str, Any], Any]) -> None:
        self._declare = declare
        self.arguments: list[tuple[str, Any]] = []
        self.constants: list[tuple[str, Any]] = []
        self._found: dict[str, Any] = {}

    def parameter(self, path: str, value: Any) -> Any:
        """What stands for a template parameter in the kernel: numbers are constants."""
        if isinstance(value, int | float):
            self.constants.append((path, value))
            return value
        return self.value(path, value)

    def value(self, path: str, value: Any) -> Any:
        """What stands for a value in the kernel."""
        if path not in self._found:
            self._found[path] = self._value(path, value)
        return self._found[path]

    def _value(self, path: str, value: Any) -> Any:
        if isinstance(value, CONSTANTS) or (has_constant_counts() and isinstance(value, int)):
            self.constants.append((path, value))
            return value
        if isinstance(value, list | tuple):
            self.constants.append((f"len({path})", len(value)))
            return type(value)(self.value(f"{path}[{k}]", each) for k, each in enumerate(value))
        kind = _kind(value)
        if kind is None:
            self.constants.append((f"type({path})", type(value)))
            return _TracedObject(self, path, value)
        return _TracedField(self, path, value) if isinstance(value, Field) else self.declared(path, value)

    def declared(self, path: str, value: Any) -> Any:
        """Make a value an argument; what stands for it in the kernel."""
        self.arguments.append((path, value))
        return self._declare(path, value)


class _TracedObject:
    """Stands for an object while Taichi reads the code of a kernel."""

    def __init__(self, trace: _Trace, path: str, value: Any) -> None:
        self.traced = trace, path, value

    def __getattr__(self, name: str) -> Any:
        trace, path, value = self.traced
        method = getattr(type(value), name, None)
        if isinstance(method, FunctionType | function):
            return MethodType(method, self)
        return trace.value(f"{path}.{name}", getattr(value, name))


class _TracedField:
    """Stands for a field while Taichi reads the code of a kernel."""

    def __init__(self, trace: _Trace, path: str, field: Field) -> None:
        self.traced, self._element = (trace, path, field), field.element

    @functools.cached_property
    def array(self) -> Any:
        # A template parameter exists before Taichi takes arguments.
        trace, path, field = self.traced
        return trace.declared(path, field)

    @property
    def shape(self) -> Any:
        """Lengths of the axes."""
        trace, path, field = self.traced
        return trace.value(f"{path}.shape", field.shape) if has_constant_counts() else self.array.shape

    def __getitem__(self, at: Any) -> Expr:
        at = 0 if at is None else at
        element = impl.subscript(None, self.array, *(at if isinstance(at, tuple) else (at,)))
        return _TracedElement(element.ptr, self._element) if self._element else element


class _TracedElement(Expr):
    """A vector or matrix of a field, while Taichi reads the code of a kernel."""

    def __init__(self, pointer: Any, shape: tuple[int, ...]) -> None:
        super().__init__(pointer)
        self._shape = shape

    def _assign(self, value: Any) -> Any:
        # All addresses before the first number: LLVM would load each address anew after each number, and use no vectors.
        places = [make_expr_group(*index) for index in np.ndindex(*self._shape)]
        whole = core.subscript_with_multiple_indices(self.ptr, places, self._shape, core.DebugInfo(""))
        return ops.assign(Expr(whole), value)


def has_constant_counts() -> bool:
    """Whether whole numbers of objects are compiled too: Vulkan starts 65,536 threads for a loop whose range it does not know."""
    return ti.cfg.arch == ti.vulkan


def _reader(paths: list[str]) -> Callable[[tuple], tuple]:
    """A function that returns the values of paths."""
    return eval(f"lambda given: ({''.join(f'{path}, ' for path in paths)})")


def _kind(value: Any) -> Any:
    """What the argument of a value is compiled for; None for what is no argument."""
    if isinstance(value, Field):
        return value.kind, value.element, len(value.shape)
    if isinstance(value, ti.Matrix):
        return "matrix", value.get_shape()
    if isinstance(value, int | np.integer) and not isinstance(value, bool):
        return int
    return float if isinstance(value, float | np.floating) else None


def _declared(name: str, value: Any) -> Any:
    """Declare an argument for a value; what stands for it in the kernel."""
    if isinstance(value, Field):
        kind = value.kind
        if value.element:
            kind = core.get_type_factory_instance().get_tensor_type(list(value.element), kind)
        unchecked = core.BoundaryMode.UNSAFE
        return kernel_arguments.decl_ndarray_arg(kind, len(value.lengths), name, False, unchecked)
    if isinstance(value, ti.Matrix):
        return kernel_arguments.decl_matrix_arg(_matrix_type(value), name, 0)
    return kernel_arguments.decl_scalar_arg(ti.i32 if _kind(value) is int else ti.f32, name, 0)


def _declared_in_function(name: str, value: Any) -> Any:
    """Declare arguments of a function for a value: for a matrix its numbers, as a function takes none; what stands for it in the function."""
    if not isinstance(value, ti.Matrix):
        return _declared(name, value)
    numbers = np.array(value.to_list(), object)
    for index in np.ndindex(numbers.shape):
        numbers[index] = kernel_arguments.decl_scalar_arg(ti.f32, name, 0)
    return make_matrix(numbers.tolist())


def _like(number: Expr) -> Expr:
    """Declare an argument of a function for a number of its caller."""
    return kernel_arguments.decl_scalar_arg(number.ptr.get_rvalue_type(), "", 0)


def _passed(argument: Any) -> list[Any]:
    """What passes a caller's argument on to a function: lengths and address of a field, the numbers of a matrix."""
    if isinstance(argument, _TracedField):
        return core.get_external_tensor_real_func_args(argument.array.ptr, core.DebugInfo(""))
    return impl.get_runtime().compiling_callable.ast_builder().expand_exprs([argument.ptr])


def _matrix_type(value: ti.Matrix) -> Any:
    shape = value.get_shape()
    return ti.types.vector(*shape, ti.f32) if len(shape) == 1 else ti.types.matrix(*shape, ti.f32)


@functools.cache
def _number_type(kind: Any) -> type:
    return to_numpy_type(getattr(kind.dtype, "dtype", kind.dtype))


def _axes(kind: Any) -> int:
    return kind.ndim + getattr(kind.dtype, "ndim", 0)


def _set_argument(context: Any, at: tuple, value: Any) -> None:
    """Set the argument of a value that an object has."""
    if isinstance(value, Field):
        memory = value.memory
        if isinstance(memory, np.ndarray):
            context.set_arg_external_array_with_shape(at, memory.ctypes.data, memory.nbytes, value.lengths, 0)
        else:
            context.set_arg_ndarray(at, memory.arr)
    elif isinstance(value, ti.Matrix):
        _set_parameter(context, at, value, _matrix_type(value))
    else:
        _set_parameter(context, at, value, ti.i32 if _kind(value) is int else ti.f32)


def _set_parameter(context: Any, at: tuple, value: Any, kind: Any) -> None:
    """Set an argument of a kind; arrays must be contiguous."""
    if kind is ti.f32 or kind is float:
        context.set_arg_float(at, float(value))
    elif kind is ti.i32 or kind is int:
        context.set_arg_int(at, int(value))
    elif isinstance(kind, ndarray_type.NdarrayType):
        if not value.flags.c_contiguous or value.dtype != _number_type(kind) or value.ndim != _axes(kind):
            expected = f"{_number_type(kind).__name__} with {_axes(kind)} axes, contiguous"
            raise ValueError(
                f"an array {value.dtype} of shape {value.shape} for a kernel: expected {expected}"
            )
        shape = value.shape[: kind.ndim]
        context.set_arg_external_array_with_shape(at, value.ctypes.data, value.nbytes, shape, 0)
    else:
        numbers = np.array(value.to_list(), float).ravel().tolist()
        kind.set_kernel_struct_args(kind(*numbers), context, at)
