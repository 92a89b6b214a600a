"""The paper's calibration: a search for the settings with the least mean bead error, judged on held-out
data.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.polynomial import Polynomial
from scipy.optimize import differential_evolution

from errors import UserError
from rehearsal.configuration import Setup, setup_of
from studies.accuracy.bead_case import BeadCase
from studies.accuracy.bead_errors import null_errors
from studies.accuracy.case_workers import Evaluate, Measured

MODEL = "shape-matching"
# Every third bead is held out, so that neighbours on a thread are in both parts.
BEADS_EVERY = 3
# Ratio of the grid's spacing to that of the finer grid around its best value.
FINER = 5
QUARTIC = 4
# stiffness, over-relaxation and iterations, with Eq. 7's range for the second.
BOUNDS = ((0.05, 1.0), (1.0, 2.0), (3, 30))
POPULATION = 5
# A larger error, in multiples of the least, is that of a body that falls apart; it is left out of the quartic
# fit.
MOST_ERROR = 4.0


class CalibrationError(UserError):
    """A calibration that is not possible; the message is one line."""


@dataclass(frozen=True)
class Split:
    """Fitted and held-out data: for each case a mask (stages, n), True where an error is fitted."""

    fitted: tuple[np.ndarray, ...]
    fitted_name: str
    held_out_name: str

    def fit_mm(self, errors: Sequence[np.ndarray]) -> float:
        """Mean of the cases' mean errors [mm] over the fitted data; ``errors`` (stages, n) of each case."""
        return _mean(errors, self.fitted)

    def held_out_mm(self, errors: Sequence[np.ndarray]) -> float:
        """Mean of the cases' mean errors [mm] over the held-out data."""
        return _mean(errors, [~mask for mask in self.fitted])


@dataclass(frozen=True)
class CalibrationTrial:
    """One setup evaluated on every case."""

    setup: Setup
    measured: tuple[Measured, ...]
    fit_mm: float
    held_out_mm: float


@dataclass
class Calibration:
    """A search by ``workers``, and all trials of each radius, in their order.

    ``done`` is called with the number of finished evaluations.
    """

    cases: Sequence[BeadCase]
    split: Split
    workers: Evaluate
    done: Callable[[int], object]
    trials: dict[float, list[CalibrationTrial]] = field(default_factory=dict)

    def best(self, radius_mm: float) -> CalibrationTrial:
        """The trial with the least error on the fitted data, the first of equals."""
        return min(self.trials[radius_mm], key=lambda trial: trial.fit_mm)

    def null_mm(self) -> float:
        """Error [mm] of predicting no motion, on the held-out data."""
        return self.split.held_out_mm([null_errors(case) for case in self.cases])

    def exhaustive(self, radii_mm: Sequence[float], spacing: float) -> None:
        """The paper's search: for each radius each stiffness on a grid, then a finer one around the best."""
        grid = stiffness_grid(spacing)
        self._try_all([setup_of(MODEL, radius_mm=r, stiffness=a) for r in radii_mm for a in grid])
        finer = {r: finer_grid(self.best(r).setup.tissue.stiffness, spacing) for r in radii_mm}
        self._try_all([setup_of(MODEL, radius_mm=r, stiffness=a) for r in radii_mm for a in finer[r]])

    def search(self, radii_mm: Sequence[float], generations: int) -> None:
        """Stiffness, over-relaxation and iterations of each radius, by differential evolution from a fixed
        seed.

        A generation is evaluated at once, so the result does not depend on the number of workers.
        """

        def errors_of(x: np.ndarray, radius: float) -> np.ndarray:
            setups = [
                setup_of(MODEL, radius_mm=radius, stiffness=a, relaxation_factor=factor, iterations=round(n))
                for a, factor, n in x.reshape(len(BOUNDS), -1).T.tolist()
            ]
            return np.array([trial.fit_mm for trial in self._try_all(setups)])

        for radius in radii_mm:
            differential_evolution(
                errors_of,
                BOUNDS,
                args=(radius,),
                integrality=[False, False, True],
                popsize=POPULATION,
                maxiter=generations,
                tol=0,
                rng=0,
                polish=False,
                updating="deferred",
                vectorized=True,
            )

    def _try_all(self, setups: Sequence[Setup]) -> list[CalibrationTrial]:
        """Evaluate setups case by case, as a worker keeps what it has built for a case and a radius."""
        results = []
        for result in self.workers([(case, setup) for case in self.cases for setup in setups]):
            results.append(result)
            self.done(1)
        trials = []
        for place, setup in enumerate(setups):
            measured = tuple(results[place :: len(setups)])
            errors = [result.errors for result in measured]
            fit_mm, held_out_mm = self.split.fit_mm(errors), self.split.held_out_mm(errors)
            trial = CalibrationTrial(setup, measured, fit_mm, held_out_mm)
            trials.append(trial)
            self.trials.setdefault(setup.tissue.radius_mm, []).append(trial)
        return trials


def split_of(cases: Sequence[BeadCase], hold_out: str) -> Split:
    """Hold out each case's deepest stage, every third of its beads, or the last case.

    Raises CalibrationError.
    """
    if len({case.digest for case in cases}) < len(cases):
        raise CalibrationError("a case is named twice: fitted data would be held out as well; name each once")
    masks: list[np.ndarray] = [np.ones(case.measured.shape[:2], bool) for case in cases]
    if hold_out == "stages":
        for mask in masks:
            mask[-1] = False
        return Split(tuple(masks), "all stages but the deepest", "the deepest stage")
    if hold_out == "beads":
        for case, mask in zip(cases, masks, strict=True):
            if mask.shape[1] < BEADS_EVERY:
                raise CalibrationError(
                    f"--hold-out beads: {case.name} has less than {BEADS_EVERY} beads; hold out stages"
                )
            mask[:, BEADS_EVERY - 1 :: BEADS_EVERY] = False
        return Split(tuple(masks), "two beads of three", "every third bead")
    if len(cases) < 2:
        raise CalibrationError(
            "--hold-out cases: there is one case; name two or more, or hold out stages or beads"
        )
    masks[-1][:] = False
    return Split(tuple(masks), ", ".join(case.name for case in cases[:-1]), cases[-1].name)


def stiffness_grid(spacing: float) -> list[float]:
    """Equal steps to 1; without 0, at which nothing holds the tissue together."""
    return np.round(np.arange(1.0, spacing / 2, -spacing)[::-1], 6).tolist()


def finer_grid(best: float, spacing: float) -> list[float]:
    """The stiffnesses between the best of a grid and its neighbours there."""
    offsets = np.arange(-FINER + 1, FINER) * spacing / FINER
    around = np.round(best + offsets[offsets != 0], 6)
    return around[(around > 0) & (around <= 1)].tolist()


def exhaustive_count(cases: int, radii: int, spacing: float) -> int:
    """Largest number of evaluations of an exhaustive search."""
    return cases * radii * (len(stiffness_grid(spacing)) + 2 * (FINER - 1))


def search_count(cases: int, radii: int, generations: int) -> int:
    """Number of evaluations of a search."""
    return cases * radii * (generations + 1) * POPULATION * len(BOUNDS)


def quartic(trials: Sequence[CalibrationTrial]) -> tuple[Polynomial, float] | None:
    """The paper's smooth curve through the errors up to MOST_ERROR times the least, over its ``domain``, and
    its best stiffness.

    None where there are too few.
    """
    at = np.array([(trial.setup.tissue.stiffness, trial.fit_mm) for trial in trials])
    at = at[np.isfinite(at[:, 1]) & (at[:, 1] <= MOST_ERROR * at[:, 1].min())]
    if len(np.unique(at[:, 0])) <= QUARTIC:
        return None
    polynomial = Polynomial.fit(at[:, 0], at[:, 1], QUARTIC)
    stiffness, error = polynomial.linspace(1001)
    return polynomial, float(stiffness[error.argmin()])


def _mean(errors: Sequence[np.ndarray], masks: Sequence[np.ndarray]) -> float:
    parts = zip(errors, masks, strict=True)
    return float(np.mean([error[mask].mean() for error, mask in parts if mask.any()]))
