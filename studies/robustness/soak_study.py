"""The command ``study soak``: hours of rehearsal, faster than real time: drift and differences."""

from collections.abc import Callable, Iterator
from typing import Any

import click
import numpy as np
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from rehearsal.configuration import PRESETS, Setup
from rehearsal.pressed_organ import OrganState
from rehearsal.rehearsal import Rehearsal
from rehearsal.stopwatch import timed
from scenes.anatomy import LoadedAnatomy
from scenes.scene import EMBEDDED, Scene
from studies.harness import build, distances_after_fit, memory_of_process_mb, positions_of
from studies.study import CHOSEN, Results, Study, quick_option, study_command, whole_option
from studies.tables_and_panels import curves_by, draw_panel, panels_of, table_of
from ultrasound.probe_manipulator import advanced

SEED = 20161130
HOUR = 60
# At the end of each minute the transducer is away and the tissue comes to rest.
MINUTE_S, QUICK_MINUTE_S, REST_S = 60.0, 16.0, 10.0
# Time between two goals of the probe; their reach to the sides, obliquity and depth.
CHANGE_S = 1.5
ASIDE_MM, OBLIQUE_DEG, DEEPEST_MM = (20.0, 10.0), 20.0, 12.0
AWAY_MM = 100.0
# The last minutes are computed again from a snapshot.
REPLAYED_MINUTES = 2
SHOWN = {
    "shape_mm": "shape: mean distance from the first rest,\nafter a rigid fit (mm)",
    "moved_mm": "position: mean distance from the first rest (mm);\n"
    "held by its pedicle, in shape matching by friction alone",
    "memory_mb": "memory of the process since the first minute (MB)",
    "ms_median": "time of a step (ms)",
}
# Half the least range of the axis of memory.
LEAST_MB = 10.0
COLUMNS = {
    "model": "{model}",
    "minute": "{minute:g}",
    "moved, mm": "{moved_mm:.3f}",
    "shape, mm": "{shape_mm:.4f}",
    "volume": "{volume_ratio:.4f}",
    "ms a step": "{ms_median:.2f}",
    "memory, MB": "{memory_mb:.1f}",
}


@study_command(
    "soak",
    whole_option("--minutes", 1, 6000, HOUR, "Simulated minutes."),
    quick_option("A quarter of a simulated minute of each model."),
    click.option("--model", type=click.Choice(list(PRESETS)), help="One tissue model [all]."),
    scene=EMBEDDED,
    arch=CHOSEN,
)
def soak(study: Study, minutes: int, quick: bool, model: str | None) -> Results:
    """Rehearse for an hour in SCENE, faster than real time.

    Does the rest shape drift, memory grow, a replay differ?
    """
    minutes, minute_s = (1, QUICK_MINUTE_S) if quick else (minutes, MINUTE_S)
    setups = [presets["fast"] for name, presets in PRESETS.items() if model in (None, name)]
    with study.progress(len(setups) * (minutes + min(minutes, REPLAYED_MINUTES)), "min") as bar:
        runs = [
            run_soak(*study.scene, setup, minutes, minute_s, study.backend, bar.update) for setup in setups
        ]
    return Results(dict(arch=study.backend, runs=runs), table(runs), rows_of(runs), figure_of(runs))


def rows_of(runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The minutes of all models."""
    return [dict(model=run["model"]) | row for run in runs for row in run["minutes"]]


def run_soak(
    scene: Scene,
    anatomy: LoadedAnatomy,
    setup: Setup,
    minutes: int,
    minute_s: float,
    arch: str,
    done: Callable[[], Any],
) -> dict[str, Any]:
    """Figures of each minute of ``minute_s`` [s], and whether replay and reset are identical to the bit."""
    rehearsal = build(scene, anatomy, setup, arch)
    organ = rehearsal.organ
    first, begun = organ.snapshot(), organ.digest()
    replayed = range(max(minutes - REPLAYED_MINUTES, 0), minutes)
    rows = []
    for number in range(minutes):
        if number == replayed.start:
            before = organ.snapshot()
        rows.append(_minute(rehearsal, number, minute_s, first))
        done()
    ended = organ.digest()
    organ.restore(before)
    for number in replayed:
        _minute(rehearsal, number, minute_s, first)
        done()
    again = organ.digest()
    organ.restore(first)
    return dict(
        model=setup.model,
        minutes=rows,
        digest=ended,
        replay_equal=ended == again,
        reset_equal=organ.digest() == begun,
        fallbacks=sum(row["fallbacks"] for row in rows),
        memory_growth_mb=round(rows[-1]["memory_mb"] - rows[min(1, len(rows) - 1)]["memory_mb"], 3),
    )


def _minute(rehearsal: Rehearsal, minute: int, minute_s: float, first: OrganState) -> dict[str, Any]:
    """One minute of rehearsal, and the distance of the tissue from its first rest position."""
    organ, fallbacks = rehearsal.organ, 0
    step_ms: list[float] = []
    for pose in _poses(rehearsal, minute, minute_s):
        timed(lambda: rehearsal.advance(pose), step_ms)
        fallbacks += bool(organ.notice)
    position = positions_of(organ.solver)
    rest = first.solver.body.position.astype(float)
    rehearsal.show()
    return dict(
        minute=minute + 1,
        moved_mm=round(float(np.linalg.norm(position - rest, axis=1).mean()), 6),
        shape_mm=round(float(distances_after_fit(position, rest).mean()), 6),
        volume_ratio=round(rehearsal.anatomy.volume_ratio(), 6),
        tangled=organ.divergence_check.health().tangled,
        finite=bool(np.isfinite(position).all()),
        fallbacks=fallbacks,
        ms_median=round(float(np.median(step_ms)), 4),
        memory_mb=round(memory_of_process_mb(), 3),
    )


def _poses(rehearsal: Rehearsal, minute: int, minute_s: float) -> Iterator[np.ndarray]:
    """Moves to random goals over and in the organ, the same for the same minute; then away, to rest."""
    random = np.random.default_rng([SEED, minute])
    manipulator, dt = rehearsal.manipulator, rehearsal.organ.settings.time_step_s
    home = manipulator.home
    for step in range(round(minute_s / dt)):
        if step * dt >= minute_s - REST_S:
            goal = advanced(home, -AWAY_MM)
        elif step % round(CHANGE_S / dt) == 0:
            goal = advanced(home, random.uniform(-5.0, DEEPEST_MM))
            goal[:3, 3] += home[:3, :2] @ (random.uniform(-1, 1, 2) * ASIDE_MM)
            oblique = Rotation.from_rotvec(np.radians(OBLIQUE_DEG) * random.uniform(-1, 1, 3))
            goal[:3, :3] = home[:3, :3] @ oblique.as_matrix()
        yield manipulator.pose_towards(goal, rehearsal.organ.pose, dt)


def table(runs: list[dict[str, Any]]) -> str:
    """The first, the middle and the last minute of each model, and what must be equal."""
    rows, lines = [], []
    for run in runs:
        minutes = run["minutes"]
        shown = sorted({0, len(minutes) // 2, len(minutes) - 1})
        rows += [dict(model=run["model"]) | minutes[at] for at in shown]
        worst = max(row["shape_mm"] for row in minutes)
        same = {name: "identical" if run[f"{name}_equal"] else "DIFFERS" for name in ("replay", "reset")}
        lines.append(
            f"{run['model']}: shape at most {worst:.4f} mm from the first rest; "
            f"memory {run['memory_growth_mb']:+.1f} MB; replay {same['replay']}; reset {same['reset']}; "
            f"state restored {run['fallbacks']} times"
        )
    return "\n".join([table_of(COLUMNS, rows), *lines])


def figure_of(runs: list[dict[str, Any]]) -> Figure:
    """Shape, position, memory and time of a step over the minutes."""
    figure, panels = panels_of((11, 7), 2, 2, sharex=True)
    begins_mb = {run["model"]: run["minutes"][0]["memory_mb"] for run in runs}
    rows = [row | dict(memory_mb=row["memory_mb"] - begins_mb[row["model"]]) for row in rows_of(runs)]
    for axes, (name, label) in zip(panels.ravel(), SHOWN.items(), strict=True):
        draw_panel(axes, curves_by(rows, "minute", name, "model", ".-"))
        axes.set_title(label, fontsize=10)
        low, high = axes.get_ylim()
        is_memory = name == "memory_mb"
        axes.set_ylim((min(low, -LEAST_MB), max(high, LEAST_MB)) if is_memory else (0, 1.05 * high))
    for axes in panels[1]:
        axes.set_xlabel("simulated minutes, each of random presses and drags and a rest")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=len(runs))
    figure.suptitle("An hour of rehearsal" if len(runs[0]["minutes"]) == HOUR else "Soak test")
    return figure
