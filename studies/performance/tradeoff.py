"""The command ``study trade``: the speed-accuracy trade-off of settings, and their Pareto front.

Bead experiments give the error of each setting, presses in turn its time.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rehearsal.configuration import PRESETS, Setup, setup_of
from rehearsal.result_files import rounded
from rehearsal.speed_accuracy import SETTINGS, pareto, preset_of, setup_of_row
from rehearsal.stopwatch import timed
from scenes.tissue import USUAL
from sim.device import start
from studies.accuracy.bead_case import BeadCase, load_case
from studies.accuracy.bead_errors import bead_errors
from studies.accuracy.bead_experiment import BeadExperiment
from studies.performance.step_timing import FRAME_MS
from studies.study import CHOSEN, Results, Study, paths_argument, quick_option, study_command
from studies.tables_and_panels import draw_panel, panels_of, table_of
from ultrasound.probe_manipulator import poses_between

EMBEDDED_CASE = Path(__file__).parents[1] / "reference" / "embedded"
COLUMNS = {
    "model": "{model}",
    "size, mm": "{size_mm:g}",
    "substeps x iterations": "{substeps} x {iterations}",
    "relax.": "{relaxation_factor:g}",
    "ms a step": "{ms_median:.2f}",
    "error, mm": "{error_mean_mm:.3f}",
    "arriving": "{error_arriving_mm:.3f}",
    "": "{words}",
}
CELLS_MM = (10.0, 8.0, 6.0, 5.0, 4.0, 3.5, 3.0, 2.5, 2.0)
CELL_ITERATIONS = (1, 2, 4, 8, 12, 20)
RADII_MM = (2.2, 2.5, 2.7, 3.0, 3.3, 4.0, 5.0)
# Substeps and iterations; the paper's first.
SUBSTEPS_ITERATIONS = ((3, 9), (1, 9), (3, 3), (1, 27), (3, 27))
# The paper's Table 3: the best stiffness for each radius.
PAPER = tuple(
    setup_of("shape-matching", radius_mm=radius, stiffness=stiffness)
    for radius, stiffness in ((2.2, 0.95), (2.5, 0.6), (2.7, 0.5), (3.0, 0.45), (3.3, 0.35))
)
QUICK = (
    setup_of("neo-hookean", cell_mm=8.0, iterations=4),
    *(PRESETS["neo-hookean"][name] for name in ("fast", "balanced")),
    PRESETS["shape-matching"]["fast"],
    PAPER[-1],
)
# The machine's speed changes within minutes: every setting is timed in each round, and the median is taken.
ROUNDS, TIMED_STEPS = 3, 45


@study_command(
    "trade",
    paths_argument("cases", "[CASE]..."),
    quick_option("A few settings on the embedded case, in less than a minute."),
    arch=CHOSEN,
)
def trade(study: Study, cases: tuple[Path, ...], quick: bool) -> Results:
    """Measure the error of beads against the time of a step.

    Over model, resolution, substeps, iterations and relaxation.
    The error is the mean over the embedded patient's bead experiment and those of CASE..., folders as
    `validate` takes them.
    """
    loaded = [load_case(case) for case in (EMBEDDED_CASE, *cases)]
    tried, rounds = setups(quick), 0 if quick else ROUNDS
    runs = _runs(loaded, tried, study.backend, rounds)
    measured = points(tried, list(study.progress((len(loaded) + rounds) * len(tried), "run", runs)))
    report = dict(arch=study.backend, cases=[case.name for case in loaded], points=measured)
    # In the table the errors of single cases have columns of their own.
    rows = [
        {name: value for name, value in point.items() if name != "errors_mm"}
        | {f"error_{name}_mm": value for name, value in point["errors_mm"].items()}
        for point in measured
    ]
    return Results(report, table(measured), rows, figure_of(measured))


def setups(quick: bool) -> list[Setup]:
    """All settings, each once, those of one model and size together."""
    if quick:
        return _sorted(list(QUICK))
    balanced = PRESETS["neo-hookean"]["balanced"]
    cells = [
        setup_of("neo-hookean", cell_mm=cell, iterations=iterations)
        for cell in CELLS_MM
        for iterations in CELL_ITERATIONS
    ]
    around = [balanced.but(relaxation_factor=factor) for factor in (1.0, 1.4, 1.9)]
    around += [balanced.but(substeps=substeps) for substeps in (2, 4)]
    particles = [
        setup_of("shape-matching", radius_mm=radius, substeps=substeps, iterations=iterations)
        for radius in RADII_MM
        for substeps, iterations in SUBSTEPS_ITERATIONS
    ]
    stiff = [setup_of("shape-matching", radius_mm=radius, stiffness=1.0) for radius in (2.7, 3.3, 5.0)]
    relaxed = [setup_of("shape-matching", radius_mm=radius, relaxation_factor=1.5) for radius in (2.7, 3.3)]
    named = [setup for presets in PRESETS.values() for setup in presets.values()]
    return _sorted([*cells, *around, *particles, *stiff, *relaxed, *PAPER, *named])


def _sorted(chosen: list[Setup]) -> list[Setup]:
    return sorted(dict.fromkeys(chosen), key=lambda setup: (setup.model, -setup.size_mm))


def _runs(cases: list[BeadCase], tried: list[Setup], arch: str, rounds: int) -> Iterator[dict[str, Any]]:
    """One run each: the setup's number, and its errors in a case or, on the first case, its time.

    Each stage counts twice: when the transducer arrives, as in a moving press, and after it has rested.
    With 0 ``rounds`` the time is that of the steps whose error was measured.
    """
    for case in cases:
        for number, experiment, setup in _built(case, tried, arch):
            run = experiment.run(setup)
            errors = dict(
                resting=_mean_error(case, run.beads, run.finite),
                arriving=_mean_error(case, run.arriving, run.finite),
            )
            ms = float(np.median(run.step_ms)) if rounds == 0 and case is cases[0] else None
            yield dict(setup=number, case=case.name, ms=ms, **errors)
    for _ in range(rounds):
        for number, experiment, setup in _built(cases[0], tried, arch):
            yield dict(setup=number, ms=_time(experiment, setup))


def points(tried: list[Setup], runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows of trade.json: error over all cases, and time."""
    by_setup = pd.DataFrame(runs).groupby("setup")
    time_ms, resting, arriving = by_setup.ms.median(), by_setup.resting.mean(), by_setup.arriving.mean()
    error = (resting + arriving) / 2
    best = pareto(time_ms.to_numpy(), error.to_numpy())
    return [
        dict(
            model=setup.model,
            **{name: getattr(setup, name, getattr(setup.tissue, name, None)) for name in SETTINGS},
            time_step_s=setup.solver.time_step_s,
            ms_median=round(float(time_ms[number]), 4),
            error_mean_mm=rounded(error[number]),
            error_resting_mm=rounded(resting[number]),
            error_arriving_mm=rounded(arriving[number]),
            errors_mm={
                run["case"]: rounded(run["resting"])
                for run in runs
                if run["setup"] == number and "case" in run
            },
            pareto=bool(best[number]),
        )
        for number, setup in enumerate(tried)
    ]


def _built(case: BeadCase, tried: list[Setup], arch: str) -> Iterator[tuple[int, BeadExperiment, Setup]]:
    """Each setting and its number, with the experiment for it, built anew on a freshly started device for
    each model and size.
    """
    for _, sharing in groupby(
        enumerate(tried), key=lambda numbered: (numbered[1].model, numbered[1].size_mm)
    ):
        same = list(sharing)
        start(arch)
        experiment = BeadExperiment(case, same[0][1])
        yield from ((number, experiment, setup) for number, setup in same)


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


def table(points: list[dict[str, Any]]) -> str:
    """All points, fastest first; those on the front, the presets and the paper's are marked."""
    rows = []
    for point in sorted(points, key=lambda point: point["ms_median"]):
        setup = setup_of_row(point)
        stiffness = "" if point["stiffness"] is None else f"alpha {point['stiffness']:g}"
        front = "front" if point["pareto"] else ""
        name = preset_of(setup) or ("the paper's" if setup in PAPER else "")
        words = ", ".join(filter(None, (stiffness, front, name)))
        rows.append(point | dict(size_mm=setup.size_mm, words=words))
    return table_of(COLUMNS, rows)


def figure_of(points: list[dict[str, Any]]) -> Figure:
    """Every point by its time and its error, the Pareto front, the presets and the paper's settings."""
    points = [point for point in points if point["error_mean_mm"] is not None]
    figure, ((axes,),) = panels_of((11, 7))
    for model in sorted({point["model"] for point in points}):
        _scatter(axes, [point for point in points if point["model"] == model], model)
    front = sorted(_place(point) for point in points if point["pareto"])
    ms, error = [place[0] for place in front], [place[1] for place in front]
    axes.plot(ms, error, color="black", linewidth=1.2, label="Pareto front", drawstyle="steps-post")
    axes.axvline(FRAME_MS, color="0.5", linestyle="--", linewidth=0.8)
    axes.annotate(" a frame at 60 Hz", (FRAME_MS, axes.get_ylim()[1]), color="0.4", va="top")
    draw_panel(
        axes,
        legend=dict(loc="center right"),
        title="Speed-accuracy trade-off",
        xlabel="time of a step (ms, median)",
        ylabel="mean error of the beads (mm)",
        xscale="log",
        yscale="log",
    )
    return figure


def _place(point: dict[str, Any]) -> tuple[float, float]:
    return point["ms_median"], point["error_mean_mm"]


def _scatter(axes: Axes, points: list[dict[str, Any]], model: str) -> None:
    ms, error = np.array([_place(point) for point in points]).T
    size = np.array([setup_of_row(point).size_mm for point in points])
    axes.scatter(ms, error, s=7 * size, alpha=0.55, label=f"{model} (area: size of cells or particles)")
    for k, point in enumerate(point for point in points if setup_of_row(point) in PAPER):
        label = "the paper's radii (mm), with its best stiffness" if k == 0 else None
        axes.scatter(*_place(point), marker="x", color="tab:red", zorder=3, label=label)
        _annotate(axes, point, f"{point['radius_mm']:g}", 6, fontsize=9, color="tab:red")
    for point in points:
        name = preset_of(setup_of_row(point))
        # The presets of shape matching have the paper's particles, and finer ones are not more accurate.
        if name and model == USUAL:
            axes.scatter(*_place(point), marker="D", facecolors="none", edgecolors="black", zorder=3)
            _annotate(axes, point, name, -15, fontsize=10, weight="bold")


def _annotate(axes: Axes, point: dict[str, Any], text: str, up: int, **style: Any) -> None:
    axes.annotate(text, _place(point), xytext=(0, up), textcoords="offset points", ha="center", **style)
