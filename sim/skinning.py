"""Skinning: points that move with a tissue model, such as surfaces, beads and the vertices of the embedding."""

import numpy as np
import taichi as ti

from sim.fields import fields_of
from sim.tissue_model import TissueModel


@ti.data_oriented
class Skin:
    """Points (n, 3) [mm] attached to a tissue model's frames (the paper's "skinning").

    ``vertices`` (n,): positions [mm] at the last ``update``.
    """

    def __init__(self, model: TissueModel, points: np.ndarray) -> None:
        points = np.asarray(points, np.float64)
        frame, weight = model.attach(points)
        self.model = model
        self.vertices = ti.Vector.field(3, ti.f32, len(points))
        self.rest, self.frame, self.weight = fields_of(points, frame, weight, within=1)
        self.update()

    def update(self) -> None:
        """Move the points with the model's current frames."""
        self.model.carry(self.rest, self.frame, self.weight, self.vertices)
