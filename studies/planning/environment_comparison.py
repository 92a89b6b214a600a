"""The command ``study gymnasium``: planned, straight and random sweeps, followed in the environment."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rehearsal.commands.command_line import CommandError
from rehearsal.planning.plan_search import make_plan, total_work
from rehearsal.planning.sweep_trial import TrialWorkers
from scenes.scene import EMBEDDED
from studies.planning.baseline_sweeps import planned, random_sweep, straight
from studies.planning.plan_comparison import trials_option
from studies.study import Results, Study, paths_argument, study_command
from studies.tables_and_panels import table_of

if TYPE_CHECKING:
    from rehearsal.gymnasium_environment import ProbeEnvironment

SPEED_MM_S, PASSES, SEEDS = 10.0, 2, range(3)
# Of the environment: an episode is as long as its sweep; the images do not count.
MOST_ACTIONS, PIXELS = 10_000, 24
# A pose is reached where the rest of the way is less than this share of the greatest action; one that is too
# deep for the environment is never reached.
REACHED, MOST_TRIES = 0.02, 30
COLUMNS = {
    "sweep": "{sweep}",
    "actions": "{actions}",
    "covered, %": "{covered_percent:.0f}",
    "sum of rewards": "{rewards:.1f}",
}


@study_command("gymnasium", paths_argument("scenes"), trials_option, has_workers=True)
def gymnasium_study(study: Study, scenes: tuple[Path, ...], trials: int) -> Results:
    """Follow planned, straight and random sweeps in the Gymnasium environment.

    Over the tumour of SCENES [the embedded patient], with the preset fast.
    """
    try:
        from rehearsal.gymnasium_environment import ProbeEnvironment
    except ImportError:
        raise CommandError("study gymnasium needs the package gymnasium: pip install gymnasium") from None
    runs = []
    for number, patient in enumerate(scenes or (EMBEDDED,), 1):
        environment = ProbeEnvironment(patient, actions=MOST_ACTIONS, pixels=PIXELS)
        title = environment.problem.scene.title or f"patient {number}"
        runs.append(dict(patient=title) | compare(study, environment, trials))
    tables = [f"{run['patient']}\n{table_of(COLUMNS, run['rows'])}" for run in runs]
    return Results(dict(trials=trials, runs=runs), "\n\n".join(tables))


def compare(study: Study, environment: "ProbeEnvironment", trials: int) -> dict[str, Any]:
    """A row a sweep: of a plan for the environment's problem, straight, and random ones."""
    problem, trial = environment.problem, environment.trial
    total = total_work(trials, SPEED_MM_S)
    with study.workers() as workers, study.progress(total, "trial") as bar:
        plan = make_plan(TrialWorkers(problem, workers), SPEED_MM_S, trials, bar.update)
    sweeps = {f"planned: {sweep.name}": planned(trial, sweep) for sweep in plan.sweeps}
    sweeps |= {"straight": straight(trial)}
    sweeps |= {f"random, seed {seed}": random_sweep(trial, PASSES, seed) for seed in SEEDS}
    rows = [dict(sweep=name) | followed(environment, passes) for name, passes in sweeps.items()]
    return dict(quality="fast", target=problem.target, rows=rows)


def followed(environment: "ProbeEnvironment", passes: list[np.ndarray]) -> dict[str, Any]:
    """The figures of an episode whose actions go to the poses (n, 4, 4) of passes one by one."""
    environment.reset(seed=1)
    rewards, seen, actions = 0.0, 0.0, 0
    for goal in np.concatenate(passes):
        for _ in range(MOST_TRIES):
            action = environment.action_towards(goal)
            if np.abs(action).max() <= REACHED:
                break
            _, reward, _, _, info = environment.step(action)
            rewards, seen, actions = rewards + reward, info["seen"], actions + 1
    return dict(rewards=round(rewards, 2), covered_percent=round(100 * seen, 1), actions=actions)
