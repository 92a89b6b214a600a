"""The bead experiment: a kidney that settles in its support under gravity and is pressed by a transducer.

z is up. The solution depends on the loading path, as friction does: the kidney is lowered until it touches, settles in
slow motion, and then the transducer moves down in increments.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from skfem import MeshTet2

from studies.reference.equilibrium import LEAST_VOLUME_RATIO, Equilibrium, NotConvergedError
from studies.reference.fem_solid import FemMaterial, FemSolid
from studies.reference.penalty_contact import ContactSurface, Law, PenaltyContact
from studies.reference.smooth_obstacles import FAR_MM, DistanceField, RoundedBox

GRAVITY_M_S2, FRICTION = 9.81, 0.35
STAGE_TOLERANCE, PATH_TOLERANCE = 1e-5, 5e-5
# First tethers: while the kidney settles, and where tissue jumps around the edge of the probe, so that there is no
# continuous path of equilibria.
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


@dataclass
class _Path:
    """Progress of the press; displacements [mm], shape (nodes, 3)."""

    home_mm: float  # height of the transducer's centre at first contact
    state: np.ndarray
    before: np.ndarray  # displacements an increment earlier
    depth_mm: float = 0.0
    last_mm: float = 0.0  # length of the last increment
    step_mm: float = FIRST_INCREMENT_MM

    def extrapolated(self, depth_mm: float) -> np.ndarray:
        """Displacements at a depth [mm], extrapolated from the last increment."""
        return self.state + (self.state - self.before) * (depth_mm - self.depth_mm) / self.last_mm

    def append(self, state: np.ndarray, depth_mm: float, easily: bool) -> None:
        """Take a solution; the next increment is longer if this one converged easily."""
        self.before, self.state = self.state, state
        self.last_mm, self.depth_mm = depth_mm - self.depth_mm, depth_mm
        if easily:
            self.step_mm = min(LONGER * self.step_mm, MOST_INCREMENT_MM)

    def jump(self, state: np.ndarray, depth_mm: float) -> None:
        """Take a solution after a jump; the extrapolation keeps the increment before the jump."""
        self.before = state - (self.state - self.before)
        self.state, self.depth_mm = state, depth_mm


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
        friction: float = FRICTION,
        report: Callable[[str], None] = lambda text: None,
    ) -> None:
        """Meshes are in one frame [mm], and the kidney does not yet touch its support."""
        self.solid, self.press, self._report = FemSolid(mesh, material), press, report
        self.worst_residual = 0.0
        surface = ContactSurface(self.solid)
        box = RoundedBox(np.array(press.size_mm), press.edge_mm)
        self.support = PenaltyContact(surface, DistanceField(support), Law(300.0, friction))
        # 0.05 mm of overlap at 20 kPa; stiffer contact needs many more iterations at the edges of the probe.
        law = Law(800.0, friction, soft_mm=0.05)
        self.probe = PenaltyContact(surface, box, law, np.array([*press.over_mm, FAR_MM]))
        weight = self.solid.weight(np.array([0.0, 0.0, -GRAVITY_M_S2]))
        self.equilibrium = Equilibrium(self.solid, [self.support, self.probe], weight)

    def stages(self) -> Iterator[FemStage]:
        """Solve stage by stage. Raises NotConvergedError."""
        state, residual = self._settled()
        path = _Path(home_mm=self._touching_height(state), state=state, before=state)
        self._move_probe(path.home_mm)
        self._carry(state)
        yield self._stage(0.0, state, residual)
        for goal in self.press.indentations_mm[1:]:
            while path.depth_mm < goal:
                residual = self._advance(path, goal)
            yield self._stage(goal, path.state, residual)

    def _advance(self, path: _Path, goal: float) -> float:
        """One increment towards a goal [mm], shorter or in slow motion where Newton's method does not converge.

        Return the relative residual. Raises NotConvergedError.
        """
        # A remainder too short for its own increment is included.
        after = goal if goal - path.depth_mm < 1.1 * path.step_mm else path.depth_mm + path.step_mm
        self._move_probe(path.home_mm - after)
        guess = path.extrapolated(after) if path.last_mm else self._first_guess(path.state)
        tolerance = STAGE_TOLERANCE if after == goal else PATH_TOLERANCE
        try:
            solved, residual, steps = self.equilibrium.solve(guess, tolerance, most=MOST_ITERATIONS)
        except NotConvergedError:
            if after - path.depth_mm > LEAST_INCREMENT_MM:
                path.step_mm = (after - path.depth_mm) / 2
                return self._advance(path, goal)
            valid = self.solid.least_volume_ratio(guess) > LEAST_VOLUME_RATIO
            start = guess if valid else path.state
            solved, residual, steps = self.equilibrium.relaxed(start, tolerance, JUMPING_KPA_MM2)
            path.jump(solved, after)
        else:
            self._carry(solved)
            path.append(solved, after, steps <= EASY_ITERATIONS)
        self._report(f"{after:6.2f} mm deep, {steps} steps, residual {residual:.0e}")
        self.worst_residual = max(self.worst_residual, residual)
        return residual

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
        """Contact with a softer transducer, as a whole increment of overlap would be an unrealistic pressure."""
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
        height = self.probe.surface.points(state)[:, 2].max() + self.press.size_mm[2]
        self._move_probe(height)
        # Lowering by the gap cannot pass the first contact.
        while (gap := self.probe.gaps(state).min()) > TOUCHING_MM:
            height -= gap
            if height < self.probe.surface.points(state)[:, 2].min():
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
