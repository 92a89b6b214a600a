"""The key to quit asks once after an action, and where a cut was made."""

from dataclasses import replace

import pytest
from fake_organ import fake_timeline

from rehearsal import quit_check
from rehearsal.notices import Notices
from rehearsal.quit_check import QuitCheck
from rehearsal.resection.resection_state import NO_RESECTION, Attempt

FRAME = fake_timeline().newest()
CUT = replace(FRAME, attempts=(Attempt(1, 7, NO_RESECTION),))


@pytest.mark.parametrize(
    ("frame", "acted_at", "reason"),
    [
        (FRAME, 95.0, "the last action is less than 10 s old"),
        (CUT, 95.0, "this session has 1 cut"),
        (CUT, 20.0, "this session has 1 cut"),
        (FRAME, 89.0, None),
        (FRAME, None, None),
        # That of a replay.
        (CUT, None, None),
    ],
)
def test_it_asks_once_and_the_second_press_within_five_seconds_quits(monkeypatch, frame, acted_at, reason):
    now = [100.0]
    monkeypatch.setattr(quit_check, "perf_counter", lambda: now[0])
    notices = Notices()
    check = QuitCheck(notices, lambda: acted_at and acted_at + now[0] - 100)
    assert check.quits(frame) is (reason is None)
    assert notices.present() == ([] if reason is None else [f"{{quit}} again quits; {reason}"])
    if reason is None:
        return
    now[0] += 5.1
    assert not check.quits(frame)
    now[0] += 4.9
    assert check.quits(frame)
