"""A planned sweep against unplanned ones, all on a finer model than the one it was planned on."""

from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import numpy as np

from rehearsal.configuration import PRESETS, probe_of, scene_of
from rehearsal.planning.plan_search import make_plan, total_work, work_at
from rehearsal.planning.sweep_path import SweepPath
from rehearsal.planning.sweep_score import ScoreTerms, score
from rehearsal.planning.sweep_trial import Trial
from rehearsal.planning.trial_workers import PlanningProblem, TrialResult, TrialWorkers
from scenes.anatomy import LoadedAnatomy
from scenes.scene import Scene
from studies.planning.baseline_sweeps import UNPLANNED, planned, random_sweeps
from ultrasound.target import Target

TARGET: Target = "margin"
MARGIN_MM, SPEED_MM_S = 5.0, 10.0
SEEDS = range(3)
PLANNED_ON = PRESETS["neo-hookean"]["balanced"]
# Another grid and more iterations: a plan that suits only its own model scores badly here.
JUDGED_ON = PLANNED_ON.but(cell_mm=2.7, iterations=8)


def count_of(trials: int) -> int:
    """Sum of what ``compare`` reports as done."""
    return total_work(trials, SPEED_MM_S) + (1 + len(UNPLANNED) + len(SEEDS)) * work_at(SPEED_MM_S)


def compare(
    scene: Scene, anatomy: LoadedAnatomy, trials: int, jobs: int | None, done: Callable[[int], Any]
) -> dict[str, Any]:
    """Plan for the tumour and its margin, and compute planned, straight and random sweeps. Raises PlanError."""
    probe = probe_of(scene)
    problem = PlanningProblem(scene_of(scene, PLANNED_ON), anatomy, probe, TARGET, MARGIN_MM, scene.trocar)
    with TrialWorkers(problem, jobs) as workers:
        plan = make_plan(problem, workers, SPEED_MM_S, trials, done)
    sweep = plan.sweeps[0]
    paths: list[Callable[[Trial], SweepPath]] = [
        partial(planned, sweep=sweep),
        *UNPLANNED.values(),
        *random_sweeps(len(sweep.passes), SEEDS),
    ]
    outcomes: list[TrialResult] = []
    with TrialWorkers(replace(problem, scene=scene_of(scene, JUDGED_ON)), jobs) as workers:
        for one in workers.try_paths(paths, SPEED_MM_S):
            outcomes.append(one)
            done(work_at(SPEED_MM_S))
    rows = [_row(name, [one]) for name, one in zip(["planned", *UNPLANNED], outcomes, strict=False)]
    rows.append(_row("random", outcomes[len(rows) :]))
    return dict(
        plan=sweep.name,
        why=plan.why,
        probe=probe.transducer_name,
        planned_on=plan.model,
        judged_on=dict(cell_mm=JUDGED_ON.size_mm, iterations=JUDGED_ON.iterations),
        speed_mm_s=SPEED_MM_S,
        rows=rows,
    )


def _row(name: str, outcomes: list[TrialResult]) -> dict[str, Any]:
    """Means over several sweeps, and their number."""
    parts = [asdict(one.terms) for one in outcomes]
    means = ScoreTerms(**{key: float(np.mean([each[key] for each in parts])) for key in parts[0]})
    return dict(
        sweep=name,
        count=len(outcomes),
        **asdict(means),
        score=float(np.mean([score(one.terms) for one in outcomes])),
    )
