"""The progress of a start, in terminal and window."""

import pytest

from rehearsal import start_progress
from rehearsal.real_time.start_times import StartTimes
from rehearsal.start_progress import ANATOMY, AT_REST, STAGES, TISSUE, StartProgress


class FakeWindow:
    def __init__(self) -> None:
        self.shown: list[tuple[str, float]] = []

    def show_progress(self, text: str, share: float) -> None:
        self.shown.append((text, share))


def test_what_is_done_and_what_remains_is_shown_while_a_stage_lasts(monkeypatch):
    now_s = [50.0]
    monkeypatch.setattr(start_progress, "perf_counter", lambda: now_s[0])
    window, lines = FakeWindow(), list[str]()
    progress = StartProgress(StartTimes(), lines.append)
    # Before there is a window.
    progress(ANATOMY)
    progress.viewer = window
    progress("Making the embedded patient, only once: its CT")
    progress(TISSUE)
    now_s[0] += 3.4
    progress.wait()
    progress(AT_REST)
    assert lines == [ANATOMY, "Making the embedded patient, only once: its CT", TISSUE, AT_REST]
    count = len(STAGES)
    assert window.shown == [
        (f"1 of {count}   Making the embedded patient, only once: its CT", 0.0),
        (f"2 of {count}   {TISSUE}", pytest.approx(1 / count)),
        (f"2 of {count}   {TISSUE}, 3 s", pytest.approx(1 / count)),
        (f"{count} of {count}   {AT_REST}", pytest.approx((count - 1) / count)),
    ]
