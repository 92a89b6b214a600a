"""The layers of the program: which folder may import which, and no module in a circle."""

import ast
from collections import Counter
from functools import cache
from graphlib import CycleError, TopologicalSorter
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import pytest
import taichi
from conftest import ROOT

LAYERS = ("app", "studies", "rehearsal", "render", "ultrasound", "sim", "scenes")
# app -> studies -> rehearsal -> render, ultrasound -> sim, and scenes is data: what a layer must not know,
# and which libraries.
FORBIDDEN = {
    "scenes": {"app", "studies", "rehearsal", "render", "ultrasound", "sim", "taichi"},
    "sim": {"app", "studies", "rehearsal", "render", "ultrasound", "scenes"},
    "ultrasound": {"app", "studies", "rehearsal", "render", "scenes"},
    "render": {"app", "studies", "rehearsal", "scenes"},
    "rehearsal": {"app", "studies"},
    "studies": {"app"},
}
# What of other layers the screen may name: which choices there are, and the folder itself, which keeps Taichi
# quiet.
# Solvers, bodies and scanners stay out: it is handed arrays.
KNOWN_TO_RENDER = {
    "sim",
    "sim.device",
    "sim.fields",
    "sim.kernels",
    "sim.taichi_internals",
    "ultrasound.probe",
    "ultrasound.target",
}
INTERNALS = "sim/taichi_internals.py"
# What Taichi's documentation has of its modules; render/window.py alone uses ti.ui.
PUBLIC_MODULES = {"taichi", "taichi.math"}
PUBLIC_SUBMODULES = {"math", "profiler", "types", "ui"}
# What of Taichi's objects its documentation does not have, the last names of an expression each.
PRIVATE = {
    *("arr", "prog", "ptr", "mapper", "canvas.canvas", "scene.scene"),
    *("compiled_kernels", "compiling_callable", "current_kernel", "kernel_cpp", "template_slot_locations"),
    *("ast_builder", "compile_kernel", "create_function", "launch_kernel", "make_launch_context"),
    *("materialize", "set_arg_external_array_with_shape", "set_arg_float", "set_arg_int", "set_arg_ndarray"),
    *("_is_wrapped_kernel", "_traced_records", "_update_records"),
}
# Taichi reads its environment when it is imported, which sim/__init__.py must not do.
ENVIRONMENT, BEFORE_IMPORT = ("TI_", "ENABLE_TAICHI_"), "sim/__init__.py"


class Import(NamedTuple):
    """One import, wherever it stands, also within a function: module ``name`` by ``module``."""

    module: str
    name: str
    file: str
    line: int

    def __str__(self) -> str:
        return f"{self.file}:{self.line} imports {self.name}"


def module_of(path: Path) -> str:
    """The name of a file of the project: scenes/patients/readers/ct_series.py ->
    scenes.patients.readers.ct_series.
    """
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


@cache
def modules() -> dict[str, Path]:
    """All of the program, by name."""
    files = (file for layer in LAYERS for file in (ROOT / layer).rglob("*.py"))
    return {module_of(path): path for path in (ROOT / "app.py", *sorted(files))}


def packages() -> dict[str, Path]:
    """The folders of the program, by name."""
    return {module_of(path.parent / "__init__.py"): path.parent for path in modules().values()}


@cache
def nodes() -> list[tuple[str, str, ast.AST]]:
    """All that the program's sources consist of, each with its module and file."""
    return [
        (module, path.relative_to(ROOT).as_posix(), node)
        for module, path in modules().items()
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
    ]


@cache
def imports() -> list[Import]:
    """All imports of the program; ``from a import b`` names a.b where that is a module, else a."""
    found = []
    for module, file, node in nodes():
        if isinstance(node, ast.Import):
            names = [each.name for each in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}:{node.lineno} imports by dots: write the whole name"
            inner = [f"{node.module}.{each.name}" for each in node.names]
            names = [name if name in modules() else str(node.module) for name in inner]
        else:
            continue
        found += [Import(module, name, file, node.lineno) for name in dict.fromkeys(names)]
    return found


def layer_of(name: str) -> str:
    return name.partition(".")[0]


def listed(wrong: list) -> str:
    return "\n" + "\n".join(map(str, wrong))


def test_the_program_is_found():
    assert {layer_of(name) for name in modules()} == set(LAYERS)
    # One that stands in a function.
    assert Import(
        "studies.accuracy.accuracy_commands",
        "studies.accuracy.case_workers",
        "studies/accuracy/accuracy_commands.py",
        0,
    ) in {each._replace(line=0) for each in imports()}
    assert {"taichi.ui.utils", "sim.embedding"} <= {each.name for each in imports()}


def test_every_import_of_the_program_exists():
    # mypy ignores imports that it cannot find, for the libraries' sake.
    known = modules().keys() | packages().keys()
    wrong = [each for each in imports() if layer_of(each.name) in LAYERS and each.name not in known]
    assert not wrong, f"no such module:{listed(wrong)}"


@pytest.mark.parametrize("layer", FORBIDDEN)
def test_imports_go_one_way(layer):
    wrong = [
        each
        for each in imports()
        if layer_of(each.module) == layer and layer_of(each.name) in FORBIDDEN[layer]
    ]
    assert not wrong, f"{layer} must not know {', '.join(sorted(FORBIDDEN[layer]))}:{listed(wrong)}"


def test_the_screen_is_handed_arrays():
    wrong = [
        each
        for each in imports()
        if layer_of(each.module) == "render"
        and layer_of(each.name) in ("sim", "ultrasound")
        and each.name not in KNOWN_TO_RENDER
    ]
    assert not wrong, f"render knows {', '.join(sorted(KNOWN_TO_RENDER))} alone:{listed(wrong)}"


def private_name(node: ast.AST) -> str | None:
    """What a node names of Taichi's internals: a module, an attribute, or a variable of its environment."""
    if isinstance(node, ast.Constant) and str(node.value).startswith(ENVIRONMENT):
        return str(node.value)
    if isinstance(node, ast.ImportFrom) and node.module == "taichi":
        return next((each.name for each in node.names if is_submodule(each.name)), None)
    if not isinstance(node, ast.Attribute):
        return None
    owner = ast.unparse(node.value).rpartition(".")[2].lstrip("_")
    if owner in ("ti", "taichi") and (node.attr.startswith("_") or is_submodule(node.attr)):
        return f"{owner}.{node.attr}"
    return next((name for name in (node.attr, f"{owner}.{node.attr}") if name in PRIVATE), None)


def is_submodule(name: str) -> bool:
    """Whether ``ti`` has a module of a name that its documentation has not."""
    return name not in PUBLIC_SUBMODULES and isinstance(getattr(taichi, name, None), ModuleType)


def test_one_file_knows_the_internals_of_taichi():
    imported = [
        (each.file, each.line, each.name)
        for each in imports()
        if layer_of(each.name) == "taichi" and each.name not in PUBLIC_MODULES
    ]
    used = [(file, getattr(node, "lineno", 0), private_name(node)) for _, file, node in nodes()]
    found = imported + [each for each in used if each[2] is not None]
    known = {name for file, _, name in found if file == INTERNALS}
    assert known >= PRIVATE, f"{INTERNALS} does not use {PRIVATE - known}: what is looked for here is wrong"
    wrong = [
        f"{file}:{line} uses {name}"
        for file, line, name in found
        if file != INTERNALS and not (file == BEFORE_IMPORT and str(name).startswith(ENVIRONMENT))
    ]
    assert not wrong, f"Taichi's internals belong to {INTERNALS}:{listed(wrong)}"


def test_one_file_knows_the_window_library():
    found = [
        f"{file}:{node.lineno} uses {ast.unparse(node)}"
        for _, file, node in nodes()
        if isinstance(node, ast.Attribute) and ast.unparse(node) in ("ti.ui", "taichi.ui")
    ]
    wrong = [each for each in found if not each.startswith("render/window.py:")]
    assert len(wrong) < len(found), "render/window.py does not use ti.ui: what is looked for here is wrong"
    assert not wrong, f"ti.ui belongs to render/window.py:{listed(wrong)}"


def test_no_module_imports_itself_in_a_circle():
    graph: dict[str, set[str]] = {name: set() for name in modules()}
    for each in imports():
        if each.name in graph and each.name != each.module:
            graph[each.module].add(each.name)
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        # graphlib lists a circle from what is imported to what imports it.
        steps = {(name, module) for name, module in pairwise(error.args[1])}
        pytest.fail("modules in a circle:" + listed([e for e in imports() if (e.name, e.module) in steps]))


def test_a_name_with_an_underscore_stays_in_its_module():
    wrong = [
        f"{file}:{node.lineno} imports {each.name}"
        for _, file, node in nodes()
        if isinstance(node, ast.ImportFrom) and layer_of(str(node.module)) in LAYERS
        for each in node.names
        if each.name.startswith("_")
    ]
    # Of attributes those that a class of the program has; a library's may be all there is.
    own = {node.name for _, _, node in nodes() if isinstance(node, ast.FunctionDef)}
    attributes = [(file, node) for _, file, node in nodes() if isinstance(node, ast.Attribute)]
    own |= {
        node.attr
        for _, node in attributes
        if isinstance(node.ctx, ast.Store) and ast.unparse(node.value) == "self"
    }
    wrong += [
        f"{file}:{node.lineno} uses {ast.unparse(node)}"
        for file, node in attributes
        if node.attr in own
        and node.attr.startswith("_")
        and not node.attr.startswith("__")
        and ast.unparse(node.value) not in ("self", "cls")
    ]
    assert not wrong, f"private to another module:{listed(wrong)}"


def test_no_two_public_classes_and_no_two_files_share_a_name():
    classes = [
        (node.name, file)
        for _, file, node in nodes()
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    ]
    named = [(path.name, str(path)) for path in modules().values() if path.name != "__init__.py"]
    for names in (classes, named):
        counted = Counter(name for name, _ in names)
        wrong = [f"{name}: {place}" for name, place in names if counted[name] > 1]
        assert not wrong, f"one name for two things:{listed(wrong)}"
