"""One case: maltreat a body, let go of it, and see what is left."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sim.body import BodyState
from sim.neo_hookean import NeoHookean
from sim.solver import SolverState, StepSettings
from studies.stability.bodies import Patient, admit
from studies.stability.cases import Case, Subject
from studies.stability.motion import PROBES, STATES
from ultrasound.probe import advanced

RECOVERED_MM = 0.1
# Long enough for the guard's patience and for what was thrown to come down and to rest.
RELEASE_STEPS, LIFT_STEPS, LOOK_EVERY = 300, 240, 30
LEAST_STEPS, LEAST_S = 40, 0.04
LIFT_MM = 400.0
AWAY_MM = 200.0
YOUNG_KPA, POISSON = 15.0, 0.45
_admitted: dict[tuple[str, Subject], Patient] = {}


@dataclass
class Course:
    """What was seen from the beginning to the end."""

    finite: bool = True
    kinetic_peak_mj: float = 0.0
    volume_least: float = 1.0
    volume_most: float = 1.0
    fallbacks: list[str] = field(default_factory=list)

    def look(self, patient: Patient, notice: str) -> None:
        """After a step, which the guard has seen."""
        if notice:
            self.fallbacks.append(notice)
        finite = bool(np.isfinite(patient.body.position.to_numpy()).all())
        self.finite &= finite
        if finite:
            volume = patient.volume_ratio()
            self.volume_least, self.volume_most = (
                min(self.volume_least, volume),
                max(self.volume_most, volume),
            )
            self.kinetic_peak_mj = max(self.kinetic_peak_mj, patient.kinetic_mj())


def run(model: str, case: Case) -> dict[str, Any]:
    """One case's figures, under the names of stability.json."""
    key = (model, case.subject)
    if key not in _admitted:
        _admitted.clear()
        _admitted[key] = admit(model, case.subject)
    patient = _admitted[key]
    course = Course()
    _maltreat(patient, case, course)
    _let_go(patient, course)
    rest_error = _distance(patient)
    end = dict(volume_ratio=patient.volume_ratio(), kinetic_end_mj=patient.kinetic_mj())
    recovered = rest_error <= RECOVERED_MM
    shape_error = None if recovered else _lifted(patient)
    return dict(
        name=case.name,
        model=model,
        kind=case.kind,
        extreme=case.extreme,
        body=case.subject.kind,
        points=patient.body.count,
        finite=course.finite and bool(np.isfinite(patient.body.position.to_numpy()).all()),
        recovered=recovered,
        rest_error_mm=_rounded(rest_error),
        shape_error_mm=_rounded(shape_error),
        **{name: _rounded(value) for name, value in end.items()},
        volume_ratio_min=_rounded(course.volume_least),
        volume_ratio_max=_rounded(course.volume_most),
        kinetic_peak_mj=_rounded(course.kinetic_peak_mj),
        fallback=_told(course.fallbacks),
        reason=_reason(rest_error, shape_error),
    )


def _maltreat(patient: Patient, case: Case, course: Course) -> None:
    """From the settled state, under the case's own settings."""
    settings = replace(patient.settings, **case.settings)
    x, y, z = patient.settings.gravity
    settings.gravity = (case.gravity * x, case.gravity * y, case.gravity * z)
    dt = settings.time_step_s
    position, velocity = _state(patient, case)
    patient.solver.restore(patient.settled)
    patient.guard.settle()
    if case.state[0] != "settled":
        patient.body.restore(BodyState(position.astype(np.float32), velocity.astype(np.float32)))
        patient.solver.contacts.forget()
    _weigh(patient, case.heaviest)
    _harden(patient, case.material)
    kind, *numbers = case.probe
    path = PROBES[kind](patient.home, patient.thickness_mm, dt, *numbers)
    for step in range(max(LEAST_STEPS, round(LEAST_S / dt))):
        times = dt * (step + np.linspace(0.0, 1.0, settings.substeps + 1))
        patient.solver.step(settings, np.stack([path(float(t)) for t in times]))
        course.look(patient, patient.guard.check(dt))
    _weigh(patient, 1.0)
    _harden(patient, {})


def _state(patient: Patient, case: Case) -> tuple[np.ndarray, np.ndarray]:
    kind, *numbers = case.state
    return STATES[kind](patient.rest, patient.up, *numbers)


def _weigh(patient: Patient, heaviest: float) -> None:
    """Make the middle node so many times as heavy; shape matching has its ratio from the start."""
    if isinstance(patient.model, NeoHookean):
        mass = patient.mass.copy()
        mass[len(mass) // 2] *= heaviest
        patient.model.mass.from_numpy(mass.astype(np.float32))


def _harden(patient: Patient, material: Mapping[str, float]) -> None:
    if isinstance(patient.model, NeoHookean):
        patient.model.set_material(**{"young_kpa": YOUNG_KPA, "poisson": POISSON, **material})


def _let_go(patient: Patient, course: Course) -> None:
    """The transducer taken away, usual settings, until it rests or time is over."""
    away = np.stack([advanced(patient.home, -AWAY_MM)] * (patient.settings.substeps + 1))
    for step in range(1, RELEASE_STEPS + 1):
        patient.solver.step(patient.settings, away)
        notice = patient.guard.check(patient.settings.time_step_s)
        if notice or step % LOOK_EVERY == 0:
            course.look(patient, notice)
        if step % LOOK_EVERY == 0 and _distance(patient) < RECOVERED_MM / 2:
            return


def _distance(patient: Patient) -> float:
    """Mean distance [mm] of the body's points from where they were at rest."""
    position = patient.body.position.to_numpy().astype(float)
    return float(np.linalg.norm(position - patient.rest, axis=1).mean())


def _lifted(patient: Patient) -> float:
    """Mean distance [mm] from the stress-free shape, turned and moved to fit, after it was taken off its support, weightless.

    What friction or another place on the support has kept is gone then, and what the tissue itself has not undone is left.
    """
    state = patient.solver.snapshot()
    up = (state.body.position + LIFT_MM * patient.up).astype(np.float32)
    patient.solver.restore(SolverState(BodyState(up, np.zeros_like(up)), state.contacts))
    patient.solver.contacts.forget()
    weightless: StepSettings = replace(patient.settings, gravity=(0.0, 0.0, 0.0))
    error = np.inf
    for step in range(1, LIFT_STEPS + 1):
        patient.solver.step(weightless)
        if step % LOOK_EVERY == 0:
            error = _shape_error(patient)
            if error < RECOVERED_MM / 2:
                break
    return error


def _shape_error(patient: Patient) -> float:
    position = patient.body.position.to_numpy().astype(float)
    wanted = patient.body.rest_points
    if not np.isfinite(position).all():
        return np.inf
    return float(np.concatenate([_apart(position[part], wanted[part]) for part in patient.parts]).mean())


def _apart(position: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Distances (n,) [mm] of points from wanted ones, after they were turned and moved to fit."""
    position, wanted = position - position.mean(axis=0), wanted - wanted.mean(axis=0)
    if len(wanted) > 1:
        position = Rotation.align_vectors(wanted, position)[0].apply(position)
    return np.linalg.norm(position - wanted, axis=1)


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


def _rounded(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else round(float(value), 6)
