"""A long session, led by chance and recorded, and computed again from its file: does it end in the same bits?"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rehearsal.adaptive_iterations import AdaptiveIterations
from rehearsal.configuration import Setup, scene_of
from rehearsal.frame_view import initial_settings
from rehearsal.inputs.user_input import UserInput
from rehearsal.rehearsal import Rehearsal
from rehearsal.sessions.recorder import record
from rehearsal.sessions.replay import Replay
from rehearsal.sessions.session import Session
from rehearsal.sessions.session_file import Log, read_log
from render.viewer import Controls, Settings
from scenes.anatomy import LoadedAnatomy
from scenes.scene import Scene
from sim.device import start

SEED = 20161130
# Chance changes what the user does so often; the mouse comes from so far above the organ.
CHANGE_S, FROM_MM = 0.7, 60.0
# How often one of these is done instead of leading the transducer.
SELDOM = {"undo": 0.06, "redo": 0.03, "bookmark": 0.03, "to_bookmark": 0.02, "reset": 0.01}


def chance(rehearsal: Rehearsal, settings: Settings, moments: int) -> Iterator[Controls]:
    """What a restless user would do: the same each time."""
    random = np.random.default_rng(SEED)
    manipulator = rehearsal.manipulator
    above = np.flatnonzero(manipulator.normals @ rehearsal.gravity_direction < -0.5)
    every = round(CHANGE_S / rehearsal.settings.time_step_s)
    lasting: dict[str, Any] = {}
    for moment in range(moments):
        controls = Controls(settings)
        if moment % every == 0:
            at = int(random.choice(above))
            lasting = dict(
                ray=(manipulator.vertices[at] + FROM_MM * manipulator.normals[at], -manipulator.normals[at]),
                press=bool(random.random() < 0.5),
                push_mm=float(random.normal(0, 0.05)),
                rotate_deg=float(random.normal(0, 0.3)),
                rock_deg=float(random.normal(0, 0.2)),
                tilt_deg=float(random.normal(0, 0.2)),
            )
            for name, share in SELDOM.items():
                setattr(controls, name, bool(random.random() < share))
            if settings.young_kpa is not None and random.random() < 0.1:
                settings.young_kpa = float(random.uniform(8, 25))
            if random.random() < 0.1:
                settings.iterations = int(random.integers(3, 7))
        for name, value in lasting.items():
            setattr(controls, name, value)
        yield controls


def recorded_session(
    scene: Scene,
    anatomy: LoadedAnatomy,
    setup: Setup,
    minutes: float,
    arch: str,
    out: Path,
    done: Callable[[int], Any],
) -> tuple[Path, str]:
    """Record a session led by chance; its file, and the state's digest at its end."""
    start(arch)
    rehearsal = Rehearsal(scene_of(scene, setup), anatomy)
    session = Session(rehearsal)
    # What a step costs would otherwise have its say, and another session would be recorded each time.
    recorded = record(session, anatomy, arch, out)
    live = UserInput(session, AdaptiveIterations(np.inf), recorded)
    moments = round(60 * minutes / rehearsal.settings.time_step_s)
    for controls in chance(rehearsal, initial_settings(rehearsal), moments):
        pose = live.next_pose(controls)
        if pose is not None:
            rehearsal.advance(pose)
            live.after_step(0.0)
        live.after_frame()
        done(1)
    recorded.close({})
    return recorded.recording.path, rehearsal.digest()


def replayed(
    scene: Scene,
    anatomy: LoadedAnatomy,
    setup: Setup,
    log: Log,
    from_s: float,
    arch: str,
    done: Callable[[int], Any],
) -> dict[str, Any]:
    """Compute a session again, from the last stored state before a time on; how it ended."""
    start(arch)
    rehearsal = Rehearsal(scene_of(scene, setup), anatomy)
    replay = Replay(rehearsal, log)
    begins = replay.begin_at(from_s)
    # The way from there to the time itself is not counted.
    done(begins - replay.step_at(from_s))
    for _ in replay.go_to(log.length_s):
        done(1)
    return dict(
        begins_s=begins * log.header.time_step_s,
        digest=rehearsal.digest(),
        compared=replay.compared,
        differs_s=replay.differs_s,
    )


def measure(
    scene: Scene, anatomy: LoadedAnatomy, setup: Setup, minutes: float, arch: str, out: Path, done: Callable
) -> dict[str, Any]:
    """Record, replay twice, and once from the stored state in the middle."""
    path, digest = recorded_session(scene, anatomy, setup, minutes, arch, out, done)
    log = read_log(path)
    runs = [
        replayed(scene, anatomy, setup, log, from_s, arch, done) for from_s in (0.0, 0.0, log.length_s / 2)
    ]
    backs = sum(event.kind == "back" for events in log.events.values() for event in events)
    return dict(
        file=path.name,
        minutes=minutes,
        moments=len(log.poses),
        ways_back=backs,
        megabytes=round(path.stat().st_size / 1e6, 3),
        digest=digest,
        replays=runs,
    )
