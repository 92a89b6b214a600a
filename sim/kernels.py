"""Kernels that are compiled for what an object is, not for its sizes: one kernel serves all patients.

Taichi compiles the fields and numbers of ``self`` into a kernel, anew for each object. Of a method with
``@kernel``, fields and numbers are arguments, read from the object at each call. What else an object has is
compiled: its class, flags, texts, and the lengths of lists. Of a method with ``@function``, which kernels
call, the same are arguments.

While Taichi reads the code of a kernel, stand-ins take the place of its objects (``_TracedObject``,
``_TracedField``). What the code reads of them is recorded (``_Trace``) as Python expressions, such as
``objects[0].body.position``. They show whether a kernel is that of other objects too (``_Compiled``), and
give the arguments of each call (``_Call``).
"""

import functools
from collections.abc import Callable
from itertools import count
from types import FunctionType, MethodType
from typing import Any

import numpy as np
import taichi as ti

from sim import taichi_internals
from sim.fields import Field
from sim.taichi_internals import ArrayKind, Kind, MatrixKind, Parameter

# What is compiled, wherever it is found.
CONSTANTS = (bool, str, type(None), np.bool_)


class kernel:
    """Decorator of a method: a Taichi kernel.

    Numbers in parameters annotated with ``ti.template()`` are compiled; these take fields and objects too.
    """

    def __init__(self, function: Callable) -> None:
        functools.update_wrapper(self, function)
        self._taichi = taichi_internals.kernel_of(function)
        self._parameters = taichi_internals.parameters_of(self._taichi)
        self._templates = [at for at, parameter in enumerate(self._parameters) if parameter.kind is None]
        self._own = [at for at, parameter in enumerate(self._parameters) if parameter.kind is not None]
        self._program: Any = None
        self._compiled: list[_Compiled] = []

    def __get__(self, owner: Any, of: type | None = None) -> Callable:
        return self if owner is None else MethodType(self, owner)

    def __call__(self, *values: Any, **named: Any) -> Any:
        if named:
            values += tuple(named[parameter.name] for parameter in self._parameters[len(values) :])
        program = taichi_internals.program()
        if self._program is not program:
            self._program, self._compiled = program, []
        objects = tuple([values[at] for at in self._templates])
        calls = objects[0].__dict__.setdefault("_calls", {})
        # A call stays with the object: so its fields are freed with it.
        key = (
            self,
            *[
                argument if isinstance(argument, int | float | str) else id(argument)
                for argument in objects[1:]
            ],
        )
        call = calls.get(key)
        if call is None or call.program is not program or not call.update():
            call = calls[key] = _Call(self._compiled_for(objects, values), objects)
        return call([values[at] for at in self._own])

    def _compiled_for(self, objects: tuple, values: tuple) -> "_Compiled":
        for compiled in self._compiled:
            if compiled.suits(objects):
                return compiled
        self._compiled.append(_Compiled(self._taichi, self._parameters, len(self._compiled), values))
        return self._compiled[-1]


@taichi_internals.callable_in_kernels
class function:
    """Decorator of a method that kernels call, without a result.

    Of an object with a flag ``serial`` that is set, it is compiled as a function, whose arguments LLVM keeps
    in registers: addresses of fields among the arguments of a kernel are loaded anew after each write.
    Otherwise it is a part of the kernel, since only outermost loops of kernels run in parallel.
    """

    def __init__(self, method: Callable) -> None:
        functools.update_wrapper(self, method)
        self._inline = taichi_internals.function_of(method)

    def __get__(self, owner: Any, of: type | None = None) -> Callable:
        return self if owner is None else MethodType(self, owner)

    def __call__(self, owner: "_TracedObject", *values: Any) -> None:
        if not owner.serial:
            self._inline(owner, *values)
            return
        callers, path, value = owner.traced
        trace = _Trace(taichi_internals.declared_in_function)

        def read() -> None:
            own = [taichi_internals.in_function(argument) for argument in values]
            self._inline(trace.value(path, value), *own)

        compiled = taichi_internals.add_function(self._inline, read)
        callers.constants += trace.constants
        passed = [_argument(callers.value(path, value)) for path, value in trace.arguments]
        taichi_internals.call_function(compiled, values, passed)


class _Compiled:
    """A kernel compiled for objects that are alike: kinds of its arguments, and what it takes as constant.

    ``number`` tells those of the same method apart; ``values`` are of its parameters.
    """

    def __init__(self, taichi: Any, parameters: list[Parameter], number: int, values: tuple) -> None:
        trace = _Trace(taichi_internals.declared)
        places = count()
        traced = [
            trace.parameter(f"objects[{next(places)}]", value) if parameter.kind is None else value
            for parameter, value in zip(parameters, values, strict=True)
        ]
        self.kernel = taichi_internals.compiled(taichi, number, traced)
        # Of the method's own parameters, which come before what the code reads of the objects.
        self.own = [parameter.kind for parameter in parameters if parameter.kind is not None]
        self.kinds = [_kind(value) for _, value in trace.arguments]
        self._wanted = tuple(value for _, value in trace.constants)
        self._constants = _reader([path for path, _ in trace.constants])
        self._arguments = _reader([path for path, _ in trace.arguments])

    def arguments(self, objects: tuple) -> tuple | None:
        """The present fields and numbers of objects; None where the kernel is not theirs."""
        try:
            return self._arguments(objects) if self._constants(objects) == self._wanted else None
        except (AttributeError, IndexError, TypeError):
            return None

    def suits(self, objects: tuple) -> bool:
        """Whether the kernel is that of these objects too."""
        arguments = self.arguments(objects)
        return arguments is not None and list(map(_kind, arguments)) == self.kinds


class _Call:
    """A compiled kernel with the fields and numbers of its objects as arguments."""

    def __init__(self, compiled: _Compiled, objects: tuple) -> None:
        self.compiled, self.program = compiled, compiled.kernel.program
        self._objects = objects
        self._context = taichi_internals.new_arguments(compiled.kernel)
        self._values: tuple = (None,) * len(compiled.kinds)
        self.update()

    def update(self) -> bool:
        """Take the present fields and numbers; whether the kernel still is that of the objects."""
        compiled = self.compiled
        values = compiled.arguments(self._objects)
        if values is None:
            return False
        if values != self._values:
            places = count(len(compiled.own))
            for at, kind, value, last in zip(places, compiled.kinds, values, self._values, strict=False):
                if value is not last:
                    if _kind(value) != kind:
                        return False
                    _set_argument(self._context, at, kind, value)
            self._values = values
        return True

    def __call__(self, own: list) -> Any:
        for at, (kind, value) in enumerate(zip(self.compiled.own, own, strict=True)):
            _set_argument(self._context, at, kind, value)
        return taichi_internals.launch(self.compiled.kernel, self._context)


class _Trace:
    """What a kernel reads of the objects that it is compiled for, as Python expressions of ``objects``.

    ``declare`` makes a value of a kind an argument.
    """

    def __init__(self, declare: Callable[[Kind, str], Any]) -> None:
        self._declare = declare
        self.arguments: list[tuple[str, Any]] = []
        self.constants: list[tuple[str, Any]] = []
        self._stand_ins: dict[str, Any] = {}

    def parameter(self, path: str, value: Any) -> Any:
        """What stands for a template parameter in the kernel: numbers are constants."""
        if isinstance(value, int | float):
            self.constants.append((path, value))
            return value
        return self.value(path, value)

    def value(self, path: str, value: Any) -> Any:
        """What stands for a value in the kernel."""
        if path not in self._stand_ins:
            self._stand_ins[path] = self._stand_in(path, value)
        return self._stand_ins[path]

    def _stand_in(self, path: str, value: Any) -> Any:
        if isinstance(value, CONSTANTS) or (has_constant_counts() and isinstance(value, int)):
            self.constants.append((path, value))
            return value
        if isinstance(value, list | tuple):
            self.constants.append((f"len({path})", len(value)))
            return type(value)(self.value(f"{path}[{k}]", item) for k, item in enumerate(value))
        if isinstance(value, Field):
            return _TracedField(self, path, value)
        if _kind(value) is None:
            self.constants.append((f"type({path})", type(value)))
            return _TracedObject(self, path, value)
        return self.declared(path, value)

    def declared(self, path: str, value: Any) -> Any:
        """Make a value an argument; what stands for it in the kernel."""
        self.arguments.append((path, value))
        return self._declare(_kind(value), path)


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
        self._traced = trace, path, field

    @functools.cached_property
    def array(self) -> Any:
        """The field as an argument: a template parameter exists before Taichi takes arguments."""
        trace, path, field = self._traced
        return trace.declared(path, field)

    @property
    def shape(self) -> Any:
        """Lengths of the axes."""
        trace, path, field = self._traced
        return trace.value(f"{path}.shape", field.shape) if has_constant_counts() else self.array.shape

    def __getitem__(self, at: Any) -> Any:
        at = 0 if at is None else at
        index = at if isinstance(at, tuple) else (at,)
        return taichi_internals.element_at(self.array, index, self._traced[2].element)


def _argument(stand_in: Any) -> Any:
    """The argument that a stand-in of a field, number or matrix is."""
    return stand_in.array if isinstance(stand_in, _TracedField) else stand_in


def has_constant_counts() -> bool:
    """Whether whole numbers of objects are compiled too.

    Vulkan starts 65,536 threads for a loop whose range it does not know.
    """
    return ti.cfg.arch == ti.vulkan


def _reader(paths: list[str]) -> Callable[[tuple], tuple]:
    """A function that returns the values of paths."""
    return eval(f"lambda objects: ({''.join(f'{path}, ' for path in paths)})")


def _kind(value: Any) -> Any:
    """What the argument of a value is compiled for; None for what is no argument."""
    if isinstance(value, Field):
        return ArrayKind(value.kind, value.element, len(value.lengths))
    if isinstance(value, ti.Matrix):
        return MatrixKind(value.get_shape())
    if isinstance(value, int | np.integer) and not isinstance(value, bool):
        return int
    return float if isinstance(value, float | np.floating) else None


def _set_argument(context: Any, at: int, kind: Kind, value: Any) -> None:
    """Set the argument at a place. Raises ValueError for an array of another kind, or not contiguous."""
    if isinstance(value, Field):
        taichi_internals.set_array(context, at, value.memory, value.lengths)
    elif isinstance(kind, ArrayKind):
        _check_array(kind, value)
        taichi_internals.set_array(context, at, value, value.shape[: kind.axes])
    else:
        taichi_internals.set_argument(context, at, kind, value)


def _check_array(kind: ArrayKind, array: np.ndarray) -> None:
    axes = kind.axes + len(kind.element)
    if not array.flags.c_contiguous or array.dtype != kind.numpy_type or array.ndim != axes:
        raise ValueError(
            f"an array {array.dtype} of shape {array.shape} for a kernel: "
            f"expected {kind.numpy_type.__name__} with {axes} axes, contiguous"
        )
