"""Error and time of settings: bead experiments for the error, presses in turn for the time."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import groupby
from typing import Any

import numpy as np

from rehearsal.configuration import Setup
from rehearsal.result_files import rounded
from rehearsal.speed_accuracy.pareto_front import SETTINGS, pareto
from rehearsal.stopwatch import timed
from sim.device import start
from studies.accuracy.bead_case import BeadCase
from studies.accuracy.bead_errors import bead_errors
from studies.accuracy.bead_experiment import BeadExperiment
from ultrasound.probe_manipulator import poses_between

# The machine's speed changes within minutes: every setting is timed in each round, and the median is taken.
ROUNDS, TIMED_STEPS = 3, 45

Built = Iterator[tuple[BeadExperiment, list[Setup]]]


def points(
    cases: list[BeadCase], tried: list[Setup], arch: str, rounds: int, done: Callable[[], Any]
) -> list[dict[str, Any]]:
    """Rows of trade.json: error over all cases, time on the first; ``done`` is called after each run.

    Each stage counts twice: when the transducer arrives, as in a moving press, and after it has rested.
    With 0 ``rounds`` the time is that of the steps whose error was measured.
    """
    resting: dict[Setup, dict[str, float]] = {setup: {} for setup in tried}
    arriving: dict[Setup, dict[str, float]] = {setup: {} for setup in tried}
    ms: dict[Setup, list[float]] = {setup: [] for setup in tried}
    for case in cases:
        for experiment, setups in _built(case, tried, arch):
            for setup in setups:
                run = experiment.run(setup)
                if rounds == 0 and case is cases[0]:
                    ms[setup].append(float(np.median(run.step_ms)))
                resting[setup][case.name] = _mean_error(case, run.beads, run.finite)
                arriving[setup][case.name] = _mean_error(case, run.arriving, run.finite)
                done()
    for _ in range(rounds):
        for experiment, setups in _built(cases[0], tried, arch):
            for setup in setups:
                ms[setup].append(_time(experiment, setup))
                done()
    time_ms = np.array([np.median(ms[setup]) for setup in tried])
    error = np.array([np.mean([*resting[setup].values(), *arriving[setup].values()]) for setup in tried])
    best = pareto(time_ms, error)
    return [
        _row(setup, time_ms[k], best[k], resting[setup], arriving[setup]) for k, setup in enumerate(tried)
    ]


def count(cases: list[BeadCase], tried: list[Setup], rounds: int) -> int:
    """How often ``points`` calls ``done``."""
    return (len(cases) + rounds) * len(tried)


def _built(case: BeadCase, tried: list[Setup], arch: str) -> Built:
    """Each model and size on a freshly started device, with the settings that share it."""
    for _, sharing in groupby(tried, key=lambda setup: (setup.model, setup.size_mm)):
        group = list(sharing)
        start(arch)
        yield BeadExperiment(case, group[0]), group


def _mean_error(case: BeadCase, beads: np.ndarray, finite: bool) -> float:
    return float(bead_errors(case, beads).mean()) if finite else float("inf")


def _time(experiment: BeadExperiment, setup: Setup) -> float:
    """Median time of a step [ms] in a press to the deepest stage."""
    short = replace(setup, warm_up_steps=10)
    step = experiment.prepare(short)
    first, last = experiment.case.poses[0], experiment.case.poses[-1]
    path = poses_between(experiment.relative(first), experiment.relative(last), TIMED_STEPS)
    ms: list[float] = []
    for n in range(TIMED_STEPS):
        poses = poses_between(path[n], path[n + 1], step.substeps)
        timed(lambda: experiment.solver.step(step, poses), ms)
    return float(np.median(ms))


def _row(
    setup: Setup, ms: float, best: bool, resting: dict[str, float], arriving: dict[str, float]
) -> dict[str, Any]:
    settings = {name: getattr(setup, name, getattr(setup.tissue, name, None)) for name in SETTINGS}
    return dict(
        model=setup.model,
        **settings,
        time_step_s=setup.solver.time_step_s,
        ms_median=round(float(ms), 4),
        error_mean_mm=rounded(float(np.mean([*resting.values(), *arriving.values()]))),
        error_resting_mm=rounded(float(np.mean(list(resting.values())))),
        error_arriving_mm=rounded(float(np.mean(list(arriving.values())))),
        errors_mm={name: rounded(value) for name, value in resting.items()},
        pareto=bool(best),
    )
