"""One stress test: an extreme applied to a body, its release, and what remains of the deformation."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from rehearsal.result_files import rounded
from sim.body import BodyState
from sim.fields import array_of, fill
from sim.neo_hookean import NeoHookean
from sim.solver import SolverState, StepSettings
from studies.harness import distances_after_fit
from studies.robustness.stress_bodies import Specimen, prepared
from studies.robustness.stress_cases import RECOVERED_MM, StressCase, Subject
from studies.robustness.stress_motion import AWAY_MM, PROBES, STATES
from ultrasound.probe_manipulator import advanced

# Long enough for the divergence check to restore a state, and for a thrown body to fall and come to rest.
RELEASE_STEPS, LIFT_STEPS, CHECK_EVERY = 300, 240, 30
LEAST_STEPS, LEAST_S = 40, 0.04
LIFT_MM = 400.0
YOUNG_KPA, POISSON = 15.0, 0.45
_prepared: dict[tuple[str, Subject], Specimen] = {}


@dataclass
class Extremes:
    """Extreme values over a whole stress test."""

    finite: bool = True
    kinetic_peak_mj: float = 0.0
    volume_least: float = 1.0
    volume_most: float = 1.0
    fallbacks: list[str] = field(default_factory=list)

    def record(self, specimen: Specimen, notice: str) -> None:
        """Take the state after a step and the divergence check's notice."""
        if notice:
            self.fallbacks.append(notice)
        if not specimen.is_finite():
            self.finite = False
            return
        volume = specimen.volume_ratio()
        self.volume_least = min(self.volume_least, volume)
        self.volume_most = max(self.volume_most, volume)
        self.kinetic_peak_mj = max(self.kinetic_peak_mj, specimen.kinetic_mj())

    def fallback(self) -> str | None:
        """The first notice of the divergence check, and how many there were."""
        if not self.fallbacks:
            return None
        times = f" ({len(self.fallbacks)} times)" if len(self.fallbacks) > 1 else ""
        return self.fallbacks[0] + times


def run(model: str, case: StressCase) -> dict[str, Any]:
    """One case's figures, under the names of stability.json."""
    key = (model, case.subject)
    if key not in _prepared:
        _prepared.clear()
        _prepared[key] = prepared(model, case.subject)
    specimen = _prepared[key]
    extremes = Extremes()
    _apply(specimen, case, extremes)
    _release(specimen, extremes)
    rest_error = specimen.rest_error_mm()
    end = dict(volume_ratio=specimen.volume_ratio(), kinetic_end_mj=specimen.kinetic_mj())
    recovered = rest_error <= RECOVERED_MM
    shape_error = None if recovered else _free_shape_error(specimen)
    return dict(
        name=case.name,
        model=model,
        kind=case.kind,
        extreme=case.extreme,
        body=case.subject.kind,
        points=specimen.body.count,
        finite=extremes.finite and specimen.is_finite(),
        recovered=recovered,
        rest_error_mm=rounded(rest_error),
        shape_error_mm=rounded(shape_error),
        **{name: rounded(value) for name, value in end.items()},
        volume_ratio_min=rounded(extremes.volume_least),
        volume_ratio_max=rounded(extremes.volume_most),
        kinetic_peak_mj=rounded(extremes.kinetic_peak_mj),
        fallback=extremes.fallback(),
        reason=_reason(rest_error, shape_error),
    )


def _apply(specimen: Specimen, case: StressCase, extremes: Extremes) -> None:
    """The extreme, from the settled state and with the case's own settings."""
    settings = replace(specimen.settings, **case.settings)
    x, y, z = specimen.settings.gravity
    settings.gravity = (case.gravity * x, case.gravity * y, case.gravity * z)
    dt = settings.time_step_s
    specimen.solver.restore(specimen.settled)
    specimen.divergence_check.set_initial_state()
    state, *numbers = case.state
    if state != "settled":
        position, velocity = STATES[state](specimen.rest, specimen.up, *numbers)
        specimen.body.restore(BodyState(position.astype(np.float32), velocity.astype(np.float32)))
        specimen.solver.contacts.reset()
    _set_material(specimen, case.heaviest, case.material)
    motion, *numbers = case.probe
    path = PROBES[motion](specimen.home, specimen.thickness_mm, dt, *numbers)
    for step in range(max(LEAST_STEPS, round(LEAST_S / dt))):
        times = dt * (step + np.linspace(0.0, 1.0, settings.substeps + 1))
        specimen.solver.step(settings, np.stack([path(float(t)) for t in times]))
        extremes.record(specimen, specimen.divergence_check.check(dt))
    _set_material(specimen, 1.0, {})


def _set_material(specimen: Specimen, heaviest: float, material: Mapping[str, float]) -> None:
    """Multiply the mass of the middle node and change the material; shape matching has its mass ratio from the start."""
    if isinstance(specimen.model, NeoHookean):
        mass = specimen.mass.copy()
        mass[len(mass) // 2] *= heaviest
        fill((specimen.model.mass, mass))
        specimen.model.set_material(**{"young_kpa": YOUNG_KPA, "poisson": POISSON, **material})


def _release(specimen: Specimen, extremes: Extremes) -> None:
    """The default settings without the transducer, until the body is at rest or RELEASE_STEPS are over."""
    away = np.stack([advanced(specimen.home, -AWAY_MM)] * (specimen.settings.substeps + 1))
    for step in range(1, RELEASE_STEPS + 1):
        specimen.solver.step(specimen.settings, away)
        notice = specimen.divergence_check.check(specimen.settings.time_step_s)
        if notice or step % CHECK_EVERY == 0:
            extremes.record(specimen, notice)
        if step % CHECK_EVERY == 0 and specimen.rest_error_mm() < RECOVERED_MM / 2:
            return


def _free_shape_error(specimen: Specimen) -> float:
    """Mean distance [mm] from the stress-free shape after a rigid fit, lifted off the support and without gravity.

    This removes the effect of friction and of another position on the support.
    """
    state = specimen.solver.snapshot()
    up = (state.body.position + LIFT_MM * specimen.up).astype(np.float32)
    specimen.solver.restore(SolverState(BodyState(up, np.zeros_like(up)), state.contacts))
    specimen.solver.contacts.reset()
    weightless: StepSettings = replace(specimen.settings, gravity=(0.0, 0.0, 0.0))
    error = np.inf
    for step in range(1, LIFT_STEPS + 1):
        specimen.solver.step(weightless)
        if step % CHECK_EVERY == 0:
            error = _shape_error(specimen)
            if error < RECOVERED_MM / 2:
                break
    return error


def _shape_error(specimen: Specimen) -> float:
    position = array_of(specimen.body.position).astype(float)
    if not np.isfinite(position).all():
        return np.inf
    rest = specimen.body.rest_points
    apart = [distances_after_fit(position[part], rest[part]) for part in specimen.parts]
    return float(np.concatenate(apart).mean())


def _reason(rest_error: float, shape_error: float | None) -> str | None:
    """Why a body has not recovered its position; None where it has."""
    if shape_error is None:
        return None
    if shape_error <= RECOVERED_MM:
        return f"its shape has recovered, {rest_error:.2g} mm from its rest position (friction or another place on the support)"
    return f"its shape differs by {shape_error:.2g} mm: entangled below what the divergence check detects, or not yet at rest"
