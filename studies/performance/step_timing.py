"""The command ``study timing``: the paper's Figures 7 and 8 and its Table 5 on this machine, and lower bounds
of the time.

Timed are a scene's press at several sizes, and blocks of more and more particles.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise, repeat
from typing import Any

import numpy as np
import pandas as pd
import psutil
import taichi as ti
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rehearsal.configuration import PRESETS, Setup, setup_of
from rehearsal.rehearsal import Rehearsal, script_length_s
from rehearsal.result_files import spread
from rehearsal.stopwatch import timed
from scenes.scene import PAPER
from sim.device import start
from sim.neo_hookean import LATTICE_SETTINGS
from sim.shapes import Plane
from sim.solver import Solver, StepSettings
from studies.harness import (
    block_of_cells,
    block_of_particles,
    build,
    memory_mb,
    memory_of_process_mb,
    step_of,
)
from studies.performance.lower_bound import compare
from studies.performance.step_phases import AFTER, BEFORE, CONTACTS, IN_ITERATION, Phases, without_calls
from studies.study import CHOSEN, Results, Study, quick_option, study_command
from studies.tables_and_panels import Curve, draw_panel, panels_of, table_of
from ultrasound.probe_manipulator import advanced, poses_between

AWAY_MM = 100.0
# The particle distance of a block is the paper's smallest.
BLOCK_RADIUS_MM, BLOCK_CELL_MM = 2.2, 4.0
UP = np.array([0.0, 0.0, 1.0])
# A block takes at most this share of the free memory.
MOST_MEMORY = 0.6
RADII_MM = (2.2, 2.5, 2.7, 3.0, 3.3)
PIECES_STEPS = 9
COUNTS = [1_000, 4_000, 16_000, 64_000, 250_000, 1_000_000]
QUICK_COUNTS = [1_000, 4_000, 16_000]
# The particle radius of the paper's figures, which is compared with other programs.
PAPERS = setup_of("shape-matching", radius_mm=2.2)
STEPS, QUICK_STEPS, QUICK_SHARE = 7, 3, 0.1
# Figures of a case that are not in the table of CSV, beside the times.
JSON_ONLY = ("time_step_s", "ms", "phases_ms", "bound_ms")
MS = ("mean", "sd", "min", "max", "median")
COLUMNS = {
    "model": "{model}",
    "size, mm": "{size_mm:g}",
    "particles": "{particles:g}",
    "substeps x iterations": "{substeps} x {iterations}",
    **{name: f"{{{name}_ms:.2f}}" for name in MS},
    "MB": "{memory_mb:.1f}",
}
# The paper's Table 5: radius [mm], mean, minimum and maximum [ms].
PAPER_MS = (
    (2.2, 12.10, 11.68, 12.77),
    (2.5, 12.10, 11.68, 12.77),
    (2.7, 12.37, 11.96, 12.84),
    (3.0, 12.66, 12.28, 13.37),
    (3.3, 14.16, 13.67, 15.68),
)
FRAME_MS = 1000 / 60
# Pieces of a step below this share [%] for every model and size are drawn as one.
LEAST_SHARE = 2.0


@dataclass(frozen=True)
class TimedPress:
    """One press: the duration of each step, and the durations of its pieces."""

    setup: Setup
    case: dict[str, Any]
    step_ms: list[float]
    pieces_ms: list[dict[str, float]]
    warm_up_steps: int


@study_command(
    "timing",
    quick_option("Fewer sizes and shorter presses, in less than a minute."),
    scene=PAPER,
    arch=CHOSEN,
)
def timing(study: Study, quick: bool) -> Results:
    """Measure how long a time step of SCENE takes.

    Over time, by its pieces, by size, and against a plain loop in C.
    """
    scene, anatomy = study.scene
    setups, counts = _setups(quick), QUICK_COUNTS if quick else COUNTS
    presses, sizes = [], []
    comparison: dict[str, Any] = {}
    missing: list[str] = []
    with study.progress(len(setups) + 2 * len(counts), "size") as bar:
        for setup in setups:
            rehearsal = build(scene, anatomy, setup, study.backend)
            presses.append(measure(rehearsal, setup, QUICK_SHARE if quick else 1.0, study.backend))
            if setup == PAPERS:
                comparison, missing = compare(rehearsal)
            bar.update()
        for size in blocks(counts, study.backend, QUICK_STEPS if quick else STEPS):
            sizes.append(size)
            bar.update()
        bar.total = bar.n
    bound_ms = comparison.get("bound_ms")
    cases = [press.case | dict(bound_ms=bound_ms if press.setup == PAPERS else None) for press in presses]
    report = dict(arch=study.backend, cases=cases, bound_ms=bound_ms, comparison=comparison, sizes=sizes)
    text = "\n".join([table(cases, sizes), *pieces(cases), *against(comparison), *missing])
    return Results(report, text, [_flat(case) for case in cases + sizes], figure_of(presses, sizes))


def _setups(quick: bool) -> list[Setup]:
    presets = PRESETS["neo-hookean"]
    if quick:
        return [presets["balanced"], PAPERS]
    return [*presets.values(), *(setup_of("shape-matching", radius_mm=radius) for radius in RADII_MM)]


def press(rehearsal: Rehearsal, warm_up_steps: int, share: float) -> Iterator[np.ndarray]:
    """Poses of each step, from the stress-free shape: the paper's warm-up, a share of the scripted press."""
    rehearsal.organ.solver.restart()
    substeps, script = rehearsal.organ.settings.substeps, script_length_s(rehearsal.case)
    away = advanced(rehearsal.manipulator.home, -AWAY_MM)
    yield from repeat(poses_between(away, away, substeps), warm_up_steps)
    steps = max(1, round(share * script / rehearsal.organ.settings.time_step_s))
    path = [rehearsal.scripted_pose(script * n / steps) for n in range(steps + 1)]
    for first, last in pairwise(path):
        yield poses_between(first, last, substeps)


def measure(rehearsal: Rehearsal, setup: Setup, share: float, arch: str) -> TimedPress:
    """Press twice: timed as a whole, and piece by piece; the first step, which compiles, is not timed."""
    solver, settings, home = rehearsal.organ.solver, rehearsal.organ.settings, rehearsal.manipulator.home
    warm_up_steps = max(1, round(share * rehearsal.case.press.warm_up_steps))
    phases = Phases(solver, settings)
    phases.step(poses_between(home, home, settings.substeps))
    step_ms: list[float] = []
    for poses in press(rehearsal, warm_up_steps, share):
        timed(lambda: solver.step(settings, poses), step_ms)
    pieces: list[dict[str, float]] = []
    for poses, ms in zip(press(rehearsal, warm_up_steps, share), step_ms, strict=True):
        phases.step(poses)
        pieces.append(without_calls(phases.ms, phases.calls, ms))
    means = {name: round(float(np.mean([ms[name] for ms in pieces])), 4) for name in pieces[0]}
    case = describe(setup, solver, arch) | dict(ms=spread(step_ms), phases_ms=means)
    return TimedPress(setup, case, step_ms, pieces, warm_up_steps)


def describe(setup: Setup, solver: Solver, arch: str) -> dict[str, Any]:
    """What was timed, under the names of timing.json."""
    counts = solver.model.counts()
    return dict(
        model=setup.model,
        radius_mm=getattr(setup.tissue, "radius_mm", None),
        cell_mm=getattr(setup.tissue, "cell_mm", None),
        particles=counts["particles"],
        clusters=counts.get("clusters"),
        memberships=counts.get("memberships"),
        **step_of(setup),
        arch=arch,
        cores=1 if solver.model.serial else ti.cfg.cpu_max_num_threads,
        memory_mb=round(memory_mb(solver), 3),
    )


def blocks(counts: list[int], arch: str, steps: int) -> Iterator[dict[str, Any]]:
    """Blocks of about ``counts`` particles or nodes at rest on a plane, while the memory suffices."""
    for make in (_block_of_cells, _block_of_particles):
        each_mb = 0.0
        for count in counts:
            if each_mb * count > MOST_MEMORY * psutil.virtual_memory().available / 1e6:
                break
            start(arch)
            before = memory_of_process_mb()
            solver, settings, setup = make(count)
            solver.step(settings)
            step_ms: list[float] = []
            for _ in range(steps):
                timed(lambda: solver.step(settings), step_ms)
            # Building a block takes more memory than the block itself.
            used_mb = memory_of_process_mb() - before
            each_mb = max(used_mb, memory_mb(solver)) / solver.body.count
            yield describe(setup, solver, arch) | dict(ms=spread(step_ms))


def _block_of_particles(count: int) -> tuple[Solver, StepSettings, Setup]:
    side = max(4, round(count ** (1 / 3)))
    points = BLOCK_RADIUS_MM * np.indices((side, side, side)).reshape(3, -1).T
    solver = block_of_particles(points, BLOCK_RADIUS_MM, [Plane(UP, -BLOCK_RADIUS_MM / 2)])
    return solver, StepSettings(), setup_of("shape-matching", radius_mm=BLOCK_RADIUS_MM)


def _block_of_cells(count: int) -> tuple[Solver, StepSettings, Setup]:
    side = max(2, round(count ** (1 / 3)) - 1)
    setup = setup_of("neo-hookean", cell_mm=BLOCK_CELL_MM, iterations=8)
    return block_of_cells(side, BLOCK_CELL_MM, [Plane(UP, 0.0)]), LATTICE_SETTINGS, setup


def _flat(case: dict) -> dict[str, Any]:
    """A case's size, and mean, SD, minimum, maximum and median of its steps [ms]."""
    size = {name: value for name, value in case.items() if name not in JSON_ONLY}
    return size | {f"{name}_ms": ms for name, ms in case["ms"].items()}


def _size(case: dict) -> float:
    return case["radius_mm"] or case["cell_mm"]


def table(cases: list[dict], sizes: list[dict]) -> str:
    """The paper's Table 5, and the blocks."""
    of_cases, of_sizes = (
        table_of(COLUMNS, [_flat(case) | dict(size_mm=_size(case)) for case in timed_cases])
        for timed_cases in (cases, sizes)
    )
    title = "Time of a step (ms), over warm-up and press (the paper's Table 5):"
    return "\n".join([title, of_cases, "\nBlocks at rest on a plane:", of_sizes])


def pieces(cases: list[dict]) -> list[str]:
    """The numbers of the paper's Figure 8."""
    lines = []
    for case in cases:
        phases = case["phases_ms"]
        total = sum(phases.values())
        lines.append(f"\nPieces of a step, {case['model']} {_size(case):g} mm (mean ms, share):")
        lines += [f"  {name:20}{ms:8.3f}{100 * ms / total:6.1f} %" for name, ms in phases.items()]
    return lines


def against(figures: dict) -> list[str]:
    """The step beside the loop in C and pypbd."""
    if not figures:
        return []
    lines = [
        f"\nIn turn, {PAPERS.size_mm:g} mm, medians: a step with all contacts {figures['step_ms']:.2f} ms, "
        f"without any {figures['without_contacts_ms']:.2f} ms"
    ]
    if figures["bound_ms"]:
        lines.append(
            f"  fits and averages alone in plain C: {figures['bound_1_core_ms']:.2f} ms on one core, "
            f"{figures['bound_2_cores_ms']:.2f} ms on two; the step with contacts is "
            f"{figures['ratio_to_bound']:.2f} times that"
        )
    if figures["times_pypbd"]:
        lines.append(
            f"  pypbd's shape matching: {figures['pypbd_1_core_ms']:.2f} ms; "
            f"{figures['pypbd_million_a_second']:.0f} million membership-iterations a second against "
            f"{figures['million_a_second']:.0f}: {figures['times_pypbd']:.1f} times"
        )
    return lines


def figure_of(presses: list[TimedPress], sizes: list[dict]) -> Figure:
    """The paper's Figures 7 and 8, its Table 5 and time against size, in four panels."""
    figure, ((over_time, pieces_of_step), (radii, by_size)) = panels_of((13, 9), 2, 2)
    matched = [press for press in presses if press.case["model"] == "shape-matching"]
    _over_time(over_time, matched[0])
    _pieces(pieces_of_step, presses)
    _radii(radii, matched)
    _sizes(by_size, sizes)
    return figure


def _over_time(axes: Axes, press: TimedPress) -> None:
    """The paper's Figure 7."""
    case = press.case
    contacts = pd.Series([sum(ms.get(name, 0.0) for name in CONTACTS) for ms in press.pieces_ms])
    # What interrupts one piece of a step is taken off all of them.
    contacts = contacts.rolling(PIECES_STEPS, center=True, min_periods=1).median()
    elapsed_s = case["time_step_s"] * np.arange(1, len(press.step_ms) + 1)
    warm_up_s = case["time_step_s"] * press.warm_up_steps
    name, thin = f"contacts, median of {PIECES_STEPS} steps", dict(linewidth=0.8)
    curves = [
        Curve(elapsed_s, press.step_ms, "-", "whole step", thin),
        Curve(elapsed_s, contacts.to_numpy(), "-", name, thin),
    ]
    title = f"Time of a step, {case['particles']} particles of {case['radius_mm']:g} mm (the paper's Fig. 7)"
    draw_panel(axes, curves, {}, title=title, xlabel="simulated time (s)", ylabel="ms")
    axes.axvline(warm_up_s, color="0.5", linestyle="--", linewidth=0.8)
    axes.annotate(" press", (warm_up_s, 0), color="0.4", va="bottom")
    axes.set_ylim(0, 1.5 * sorted(press.step_ms)[int(0.98 * len(press.step_ms))])


def _pieces(axes: Axes, presses: list[TimedPress]) -> None:
    """The paper's Figure 8, for every model and size."""
    ms = pd.DataFrame([press.case["phases_ms"] for press in presses]).fillna(0.0)
    shares = 100 * ms.div(ms.sum(axis=1), axis=0)
    names = [*BEFORE, *IN_ITERATION[False], *IN_ITERATION[True], *AFTER, "frames"]
    shown = shares[[name for name in names if shares.get(name, np.zeros(1)).max() > LEAST_SHARE]]
    colours = [*(colormaps["tab20"](number) for number in range(shown.shape[1])), "0.8"]
    shown = shown.assign(**{"the rest": 100 - shown.sum(axis=1)})
    shown.plot.barh(stacked=True, width=0.8, color=colours, ax=axes)
    axes.set_yticks(
        range(len(presses)), [f"{press.case['model']} {_size(press.case):g} mm" for press in presses]
    )
    axes.invert_yaxis()
    axes.set(title="Pieces of a step (the paper's Fig. 8)", xlabel="% of the step", xlim=(0, 100))
    axes.legend(fontsize=8, ncols=1, loc="center left", bbox_to_anchor=(1.0, 0.5))


def _radii(axes: Axes, matched: list[TimedPress]) -> None:
    """The paper's Table 5."""
    cases = [press.case for press in matched]
    rows = [(case["radius_mm"], *(case["ms"][key] for key in ("mean", "min", "max"))) for case in cases]
    for shown, marker, colour, name in (
        (rows, "o", "tab:blue", "here, one core"),
        (PAPER_MS, "s", "0.5", "the paper's, a GPU of 1536 cores"),
    ):
        radius, mean, least, most = np.array(shown).T
        spread = [mean - least, most - mean]
        axes.errorbar(radius, mean, spread, fmt=marker, color=colour, capsize=3, label=name)
    axes.axhline(FRAME_MS, color="0.6", linestyle=":", label="1/60 s")
    title = "Mean, minimum and maximum of a step (the paper's Table 5)"
    draw_panel(axes, (), {}, title=title, xlabel="particle radius (mm)", ylabel="ms", ylim=(0, None))


def _sizes(axes: Axes, sizes: list[dict]) -> None:
    for model, name, place in (
        ("shape-matching", "shape matching, 3 x 9", dict(xytext=(4, -9))),
        ("neo-hookean", "neo-Hookean, 1 x 8", dict(xytext=(-4, 5), ha="right")),
    ):
        rows = [size for size in sizes if size["model"] == model]
        points = [(row["particles"], row["ms"]["median"]) for row in rows]
        axes.loglog(*zip(*points, strict=True), "o-", label=name)
        for row, point in zip(rows, points, strict=True):
            text = f"{row['memory_mb']:.0f} MB"
            axes.annotate(text, point, fontsize=7, textcoords="offset points", **place)
    axes.axhline(FRAME_MS, color="0.6", linestyle=":", label="1/60 s")
    title = "Blocks at rest: time and memory against size"
    draw_panel(axes, (), {}, title=title, xlabel="particles or nodes", ylabel="median ms a step")
