"""Spatial compounding: the mean of B-mode images that are steered by different angles."""

from collections.abc import Callable

import numpy as np

from ultrasound.bmode import BMode
from ultrasound.probe import DetailLevel, Probe


class Compounding:
    """The B-mode image ``straight`` and, for each further angle of a probe, one of ``make_steered``.

    ``steered`` are those of the last image. They are memory alone: an image depends on none before it.
    """

    def __init__(self, straight: BMode, make_steered: Callable[[], BMode]) -> None:
        self.straight, self._make_steered = straight, make_steered
        self.steered: dict[float, BMode] = {}

    def render(self, probe: Probe, detail_level: DetailLevel) -> np.ndarray:
        """The mean (rows, columns) uint8 of all angles, where these reach, of the plane located."""
        angles = probe.compound_angles_deg[1:]
        self.steered = {angle: self.steered.get(angle) or self._make_steered() for angle in angles}
        first = self.straight.render(probe, detail_level)
        if not angles:
            return first
        total, count = first.astype(np.float32), np.ones(first.shape, np.float32)
        for angle, image in self.steered.items():
            total += image.render(probe.model_copy(update={"steering_deg": angle}), detail_level)
            count += image.covered
        # The image is as wide as without compounding.
        return np.where(self.straight.covered, np.rint(total / count), 0).astype(np.uint8)
