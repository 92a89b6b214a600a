"""What the program takes from Taichi's internals: its version, the kernel cache, how kernels are built."""

import os
import subprocess
import sys

import pytest
import taichi as ti
from conftest import ROOT
from taichi.lang import impl

from sim import taichi_internals
from sim.taichi_internals import TEMPORARY, VERSION, kernel_folder


def test_the_installed_version_is_the_one_that_the_internals_are_of():
    named = ".".join(map(str, VERSION))
    assert ti.__version__ == VERSION
    assert f"taichi=={named}\n" in (ROOT / "requirements.txt").read_text("utf-8")
    assert f"internals of Taichi {named}." in str(taichi_internals.__doc__)


def test_a_patch_of_what_is_not_there_is_an_error():
    with pytest.raises(AttributeError, match="is_gone"):
        taichi_internals._patch(impl, "is_gone", None)


def test_the_kernel_cache_is_not_in_the_folder_of_other_programs(monkeypatch):
    monkeypatch.delenv("TI_OFFLINE_CACHE_FILE_PATH", raising=False)
    # Taichi's own default is elsewhere, until it starts.
    assert kernel_folder().name == "nephron"


@pytest.mark.parametrize("name", ["a file in the way", "new"])
def test_the_kernel_cache_is_in_a_writable_folder(tmp_path, name):
    (tmp_path / "a file in the way").write_text("")
    program = (
        "import sim.device, taichi as ti; sim.device.start(); "
        "print(ti.cfg.offline_cache_file_path); ti.field(int, 3).fill(1)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=os.environ | {"TI_OFFLINE_CACHE_FILE_PATH": str(tmp_path / name)},
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    kept = tmp_path / name if name == "new" else TEMPORARY
    # With a folder that is not writable Taichi would crash at the end.
    assert (done.returncode, done.stdout) == (0, f"{kept}\n"), done.stderr


def test_a_field_is_made_without_formatting_the_call_stack(device, monkeypatch):
    def written(*_):
        raise AssertionError("the stack was written down")

    monkeypatch.setattr("traceback.format_list", written)
    ti.field(int, 3).fill(1)
    ti.Vector.field(3, float, 3).fill(1)


def test_an_error_in_a_kernel_names_file_line_and_function(device):
    @ti.func
    def inner(value):
        return value + not_defined_anywhere  # noqa: F821

    @ti.kernel
    def outer() -> int:
        total = 0

        total += inner(1)
        return total

    for _ in range(2):
        with pytest.raises(ti.TaichiCompilationError, match="not_defined_anywhere") as error:
            outer()
        message = str(error.value)
        line = inner.func.func.__code__.co_firstlineno + 2
        assert f'"{__file__}", line {line}, in inner:' in message and "return value + not_defined" in message
        assert f"line {outer._primal.func.__code__.co_firstlineno + 4}, in outer:" in message


def test_a_decorator_reads_no_source_file(device, monkeypatch):
    def read(*_):
        raise AssertionError("a source file was read")

    monkeypatch.setattr("inspect.getframeinfo", read)

    class Owner:
        @ti.func
        def inner(self):
            return 1

    @ti.func
    def outside():
        return 1

    assert Owner.inner.func.classfunc and not outside.func.classfunc
