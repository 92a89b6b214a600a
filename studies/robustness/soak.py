"""Hours of rehearsal without a window, faster than real: does anything drift, grow or differ?"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import psutil
from scipy.spatial.transform import Rotation

from rehearsal.configuration import Setup, scene_of
from rehearsal.rehearsal import Rehearsal, RehearsalState
from rehearsal.stopwatch import timed
from scenes.anatomy import LoadedAnatomy
from scenes.scene import Scene
from sim.device import start
from sim.fields import array_of
from studies.robustness.rigid_fit import apart_after_fit
from ultrasound.probe_manipulator import advanced

SEED = 20161130
# At each minute's end the transducer is away, and the tissue comes to rest.
MINUTE_S, QUICK_MINUTE_S, REST_S = 60.0, 16.0, 10.0
# A new place to go to so often; as far to the sides, as oblique and as deep as that.
CHANGE_S = 1.5
ASIDE_MM, OBLIQUE_DEG, DEEPEST_MM = (20.0, 10.0), 20.0, 12.0
AWAY_MM = 100.0
# So much of the end is computed again from a snapshot.
REPLAYED_MINUTES = 2


def soak(
    scene: Scene,
    anatomy: LoadedAnatomy,
    setup: Setup,
    minutes: int,
    minute_s: float,
    arch: str,
    done: Callable[[], Any],
) -> dict[str, Any]:
    """Rehearse for some minutes of simulated time; figures of each, and whether its end can be replayed bit for bit.

    A minute takes ``minute_s`` [s], so that a quick look need not wait for a whole one.
    """
    start(arch)
    rehearsal = Rehearsal(scene_of(scene, setup), replace(anatomy, ct=None))
    first, begun = rehearsal.snapshot(), rehearsal.digest()
    replayed = min(REPLAYED_MINUTES, minutes)
    rows, kept = [], first
    for minute in range(minutes):
        if minute == minutes - replayed:
            kept = rehearsal.snapshot()
        rows.append(_minute(rehearsal, minute, minute_s, first))
        done()
    ended = rehearsal.digest()
    rehearsal.restore(kept)
    for minute in range(minutes - replayed, minutes):
        _minute(rehearsal, minute, minute_s, first)
        done()
    again = rehearsal.digest()
    rehearsal.restore(first)
    return dict(
        model=setup.model,
        minutes=rows,
        digest=ended,
        replay_equal=ended == again,
        reset_equal=rehearsal.digest() == begun,
        fallbacks=sum(row["fallbacks"] for row in rows),
        memory_growth_mb=round(rows[-1]["memory_mb"] - rows[min(1, len(rows) - 1)]["memory_mb"], 3),
    )


def _minute(rehearsal: Rehearsal, minute: int, minute_s: float, first: RehearsalState) -> dict[str, Any]:
    """One minute of rehearsal, and how far from its first rest the tissue then lies."""
    dt = rehearsal.settings.time_step_s
    ms: list[float] = []
    fallbacks = 0
    goals = _goals(rehearsal, minute)
    for step in range(round(minute_s / dt)):
        if step * dt >= minute_s - REST_S:
            goal = advanced(rehearsal.manipulator.home, -AWAY_MM)
        elif step % round(CHANGE_S / dt) == 0:
            goal = next(goals)
        timed(lambda: rehearsal.advance(rehearsal.pose_towards(goal)), ms)
        fallbacks += bool(rehearsal.notice)
    position = array_of(rehearsal.body.position).astype(float)
    rest = first.solver.body.position.astype(float)
    rehearsal.update_surfaces()
    return dict(
        minute=minute + 1,
        moved_mm=round(float(np.linalg.norm(position - rest, axis=1).mean()), 6),
        shape_mm=round(float(apart_after_fit(position, rest).mean()), 6),
        volume_ratio=round(rehearsal.volume_ratio(), 6),
        tangled=rehearsal.divergence_check.health().tangled,
        finite=bool(np.isfinite(position).all()),
        fallbacks=fallbacks,
        ms_median=round(float(np.median(ms)), 4),
        memory_mb=round(psutil.Process().memory_info().rss / 1e6, 3),
    )


def _goals(rehearsal: Rehearsal, minute: int) -> Iterator[np.ndarray]:
    """Poses over the organ and in it, the same for every minute of one number."""
    random = np.random.default_rng([SEED, minute])
    home = rehearsal.manipulator.home
    while True:
        goal = advanced(home, random.uniform(-5.0, DEEPEST_MM))
        goal[:3, 3] += home[:3, :2] @ (random.uniform(-1, 1, 2) * ASIDE_MM)
        oblique = Rotation.from_rotvec(np.radians(OBLIQUE_DEG) * random.uniform(-1, 1, 3))
        goal[:3, :3] = home[:3, :3] @ oblique.as_matrix()
        yield goal
