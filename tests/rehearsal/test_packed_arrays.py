"""A rehearsal's state as text, bit for bit, and what a session comes to in figures."""

import base64
import io
import zipfile
from contextlib import suppress
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import pytest
from fake_organ import STEP_S

from rehearsal.loop.state import WholeState
from rehearsal.measurements.session_summary import SessionCourse, summary_text
from rehearsal.pressed_organ import OrganState
from rehearsal.resection.cut import CutSettings
from rehearsal.resection.resection_state import CutRequest, Resection
from rehearsal.sessions import packed_arrays
from rehearsal.sessions.packed_arrays import StateError, pack_state, unpack_state
from sim.body import BodyState
from sim.divergence_check import DivergenceState
from sim.solver import SolverState
from ultrasound.coverage import Gap


def arrays_of(state: Any) -> list[np.ndarray]:
    """All that a state holds, depth first."""
    if isinstance(state, dict):
        return [array for _, each in sorted(state.items()) for array in arrays_of(each)]
    if is_dataclass(state):
        return [array for each in fields(state) for array in arrays_of(getattr(state, each.name))]
    return [np.asarray(state)]


POSITIONS = np.arange(6, dtype=np.float32).reshape(2, 3) / 3


def solver_state(*velocity: list[float]) -> SolverState:
    """Of two points in contact with a plane."""
    friction = np.sin(np.pad(POSITIONS, ((0, 0), (0, 1))))
    return SolverState(BodyState(POSITIONS, np.array(velocity, np.float32)), {"plane": friction})


def state_of(*velocity: list[float]) -> WholeState:
    """A state whose last valid one is another, with a cut."""
    good = solver_state([1 / 3, 0, 0], [0, 1e-45, 0])
    divergence = DivergenceState(good, 5, 3, True, 1 / 3)
    organ = OrganState(solver_state(*velocity), divergence, np.diag([-0.0, 1 / 3, 5e-324, 1.0]), 15)
    cut = CutRequest(CutSettings("wedge", 1 / 3, None, "air"), b"\x05", (POSITIONS / 7).tobytes())
    return WholeState(organ, Resection(((1 / 3, -0.0, 5e-324), (1.0, 2.0, 3.0)), cut))


STATE = state_of([-0.0, 1e-45, -2.5], [3.4e38, 1 / 3, -7])


def test_a_state_as_text_keeps_every_bit():
    pairs = list(zip(arrays_of(STATE), arrays_of(unpack_state(pack_state(STATE), POSITIONS)), strict=True))
    # Now and when last good: position, velocity and contacts; the check's four; pose, steps; marks, and of
    # the cut its four settings, what was seen, and the nodes; no manipulator.
    assert len(pairs) == 2 * 3 + 4 + 2 + 1 + 4 + 2 + 1
    assert all(old.dtype == new.dtype and old.tobytes() == new.tobytes() for old, new in pairs)


def packed(**arrays: np.ndarray) -> str:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return base64.b64encode(file.getvalue()).decode()


def test_what_is_no_state_of_this_body_is_refused(monkeypatch):
    random, text = np.random.default_rng(0), pack_state(WholeState(STATE.organ))
    whole = base64.b64decode(text)
    arrays = dict(np.load(io.BytesIO(whole)))
    hostile = ["", "no state", text[:-40], packed(), packed(**arrays | {"pose": np.full((4, 4), np.nan)})]
    # The internal variables' shapes are those of a tissue model, which a timeline compares.
    for name, array in arrays.items():
        if ".contacts." in name:
            continue
        others = np.array(["a"]), np.array([{}]), np.stack([array, array])
        hostile += [packed(**arrays | {name: other}) for other in others]
        if name != "good.position":  # without it the last valid state is the present one
            hostile.append(packed(**{key: values for key, values in arrays.items() if key != name}))
    huge, npy = io.BytesIO(), io.BytesIO()
    np.lib.format.write_array_header_1_0(npy, dict(descr="<f8", fortran_order=False, shape=(10**15,)))
    with zipfile.ZipFile(huge, "w") as members:
        members.writestr("pose.npy", npy.getvalue())
    for each in [*hostile, base64.b64encode(huge.getvalue()).decode()]:
        with pytest.raises(StateError, match=r"^[^\n]+$"):
            unpack_state(each, POSITIONS)
    for _ in range(300):
        flipped = bytearray(whole)
        flipped[random.integers(len(whole))] ^= 1 << random.integers(8)
        with suppress(StateError):
            assert pack_state(unpack_state(base64.b64encode(flipped).decode(), POSITIONS)) == text
    monkeypatch.setattr(packed_arrays, "MOST_BYTES", 500)
    with pytest.raises(StateError, match="too large"):
        unpack_state(text, POSITIONS)


def test_a_course_counts_presses_ways_and_time_over_the_limit():
    course = SessionCourse(compression_warning_mm=8.0)
    pose = np.eye(4)
    # Squeezed over 1 mm is a press, until it is less than 0.5 mm.
    for compression_mm in (0.0, 1.0, 1.1, 0.6, 1.2, 0.5, 0.9, 1.5, 9.0, 8.0, 8.5):
        course.add(pose, compression_mm, STEP_S, compression_mm / 4)
    assert (course.presses, course.compression_max_mm, course.over_warning_s) == (2, 9.0, 2 * STEP_S)
    assert course.force_max_n == 9.0 / 4
    assert course.path_mm == course.fastest_mm_s == 0.0
    for at_mm in ([3.0, 4.0, 0.0], [3.0, 4.0, 1.0], None, [90.0, 0.0, 0.0], [90.0, 0.0, 2.0]):
        pose[:3, 3] = at_mm or 0.0
        course.add(None if at_mm is None else pose, 0.0, STEP_S)
    # 5 mm, 1 mm, a way back, whose leap is no way of the transducer, 2 mm.
    assert (course.path_mm, course.fastest_mm_s, course.went_back) == (8.0, 5.0 / STEP_S, 1)
    figures = course.summary({"seen_organ": 0.25, "contact_mm2": 3.0}, [Gap(1.5, 2.0), Gap(0.4, 3.0)], 4)
    assert (figures["duration_s"], figures["bookmarks"], figures["seen_organ"]) == (2.0, 4, 0.25)
    assert "contact_mm2" not in figures
    # Of 16 steps of 1/8 s, in two the limit was exceeded.
    assert summary_text(figures).splitlines() == [
        "session     2.0 s, 2 presses, the path of the transducer 8 mm, at most 40 mm/s; 4 bookmarks",
        "compression 9.0 mm at most, also by the organ's own weight; 0.2 s above the limit of 8 mm",
        "force       2.25 N at most on the probe",
        "coverage    of the volume: organ 25 %; the largest region not imaged is 1.5 ml, up to 2.0 mm thick",
    ]
    said = summary_text(figures | dict(presses=1, bookmarks=1))
    # Shape matching has no forces.
    without = SessionCourse(8.0)
    without.add(np.eye(4), 3.0, STEP_S)
    assert "on the probe" not in summary_text(without.summary({}, [], 0))
    assert "1 press," in said and "1 bookmark\n" in said


def test_forces_of_steps_are_kept_as_float32_and_none_where_there_is_none():
    wrench = np.array([0.125, -2.0, 1 / 3, 1e-7, 50.0, -1.0])
    found = packed_arrays.unpack_wrenches(packed_arrays.pack_wrenches([wrench, None]))
    assert (found[0] == wrench.astype(np.float32)).all() and np.isnan(found[1]).all()
    with pytest.raises(ValueError, match="not finite"):
        packed_arrays.unpack_wrenches(packed_arrays.pack_wrenches([wrench / 0.0]))
