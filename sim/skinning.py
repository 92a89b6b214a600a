"""Skinning: points that move with a tissue model, such as surfaces, beads and the vertices of the embedding."""

import numpy as np

from sim.fields import fields_of, fill
from sim.kernels import kernel
from sim.tissue_model import TissueModel


class Skin:
    """Points (n, 3) [mm] attached to a tissue model's frames (the paper's "skinning").

    They move as the tissue at ``at`` (n, 3) does, by default the tissue where they are. ``vertices`` (n,): positions [mm] at
    the last ``update``.
    """

    def __init__(self, model: TissueModel, points: np.ndarray, at: np.ndarray | None = None) -> None:
        points = np.asarray(points, np.float64)
        self.at = points if at is None else np.asarray(at, np.float64)
        frame, weight = model.attach(self.at)
        self.model = model
        self.count = len(points)
        given = points, points, frame, weight
        self.vertices, self.rest, self.frame, self.weight = fields_of(*given, within=1)
        self.update()

    def attach_again(self) -> None:
        """Attach the points anew, after tissue was removed from the model or restored."""
        frame, weight = self.model.attach(self.at)
        fill((self.frame, frame), (self.weight, weight))

    def update(self) -> None:
        """Move the points with the model's current frames."""
        self._carry()

    @kernel
    def _carry(self):
        for v in range(self.count):
            self.vertices[v] = self.model.carried(self.rest[v], self.frame[v], self.weight[v])
