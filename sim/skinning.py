"""Skinning: points that move with a tissue model, such as surfaces, beads and the vertices of the embedding."""

import numpy as np
import taichi as ti
import taichi.math as tm

from sim.fields import fields_of, fill, run_kernel
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
        given = points, points, frame, weight
        self.vertices, self.rest, self.frame, self.weight = fields_of(*given, within=1)
        self.update()

    def attach_again(self) -> None:
        """Attach the points anew, after tissue was removed from the model or restored."""
        frame, weight = self.model.attach(self.at)
        fill((self.frame, frame), (self.weight, weight))

    def update(self) -> None:
        """Move the points with the model's current frames."""
        fields = self.rest, self.frame, self.weight, self.vertices
        run_kernel(_carry_in_memory, _carry_in_fields, fields, self.model, self.frame.n)


@ti.kernel
def _carry_in_memory(
    rest: ti.types.ndarray(ti.f32, ndim=2),
    frame: ti.types.ndarray(ti.i32, ndim=2),
    weight: ti.types.ndarray(ti.f32, ndim=2),
    out: ti.types.ndarray(ti.f32, ndim=2),
    model: ti.template(),
    frames: ti.template(),
):
    for v in range(rest.shape[0]):
        at = tm.vec3(rest[v, 0], rest[v, 1], rest[v, 2])
        own = ti.Vector([frame[v, k] for k in ti.static(range(frames))])
        share = ti.Vector([weight[v, k] for k in ti.static(range(frames))])
        carried = model.carried(at, own, share)
        for axis in ti.static(range(3)):
            out[v, axis] = carried[axis]


@ti.kernel
def _carry_in_fields(
    rest: ti.template(),
    frame: ti.template(),
    weight: ti.template(),
    out: ti.template(),
    model: ti.template(),
    frames: ti.template(),
):
    for v in rest:
        out[v] = model.carried(rest[v], frame[v], weight[v])
