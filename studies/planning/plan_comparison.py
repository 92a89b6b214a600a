"""The command ``study plan``: planned sweeps against unplanned ones, all on a finer model than the one of
the plan.
"""

from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np
import trimesh

from rehearsal.commands.command_line import load_patient
from rehearsal.configuration import PRESETS, probe_of, scene_of
from rehearsal.planning.plan_file import MOST_SWEEPS
from rehearsal.planning.plan_search import make_plan, total_work, try_path, work_at
from rehearsal.planning.sweep_score import ScoreTerms, score
from rehearsal.planning.sweep_trial import PlanningProblem, Trial, TrialWorkers
from rehearsal.worker_processes import Workers
from scenes.anatomy import LoadedAnatomy
from scenes.scene import EMBEDDED, Scene
from studies.planning.baseline_sweeps import UNPLANNED, planned, random_sweep
from studies.study import Results, Study, paths_argument, study_command, whole_option
from studies.tables_and_panels import table_of
from ultrasound.target import Target

TARGET: Target = "margin"
MARGIN_MM, SPEED_MM_S = 5.0, 10.0
SEEDS = range(3)
# The tumour of a kidney that has none: its radius, the depth of its top under the surface [mm], and its place
# along the organ, a share of the length from the lower pole.
TUMOUR_MM, UNDER_MM, ALONG = 10.0, 1.5, 0.35
PLANNED_ON = PRESETS["neo-hookean"]["balanced"]
# Another grid and more iterations: a plan that suits only its own model scores badly here.
JUDGED_ON = PLANNED_ON.but(cell_mm=2.7, iterations=8)
trials_option = whole_option(
    "--trials", MOST_SWEEPS, 100_000, 24, "Simulated passes of the probe in the search for a plan."
)
COLUMNS = {
    "sweep": "{name}",
    "covered, %": "{seen_percent:.0f}",
    "compression, mean, mm": "{compression_mean_mm:.1f}",
    "maximum, mm": "{compression_max_mm:.1f}",
    "contact, %": "{contact_percent:.0f}",
    "incidence, deg": "{incidence_deg:.0f}",
    "path, mm": "{path_mm:.0f}",
    "reachable, %": "{reachable_percent:.0f}",
    "score": "{score:.1f}",
}


@study_command(
    "plan",
    paths_argument("scenes"),
    trials_option,
    click.option("--probe", default="drop-in", show_default=True, help="Probe, by its name or as a file."),
    has_workers=True,
)
def plan_study(study: Study, scenes: tuple[Path, ...], trials: int, probe: str) -> Results:
    """Compare planned sweeps with straight and random ones.

    Over the tumour and 5 mm around it, in SCENES [the embedded patient].
    A kidney without a tumour is given one.
    """
    runs = []
    patients = scenes or (EMBEDDED,)
    with study.workers() as workers, study.progress(len(patients) * count_of(trials), "trial") as bar:
        for number, patient in enumerate(patients, 1):
            scene, loaded = load_patient(patient, {"transducer.probe": probe})
            anatomy = with_tumour(loaded, np.array(scene.gravity.direction))
            run = compare(scene, anatomy, trials, workers, bar.update)
            runs.append(dict(patient=scene.title or f"patient {number}") | run)
            bar.update(number * bar.total // len(patients) - bar.n)
    return Results(dict(trials=trials, runs=runs), "\n".join(map(table, runs)))


def count_of(trials: int) -> int:
    """Sum of what ``compare`` reports as done."""
    return total_work(trials, SPEED_MM_S) + (1 + len(UNPLANNED) + len(SEEDS)) * work_at(SPEED_MM_S)


def compare(
    scene: Scene, anatomy: LoadedAnatomy, trials: int, workers: Workers, done: Callable[[int], Any]
) -> dict[str, Any]:
    """Plan for the tumour and its margin, and compute planned, straight and random sweeps.

    Raises PlanError.
    """
    probe = probe_of(scene)
    problem = PlanningProblem(scene_of(scene, PLANNED_ON), anatomy, probe, TARGET, MARGIN_MM, scene.trocar)
    plan = make_plan(TrialWorkers(problem, workers), SPEED_MM_S, trials, done)
    sweep = plan.sweeps[0]
    paths: list[Callable[[Trial], list[np.ndarray]]] = [
        partial(planned, sweep=sweep),
        *UNPLANNED.values(),
        *(partial(random_sweep, count=len(sweep.passes), seed=seed) for seed in SEEDS),
    ]
    outcomes: list[ScoreTerms] = []
    judges = TrialWorkers(replace(problem, scene=scene_of(scene, JUDGED_ON)), workers)
    for terms, *_ in judges.map(try_path, [(make, SPEED_MM_S) for make in paths]):
        outcomes.append(terms)
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


def with_tumour(anatomy: LoadedAnatomy, gravity: np.ndarray) -> LoadedAnatomy:
    """The anatomy with a ball just under the highest point of its organ, unless it has a tumour."""
    if anatomy.tumour is not None:
        return anatomy
    organ, up = anatomy.organ, -np.asarray(gravity) / np.linalg.norm(gravity)
    axis = np.linalg.svd(organ.vertices - organ.vertices.mean(axis=0), full_matrices=False)[2][0]
    axis *= np.sign(axis[2])
    along = organ.vertices @ axis
    away = np.abs((along - along.min()) / np.ptp(along) - ALONG)
    near = np.flatnonzero(away < 0.1)
    top = near[np.argmax(organ.vertices[near] @ up)]
    centre = organ.vertices[top] - (TUMOUR_MM + UNDER_MM) * organ.vertex_normals[top]
    ball = trimesh.creation.icosphere(subdivisions=3, radius=TUMOUR_MM)
    return replace(anatomy, tumour=trimesh.Trimesh(ball.vertices + centre, ball.faces, process=False))


def _row(name: str, outcomes: list[ScoreTerms]) -> dict[str, Any]:
    """Means over several sweeps, and their number."""
    parts = [asdict(terms) | dict(score=score(terms)) for terms in outcomes]
    means = {key: float(np.mean([part[key] for part in parts])) for key in parts[0]}
    return dict(sweep=name, count=len(outcomes), **means)


def table(run: dict[str, Any]) -> str:
    """The figures of one patient."""
    rows = []
    for row in run["rows"]:
        name = row["sweep"] if row["count"] == 1 else f"{row['sweep']} ({row['count']})"
        percent = {f"{key}_percent": 100 * row[key] for key in ("seen", "contact", "reachable")}
        rows.append(row | percent | dict(name=name))
    return f"{run['patient']}, {run['probe']}: {run['plan']}\n{table_of(COLUMNS, rows)}\n"
