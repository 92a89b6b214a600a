"""How Taichi is started."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import taichi as ti

import sim.device
from sim.device import NoDevice, start
from sim.taichi_internals import program


def test_the_kernel_cache_has_space_for_many_patients(device, tmp_path):
    assert ti.cfg.offline_cache and ti.cfg.offline_cache_max_size_of_files == sim.device.CACHE_BYTES
    # Taichi removes what is too large: not from the user's folder.
    start("cpu", offline_cache_max_size_of_files=7, offline_cache_file_path=str(tmp_path))
    assert ti.cfg.offline_cache_max_size_of_files == 7


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


def test_a_second_start_keeps_what_is_compiled(device):
    first = program()
    assert start("cpu") == "cpu" and program() is first
    start("cpu", kernel_profiler=True)
    assert program() is not first
