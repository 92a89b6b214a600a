"""Time of a step: a scene's press at several sizes, and blocks of more and more particles."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import psutil
import taichi as ti

from rehearsal.configuration import Setup, scene_of, setup_of
from rehearsal.rehearsal import Rehearsal
from rehearsal.result_files import spread
from rehearsal.stopwatch import timed
from scenes.anatomy import LoadedAnatomy
from scenes.scene import Scene
from sim.body import ParticleBody
from sim.device import start
from sim.neo_hookean import LATTICE_SETTINGS
from sim.shape_matching import ShapeMatching
from sim.shapes import Plane
from sim.solver import Solver, StepSettings
from studies.performance.lower_bound import Bound, NoBound, Pypbd
from studies.performance.step_phases import Phases, without_calls
from studies.uniform_blocks import block_of_cells, block_of_particles
from ultrasound.probe_manipulator import advanced, poses_between

AWAY_MM = 100.0
# The particle distance of a block is the paper's smallest.
BLOCK_RADIUS_MM, BLOCK_CELL_MM = 2.2, 4.0
# A block takes at most this share of the free memory.
MOST_MEMORY = 0.6
ROUNDS, STEPS_A_ROUND = 9, 5


@dataclass(frozen=True)
class TimedPress:
    """One press: simulated time and duration of each step, and the durations of its pieces."""

    setup: Setup
    case: dict[str, Any]
    elapsed_s: list[float]
    step_ms: list[float]
    pieces_ms: list[dict[str, float]]
    warm_up_s: float


def build(scene: Scene, anatomy: LoadedAnatomy, setup: Setup, arch: str) -> Rehearsal:
    """The scene's body under its transducer, without an image, on a freshly started device."""
    start(arch)
    return Rehearsal(scene_of(scene, setup), replace(anatomy, ct=None))


def press(
    rehearsal: Rehearsal, share: float, step: Callable[[StepSettings, np.ndarray], None]
) -> Iterator[float]:
    """The paper's warm-up from the resting shape, then the scripted press, or a ``share`` of both; yields the time [s]."""
    solver, settings, script = rehearsal.solver, rehearsal.settings, rehearsal.script_length_s()
    solver.body.restore(solver.body.rest_state())
    solver.contacts.reset()
    solver.model.update_frames()
    dt = settings.time_step_s
    warm_up = max(1, round(share * rehearsal.press.warm_up_steps))
    pressed = max(1, round(share * script / dt))
    away = advanced(rehearsal.manipulator.home, -AWAY_MM)
    for n in range(warm_up):
        step(settings, poses_between(away, away, settings.substeps))
        yield (n + 1) * dt
    pose = rehearsal.scripted_pose(0.0)
    for n in range(pressed):
        goal = rehearsal.scripted_pose(script * (n + 1) / pressed)
        step(settings, poses_between(pose, goal, settings.substeps))
        pose = goal
        yield (warm_up + n + 1) * dt


def measure(rehearsal: Rehearsal, setup: Setup, share: float, arch: str) -> TimedPress:
    """Press twice: once timed as a whole, once piece by piece; the first step, which compiles, is not timed."""
    solver = rehearsal.solver
    phases = Phases(solver)
    home = poses_between(rehearsal.manipulator.home, rehearsal.manipulator.home, rehearsal.settings.substeps)
    phases.step(rehearsal.settings, home)
    step_ms: list[float] = []
    pieces: list[dict[str, float]] = []
    elapsed = []
    for time_s in press(rehearsal, share, lambda s, poses: timed(lambda: solver.step(s, poses), step_ms)):
        elapsed.append(time_s)
    for n, _ in enumerate(press(rehearsal, share, phases.step)):
        pieces.append(without_calls(phases.ms, phases.calls, step_ms[n]))
    case = describe(setup, solver, arch) | dict(ms=spread(step_ms), phases_ms=mean_of(pieces))
    warm_up_s = max(1, round(share * rehearsal.press.warm_up_steps)) * rehearsal.settings.time_step_s
    return TimedPress(setup, case, elapsed, step_ms, pieces, warm_up_s)


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
        substeps=setup.substeps,
        iterations=setup.iterations,
        time_step_s=setup.solver.time_step_s,
        arch=arch,
        cores=1 if solver.model.serial else ti.cfg.cpu_max_num_threads,
        memory_mb=round(memory_mb(solver), 3),
    )


def mean_of(pieces: list[dict[str, float]]) -> dict[str, float]:
    """Mean time of each piece over the steps [ms]."""
    return {name: round(float(np.mean([ms[name] for ms in pieces])), 4) for name in pieces[0]}


def memory_mb(owner: Any, apart: Any = None) -> float:
    """Memory of the fields [MB] on the device that an object refers to, without those of ``apart``."""
    seen: set[int] = set()
    _bytes_in(apart, seen)
    return _bytes_in(owner, seen) / 1e6


def _bytes_in(owner: Any, seen: set[int]) -> int:
    if id(owner) in seen:
        return 0
    seen.add(id(owner))
    if isinstance(owner, ti.Field):
        return int(np.prod(owner.shape, dtype=np.int64)) * 4 * _entries(owner)
    if isinstance(owner, list | tuple):
        return sum(_bytes_in(part, seen) for part in owner)
    if type(owner).__module__.startswith(("sim.", "ultrasound.")):
        return sum(_bytes_in(part, seen) for part in vars(owner).values())
    return 0


def _entries(field: ti.Field) -> int:
    if isinstance(field, ti.StructField):
        return sum(_entries(field.get_member_field(name)) for name in field.keys)
    return getattr(field, "n", 1) * getattr(field, "m", 1)


def compare(rehearsal: Rehearsal) -> tuple[dict[str, Any], list[str]]:
    """Medians [ms] of the pressed body's step with contacts and of its references, run in turn; the references that are missing."""
    solver, settings, model = rehearsal.solver, rehearsal.settings, rehearsal.model
    assert isinstance(model, ShapeMatching) and isinstance(model.body, ParticleBody)
    iterations = settings.substeps * settings.iterations
    alone = Solver(ShapeMatching(model.body, model.patches))
    pose = rehearsal.scripted_pose(rehearsal.script_length_s())
    poses = poses_between(pose, pose, settings.substeps)
    others, missing = _others(model, iterations)
    runs = {
        "step_ms": lambda: _one(lambda: solver.step(settings, poses)),
        "without_contacts_ms": lambda: _one(lambda: alone.step(replace(settings, gravity=(0.0, 0.0, 0.0)))),
        **others,
    }
    times: dict[str, list[float]] = {name: [] for name in runs}
    pressed = solver.snapshot()
    for _ in range(ROUNDS):
        for name, run in runs.items():
            solver.restore(pressed)
            times[name] += [run() for _ in range(STEPS_A_ROUND)]
    figures: dict[str, Any] = {name: round(float(np.median(ms)), 4) for name, ms in times.items()}
    work = model.counts()["memberships"] * iterations / 1e3
    figures |= dict(
        membership_iterations=round(1e3 * work),
        bound_ms=figures.get("bound_2_cores_ms"),
        ratio_to_bound=_ratio(figures["step_ms"], figures.get("bound_2_cores_ms")),
        million_a_second=round(work / figures["without_contacts_ms"], 2),
        pypbd_million_a_second=_ratio(work, figures.get("pypbd_1_core_ms")),
        times_pypbd=_ratio(figures.get("pypbd_1_core_ms"), figures["without_contacts_ms"]),
    )
    return figures, missing


def _others(model: ShapeMatching, iterations: int) -> tuple[dict[str, Callable[[], float]], list[str]]:
    """The references available on this machine, and why others are not."""
    runs: dict[str, Callable[[], float]] = {}
    missing = []
    try:
        bound = Bound(model)
        runs["bound_1_core_ms"] = lambda: bound.run(iterations, 1)
        runs["bound_2_cores_ms"] = lambda: bound.run(iterations, 2)
    except NoBound as reason:
        missing.append(str(reason))
    try:
        other = Pypbd(model)
        runs["pypbd_1_core_ms"] = lambda: other.run(iterations)
    except NoBound as reason:
        missing.append(str(reason))
    return runs, missing


def _one(work: Callable[[], None]) -> float:
    into: list[float] = []
    timed(work, into)
    return into[0]


def _ratio(first: float | None, second: float | None) -> float | None:
    return round(first / second, 3) if first and second else None


def blocks(counts: list[int], arch: str, steps: int) -> Iterator[dict[str, Any]]:
    """Blocks of about ``counts`` particles or nodes at rest on a plane, smallest first, while memory suffices."""
    for make in (_block_of_cells, _block_of_particles):
        each_mb = 0.0
        for count in counts:
            if each_mb * count > MOST_MEMORY * psutil.virtual_memory().available / 1e6:
                break
            start(arch)
            before = psutil.Process().memory_info().rss
            solver, settings, setup = make(count)
            solver.step(settings)
            step_ms: list[float] = []
            for _ in range(steps):
                timed(lambda: solver.step(settings), step_ms)
            # Building a block takes more memory than the block itself.
            used_mb = (psutil.Process().memory_info().rss - before) / 1e6
            each_mb = max(used_mb, memory_mb(solver)) / solver.body.count
            yield describe(setup, solver, arch) | dict(ms=spread(step_ms))


def _block_of_particles(count: int) -> tuple[Solver, StepSettings, Setup]:
    side = max(4, round(count ** (1 / 3)))
    points = BLOCK_RADIUS_MM * np.indices((side, side, side)).reshape(3, -1).T
    floor = Plane(np.array([0.0, 0.0, 1.0]), -BLOCK_RADIUS_MM / 2)
    solver = block_of_particles(points, BLOCK_RADIUS_MM, [floor])
    return solver, StepSettings(), setup_of("shape-matching", radius_mm=BLOCK_RADIUS_MM)


def _block_of_cells(count: int) -> tuple[Solver, StepSettings, Setup]:
    side = max(2, round(count ** (1 / 3)) - 1)
    solver = block_of_cells(side, BLOCK_CELL_MM, [Plane(np.array([0.0, 0.0, 1.0]), 0.0)])
    setup = setup_of("neo-hookean", cell_mm=BLOCK_CELL_MM, iterations=8)
    return solver, LATTICE_SETTINGS, setup
