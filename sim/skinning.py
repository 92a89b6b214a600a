"""Points carried by the body through weighted matrix blending: surfaces, fiducials, embedding vertices."""

import numpy as np
import taichi as ti
from scipy.spatial import cKDTree

MOST_FRAMES = 4
# Keeps the weight of a point on a cluster's very origin finite.
LEAST_SQUARED_MM2 = 1e-6


@ti.data_oriented
class Skin:
    """Points (n, 3) [mm] attached to up to four nearest cluster frames (Kavan 2014; the paper's "skinning").

    Weights fall off with the inverse square of the distance from point to cluster origin and sum to 1.
    ``vertices`` (n,) holds where the points are since the last ``update``.
    """

    def __init__(self, model, points: np.ndarray) -> None:
        points = np.asarray(points, np.float64)
        frames = min(MOST_FRAMES, len(model.rest_centres))
        distance, nearest = cKDTree(model.rest_centres).query(points, list(range(1, frames + 1)))
        weight = 1.0 / (distance**2 + LEAST_SQUARED_MM2)
        weight /= weight.sum(axis=1, keepdims=True)
        self.model = model
        self.rest = ti.Vector.field(3, ti.f32, len(points))
        self.vertices = ti.Vector.field(3, ti.f32, len(points))
        self.frame = ti.Vector.field(frames, ti.i32, len(points))
        self.weight = ti.Vector.field(frames, ti.f32, len(points))
        self.rest.from_numpy(points.astype(np.float32))
        self.frame.from_numpy(nearest.astype(np.int32))
        self.weight.from_numpy(weight.astype(np.float32))
        self.update()

    def update(self) -> None:
        """Carry the points to where the model's frames are now."""
        self.model.carry(self.rest, self.frame, self.weight, self.vertices)
