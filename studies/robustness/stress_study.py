"""The command ``study stability``: a stress test of every tissue model, its table and its figure.

An extreme is applied to a body and released, and what remains of the deformation is measured.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from rehearsal.result_files import rounded
from rehearsal.worker_processes import built_once
from sim.body import BodyState
from sim.fields import fill
from sim.neo_hookean import NeoHookean
from sim.solver import SolverState, StepSettings
from studies.harness import distances_after_fit, positions_of
from studies.robustness.stress_bodies import Specimen, prepared
from studies.robustness.stress_cases import (
    MODELS,
    RECOVERED_MM,
    StressCase,
    cases_of,
    quick_cases_of,
)
from studies.robustness.stress_motion import AWAY_MM, PROBES, STATES
from studies.study import Results, Study, quick_option, study_command
from studies.tables_and_panels import draw_panel, panels_of, table_of
from ultrasound.probe_manipulator import advanced

# How a case may end, and its colour; good ends first.
OUTCOMES = {
    "recovered its position": "#2a7f4f",
    "recovered its position after the state was restored": "#8fce9d",
    "recovered its shape in another position": "#4f86c6",
    "recovered its shape in another position after the state was restored": "#a9c8ea",
    "shape changed": "#f0a030",
    "not finite": "#c0202a",
}
COLUMNS = {
    "model": "{model}",
    "kind": "{kind}",
    "cases": "{cases:g}",
    "finite": "{finite:g}",
    "recovered": "{recovered:g}",
    "restored": "{restored:g}",
    "worst rest error, mm": "{worst:.2f}",
    "volume": "{least:.2f}-{most:.2f}",
}
# Long enough for the divergence check to restore a state, and for a thrown body to fall and come to rest.
RELEASE_STEPS, LIFT_STEPS, CHECK_EVERY = 300, 240, 30
LEAST_STEPS, LEAST_S = 40, 0.04
LIFT_MM = 400.0
YOUNG_KPA, POISSON = 15.0, 0.45


@study_command("stability", quick_option("One case of each kind, in one to two minutes."), has_workers=True)
def stability(study: Study, quick: bool) -> Results:
    """Stress-test the tissue and see whether it recovers.

    Each model, under extremes of settings, tool and state.
    """
    tasks = [(model, case) for model in MODELS for case in (quick_cases_of if quick else cases_of)(model)]
    with study.workers() as workers:
        rows = list(study.progress(len(tasks), "case", workers.map(_run_in_worker, tasks)))
    return Results(dict(cases=rows), f"{table(rows)}\n\n{summary(rows)}", rows, figure_of(rows))


def _run_in_worker(model: str, case: StressCase) -> dict[str, Any]:
    """The figures of a case; the process keeps the body for the next one, which mostly has the same."""
    return run(built_once((model, case.subject), lambda: prepared(model, case.subject)), model, case)


class Extremes:
    """Extreme values over a whole stress test, and the messages of the divergence check."""

    def __init__(self, specimen: Specimen) -> None:
        self.specimen = specimen
        self.finite = True
        self.volumes, self.kinetic_mj = [1.0], [0.0]
        self.restored: list[str] = []

    def advance(self, settings: StepSettings, poses: np.ndarray) -> bool:
        """Take a step; whether the state was restored."""
        notice = self.specimen.advance(settings, poses)
        self.restored += [notice] if notice else []
        return bool(notice)

    def record(self) -> None:
        """Take the state after a step."""
        if not self.specimen.is_finite():
            self.finite = False
            return
        self.volumes.append(self.specimen.volume_ratio())
        self.kinetic_mj.append(self.specimen.kinetic_mj())

    def fallback(self) -> str | None:
        """The first message of the divergence check, and how many there were."""
        if not self.restored:
            return None
        times = f" ({len(self.restored)} times)" if len(self.restored) > 1 else ""
        return self.restored[0] + times


def run(specimen: Specimen, model: str, case: StressCase) -> dict[str, Any]:
    """One case's figures, under the names of stability.json."""
    extremes = Extremes(specimen)
    _apply(specimen, case, extremes)
    _release(specimen, extremes)
    rest_error, volume, kinetic = specimen.rest_error_mm(), specimen.volume_ratio(), specimen.kinetic_mj()
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
        volume_ratio=rounded(volume),
        kinetic_end_mj=rounded(kinetic),
        volume_ratio_min=rounded(min(extremes.volumes)),
        volume_ratio_max=rounded(max(extremes.volumes)),
        kinetic_peak_mj=rounded(max(extremes.kinetic_mj)),
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
    pose_at = PROBES[motion]
    within = np.linspace(0.0, 1.0, settings.substeps + 1)
    for step in range(max(LEAST_STEPS, round(LEAST_S / dt))):
        extremes.advance(
            settings, np.stack([pose_at(float(t), specimen, dt, *numbers) for t in dt * (step + within)])
        )
        extremes.record()
    _set_material(specimen, 1.0, {})


def _set_material(specimen: Specimen, heaviest: float, material: Mapping[str, float]) -> None:
    """Change the middle node's mass and the material; shape matching has its mass ratio from the start."""
    if isinstance(specimen.model, NeoHookean):
        mass = specimen.mass.copy()
        mass[len(mass) // 2] *= heaviest
        fill((specimen.model.mass, mass))
        specimen.model.set_material(material.get("young_kpa", YOUNG_KPA), material.get("poisson", POISSON))


def _release(specimen: Specimen, extremes: Extremes) -> None:
    """The default settings without the transducer, until the body is at rest or RELEASE_STEPS are over."""
    away = np.stack([advanced(specimen.home, -AWAY_MM)] * (specimen.settings.substeps + 1))
    for step in range(1, RELEASE_STEPS + 1):
        if extremes.advance(specimen.settings, away) or step % CHECK_EVERY == 0:
            extremes.record()
        if step % CHECK_EVERY == 0 and specimen.rest_error_mm() < RECOVERED_MM / 2:
            return


def _free_shape_error(specimen: Specimen) -> float:
    """Mean distance [mm] from the stress-free shape after a rigid fit, lifted off the support and without
    gravity.

    This removes the effect of friction and of another position on the support.
    """
    state = specimen.solver.snapshot()
    up = (state.body.position + LIFT_MM * specimen.up).astype(np.float32)
    specimen.solver.restore(SolverState(BodyState(up, np.zeros_like(up)), state.internal_state))
    specimen.solver.contacts.reset()
    weightless = replace(specimen.settings, gravity=(0.0, 0.0, 0.0))
    error = np.inf
    for step in range(1, LIFT_STEPS + 1):
        specimen.solver.step(weightless)
        if step % CHECK_EVERY == 0:
            error = _shape_error(specimen)
            if error < RECOVERED_MM / 2:
                break
    return error


def _shape_error(specimen: Specimen) -> float:
    position = positions_of(specimen.solver)
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
        return (
            f"its shape has recovered, {rest_error:.2g} mm from its rest position (friction or another "
            "place on the support)"
        )
    return (
        f"its shape differs by {shape_error:.2g} mm: entangled below what the divergence check detects, "
        "or not yet at rest"
    )


def table(rows: list[dict[str, Any]]) -> str:
    """A line a model and kind of case: how many, and how they ended."""
    kinds = pd.DataFrame(rows).groupby(["model", "kind"], sort=False)
    counts = kinds.agg(
        cases=("name", "size"),
        finite=("finite", "sum"),
        recovered=("recovered", "sum"),
        restored=("fallback", "count"),
        worst=("rest_error_mm", "max"),
        least=("volume_ratio", "min"),
        most=("volume_ratio", "max"),
    )
    return table_of(COLUMNS, counts.reset_index().to_dict("records"))


def summary(rows: list[dict[str, Any]]) -> str:
    """The outcome of all cases of a model, and the reasons of those that did not recover."""
    lines = []
    for model, cases in pd.DataFrame(rows).groupby("model", sort=False):
        changed = cases[cases.apply(outcome_of, axis=1).isin(["shape changed", "not finite"])]
        recovered = cases.recovered.sum()
        lines.append(
            f"{model}: {len(cases)} cases, {cases.finite.sum()} finite; {recovered} recovered to "
            f"within {RECOVERED_MM:g} mm; the state was restored in {cases.fallback.count()}; "
            f"{len(cases) - len(changed) - recovered} recovered their shape in another position; "
            f"{len(changed)} did not"
        )
        lines += [f"  {row['name']}: {row['reason']}" for _, row in changed.iterrows()]
    return "\n".join(lines)


def outcome_of(row: Mapping[str, Any]) -> str:
    """How a case ended: one of ``OUTCOMES``."""
    if not row["finite"]:
        return "not finite"
    if row["recovered"]:
        end = "recovered its position"
    elif row["shape_error_mm"] is not None and row["shape_error_mm"] <= RECOVERED_MM:
        end = "recovered its shape in another position"
    else:
        return "shape changed"
    return end + (" after the state was restored" if isinstance(row["fallback"], str) else "")


def figure_of(rows: list[dict[str, Any]]) -> Figure:
    """A panel a model, a bar a kind of case."""
    frame = pd.DataFrame(rows).assign(outcome=[outcome_of(row) for row in rows])
    kinds, models = list(frame.kind.unique()), list(frame.model.unique())
    figure, panels = panels_of((12, 0.25 * len(kinds) + 2), 1, len(models), sharey=True)
    for axes, (model, cases) in zip(panels[0], frame.groupby("model", sort=False), strict=True):
        counts = pd.crosstab(cases.kind, cases.outcome).reindex(kinds, columns=list(OUTCOMES), fill_value=0)
        counts.plot.barh(stacked=True, color=OUTCOMES, width=0.8, legend=False, title=model, ax=axes)
        draw_panel(axes, grid="x", xlabel=f"cases, of {len(cases)}", ylabel="", axisbelow=True)
    panels[0, 0].invert_yaxis()
    ends = pd.crosstab(frame.outcome, frame.model).reindex(OUTCOMES, columns=models, fill_value=0)
    handles = [
        Patch(color=colour, label=f"{outcome}: {', '.join(map(str, ends.loc[outcome]))}")
        for outcome, colour in OUTCOMES.items()
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    figure.suptitle("How the tissue ended after the stress test")
    return figure
