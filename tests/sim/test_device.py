"""How Taichi is started, and its error messages for a wrong kernel."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import taichi as ti
from taichi.lang import impl
from taichi.lang.impl import default_cfg

import sim.device
from sim.device import NoDevice, start


def test_the_kernel_cache_has_space_for_many_patients(device, tmp_path):
    assert ti.cfg.offline_cache and ti.cfg.offline_cache_max_size_of_files == sim.device.CACHE_BYTES
    # Taichi removes what is too large: not from the user's folder.
    start("cpu", offline_cache_max_size_of_files=7, offline_cache_file_path=str(tmp_path))
    assert ti.cfg.offline_cache_max_size_of_files == 7


def test_the_kernel_cache_is_not_in_the_folder_of_other_programs(monkeypatch):
    monkeypatch.delenv("TI_OFFLINE_CACHE_FILE_PATH", raising=False)
    assert sim.device._kernel_folder() != Path(default_cfg().offline_cache_file_path)


@pytest.mark.parametrize("name", ["a file in the way", "new"])
def test_the_kernel_cache_is_in_a_writable_folder(tmp_path, name):
    (tmp_path / "a file in the way").write_text("")
    program = "import sim.device, taichi as ti; sim.device.start(); print(ti.cfg.offline_cache_file_path); ti.field(int, 3).fill(1)"
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=os.environ | {"TI_OFFLINE_CACHE_FILE_PATH": str(tmp_path / name)},
        cwd=Path(sim.device.__file__).parents[1],
        capture_output=True,
        text=True,
    )
    kept = tmp_path / name if name == "new" else sim.device.TEMPORARY
    # With a folder that is not writable Taichi would crash at the end.
    assert (done.returncode, done.stdout) == (0, f"{kept}\n"), done.stderr


def test_without_a_home_taichi_starts():
    without = {name: value for name, value in os.environ.items() if name != "HOME"}
    done = subprocess.run(
        [sys.executable, "-c", "import sim, taichi"], env=without, cwd=Path(sim.device.__file__).parents[1]
    )
    assert done.returncode == 0


def test_a_missing_driver_gives_one_error_and_no_output():
    program = "import sim.device; sim.device.start('vulkan')"
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=os.environ | {"VK_DRIVER_FILES": "/nonexistent", "VK_ICD_FILENAMES": "/nonexistent"},
        cwd=Path(sim.device.__file__).parents[1],
        capture_output=True,
        text=True,
    )
    *above, last = done.stderr.splitlines()
    assert "no vulkan device or driver; use --arch cpu" in last and not any("RHI" in line for line in above)


def test_a_driver_with_wrong_results_is_refused(device, monkeypatch):
    assert sim.device.counts_correctly()
    monkeypatch.setattr("sim.device._count", lambda count, least: None)
    assert not sim.device.counts_correctly()
    # Without any driver the error is another one.
    with pytest.raises(NoDevice, match="gives wrong results|no vulkan device"):
        start("vulkan")


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
        told = str(error.value)
        line = inner.func.func.__code__.co_firstlineno + 2
        assert f'"{__file__}", line {line}, in inner:' in told and "return value + not_defined" in told
        assert f"line {outer._primal.func.__code__.co_firstlineno + 4}, in outer:" in told


def test_a_second_start_keeps_what_is_compiled(device):
    program = impl.get_runtime().prog
    assert start("cpu") == "cpu" and impl.get_runtime().prog is program
    start("cpu", kernel_profiler=True)
    assert impl.get_runtime().prog is not program
