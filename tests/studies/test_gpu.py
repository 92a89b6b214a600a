"""The study of graphics cards: differences from the processor's results, what is not as asked, and
processes that fail.
"""

import os
import signal

import numpy as np
import pytest

from studies.gpu.backend_runs import run_backend
from studies.gpu.device_cases import CaseFigures
from studies.gpu.gpu_command import differences, faults, row, text_of

MS = dict(mean=2.0, sd=0.0, min=1.5, max=3.0, median=2.0)


def test_differences_are_the_largest_distance_share_of_force_and_grey_level():
    beads, force = np.zeros((2, 3, 3)), np.array([[0.0, 0.0, 1.0], [0.0, -4.0, 3.0]])
    moved = beads.copy()
    moved[1, 2] = 0.02, -0.06, 0.03  # 0.07 mm
    grey, other = np.full((4, 5), 3, np.uint8), np.full((4, 5), 3, np.uint8)
    other[0, 0], other[1, 1], other[2, 2] = 0, 4, 255
    found = dict(beads_mm=moved, force_n=force + [[0.0, 0.1, 0.0], [0.0, 0.0, 0.0]], grey=other)
    apart = differences(found, dict(beads_mm=beads, force_n=force, grey=grey))
    assert apart == pytest.approx(
        dict(beads_apart_mm=0.07, force_apart_percent=2.0, grey_apart=252.0, grey_share_percent=10.0)
    )


def test_what_is_slower_or_farther_than_asked_is_named():
    reference = {"balanced": CaseFigures("balanced", 1.0, MS, {}, dict(beads_mm=np.zeros((1, 1, 3))))}
    slow = CaseFigures("balanced", 1.0, MS, dict(nodes=9), dict(beads_mm=np.array([[[0.0, 0.011, 0.0]]])))
    quick = CaseFigures(
        "balanced", 1.0, MS | dict(median=0.9), {}, dict(beads_mm=np.array([[[0.0, 0.009, 0.0]]]))
    )
    rows = [
        row("cpu", reference["balanced"], reference),
        row("cuda", slow, reference),
        row("vulkan", quick, reference),
    ]
    assert faults(rows) == [
        "cuda, balanced: 2.00 ms; asked: at most 1 ms",
        "cuda, balanced: 0.011 mm from the processor's; asked: at most 0.01",
    ]
    missing = [dict(backend="vulkan", cases=["frame", "Doppler"], why="no driver")]
    text = text_of(dict(rows=rows, cores=2, vulkan_devices=[], not_measured=missing, faults=faults(rows)))
    assert "vulkan, frame, Doppler: no driver" in text and "cuda, balanced: 2.00 ms" in text
    # The processor differs from itself by nothing, which is not printed.
    cpu, cuda, _ = (
        line.split() for line in text.splitlines() if " balanced " in line and "asked" not in line
    )
    assert cpu[2:] == ["2.00", "1.50", "3.00", "1.0"] and cuda[6:] == ["0.0110"]


def _works():
    yield CaseFigures("first", 0.5, MS)
    yield CaseFigures("second", 0.5, MS)


def _fails():
    yield CaseFigures("half", 0.5, MS)
    raise RuntimeError("out of memory\nand more")


def _crashes():
    os.kill(os.getpid(), signal.SIGKILL)
    yield


def _cases(backend):
    return dict(works=_works, fails=_fails, crashes=_crashes, after=_works)


def test_a_fault_and_a_crash_leave_what_was_measured():
    *_, run = run_backend("cpu", 120.0, False, _cases)
    assert [each.case for each in run.measured] == ["first", "second", "half"] and run.ended == 2
    ended = f"the process ended by itself (exit code {-signal.SIGKILL})"
    assert run.missing == dict(fails="RuntimeError: out of memory", crashes=ended, after=ended)


def test_no_case_takes_longer_than_is_left():
    (run,) = run_backend("cpu", 0.0, False, _cases)
    assert not run.measured and set(run.missing.values()) == {"no time left of the 0 s for this backend"}
