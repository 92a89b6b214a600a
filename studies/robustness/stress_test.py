"""One case: maltreat a body, let go of it, and see what is left."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from rehearsal.result_files import rounded
from sim.body import BodyState
from sim.fields import array_of, fill
from sim.neo_hookean import NeoHookean
from sim.solver import SolverState, StepSettings
from studies.robustness.rigid_fit import apart_after_fit
from studies.robustness.stress_bodies import Specimen, prepared
from studies.robustness.stress_cases import StressCase, Subject
from studies.robustness.stress_motion import AWAY_MM, PROBES, STATES
from ultrasound.probe_manipulator import advanced

RECOVERED_MM = 0.1
# Long enough for the guard's patience and for what was thrown to come down and to rest.
RELEASE_STEPS, LIFT_STEPS, LOOK_EVERY = 300, 240, 30
LEAST_STEPS, LEAST_S = 40, 0.04
LIFT_MM = 400.0
YOUNG_KPA, POISSON = 15.0, 0.45
_prepared: dict[tuple[str, Subject], Specimen] = {}


@dataclass
class Extremes:
    """What was seen from the beginning to the end."""

    finite: bool = True
    kinetic_peak_mj: float = 0.0
    volume_least: float = 1.0
    volume_most: float = 1.0
    fallbacks: list[str] = field(default_factory=list)

    def look(self, specimen: Specimen, notice: str) -> None:
        """After a step, which the guard has seen."""
        if notice:
            self.fallbacks.append(notice)
        finite = bool(np.isfinite(array_of(specimen.body.position)).all())
        self.finite &= finite
        if finite:
            volume = specimen.volume_ratio()
            self.volume_least, self.volume_most = (
                min(self.volume_least, volume),
                max(self.volume_most, volume),
            )
            self.kinetic_peak_mj = max(self.kinetic_peak_mj, specimen.kinetic_mj())


def run(model: str, case: StressCase) -> dict[str, Any]:
    """One case's figures, under the names of stability.json."""
    key = (model, case.subject)
    if key not in _prepared:
        _prepared.clear()
        _prepared[key] = prepared(model, case.subject)
    specimen = _prepared[key]
    extremes = Extremes()
    _maltreat(specimen, case, extremes)
    _let_go(specimen, extremes)
    rest_error = _distance(specimen)
    end = dict(volume_ratio=specimen.volume_ratio(), kinetic_end_mj=specimen.kinetic_mj())
    recovered = rest_error <= RECOVERED_MM
    shape_error = None if recovered else _lifted(specimen)
    return dict(
        name=case.name,
        model=model,
        kind=case.kind,
        extreme=case.extreme,
        body=case.subject.kind,
        points=specimen.body.count,
        finite=extremes.finite and bool(np.isfinite(array_of(specimen.body.position)).all()),
        recovered=recovered,
        rest_error_mm=rounded(rest_error),
        shape_error_mm=rounded(shape_error),
        **{name: rounded(value) for name, value in end.items()},
        volume_ratio_min=rounded(extremes.volume_least),
        volume_ratio_max=rounded(extremes.volume_most),
        kinetic_peak_mj=rounded(extremes.kinetic_peak_mj),
        fallback=_told(extremes.fallbacks),
        reason=_reason(rest_error, shape_error),
    )


def _maltreat(specimen: Specimen, case: StressCase, extremes: Extremes) -> None:
    """From the settled state, under the case's own settings."""
    settings = replace(specimen.settings, **case.settings)
    x, y, z = specimen.settings.gravity
    settings.gravity = (case.gravity * x, case.gravity * y, case.gravity * z)
    dt = settings.time_step_s
    position, velocity = _state(specimen, case)
    specimen.solver.restore(specimen.settled)
    specimen.divergence_check.set_initial_state()
    if case.state[0] != "settled":
        specimen.body.restore(BodyState(position.astype(np.float32), velocity.astype(np.float32)))
        specimen.solver.contacts.reset()
    _weigh(specimen, case.heaviest)
    _harden(specimen, case.material)
    kind, *numbers = case.probe
    path = PROBES[kind](specimen.home, specimen.thickness_mm, dt, *numbers)
    for step in range(max(LEAST_STEPS, round(LEAST_S / dt))):
        times = dt * (step + np.linspace(0.0, 1.0, settings.substeps + 1))
        specimen.solver.step(settings, np.stack([path(float(t)) for t in times]))
        extremes.look(specimen, specimen.divergence_check.check(dt))
    _weigh(specimen, 1.0)
    _harden(specimen, {})


def _state(specimen: Specimen, case: StressCase) -> tuple[np.ndarray, np.ndarray]:
    kind, *numbers = case.state
    return STATES[kind](specimen.rest, specimen.up, *numbers)


def _weigh(specimen: Specimen, heaviest: float) -> None:
    """Make the middle node so many times as heavy; shape matching has its ratio from the start."""
    if isinstance(specimen.model, NeoHookean):
        mass = specimen.mass.copy()
        mass[len(mass) // 2] *= heaviest
        fill((specimen.model.mass, mass))


def _harden(specimen: Specimen, material: Mapping[str, float]) -> None:
    if isinstance(specimen.model, NeoHookean):
        specimen.model.set_material(**{"young_kpa": YOUNG_KPA, "poisson": POISSON, **material})


def _let_go(specimen: Specimen, extremes: Extremes) -> None:
    """The transducer taken away, usual settings, until it rests or time is over."""
    away = np.stack([advanced(specimen.home, -AWAY_MM)] * (specimen.settings.substeps + 1))
    for step in range(1, RELEASE_STEPS + 1):
        specimen.solver.step(specimen.settings, away)
        notice = specimen.divergence_check.check(specimen.settings.time_step_s)
        if notice or step % LOOK_EVERY == 0:
            extremes.look(specimen, notice)
        if step % LOOK_EVERY == 0 and _distance(specimen) < RECOVERED_MM / 2:
            return


def _distance(specimen: Specimen) -> float:
    """Mean distance [mm] of the body's points from where they were at rest."""
    position = array_of(specimen.body.position).astype(float)
    return float(np.linalg.norm(position - specimen.rest, axis=1).mean())


def _lifted(specimen: Specimen) -> float:
    """Mean distance [mm] from the stress-free shape, turned and moved to fit, after it was taken off its support, weightless.

    What friction or another place on the support has kept is gone then, and what the tissue itself has not undone is left.
    """
    state = specimen.solver.snapshot()
    up = (state.body.position + LIFT_MM * specimen.up).astype(np.float32)
    specimen.solver.restore(SolverState(BodyState(up, np.zeros_like(up)), state.contacts))
    specimen.solver.contacts.reset()
    weightless: StepSettings = replace(specimen.settings, gravity=(0.0, 0.0, 0.0))
    error = np.inf
    for step in range(1, LIFT_STEPS + 1):
        specimen.solver.step(weightless)
        if step % LOOK_EVERY == 0:
            error = _shape_error(specimen)
            if error < RECOVERED_MM / 2:
                break
    return error


def _shape_error(specimen: Specimen) -> float:
    position = array_of(specimen.body.position).astype(float)
    wanted = specimen.body.rest_points
    if not np.isfinite(position).all():
        return np.inf
    return float(
        np.concatenate([apart_after_fit(position[part], wanted[part]) for part in specimen.parts]).mean()
    )


def _reason(rest_error: float, shape_error: float | None) -> str | None:
    """Why a body is not back where it was."""
    if shape_error is None:
        return None
    if shape_error <= RECOVERED_MM:
        return (
            f"lies {rest_error:.2g} mm from where it lay, held by friction or its support; its shape is whole"
        )
    return f"keeps a tangle too small to be put back, or is still on its way: shape {shape_error:.2g} mm off"


def _told(fallbacks: list[str]) -> str | None:
    if not fallbacks:
        return None
    times = f" ({len(fallbacks)} times)" if len(fallbacks) > 1 else ""
    return fallbacks[0] + times
