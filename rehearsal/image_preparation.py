"""Images of other kinds are prepared while nothing moves.

The first image of a kind loads or compiles its kernels, for half a second or more, in which the window would
stand still just when the user asks for that kind.
"""

from collections.abc import Iterator
from time import perf_counter

import numpy as np

from rehearsal.live_settings import LiveSettings
from settings import with_values
from ultrasound.probe import DETAIL_LEVELS

# How long the transducer has stood still before an image is prepared.
STILL_S = 1.0

Kind = tuple[str | bool, ...]


class ImagePreparation:
    """The kinds of image that were made by now, and whether the transducer stands still."""

    def __init__(self) -> None:
        self._made: set[Kind] = set()
        self._pose = np.zeros((4, 4))
        self._moved_at_s = perf_counter()

    def is_new(self, settings: LiveSettings) -> bool:
        """Whether an image with these settings would be the first of its kind."""
        return not kinds_of(settings) <= self._made

    def note(self, settings: LiveSettings) -> None:
        """An image with these settings was made."""
        self._made |= kinds_of(settings)

    def next(self, settings: LiveSettings, pose: np.ndarray) -> LiveSettings | None:
        """The settings of an image to be prepared now, with the transducer at a pose (4, 4); None while it
        moves, or where every kind that is one key away was made.
        """
        now_s = perf_counter()
        if not np.array_equal(pose, self._pose):
            self._pose, self._moved_at_s = pose, now_s
        if now_s - self._moved_at_s < STILL_S:
            return None
        return next(filter(self.is_new, one_key_away(settings)), None)


def kinds_of(settings: LiveSettings) -> set[Kind]:
    """The kinds of kernels that an image with these settings needs."""
    probe, mode, doppler = settings.probe, settings.image.mode, settings.scanner.doppler
    kinds = set[Kind]()
    if mode != "b-mode":
        kinds.add(("ct",))
    if mode != "ct":
        kinds.add(("b-mode", settings.image.detail_level, probe.compound_angles > 1))
        if doppler != "off":
            kinds.add(("doppler", doppler, probe.colour_steering_deg != 0))
    return kinds


def one_key_away(settings: LiveSettings) -> Iterator[LiveSettings]:
    """The settings after the keys of mode, detail level and Doppler.

    Compounded images and steered Doppler, which a slider sets, would take memory that is rarely needed.
    """
    with_both = with_values(settings, {"image.mode": "both", "scanner.doppler": "off"})
    for level in DETAIL_LEVELS:
        yield with_values(with_both, {"image.detail_level": level})
    for doppler in ("colour", "power"):
        yield with_values(with_both, {"scanner.doppler": doppler})
