"""Points carried by the body through its tissue model: surfaces, fiducials, embedding vertices."""

import numpy as np
import taichi as ti

from sim.fields import fields_of
from sim.tissue_model import TissueModel


@ti.data_oriented
class Skin:
    """Points (n, 3) [mm] attached to a tissue model's frames (the paper's "skinning").

    ``vertices`` (n,) holds where the points are since the last ``update``.
    """

    def __init__(self, model: TissueModel, points: np.ndarray) -> None:
        points = np.asarray(points, np.float64)
        frame, weight = model.attach(points)
        self.model = model
        self.vertices = ti.Vector.field(3, ti.f32, len(points))
        self.rest, self.frame, self.weight = fields_of(points, frame, weight, within=1)
        self.update()

    def update(self) -> None:
        """Carry the points to where the model's frames are now."""
        self.model.carry(self.rest, self.frame, self.weight, self.vertices)
