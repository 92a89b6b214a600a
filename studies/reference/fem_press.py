"""The bead experiment: a kidney that settles in its support under gravity and is pressed by a transducer.

z is up. The solution depends on the loading path, as friction does: the kidney is lowered until it touches,
settles in slow motion, and then the transducer moves down in increments.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from skfem import MeshTet2

from studies.reference.equilibrium import LEAST_VOLUME_RATIO, Equilibrium, NotConvergedError
from studies.reference.fem_solid import FemMaterial, FemSolid
from studies.reference.penalty_contact import Law, PenaltyContact
from studies.reference.smooth_obstacles import FAR_MM, DistanceField, RoundedBox

GRAVITY_M_S2, FRICTION = 9.81, 0.35
STAGE_TOLERANCE, PATH_TOLERANCE = 1e-5, 5e-5
# First tethers: while the kidney settles, and where tissue jumps around the edge of the probe, so that there
# is no continuous path of equilibria.
SETTLING_KPA_MM2, JUMPING_KPA_MM2 = 1e-2, 4.0
# Increments of the press; the first ones are small, as the contact area then grows fastest.
FIRST_INCREMENT_MM, MOST_INCREMENT_MM, LEAST_INCREMENT_MM = 0.3, 1.2, 0.15
LONGER, EASY_ITERATIONS, MOST_ITERATIONS = 1.4, 7, 15
TOUCHING_MM = 1e-6
# A softer contact, with pressures of the order of the tissue's stiffness, gives the first guess.
SOFT_KPA_MM, SOFT_TOLERANCE = 100.0, 2e-2


@dataclass(frozen=True)
class FemPress:
    """A transducer cuboid that moves straight down, its long side along x.

    Attributes:
        over_mm: x and y of its centre.
        size_mm: full lengths along x, y and z.
        edge_mm: radius of its edges.
        indentations_mm: depth of each stage below the first, where it just touches.
    """

    over_mm: tuple[float, float] = (0.0, 0.0)
    size_mm: tuple[float, float, float] = (40.0, 10.0, 20.0)
    edge_mm: float = 1.0
    indentations_mm: tuple[float, ...] = (0.0, 5.95, 9.48, 12.38)


@dataclass(frozen=True)
class FemStage:
    """The equilibrium at one indentation."""

    indentation_mm: float
    position_mm: np.ndarray  # of the transducer's centre, shape (3,)
    displacement_mm: np.ndarray  # from the stress-free shape, shape (nodes, 3)
    probe_force_n: np.ndarray  # on the tissue, shape (3,)
    support_force_n: np.ndarray  # on the tissue, shape (3,)
    residual: float  # relative


class FemExperiment:
    """One kidney on its support under one press.

    Attributes:
        worst_residual: largest relative residual of all increments of the press.
    """

    def __init__(
        self,
        mesh: MeshTet2,
        support: trimesh.Trimesh,
        material: FemMaterial,
        press: FemPress,
        report: Callable[[str], None] = lambda text: None,
    ) -> None:
        """Meshes are in one frame [mm], and the kidney does not yet touch its support."""
        self.solid, self.press, self._report = FemSolid(mesh, material), press, report
        self.worst_residual = 0.0
        self.support = PenaltyContact(self.solid, DistanceField(support), Law(300.0, FRICTION))
        # 0.05 mm of overlap at 20 kPa; stiffer contact needs many more iterations at the edges of the probe.
        law, box = Law(800.0, FRICTION, soft_mm=0.05), RoundedBox(np.array(press.size_mm), press.edge_mm)
        self.probe = PenaltyContact(self.solid, box, law, (*press.over_mm, FAR_MM))
        weight = self.solid.weight(np.array([0.0, 0.0, -GRAVITY_M_S2]))
        self.equilibrium = Equilibrium(self.solid, [self.support, self.probe], weight)

    def stages(self) -> Iterator[FemStage]:
        """Solve stage by stage, in increments that are shorter or in slow motion where Newton's method does
        not converge.

        Raises NotConvergedError.
        """
        state, residual = self._settled()
        home, depth, increment = self._touching_height(state), 0.0, FIRST_INCREMENT_MM
        a_mm: np.ndarray | None = (
            None  # displacements (nodes, 3) a mm of the last increment, which extrapolate it
        )
        self._move_probe(home)
        self._carry(state)
        yield self._stage(0.0, state, residual)
        for goal in self.press.indentations_mm[1:]:
            while depth < goal:
                # A remainder too short for its own increment is included.
                after = goal if goal - depth < 1.1 * increment else depth + increment
                self._move_probe(home - after)
                guess = self._first_guess(state) if a_mm is None else state + (after - depth) * a_mm
                tolerance = STAGE_TOLERANCE if after == goal else PATH_TOLERANCE
                try:
                    solved, residual, steps = self.equilibrium.solve(guess, tolerance, MOST_ITERATIONS)
                except NotConvergedError:
                    if after - depth > LEAST_INCREMENT_MM:
                        increment = (after - depth) / 2
                        continue
                    valid = self.solid.least_volume_ratio(guess) > LEAST_VOLUME_RATIO
                    start = guess if valid else state
                    solved, residual, steps = self.equilibrium.relaxed(start, tolerance, JUMPING_KPA_MM2)
                else:
                    self._carry(solved)
                    a_mm = (solved - state) / (after - depth)
                    if steps <= EASY_ITERATIONS:
                        increment = min(LONGER * increment, MOST_INCREMENT_MM)
                state, depth = solved, after
                self._report(f"{depth:6.2f} mm deep, {steps} steps, residual {residual:.0e}")
                self.worst_residual = max(self.worst_residual, residual)
            yield self._stage(goal, state, residual)

    def _settled(self) -> tuple[np.ndarray, float]:
        """Displacements and relative residual after lowering to contact and settling under gravity."""
        state = np.zeros_like(self.solid.rest)
        while abs(gap := self.support.gaps(state).min()) > 1e-4:
            if gap == FAR_MM:
                raise NotConvergedError("the kidney is not above its support")
            state = state - [0.0, 0.0, gap]
        self._carry(state)
        state, residual, steps = self.equilibrium.relaxed(state, STAGE_TOLERANCE, SETTLING_KPA_MM2)
        self._report(f"at rest in the support, {steps} steps, residual {residual:.0e}")
        return state, residual

    def _first_guess(self, state: np.ndarray) -> np.ndarray:
        """Contact with a softer transducer: the pressure of an increment of overlap would be unrealistic."""
        stiff = self.probe.law
        self.probe.law = replace(stiff, stiffness_kpa_mm=SOFT_KPA_MM)
        try:
            return self.equilibrium.solve(state, SOFT_TOLERANCE, most=MOST_ITERATIONS)[0]
        except NotConvergedError:
            return state
        finally:
            self.probe.law = stiff

    def _touching_height(self, state: np.ndarray) -> float:
        """Height of the transducer's centre [mm] at first contact from above."""
        heights = self.support.places(state)[:, 2]
        height = heights.max() + self.press.size_mm[2]
        self._move_probe(height)
        # Lowering by the gap cannot pass the first contact.
        while (gap := self.probe.gaps(state).min()) > TOUCHING_MM:
            height -= gap
            if height < heights.min():
                raise NotConvergedError("the transducer does not press on the kidney")
            self._move_probe(height)
        return height

    def _move_probe(self, height_mm: float) -> None:
        self.probe.offset = np.array([*self.press.over_mm, height_mm])

    def _carry(self, state: np.ndarray) -> None:
        for contact in self.equilibrium.contacts:
            contact.carry(state)

    def _stage(self, indentation: float, state: np.ndarray, residual: float) -> FemStage:
        probe, support = (contact.force(state)[1] / 1000 for contact in (self.probe, self.support))
        return FemStage(indentation, self.probe.offset.copy(), state, probe, support, residual)
