"""Copy arrays to and from Taichi fields. On a CPU directly in memory: compiling a kernel for each field takes longer.

New fields get their values together, before the next kernel or access: so they share trees, and one kernel finds where these are.
"""

import ctypes
from collections.abc import Callable, Sequence
from weakref import WeakKeyDictionary

import numpy as np
import taichi as ti
from taichi.lang import impl

from sim.device import on_cpu

# Address of each tree of fields, for each start of Taichi; and the memory of each field.
_ROOTS: WeakKeyDictionary[object, dict[int, int]] = WeakKeyDictionary()
_VIEWS: WeakKeyDictionary[ti.Field, np.ndarray] = WeakKeyDictionary()
# Values for new fields, for each start of Taichi.
_WAITING: WeakKeyDictionary[object, list[tuple[ti.Field, np.ndarray]]] = WeakKeyDictionary()
# The sets of fields that are entered, the innermost last.
_ENTERED: "list[FieldSet]" = []


def field_of(values: np.ndarray, within: int = 0) -> ti.Field:
    """A field with the values of an array: floats as f32, others as i32.

    The last ``within`` axes are those of an element: 0 for scalars, 1 for vectors, 2 for matrices.
    """
    return fields_of(values, within=within)[0]


def fields_of(*arrays: np.ndarray, within: int = 0) -> list[ti.Field]:
    """``field_of`` for each array."""
    arrays = tuple(map(np.asarray, arrays))
    kinds = [ti.f32 if values.dtype.kind == "f" else ti.i32 for values in arrays]
    fields = _made([(values.shape, kind) for values, kind in zip(arrays, kinds, strict=True)], within)
    fill(*zip(fields, arrays, strict=True))
    return fields


class FieldSet:
    """Fields that are made while it is entered, and which ``free`` frees. Others stay until Taichi ends, which holds 512 sets of them."""

    def __init__(self) -> None:
        self._trees: list[ti._snode.snode_tree.SNodeTree] = []

    def __enter__(self) -> "FieldSet":
        _ENTERED.append(self)
        return self

    def __exit__(self, *error: object) -> None:
        _ENTERED.remove(self)

    def add(self, fields: Sequence[ti.Field], shapes: Sequence[tuple[int, ...]]) -> None:
        """Place fields that have no place yet, of these shapes."""
        builder = ti.FieldsBuilder()
        for field, shape in zip(fields, shapes, strict=True):
            builder.dense(ti.ij if len(shape) == 2 else ti.i, shape).place(field)
        self._trees.append(builder.finalize())

    def free(self) -> None:
        """Free the fields, which must not be used any more."""
        # Taichi checks new fields when it next runs a kernel, and would read the memory of the freed ones.
        impl.get_runtime().materialize()
        for tree in self._trees:
            _ROOTS.get(impl.get_runtime(), {}).pop(tree.id, None)
            _destroy(tree)
        self._trees.clear()


def _destroy(tree: ti._snode.snode_tree.SNodeTree) -> None:
    """Free a tree of fields.

    Taichi would then compile all kernels again, and keep the old ones: 9 MB for each tree. On a CPU our kernels get the memory of such
    fields (``run_kernel``), so that only Taichi's own, as those of GGUI, may have been compiled for them.
    """
    runtime = impl.get_runtime()
    if not on_cpu() or tree.destroyed or tree.prog != runtime.prog:
        tree.destroy()
        return
    tree.ptr.destroy_snode_tree(runtime.prog)
    tree.destroyed = True
    for kernel in runtime.kernels:
        if kernel.func.__module__.startswith("taichi."):
            kernel.compiled_kernels.clear()


def empty_fields(*shapes: tuple[int, ...], within: int = 0, kind: type = ti.f32) -> list[ti.Field]:
    """Fields of these shapes, without values; as for ``field_of`` the last ``within`` axes are those of an element."""
    return _made([(shape, kind) for shape in shapes], within)


def _made(asked: Sequence[tuple[tuple[int, ...], type]], within: int) -> list[ti.Field]:
    """Fields of these shapes and kinds, all in one tree where a set is entered."""
    make = (ti.field, ti.Vector.field, ti.Matrix.field)[within]
    parts = [(shape[: len(shape) - within], shape[len(shape) - within :], kind) for shape, kind in asked]
    if not _ENTERED:
        return [make(*element, kind, outer) for outer, element, kind in parts]
    fields = [make(*element, kind) for _, element, kind in parts]
    _ENTERED[-1].add(fields, [outer for outer, _, _ in parts])
    return fields


def fill(*pairs: tuple[ti.Field, np.ndarray]) -> None:
    """Write arrays into fields. Raises ValueError if the shapes differ."""
    for field, values in pairs:
        values = np.asarray(values)
        if values.shape != _shape(field):
            raise ValueError(f"an array of shape {values.shape} for a field of shape {_shape(field)}")
        if not on_cpu():
            field.from_numpy(np.ascontiguousarray(values, _kind(field)))
        elif field in _VIEWS:
            _memory(field)[...] = values
        else:
            _WAITING.setdefault(impl.get_runtime(), []).append((field, values.copy()))


def fill_evenly(field: ti.Field, value: float) -> None:
    """Write one number into all of a field."""
    if on_cpu():
        _memory(field)[...] = value
    else:
        field.fill(value)


def array_of(field: ti.Field) -> np.ndarray:
    """The values of a field, of shape (*field, *element)."""
    return _memory(field).copy() if on_cpu() else field.to_numpy()


def run_kernel(on_memory: Callable, on_fields: Callable, fields: Sequence[ti.Field], *values: object) -> None:
    """Run the one of two equal kernels that suits the backend, on fields and then on other values.

    On a CPU it is the one that takes arrays, and gets the memory of the fields: Taichi compiles it once, the other one for each field.
    """
    if on_cpu():
        on_memory(*map(_memory, fields), *values)
    else:
        on_fields(*fields, *values)


def _kind(field: ti.Field) -> type[np.float32] | type[np.int32]:
    return np.float32 if field.dtype == ti.f32 else np.int32


def _shape(field: ti.Field) -> tuple[int, ...]:
    return tuple(field.shape) + _element(field)


def _element(field: ti.Field) -> tuple[int, ...]:
    return () if isinstance(field, ti.ScalarField) else (field.n, field.m)[: field.ndim]


def _memory(field: ti.Field) -> np.ndarray:
    """View of a field's memory; each element is contiguous, next to those of the other fields of a struct."""
    if field not in _VIEWS:
        _VIEWS[field] = _view(field)
    return _VIEWS[field]


def _view(field: ti.Field) -> np.ndarray:
    # This may fill the field, and so make its view.
    impl.get_runtime().materialize()
    if field in _VIEWS:
        return _VIEWS[field]
    _find_roots([field])
    place = field.snode.ptr
    size = place.parent.cell_size_bytes
    at = _ROOTS[impl.get_runtime()][place.get_snode_tree_id()] + place.parent.offset_bytes_in_parent_cell
    memory = (ctypes.c_byte * (size * int(np.prod(field.shape)))).from_address(at)
    strides = _strides(field.shape, size) + _strides(_element(field), np.dtype(_kind(field)).itemsize)
    return np.ndarray(_shape(field), _kind(field), memory, place.offset_bytes_in_parent_cell, strides)


def _strides(shape: tuple[int, ...], size: int) -> tuple[int, ...]:
    return tuple(size * int(np.prod(shape[axis + 1 :])) for axis in range(len(shape)))


def _find_roots(fields: Sequence[ti.Field]) -> None:
    """Find the addresses of the trees of fields, of those that are not known yet."""
    roots = _ROOTS.setdefault(impl.get_runtime(), {})
    of_tree = {field.snode.ptr.get_snode_tree_id(): field for field in fields}
    new = {tree: field for tree, field in of_tree.items() if tree not in roots}
    if new:
        asked, found = _Asked(list(new.values())), np.zeros(len(new), np.uint64)
        _addresses(asked, found)
        # Taichi keeps the argument.
        asked.fields.clear()
        for (tree, field), address in zip(new.items(), found, strict=True):
            place = field.snode.ptr
            before = place.parent.offset_bytes_in_parent_cell + place.offset_bytes_in_parent_cell
            roots[tree] = int(address) - before


class _Asked:
    """The fields of one call of a kernel."""

    def __init__(self, fields: list[ti.Field]) -> None:
        self.fields = fields


@ti.kernel
def _addresses(of: ti.template(), found: ti.types.ndarray(ti.u64, ndim=1)):
    for k in ti.static(range(len(of.fields))):
        found[k] = ti.get_addr(of.fields[k], [0 for _ in ti.static(range(len(of.fields[k].shape)))])


def _materialize_and_fill(runtime: impl.PyTaichi) -> None:
    _materialize(runtime)
    waiting = _WAITING.pop(runtime, [])
    if waiting:
        _find_roots([field for field, _ in waiting])
        for field, values in waiting:
            _memory(field)[...] = values


# Taichi calls this before it runs a kernel or reads an element.
_materialize = impl.PyTaichi.materialize
impl.PyTaichi.materialize = _materialize_and_fill
