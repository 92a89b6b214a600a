"""Skinning: points that move with a tissue, such as surfaces, beads and the vertices of the embedding.

An ``Interpolation`` is a value: it says which carriers a point at rest is attached to, by which weights. A
``Carrier`` has their present positions in fields; it needs no solver, so that a process that only draws can
have one too.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import taichi as ti
import taichi.math as tm
from scipy.spatial import cKDTree

from sim.fields import Field, array_of, field_of, fields_of, fill
from sim.kernels import kernel
from sim.linear_algebra import row

# A point is interpolated from this many clusters at most.
MOST_CLUSTERS = 4
# Keeps the weight of a point at a cluster's origin finite.
LEAST_SQUARED_MM2 = 1e-6


class Interpolation(Protocol):
    """What points of a tissue are attached to, at rest. It can be sent to another process."""

    def attach(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Carriers (n, k) and weights (n, k) of rest points (n, 3) [mm]."""
        ...

    def carrier(self) -> "Carrier":
        """A carrier with fields of its own, at rest."""
        ...


class Carrier(Protocol):
    """The fields by which attached points move: a tissue model's own, or copies of them."""

    interpolation: Interpolation

    def values(self) -> np.ndarray:
        """A copy of what moves: positions of nodes (n, 3) [mm], or frames of clusters (k, 4, 4)."""
        ...

    def move(self, values: np.ndarray) -> None:
        """Take over what ``values`` has returned elsewhere."""
        ...

    def carried(self, point: ti.Vector, frame: ti.Vector, weight: ti.Vector) -> ti.Vector:
        """The present position (3,) [mm] of an attached point, from its rest position, carriers (k,) and
        weights (k,); a ti.func.
        """
        ...


class NodeCarrier:
    """Nodes of a lattice, by whose weighted displacements points move; ``position`` and ``rest`` are
    fields (n,).
    """

    def __init__(self, interpolation: Interpolation, position: Field, rest: Field) -> None:
        self.interpolation, self.position, self.rest = interpolation, position, rest

    def values(self) -> np.ndarray:
        """As ``Carrier.values``."""
        return array_of(self.position)

    def move(self, values: np.ndarray) -> None:
        """As ``Carrier.move``."""
        fill((self.position, values))

    @ti.func
    def carried(self, point, frame, weight):
        """As ``Carrier.carried``."""
        x = point
        for k in ti.static(range(frame.n)):
            x += weight[k] * (self.position[frame[k]] - self.rest[frame[k]])
        return x


class ClusterCarrier:
    """Clusters of particles, by whose weighted frames points move (weighted matrix blending); ``frame`` (k,)
    has the columns of rotation and translation as its rows.
    """

    def __init__(self, interpolation: Interpolation, frame: Field) -> None:
        self.interpolation, self.frame = interpolation, frame

    def values(self) -> np.ndarray:
        """As ``Carrier.values``."""
        return array_of(self.frame)

    def move(self, values: np.ndarray) -> None:
        """As ``Carrier.move``."""
        fill((self.frame, values))

    @ti.func
    def carried(self, point, frame, weight):
        """As ``Carrier.carried``."""
        x = tm.vec4(0.0)
        for k in ti.static(range(frame.n)):
            moved = self.frame[frame[k]]
            for axis in ti.static(range(3)):
                x += weight[k] * point[axis] * row(moved, axis)
            x += weight[k] * row(moved, 3)
        return x.xyz


@dataclass(frozen=True)
class ClusterInterpolation:
    """Points between clusters with these centres (k, 3) at rest [mm] (Kavan 2014)."""

    centres: np.ndarray

    def attach(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The up to four nearest clusters of points (n, 3) [mm], and their weights.

        Weights are proportional to the inverse squared distance from the cluster's origin, and sum to 1.
        """
        frames = min(MOST_CLUSTERS, len(self.centres))
        distance, nearest = cKDTree(self.centres).query(points, list(range(1, frames + 1)))
        weight = 1.0 / (distance**2 + LEAST_SQUARED_MM2)
        return nearest, weight / weight.sum(axis=1, keepdims=True)

    def carrier(self) -> ClusterCarrier:
        """As ``Interpolation.carrier``."""
        at_rest = np.broadcast_to(np.eye(4, dtype=np.float32), (len(self.centres), 4, 4))
        return ClusterCarrier(self, field_of(at_rest, 2))


class Skin:
    """Points (n, 3) [mm] attached to a carrier (the paper's "skinning").

    They move as the tissue at ``at`` (n, 3) does, by default the tissue where they are. ``vertices`` (n,):
    positions [mm] at the last ``update``.
    """

    def __init__(self, carrier: Carrier, points: np.ndarray, at: np.ndarray | None = None) -> None:
        points = np.asarray(points, np.float64)
        self.at = points if at is None else np.asarray(at, np.float64)
        frame, weight = carrier.interpolation.attach(self.at)
        self.carrier = carrier
        self.count = len(points)
        arrays = points, points, frame, weight
        self.vertices, self.rest, self.frame, self.weight = fields_of(*arrays, within=1)
        self.update()

    def attach_again(self) -> None:
        """Attach the points anew, after the carrier has got another interpolation."""
        frame, weight = self.carrier.interpolation.attach(self.at)
        fill((self.frame, frame), (self.weight, weight))

    def update(self) -> None:
        """Move the points with the carrier's present values."""
        self._carry()

    @kernel
    def _carry(self):
        for v in range(self.count):
            self.vertices[v] = self.carrier.carried(self.rest[v], self.frame[v], self.weight[v])
