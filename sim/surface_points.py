"""Points on the surface of a body, each interpolated from the 8 nodes of its element."""

import numpy as np
import taichi as ti
import taichi.math as tm
from scipy.sparse import csr_array

from sim.body import Body
from sim.fields import fields_of, fill, zeros
from sim.lattice import Lattice


class SurfacePoints:
    """Points (p, 3) [mm] at rest, with the area (p,) [mm^2] of the surface around each.

    point (p,): current positions [mm]. node, weight (p,): the 8 nodes of each and their weights. The points
    of node i, and its weights, are the entries node_start[i] to node_start[i + 1] of node_point and
    node_weight. ``whole`` has the points and areas that it was made with.
    """

    def __init__(self, body: Body, lattice: Lattice, points: np.ndarray, area_mm2: np.ndarray) -> None:
        self.body = body
        self.count = len(points)
        self.whole = points, area_mm2
        self.point = zeros(self.count, 3, within=1)
        nodes, weights, *by_node = self._interpolation(lattice, points)
        self.node, self.weight = fields_of(nodes, weights, within=1)
        self.area, self.node_start, self.node_point, self.node_weight = fields_of(area_mm2, *by_node)

    def _interpolation(self, lattice: Lattice, points: np.ndarray) -> tuple[np.ndarray, ...]:
        """Nodes and weights (p, 8) of points; and by node: the first entry (n + 1,), the points and their
        weights (8 p,).
        """
        nodes, weights = lattice.interpolation.attach(points)
        offsets = np.arange(0, nodes.size + 1, nodes.shape[1])
        of_nodes = csr_array(
            (weights.ravel(), nodes.ravel(), offsets), shape=(len(nodes), self.body.count)
        ).T.tocsr()
        return nodes, weights, of_nodes.indptr, of_nodes.indices, of_nodes.data

    def set_points(self, lattice: Lattice, points: np.ndarray, area_mm2: np.ndarray) -> None:
        """Put the points at other places (p, 3) [mm] at rest, with other areas (p,) [mm^2]."""
        fields = self.node, self.weight, self.node_start, self.node_point, self.node_weight
        fill((self.area, area_mm2), *zip(fields, self._interpolation(lattice, points), strict=True))

    @ti.func
    def interpolated(self, field: ti.template(), q):
        """Position of point q for the nodes' positions in a field."""
        x = tm.vec3(0.0)
        for k in ti.static(range(8)):
            x += self.weight[q][k] * field[self.node[q][k]]
        return x
