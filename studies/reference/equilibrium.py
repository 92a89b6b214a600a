"""Newton's method for a solid under its weight and in contact, with sparse direct solves."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_array, diags_array
from scipy.sparse.linalg import splu

from studies.reference.fem_solid import FemSolid
from studies.reference.penalty_contact import PenaltyContact

LEAST_VOLUME_RATIO = 0.05
SEARCHES, LEAST_REACH = 6, 1e-6
# The stiffness of the tether is changed by a factor from step to step, according to the number of iterations.
TETHER_FACTOR, EASY_ITERATIONS, TETHERED_ITERATIONS, MOST_TETHERS = 4.0, 6, 12, 80
# Tolerance of a tethered step, absolute and as a share of the residual before.
TETHERED_TOLERANCE, LESS = 1e-4, 0.1


class NotConvergedError(Exception):
    """Newton's method found no equilibrium."""


@dataclass
class Balance:
    """Unbalanced forces of a state."""

    residual: np.ndarray  # sum of all forces on the nodes [mN], shape (nodes, 3)
    forces: float  # sum of the magnitudes of loads, contact and constraint forces [mN]

    @property
    def relative(self) -> float:
        """Magnitude of the residual, as a share of that of the forces."""
        return self.size / max(self.forces, 1e-12)

    @property
    def size(self) -> float:
        """Sum of the residual's magnitudes over the nodes [mN]."""
        return float(np.linalg.norm(self.residual, axis=1).sum())

    def work(self, step: np.ndarray) -> float:
        """Work of the residual along a step [mm], shape (nodes, 3)."""
        return float((self.residual * step).sum())


class Equilibrium:
    """A solid with its contacts and loads.

    Attributes:
        contacts: contacts with obstacles.
        load: forces on the nodes [mN], shape (nodes, 3).
        fixed: prescribed displacements (Dirichlet), shape (nodes, 3) bool.
        tether_kpa_mm2: stiffness per volume of a proximal term, springs to ``tethered_to``.
        tethered_to: displacements [mm], shape (nodes, 3).
    """

    def __init__(
        self,
        solid: FemSolid,
        contacts: list[PenaltyContact],
        load: np.ndarray,
        fixed: np.ndarray | None = None,
    ):
        self.solid, self.contacts, self.load = solid, contacts, load
        self.fixed = np.zeros(load.shape, bool) if fixed is None else fixed
        self.tether_kpa_mm2, self.tethered_to = 0.0, np.zeros_like(solid.rest)
        self._free = np.flatnonzero(~self.fixed.ravel())

    def balance(self, displacement: np.ndarray) -> Balance:
        """Unbalanced forces at displacements [mm], shape (nodes, 3)."""
        pushes = [contact.force(displacement)[0] for contact in self.contacts]
        tether = self.tether_kpa_mm2 * self.solid.volume_share[:, None] * (displacement - self.tethered_to)
        residual = self.solid.elastic_force(displacement) + tether - self.load - sum(pushes)
        reactions = np.where(self.fixed, residual, 0.0)
        forces = sum(np.linalg.norm(part, axis=1).sum() for part in (self.load, reactions, *pushes))
        return Balance(np.where(self.fixed, 0.0, residual), float(forces))

    def tangent(self, displacement: np.ndarray) -> csc_array:
        """Derivative of the residual by the displacements [mN/mm], shape (3 nodes, 3 nodes)."""
        tether = diags_array(np.repeat(self.tether_kpa_mm2 * self.solid.volume_share, 3))
        contacts = sum(contact.stiffness(displacement) for contact in self.contacts)
        return (self.solid.stiffness(displacement) + tether - contacts).tocsc()

    def solve(
        self,
        guess: np.ndarray,
        tolerance: float,
        most: int = 40,
    ) -> tuple[np.ndarray, float, int]:
        """Newton's method with a line search on the residual's work along the step.

        Args:
            guess: initial displacements [mm], shape (nodes, 3).
            tolerance: on the relative residual.
            most: largest number of iterations.

        Returns:
            Displacements [mm], shape (nodes, 3), relative residual, number of iterations.

        Raises:
            NotConvergedError: no equilibrium was found.
        """
        if self.solid.least_volume_ratio(guess) <= LEAST_VOLUME_RATIO:
            raise NotConvergedError("the initial displacements invert tetrahedra, or nearly")
        state, balance = guess, self.balance(guess)
        least = np.inf
        for iteration in range(most + 1):
            if balance.relative <= tolerance:
                return state, balance.relative, iteration
            least = min(least, balance.relative)
            state, balance = self._searched(state, balance, self._newton_step(state, balance))
        raise NotConvergedError(f"residual {least:.1e} after {most} iterations")

    def relaxed(
        self, state: np.ndarray, tolerance: float, tether_kpa_mm2: float
    ) -> tuple[np.ndarray, float, int]:
        """Equilibrium by slow motion, in which each step is tethered to the end of the last one.

        Pseudo-transient continuation (Kelley & Keyes, SIAM J. Numer. Anal. 35, 1998): it converges even where
        the body jumps. Steps become longer while they converge easily. The anchors of friction are updated
        after each step.

        Args:
            state: initial displacements [mm], shape (nodes, 3).
            tolerance: on the relative residual without a tether.
            tether_kpa_mm2: stiffness per volume of the first tether.

        Returns:
            Displacements [mm], shape (nodes, 3), relative residual, number of steps.

        Raises:
            NotConvergedError: no equilibrium was found.
        """
        left = np.inf
        for step in range(1, MOST_TETHERS + 1):
            wanted = min(TETHERED_TOLERANCE, max(tolerance, LESS * left))
            self.tether_kpa_mm2, self.tethered_to = tether_kpa_mm2, state
            try:
                state, _, iterations = self.solve(state, wanted, most=TETHERED_ITERATIONS)
            except NotConvergedError:
                tether_kpa_mm2 *= TETHER_FACTOR
                continue
            finally:
                self.tether_kpa_mm2 = 0.0
            for contact in self.contacts:
                contact.carry(state)
            left = self.balance(state).relative
            if left <= tolerance:
                return state, left, step
            if iterations <= EASY_ITERATIONS:
                tether_kpa_mm2 /= TETHER_FACTOR
        raise NotConvergedError(f"no rest after {MOST_TETHERS} tethered steps")

    def _newton_step(self, state: np.ndarray, balance: Balance) -> np.ndarray:
        matrix = self.tangent(state)[self._free][:, self._free].tocsc()
        try:
            # Ordering for little fill-in; pivots stay on the diagonal unless they vanish.
            factor = splu(
                matrix,
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=1e-3,
                options=dict(SymmetricMode=True),
            )
        except RuntimeError as error:
            raise NotConvergedError(str(error)) from None
        step = np.zeros(state.size)
        step[self._free] = factor.solve(-balance.residual.ravel()[self._free])
        if not np.isfinite(step).all():
            raise NotConvergedError("the system is singular")
        return step.reshape(state.shape)

    def _searched(self, state: np.ndarray, balance: Balance, step: np.ndarray) -> tuple[np.ndarray, Balance]:
        """A line search for the residual's work, then a shorter step if it also reduces the residual.

        Without friction the residual's work is the slope of the energy. Points that stick at one end of the
        step and slide at the other make Newton's method alternate between two states; shorter steps prevent
        that.
        """
        reach, after = self._line_search(state, balance.work(step), step)
        for shorter in (reach / 2, reach / 4, reach / 8):
            if after.size <= balance.size:
                break
            tried = self.balance(state + shorter * step)
            if tried.size < balance.size:
                reach, after = shorter, tried
        return state + reach * step, after

    def _line_search(self, state: np.ndarray, before: float, step: np.ndarray) -> tuple[float, Balance]:
        """The share of a step at which the work is at most half of that before, 1 where that is enough.

        Regula falsi with a safeguard (Crisfield, *Non-linear Finite Element Analysis of Solids and
        Structures* 1, 1991, section 9.2.2).
        """
        reach = 1.0
        while self.solid.least_volume_ratio(state + reach * step) <= LEAST_VOLUME_RATIO:
            reach /= 2
            if reach < LEAST_REACH:
                raise NotConvergedError("the step inverts tetrahedra")
        low, high = 0.0, np.inf
        work_low, work_high = before, 0.0
        for _ in range(SEARCHES):
            after = self.balance(state + reach * step)
            work = after.work(step)
            if before >= 0 or abs(work) <= abs(before) / 2 or (work < 0 and high == np.inf):
                break
            if work > 0:
                high, work_high = reach, work
            else:
                low, work_low = reach, work
            share = work_low / (work_low - work_high)
            reach = low + (high - low) * float(np.clip(share, 0.1, 0.9))
        else:
            after = self.balance(state + reach * step)
        return reach, after
