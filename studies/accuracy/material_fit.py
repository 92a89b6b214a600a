"""Estimation of the material from bead experiments: moduli, Poisson's ratio and friction by nonlinear least
squares.

The residuals are positions of the beads and, where a case has them, forces on the probe. The confidence
intervals are those of the linearised model (Seber & Wild 2003, Sec. 5.1). The residuals of a computation are
not random: neighbouring beads are off alike, so that each stage counts as three independent observations
only, one for each axis. A parameter whose interval is wide, or that ends at a bound, is not determined.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import OptimizeResult, least_squares
from scipy.stats import t as student

from rehearsal.configuration import Setup
from rehearsal.worker_processes import Workers, built_once
from scenes.mechanical_tissues import mechanical_properties
from sim.neo_hookean import NeoHookean
from studies.accuracy.bead_case import BeadCase
from studies.accuracy.bead_experiment import BeadExperiment
from studies.tables_and_panels import table_of

# What a bead's position and a force are known to, and the elements are off by: the residuals are in these
# units.
BEAD_MM, FORCE_SHARE, LEAST_FORCE_N = 0.1, 0.03, 0.03
# A wider half of an interval, relative to the value, means that the data do not determine it.
MOST_UNCERTAIN = 0.25
# Independent observations of a stage.
AXES = 3
# Moduli are searched over this many times the table's range.
BEYOND = 3.0
# Relative step of finite differences: the residuals are rounded to 1e-4 of their unit.
STEP = 0.1
MOST_STEPS = 12
# Places of logarithms beyond which a value is no number, and nearer than which to a bound they are on it.
MOST_PLACE, AT_BOUND = 50.0, 1e-3
POISSON, FRICTION = (0.3, 0.495), (0.05, 0.8)
# Of parts that the table does not have.
ANY_YOUNG_KPA = (0.5, 15.0, 500.0)


COLUMNS = {
    "parameter": "{words}",
    "found": "{found:.3g}",
    "95 % from": "{low:.3g}",
    "to": "{high:.3g}",
    "": "{note}",
}


@dataclass(frozen=True)
class Fitted:
    """A parameter: its name, unit and bounds, and whether it is searched by its logarithm."""

    name: str
    unit: str
    low: float
    start: float
    high: float
    is_ratio: bool = True

    def value(self, x: float) -> float:
        """The value at a place of the search."""
        return float(np.exp(x)) if self.is_ratio else x

    def place(self, value: float) -> float:
        """The place of a value in the search."""
        return float(np.log(value)) if self.is_ratio else value

    @property
    def width(self) -> float:
        """The unit of steps in the search: 1 of a logarithm, else the range."""
        return 1.0 if self.is_ratio else self.high - self.low


@dataclass(frozen=True)
class MaterialFit:
    """The parameters as found, places (p,) in the search, with half of their 95 % intervals (p,), and how
    well they fit.
    """

    parameters: list[Fitted]
    place: np.ndarray
    half_width: np.ndarray
    rms_mm: float
    presses: int
    cases: list[str]
    size: dict[str, Any]

    def report(self) -> dict[str, Any]:
        """The figures of material.json."""
        rows = []
        for parameter, x, width in zip(self.parameters, self.place, self.half_width, strict=True):
            value, low, high = (parameter.value(v) for v in (x, x - width, min(x + width, MOST_PLACE)))
            at_bound = min(x - parameter.place(parameter.low), parameter.place(parameter.high) - x) < AT_BOUND
            determined = bool((high - low) / 2 < MOST_UNCERTAIN * value and not at_bound)
            name = dict(name=parameter.name, unit=parameter.unit)
            rows.append(name | dict(found=value, low=low, high=high, determined=determined))
        fit = dict(parameters=rows, bead_rms_mm=self.rms_mm, presses=self.presses)
        return dict(cases=self.cases, **self.size, **fit)


def parameters_of(cases: Sequence[BeadCase]) -> list[Fitted]:
    """What is estimated: modulus and Poisson's ratio outside the parts, each part's modulus, friction."""
    table = mechanical_properties().parts
    moduli = {"modulus": table["kidney"].young_kpa}
    for name in dict.fromkeys(part.name for case in cases for part in case.parts):
        moduli[f"{name} modulus"] = table[name].young_kpa if name in table else ANY_YOUNG_KPA
    return [
        *(_young(name, ranges) for name, ranges in moduli.items()),
        Fitted("Poisson's ratio", "", POISSON[0], 0.42, POISSON[1], is_ratio=False),
        Fitted("friction", "", FRICTION[0], 0.25, FRICTION[1], is_ratio=False),
    ]


def _young(name: str, ranges: tuple[float, float, float]) -> Fitted:
    low, _, high = ranges
    return Fitted(name, "kPa", low / BEYOND, float(np.sqrt(low * high)), high * BEYOND)


def fitted(
    cases: Sequence[BeadCase], setup: Setup, workers: Workers, done: Callable[[int], object]
) -> MaterialFit:
    """Fit all cases together. ``done`` is called with the number of finished presses."""
    search = _Search(parameters_of(cases), cases, workers, done)
    result = search.run(setup, [parameter.place(parameter.start) for parameter in search.parameters])
    independent = AXES * sum(len(case.poses) for case in cases)
    variance = float(result.fun @ result.fun) / independent
    deviation = np.sqrt(np.diag(variance * np.linalg.pinv(result.jac.T @ result.jac)))
    quantile = student.ppf(0.975, max(independent - len(result.x), 1))
    beads = np.concatenate(search.split(result.fun))
    return MaterialFit(
        parameters=search.parameters,
        place=result.x,
        half_width=quantile * deviation,
        rms_mm=float(BEAD_MM * np.sqrt(3 * np.mean(beads**2))),
        presses=search.presses,
        cases=[case.name for case in cases],
        size={setup.tissue.size_key: setup.size_mm, "iterations": setup.iterations},
    )


@dataclass
class _Search:
    """Least squares over the parameters, whose presses ``workers`` compute in parallel."""

    parameters: list[Fitted]
    cases: Sequence[BeadCase]
    workers: Workers
    done: Callable[[int], object]
    presses: int = 0

    def run(self, setup: Setup, start: Sequence[float]) -> OptimizeResult:
        """The best places, from a start."""
        low, high = self._places("low"), self._places("high")
        return least_squares(
            lambda place: self._residuals(setup, [place])[0],
            start,
            jac=lambda place: self._jacobian(setup, place),
            bounds=(low, high),
            x_scale=[parameter.width for parameter in self.parameters],
            xtol=3e-4,
            ftol=1e-5,
            max_nfev=MOST_STEPS,
        )

    def _places(self, end: str) -> list[float]:
        return [parameter.place(getattr(parameter, end)) for parameter in self.parameters]

    def split(self, residuals: np.ndarray) -> list[np.ndarray]:
        """Those of the beads, case by case."""
        of_cases, start = [], 0
        for case in self.cases:
            of_cases.append(residuals[start : start + case.measured.size])
            start += case.measured.size + len(_force_scale(case))
        return of_cases

    def _residuals(self, setup: Setup, places: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Residuals of all cases at several places of the search."""
        tried = [
            {parameter.name: parameter.value(x) for parameter, x in zip(self.parameters, place, strict=True)}
            for place in places
        ]
        # Case by case, as a worker keeps what it has built.
        tasks = [(case, setup, values) for case in self.cases for values in tried]
        residuals = []
        for result in self.workers.map(residuals_of, tasks):
            residuals.append(result)
            self.presses += 1
            self.done(1)
        return [np.concatenate(residuals[n :: len(tried)]) for n in range(len(tried))]

    def _jacobian(self, setup: Setup, place: np.ndarray) -> np.ndarray:
        steps = STEP * np.array([parameter.width for parameter in self.parameters])
        steps = np.where(place + steps > self._places("high"), -steps, steps)
        first, *moved = self._residuals(setup, [place, *(place + np.diag(steps))])
        return np.column_stack([(one - first) / step for one, step in zip(moved, steps, strict=True)])


def residuals_of(case: BeadCase, setup: Setup, values: dict[str, float]) -> np.ndarray:
    """Residuals of one case: beads in units of BEAD_MM, then known forces in those of their uncertainty."""
    usual = setup.but(young_kpa=15.0, poisson=0.45)
    key = "material fit", case.digest, setup.size_mm
    experiment = built_once(key, lambda: BeadExperiment(case, usual))
    model = experiment.model
    assert isinstance(model, NeoHookean)
    young_kpa, poisson = values["modulus"], values["Poisson's ratio"]
    parts = [replace(part.material, young_kpa=values[f"{part.name} modulus"]) for part in case.parts]
    model.set_material(young_kpa, poisson, parts)
    model.contacts.coefficient = values["friction"]
    run = experiment.run(setup.but(young_kpa=young_kpa, poisson=poisson))
    beads = (run.beads - case.measured).ravel() / BEAD_MM
    forces = (run.force_n - case.probe_force_n)[_known_forces(case)].ravel() / _force_scale(case)
    return np.nan_to_num(np.concatenate([beads, forces]), nan=1e3, posinf=1e3, neginf=-1e3)


def _known_forces(case: BeadCase) -> np.ndarray:
    """At which stages (stages,) the force is known."""
    return np.isfinite(case.probe_force_n).all(axis=1)


def _force_scale(case: BeadCase) -> np.ndarray:
    """What each component of the known forces is known to [N]."""
    size = np.linalg.norm(case.probe_force_n[_known_forces(case)], axis=1, keepdims=True)
    return np.repeat(np.maximum(FORCE_SHARE * size, LEAST_FORCE_N), 3, axis=1).ravel()


def table(report: dict[str, Any]) -> str:
    """The parameters with their 95 % intervals, and which the data do not determine."""
    rows = [
        parameter
        | dict(
            words=", ".join(filter(None, (parameter["name"], parameter["unit"]))),
            note="" if parameter["determined"] else "not determined by these data",
        )
        for parameter in report["parameters"]
    ]
    return (
        f"{table_of(COLUMNS, rows)}\n\nThe beads are {report['bead_rms_mm']:.3f} mm off (root mean square); "
        f"{report['presses']} presses"
    )
