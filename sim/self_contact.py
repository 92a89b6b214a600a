"""Self-contact: contacts between particles that share no cluster, found in a hashed grid, with friction."""

import taichi as ti
import taichi.math as tm

from sim.fields import field_of, zeros
from sim.friction import sticking_fraction, tangential
from sim.shape_matching import ShapeMatching

MOST_NEIGHBOURS = 24
CELLS = 1 << 15


class SelfContacts:
    """Keeps pairs of particles that share no cluster at least one particle radius apart, their distance in
    the sampling.

    Cells of a hashed grid have lists of particles. The neighbours of each particle are sorted, so that sums
    do not depend on the order in which threads filled a list.
    """

    def __init__(self, model: ShapeMatching, friction: float) -> None:
        self.body = body = model.body
        self.model = model
        self.relax_globally = model.relaxation == "global"
        self.friction, self.has_friction = friction, friction > 0
        self.distance = body.radius_mm
        # Particles approach each other during the substep, so some are listed before they touch.
        self.reach = 1.5 * self.distance
        self.patch = field_of(model.patches.of_particles())
        self.cell_start = zeros(CELLS + 1, kind=ti.i32)
        self.cell_count = zeros(CELLS, kind=ti.i32)
        self.sorted = zeros(body.count, kind=ti.i32)
        self.neighbour = zeros(body.count, MOST_NEIGHBOURS, kind=ti.i32)
        self.neighbour_count = zeros(body.count, kind=ti.i32)
        self.change = zeros(body.count, 3, within=1)
        self.most_contacts = zeros(kind=ti.i32)

    @ti.func
    def cell_of(self, p):
        """The cell (3,) of the unbounded grid that contains p."""
        return ti.cast(ti.floor(p / self.reach), ti.i32)

    @ti.func
    def hash(self, cell):
        """The list, of CELLS, that a cell's particles are in (Teschner et al. 2003)."""
        mixed = (cell.x * 73856093) ^ (cell.y * 19349663) ^ (cell.z * 83492791)
        return mixed & (CELLS - 1)

    @ti.func
    def share_cluster(self, i, j):
        """Whether two particles have a cluster in common; both rows of clusters ascend."""
        p, q = self.patch[i], self.patch[j]
        a, b = self.model.cluster_start[p], self.model.cluster_start[q]
        is_shared = 0
        while a < self.model.cluster_start[p + 1] and b < self.model.cluster_start[q + 1] and is_shared == 0:
            ca, cb = self.model.cluster_list[a], self.model.cluster_list[b]
            if ca == cb:
                is_shared = 1
            elif ca < cb:
                a += 1
            else:
                b += 1
        return is_shared

    @ti.func
    def find(self):
        """Line 7: the sorted neighbours of every particle, at the predicted positions."""
        for c in range(CELLS):
            self.cell_count[c] = 0
        for i in range(self.body.count):
            self.cell_count[self.hash(self.cell_of(self.body.predicted[i]))] += 1
        for _ in range(1):
            total = 0
            for c in range(CELLS):
                self.cell_start[c] = total
                total += self.cell_count[c]
                self.cell_count[c] = 0
            self.cell_start[CELLS] = total
        for i in range(self.body.count):
            c = self.hash(self.cell_of(self.body.predicted[i]))
            self.sorted[self.cell_start[c] + ti.atomic_add(self.cell_count[c], 1)] = i
        for i in range(self.body.count):
            self.neighbour_count[i] = self.list_neighbours(i)

    @ti.func
    def list_neighbours(self, i):
        """Write the neighbours of particle i; return their number."""
        p = self.body.predicted[i]
        count = 0
        for near in ti.grouped(ti.ndrange((-1, 2), (-1, 2), (-1, 2))):
            cell = self.cell_of(p) + near
            c = self.hash(cell)
            for k in range(self.cell_start[c], self.cell_start[c + 1]):
                j = self.sorted[k]
                q = self.body.predicted[j]
                # Two cells of the neighbourhood may have the same hash: a particle counts only in its own
                # cell.
                if j != i and (self.cell_of(q) == cell).all() and (p - q).norm() < self.reach:
                    if self.share_cluster(i, j) == 0:
                        count = self.insert(i, j, count)
        return count

    @ti.func
    def insert(self, i, j, count):
        """Insert j into the ascending row of particle i; a full row drops the highest index."""
        slot = count
        if count == MOST_NEIGHBOURS:
            slot = -1
            if j < self.neighbour[i, MOST_NEIGHBOURS - 1]:
                slot = MOST_NEIGHBOURS - 1
        if slot >= 0:
            while slot > 0 and self.neighbour[i, ti.max(slot - 1, 0)] > j:
                self.neighbour[i, slot] = self.neighbour[i, slot - 1]
                slot -= 1
            self.neighbour[i, slot] = j
        return ti.min(count + 1, MOST_NEIGHBOURS)

    @ti.func
    def project(self, relaxation_factor: float):
        """Lines 18-20 for pairs of particles: C = distance - |x_i - x_j| <= 0 and its friction, gathered."""
        self.most_contacts[None] = 0
        for i in range(self.body.count):
            x = self.body.predicted[i]
            moved = x - self.body.position[i]
            change, contacts = tm.vec3(0.0), 0
            for k in range(self.neighbour_count[i]):
                j = self.neighbour[i, k]
                away = x - self.body.predicted[j]
                gap = away.norm()
                if gap < self.distance:
                    normal = self.direction(i, j, away, gap)
                    weight = 0.5
                    if ti.static(self.body.mass_scaled):
                        weight = self.body.mass_scale[j] / (self.body.mass_scale[i] + self.body.mass_scale[j])
                    depth = self.distance - gap
                    change += weight * depth * normal
                    if ti.static(self.has_friction):
                        slip = tangential(moved - (self.body.predicted[j] - self.body.position[j]), normal)
                        factor = sticking_fraction(slip, self.friction * depth)
                        change -= weight * factor * slip
                    contacts += 1
            if contacts > 0:
                ti.atomic_max(self.most_contacts[None], contacts)
                if ti.static(not self.relax_globally):
                    change /= ti.cast(contacts, ti.f32)
            self.change[i] = relaxation_factor * change
        for i in range(self.body.count):
            if ti.static(self.relax_globally):
                self.body.predicted[i] += self.change[i] / ti.cast(
                    ti.max(self.most_contacts[None], 1), ti.f32
                )
            else:
                self.body.predicted[i] += self.change[i]

    @ti.func
    def direction(self, i, j, away, gap):
        """Unit vector from j to i; of two particles at the same point the one with the higher index moves
        up.
        """
        normal = tm.vec3(0.0, 0.0, 1.0 if i > j else -1.0)
        if gap > 1e-6:
            normal = away / gap
        return normal
