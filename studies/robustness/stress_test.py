"""The command ``study stability``: a stress test of every tissue model, its table and its figure.

An extreme is applied to a body and released, and what remains of the deformation is measured.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby, repeat
from pathlib import Path
from typing import Any

import click
import numpy as np
from joblib import Parallel, delayed
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from tqdm import tqdm

from rehearsal.commands.command_line import make_folder
from rehearsal.result_files import rounded
from rehearsal.worker_processes import processes
from sim.body import BodyState
from sim.fields import fill
from sim.neo_hookean import NeoHookean
from sim.solver import SolverState
from studies.harness import Watch, distances_after_fit, positions_of
from studies.robustness.stress_bodies import Specimen, prepared
from studies.robustness.stress_cases import (
    MODELS,
    RECOVERED_MM,
    StressCase,
    Subject,
    cases_of,
    quick_cases_of,
)
from studies.robustness.stress_motion import AWAY_MM, PROBES, STATES
from studies.study_options import jobs_option, out_option
from studies.study_results import finish_axes, text_table, write_results
from ultrasound.probe_manipulator import advanced

# Cases of one body in a task, after which the progress bar advances; the process keeps the body for the next task.
BATCH = 4
# How a case may end, and its colour; good ends first.
OUTCOMES = {
    "recovered its position": "#2a7f4f",
    "recovered its position after the state was restored": "#8fce9d",
    "recovered its shape in another position": "#4f86c6",
    "recovered its shape in another position after the state was restored": "#a9c8ea",
    "shape changed": "#f0a030",
    "not finite": "#c0202a",
}
HEADERS = ("model", "kind", "cases", "finite", "recovered", "restored", "worst rest error, mm", "volume")
# Long enough for the divergence check to restore a state, and for a thrown body to fall and come to rest.
RELEASE_STEPS, LIFT_STEPS, CHECK_EVERY = 300, 240, 30
LEAST_STEPS, LEAST_S = 40, 0.04
LIFT_MM = 400.0
YOUNG_KPA, POISSON = 15.0, 0.45
_prepared: dict[tuple[str, Subject], Specimen] = {}


@click.command()
@out_option
@click.option("--quick", is_flag=True, help="One case of each kind, in one to two minutes.")
@jobs_option
def stability(out: Path, quick: bool, jobs: int | None) -> None:
    """Stress-test the tissue and see whether it recovers.

    Each model, under extremes of settings, tool and state.
    """
    make_folder(out)
    given = {model: quick_cases_of(model) if quick else cases_of(model) for model in MODELS}
    rows: list[dict[str, Any]] = []
    with tqdm(total=sum(map(len, given.values())), desc="stability", unit="case") as bar:
        for found in _figures(given, jobs):
            rows += found
            bar.update(len(found))
    text = f"{table(rows)}\n\n{summary(rows)}"
    write_results(out, "stability", dict(cases=rows), text, rows, figure_of(rows))


def _figures(given: dict[str, list[StressCase]], jobs: int | None) -> Iterator[list[dict[str, Any]]]:
    """Batches of figures in the order of the cases, as they are done."""
    tasks = []
    for model, cases in given.items():
        for _, group in groupby(cases, key=lambda case: case.subject):
            same = list(group)
            tasks += [(model, same[first : first + BATCH]) for first in range(0, len(same), BATCH)]
    with processes(jobs):
        yield from Parallel(return_as="generator", batch_size=1)(delayed(_run_all)(*task) for task in tasks)


def _run_all(model: str, cases: list[StressCase]) -> list[dict[str, Any]]:
    return [run(model, case) for case in cases]


@dataclass
class Extremes(Watch):
    """Extreme values over a whole stress test."""

    finite: bool = True
    kinetic_peak_mj: float = 0.0
    volume_least: float = 1.0
    volume_most: float = 1.0

    def record(self, specimen: Specimen) -> None:
        """Take the state after a step."""
        if not specimen.is_finite():
            self.finite = False
            return
        volume = specimen.volume_ratio()
        self.volume_least = min(self.volume_least, volume)
        self.volume_most = max(self.volume_most, volume)
        self.kinetic_peak_mj = max(self.kinetic_peak_mj, specimen.kinetic_mj())

    def fallback(self) -> str | None:
        """The first message of the divergence check, and how many there were."""
        if not self.restored:
            return None
        times = f" ({len(self.restored)} times)" if len(self.restored) > 1 else ""
        return self.restored[0] + times


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
    within = np.linspace(0.0, 1.0, settings.substeps + 1)
    moves = (
        np.stack([path(float(t)) for t in dt * (step + within)])
        for step in range(max(LEAST_STEPS, round(LEAST_S / dt)))
    )
    for _ in extremes.drive(partial(specimen.advance, settings), moves):
        extremes.record(specimen)
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
    released = extremes.drive(partial(specimen.advance, specimen.settings), repeat(away, RELEASE_STEPS))
    for step, notice in enumerate(released, 1):
        if notice or step % CHECK_EVERY == 0:
            extremes.record(specimen)
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
        return f"its shape has recovered, {rest_error:.2g} mm from its rest position (friction or another place on the support)"
    return f"its shape differs by {shape_error:.2g} mm: entangled below what the divergence check detects, or not yet at rest"


def table(rows: list[dict[str, Any]]) -> str:
    """A line a model and kind of case: how many, and how they ended."""
    lines = []
    for model, kind in dict.fromkeys((row["model"], row["kind"]) for row in rows):
        cases = [row for row in rows if (row["model"], row["kind"]) == (model, kind)]
        volumes = [row["volume_ratio"] for row in cases if row["volume_ratio"] is not None]
        worst = max(row["rest_error_mm"] or 0.0 for row in cases)
        counts = [_count(cases, key) for key in ("finite", "recovered", "fallback")]
        volume = f"{min(volumes):.2f}-{max(volumes):.2f}"
        lines.append([model, kind, len(cases), *counts, f"{worst:.2f}", volume])
    return text_table(HEADERS, lines)


def summary(rows: list[dict[str, Any]]) -> str:
    """The outcome of all cases of a model, and the reasons of those that did not recover."""
    lines = []
    for model, group in groupby(rows, key=lambda row: row["model"]):
        cases = list(group)
        changed = [row for row in cases if outcome_of(row) in ("shape changed", "not finite")]
        elsewhere = len(cases) - len(changed) - _count(cases, "recovered")
        lines.append(
            f"{model}: {len(cases)} cases, {_count(cases, 'finite')} finite; {_count(cases, 'recovered')} recovered to "
            f"within {RECOVERED_MM:g} mm; the state was restored in {_count(cases, 'fallback')}; {elsewhere} recovered their "
            f"shape in another position; {len(changed)} did not"
        )
        lines += [f"  {row['name']}: {row['reason']}" for row in changed]
    return "\n".join(lines)


def _count(rows: list[dict[str, Any]], key: str) -> int:
    return sum(bool(row[key]) for row in rows)


def outcome_of(row: dict[str, Any]) -> str:
    """How a case ended: one of ``OUTCOMES``."""
    if not row["finite"]:
        return "not finite"
    if not row["recovered"] and (row["shape_error_mm"] is None or row["shape_error_mm"] > RECOVERED_MM):
        return "shape changed"
    position, restored, shape, shape_restored, *_ = OUTCOMES
    if row["recovered"]:
        return restored if row["fallback"] else position
    return shape_restored if row["fallback"] else shape


def figure_of(rows: list[dict[str, Any]]) -> Figure:
    """A panel a model, a bar a kind of case."""
    kinds = list(dict.fromkeys(row["kind"] for row in rows))
    models = list(dict.fromkeys(row["model"] for row in rows))
    figure = Figure(figsize=(12, 0.25 * len(kinds) + 2), layout="constrained")
    panels = figure.subplots(1, len(models), sharey=True, squeeze=False)[0]
    for axes, model in zip(panels, models, strict=True):
        _bars(axes, [row for row in rows if row["model"] == model], kinds)
        axes.set_title(model)
    panels[0].invert_yaxis()
    ends = [[outcome_of(row) for row in rows if row["model"] == model] for model in models]
    handles = [
        Patch(color=colour, label=f"{outcome}: {', '.join(str(each.count(outcome)) for each in ends)}")
        for outcome, colour in OUTCOMES.items()
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    figure.suptitle("How the tissue ended after the stress test")
    return figure


def _bars(axes: Axes, rows: list[dict[str, Any]], kinds: list[str]) -> None:
    ends = [(row["kind"], outcome_of(row)) for row in rows]
    begins = [0] * len(kinds)
    for outcome, colour in OUTCOMES.items():
        counts = [ends.count((kind, outcome)) for kind in kinds]
        axes.barh(kinds, counts, left=begins, color=colour)
        begins = [begin + count for begin, count in zip(begins, counts, strict=True)]
    finish_axes(axes, grid="x", xlabel=f"cases, of {len(rows)}", axisbelow=True)
