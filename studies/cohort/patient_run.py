"""One patient of a cohort, in a worker: settled, pressed and planned for."""

from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np

from rehearsal.loop.command import Move
from rehearsal.measurements.run_report import Tally
from rehearsal.measurements.tumour_measurements import measure
from rehearsal.planning.plan_file import Plan, PlanError
from rehearsal.planning.plan_search import make_plan
from rehearsal.planning.sweep_trial import PlanningProblem, Trial, TrialHere
from rehearsal.rehearsal import Rehearsal
from rehearsal.result_files import rounded
from rehearsal.worker_processes import built_once
from studies.harness import all_scanlines

SPEED_MM_S = 10.0
# Measured in the press at each depth.
MEASURED = (
    "compression_mm",
    "tumour_shift_mm",
    "to_tumour_mm",
    "tumour_depth_mm",
    "margin_mm",
    "force_n",
)


@dataclass(frozen=True)
class PatientResult:
    """The report of settling and press, as report.json; the plan, or why there is none; and the time."""

    report: dict[str, Any]
    plan: Plan | None
    message: str
    seconds: float


def run_patient(key: str, problem: PlanningProblem, trials: int) -> PatientResult:
    """Settle a patient's organ, make the scene's press, search a plan. Raises UserError."""
    begin = perf_counter()
    trial = built_once(key, lambda: Trial(problem))
    report = press(trial.rehearsal, perf_counter() - begin)
    plan, message = None, ""
    if not report["finite"]:
        message = "the tissue diverged in the press; no plan was searched"
    else:
        try:
            plan = make_plan(TrialHere(problem, trial), SPEED_MM_S, trials, lambda _: None)
        except PlanError as error:
            message = str(error)
    return PatientResult(report, plan, message, round(perf_counter() - begin, 1))


def press(rehearsal: Rehearsal, build_s: float) -> dict[str, Any]:
    """The report of the scripted press from the settled organ, with ``settled_shift_mm`` and ``stages``."""
    rehearsal.reset()
    case, anatomy = rehearsal.case, rehearsal.anatomy
    shift = anatomy.vertices - case.organ.vertices
    dt, steps = case.scene.solver.time_step_s, case.press.stage_steps
    tally, touches = Tally(build_s), all_scanlines(case.probe)
    stages: list[dict[str, float | None]] = []
    for stage, depth_mm in enumerate(case.press.indentations_mm):
        for step in range(stage * steps + 1, (stage + 1) * steps + 1):
            tally.add(rehearsal, rehearsal.do(Move(pose=rehearsal.scripted_pose(step * dt))))
        if not tally.finite:
            break
        measurement = measure(anatomy, case.probe, touches)
        measured = {name: rounded(getattr(measurement, name)) for name in MEASURED}
        stages.append(measured | dict(indentation_mm=depth_mm))
    settled = rounded(np.linalg.norm(shift, axis=1).max())
    return tally.report(rehearsal, "cpu") | dict(settled_shift_mm=settled, stages=stages)
