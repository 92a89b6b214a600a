"""Lattice tissue as tests build and step it, and its energy in NumPy float64."""

import numpy as np
import trimesh

from sim.body import Body, BodyState
from sim.fields import array_of
from sim.lattice import Lattice, fill_with_cells, surface_points
from sim.material import Material
from sim.neo_hookean import HOURGLASS_STIFFNESS, LATTICE_SETTINGS, LEAST_J, NeoHookean
from sim.penetration_barrier import BARRIER_SPACING_MM, PenetrationBarrier
from sim.shapes import ConvexTool
from sim.solver import Solver, StepSettings
from sim.surface_contact import SurfaceContacts

YOUNG_KPA = 15.0
DENSITY = 1.05e-3
G = 9810.0


def settings_of(iterations: int, gravity=(0.0, 0.0, 0.0), **changed) -> StepSettings:
    return StepSettings(
        **{**vars(LATTICE_SETTINGS), "iterations": iterations, "gravity": tuple(gravity), **changed}
    )


def tissue_of(
    mesh: trimesh.Trimesh,
    cell_mm: float,
    shapes: list = (),
    friction: float = 0.0,
    poisson: float = 0.45,
    fixed=None,
    barrier: bool = False,
) -> Solver:
    """A solver of a closed surface [mm] among shapes; ``fixed`` takes nodes (n, 3) and returns the mask of
    the fixed ones. With a ``barrier`` between the contact points.
    """
    lattice = fill_with_cells(mesh, cell_mm)
    body = Body(lattice.nodes)
    contacts = None
    if shapes:
        points, area = surface_points(mesh, cell_mm / 2)
        tools, between = [shape for shape in shapes if shape.moves], None
        if barrier:
            at = surface_points(mesh, BARRIER_SPACING_MM)
            between = PenetrationBarrier(body, lattice, *at, tools)
        contacts = SurfaceContacts(body, lattice, points, area, shapes, friction, barrier=between)
    fixed = None if fixed is None else fixed(lattice.nodes)
    model = NeoHookean(body, lattice, contacts, Material(YOUNG_KPA, poisson, 1e3 * DENSITY), fixed=fixed)
    return Solver(model, tool=next((s for s in shapes if isinstance(s, ConvexTool)), None))


def put(model: NeoHookean, x: np.ndarray) -> None:
    """The body at rest at positions x."""
    model.body.restore(BodyState(x.astype(np.float32), np.zeros(x.shape, np.float32)))


def position(solver: Solver) -> np.ndarray:
    return array_of(solver.body.position).astype(np.float64)


def lifted(z: float) -> np.ndarray:
    """Pose of a tool at a height [mm]."""
    pose = np.eye(4)
    pose[2, 3] = z
    return pose


def jacobians(lattice: Lattice, x: np.ndarray) -> np.ndarray:
    """Volume ratio of every cell."""
    return np.linalg.det(np.einsum("mia,mib->mab", x[lattice.cells], lattice.gradient))


def lame_parameters(poisson: float) -> tuple[float, float]:
    """Shear modulus and Lame's first parameter [g/(mm s^2)]."""
    return 1e3 * YOUNG_KPA / (2 * (1 + poisson)), 1e3 * YOUNG_KPA * poisson / (1 + poisson) / (
        1 - 2 * poisson
    )


class Energy:
    """Elastic and hourglass energy of each cell in float64 or complex128, and its derivatives colour by
    colour.

    ``mu`` and ``lambda_`` are those of all cells, or (m,) of each.

    Nodes of one colour have no cell in common: all of them can be moved at once, and the cells around a node
    tell its own derivative.
    """

    def __init__(self, lattice: Lattice, poisson: float = 0.45, mu=None, lambda_=None) -> None:
        self.lattice = lattice
        self.mu, self.lambda_ = lame_parameters(poisson) if mu is None else (mu, lambda_)

    def of_cells(self, x: np.ndarray) -> np.ndarray:
        corner = x[self.lattice.cells]
        f = np.einsum("mia,mib->mab", corner, self.lattice.gradient)
        j = (f[:, 0] * np.cross(f[:, 1], f[:, 2])).sum(axis=1)
        above = j.real > LEAST_J
        log_j = np.where(above, np.log(np.where(above, j, 1.0)), np.log(LEAST_J) + j / LEAST_J - 1)
        density = self.mu / 2 * ((f * f).sum(axis=(1, 2)) - 3) - self.mu * log_j + self.lambda_ / 2 * log_j**2
        inside = np.einsum("mia,mij,mja->m", corner, self.lattice.hourglass, corner)
        return self.lattice.volume * density + self.mu / 2 * HOURGLASS_STIFFNESS * inside

    def slope(self, x: np.ndarray, colour: int, axis: int) -> np.ndarray:
        """dE/dx (n of the colour,) along an axis, by a complex step: exact to rounding."""
        first, last = self.lattice.colour_start[colour : colour + 2]
        moved = x.astype(complex)
        moved[first:last, axis] += 1e-30j
        of_corner = np.repeat(self.of_cells(moved).imag / 1e-30, 8)
        return np.bincount(self.lattice.cells.ravel(), of_corner, len(x))[first:last]

    def force(self, x: np.ndarray) -> np.ndarray:
        return -np.concatenate(
            [np.stack([self.slope(x, colour, axis) for axis in range(3)], axis=1) for colour in range(8)]
        )

    def hessian(self, x: np.ndarray, colour: int, step: float = 1e-4) -> np.ndarray:
        """d^2E/dx^2 (n of the colour, 3, 3) by each node's own position, by central differences of the
        slope.
        """
        first, last = self.lattice.colour_start[colour : colour + 2]
        rows = []
        for axis in range(3):
            ahead, back = x.copy(), x.copy()
            ahead[first:last, axis] += step
            back[first:last, axis] -= step
            rows.append(
                [(self.slope(ahead, colour, a) - self.slope(back, colour, a)) / 2 / step for a in range(3)]
            )
        return np.array(rows).transpose(2, 0, 1)
