"""Images of other kinds are prepared while the transducer stands still, each once."""

import numpy as np
import pytest

from rehearsal import image_preparation
from rehearsal.image_preparation import STILL_S, ImagePreparation
from rehearsal.live_settings import LiveSettings
from settings import with_values
from ultrasound.probe import DETAIL_LEVELS, load_probe

SETTINGS = with_values(LiveSettings(probe=load_probe("drop-in")), {"image.mode": "both"})


@pytest.fixture
def clock(monkeypatch):
    """The time [s], in a list of one."""
    now_s = [100.0]
    monkeypatch.setattr(image_preparation, "perf_counter", lambda: now_s[0])
    return now_s


def prepared(preparation: ImagePreparation, pose: np.ndarray) -> list[tuple[str, str]]:
    """Detail level and Doppler of all that are prepared at a pose."""
    kinds = []
    while (other := preparation.next(SETTINGS, pose)) is not None:
        preparation.note(other)
        kinds.append((other.image.detail_level, other.scanner.doppler))
    return kinds


def test_every_kind_that_one_key_shows_is_prepared_once(clock):
    preparation, pose = ImagePreparation(), np.eye(4)
    preparation.note(SETTINGS)
    assert prepared(preparation, pose) == []
    clock[0] += STILL_S
    level = SETTINGS.image.detail_level
    others = [(other, "off") for other in DETAIL_LEVELS if other != level]
    assert prepared(preparation, pose) == [*others, (level, "colour"), (level, "power")]
    assert prepared(preparation, pose) == []
    for values in (
        {"image.mode": "ct"},
        {"image.detail_level": others[0][0], "scanner.doppler": "power"},
        {"image.mode": "b-mode", "scanner.doppler": "colour"},
    ):
        assert not preparation.is_new(with_values(SETTINGS, values))
    assert preparation.is_new(with_values(SETTINGS, {"probe.compound_angles": 3}))


def test_nothing_is_prepared_while_the_transducer_moves(clock):
    preparation, pose = ImagePreparation(), np.eye(4)
    preparation.next(SETTINGS, pose)
    for _ in range(5):
        clock[0] += 0.9 * STILL_S
        pose = pose.copy()
        pose[0, 3] += 0.1
        assert preparation.next(SETTINGS, pose) is None
    clock[0] += STILL_S
    assert preparation.next(SETTINGS, pose) is not None
