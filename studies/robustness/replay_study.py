"""The command ``study replay``: is a long session of random input, computed again from its file, identical to the bit?"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import numpy as np
from rehearsal.inputs.user_input import UserInput
from rehearsal.open_window import initial_settings
from rehearsal.sessions.session import Session
from tqdm import tqdm

from rehearsal.commands.command_line import arch_option
from rehearsal.configuration import PRESETS
from rehearsal.real_time.pace import Pace
from rehearsal.rehearsal import Rehearsal
from rehearsal.sessions.recorder import record
from rehearsal.sessions.replay import Replay
from rehearsal.sessions.session_file import Log, read_log
from render.viewer import Controls
from scenes.scene import EMBEDDED
from scenes.tissue import TISSUES, USUAL
from studies.harness import build
from studies.study_options import number_option, open_study, out_option, preset_option, scene_argument
from studies.study_results import write_results

SEED = 20161130
# Time between two changes of the input, and distance of the mouse ray's origin from the organ.
CHANGE_S, FROM_MM = 0.7, 60.0
# Standard deviation of the moves in a frame, and probability of each action at a change of the input.
MOVES = {"push_mm": 0.05, "rotate_deg": 0.3, "rock_deg": 0.2, "tilt_deg": 0.2}
PROBABILITY = {"undo": 0.06, "redo": 0.03, "bookmark": 0.03, "to_bookmark": 0.02, "reset": 0.01}
# Probability of another length or number of iterations at a step.
PACE_PROBABILITY = 0.02


@click.command()
@scene_argument(EMBEDDED)
@out_option
@number_option("--minutes", low=0.05, high=600, default=10.0, help="Simulated minutes.")
@click.option(
    "--model", type=click.Choice(list(TISSUES)), default=USUAL, show_default=True, help="Tissue model."
)
@preset_option
@arch_option
def replay(scene: Path, out: Path, minutes: float, model: str, quality: str, arch: str) -> None:
    """Record a session in SCENE and compute it again.

    Its input is random; from its file it is computed twice, and once from its middle.
    """
    loaded, anatomy, used = open_study(out, scene, arch)
    steps = round(60 * minutes / loaded.solver.time_step_s)

    def rehearsal() -> Rehearsal:
        return build(loaded, anatomy, PRESETS[model][quality], used, with_image=True)

    with tqdm(total=round(3.5 * steps), desc="replay", unit="step") as bar:
        session = Session(rehearsal())
        recorded = record(session, anatomy, used, out)
        live = UserInput(session, recorded)
        pace, random = Pace(loaded.solver.time_step_s), np.random.default_rng(SEED)
        for pose in random_poses(live, session.rehearsal, steps, bar):
            # As on a machine whose load changes.
            if random.random() < PACE_PROBABILITY:
                pace.level = int(random.integers(len(pace.levels)))
            iterations = pace.iterations(session.rehearsal.settings.iterations)
            live.after_step(session.rehearsal.timed_step(pose, pace.length_s, iterations))
        recorded.close({})
        path, digest = recorded.path, session.rehearsal.digest()
        log = read_log(path)
        runs = [replayed(rehearsal(), log, from_s, bar) for from_s in (0.0, 0.0, log.length_s / 2)]
    figures = dict(
        arch=used,
        model=model,
        quality=quality,
        file=path.name,
        minutes=minutes,
        moments=len(log.poses),
        ways_back=sum(event.kind == "back" for events in log.events.values() for event in events),
        megabytes=round(path.stat().st_size / 1e6, 3),
        digest=digest,
        replays=runs,
    )
    write_results(out, "replay", figures, summary(figures))


def random_poses(live: UserInput, rehearsal: Rehearsal, steps: int, bar: tqdm) -> Iterator[np.ndarray]:
    """Poses of a restless user, who also undoes, redoes and resets; the same each time. The step to each is the caller's."""
    random, settings = np.random.default_rng(SEED), initial_settings(rehearsal)
    manipulator = rehearsal.manipulator
    above = np.flatnonzero(manipulator.normals @ rehearsal.gravity_direction < -0.5)
    every = round(CHANGE_S / rehearsal.settings.time_step_s)
    lasting: dict[str, Any] = {}
    for step in range(steps):
        controls = Controls(settings)
        if step % every == 0:
            at = int(random.choice(above))
            normal = manipulator.normals[at]
            ray = (manipulator.vertices[at] + FROM_MM * normal, -normal)
            lasting = dict(ray=ray, press=bool(random.random() < 0.5))
            lasting |= {name: float(random.normal(0, deviation)) for name, deviation in MOVES.items()}
            for name, probability in PROBABILITY.items():
                setattr(controls, name, bool(random.random() < probability))
            if settings.young_kpa is not None and random.random() < 0.1:
                settings.young_kpa = float(random.uniform(8, 25))
            if random.random() < 0.1:
                settings.iterations = int(random.integers(3, 7))
        for name, value in lasting.items():
            setattr(controls, name, value)
        pose = live.next_pose(controls)
        if pose is not None:
            yield pose
        live.after_frame()
        bar.update()


def replayed(rehearsal: Rehearsal, log: Log, from_s: float, bar: tqdm) -> dict[str, Any]:
    """Compute a session again from the last stored state before a time [s]."""
    replay = Replay(rehearsal, log)
    begins = replay.begin_at(from_s)
    # The steps from there to the time itself are not counted.
    bar.update(begins - log.step_at(from_s))
    for _ in replay.go_to(log.length_s):
        bar.update()
    return dict(
        begins_s=begins * log.header.time_step_s,
        digest=rehearsal.digest(),
        compared=replay.compared,
        differs_s=replay.differs_s,
    )


def summary(figures: dict[str, Any]) -> str:
    """The session and its replays, a line each."""
    lines = [
        f"recorded  {figures['minutes']:g} minutes, {figures['moments']} steps, {figures['ways_back']} of them undone, redone, reset or "
        f"returned to a bookmark; {figures['megabytes']:.1f} MB in {figures['file']}; final state {figures['digest']}"
    ]
    for run in figures["replays"]:
        same = run["digest"] == figures["digest"] and run["differs_s"] is None
        verdict = "identical" if same else f"DIFFERS from {run['differs_s']} s on"
        lines.append(
            f"replayed  from {run['begins_s']:.0f} s: final state {run['digest']}, {verdict} in {run['compared']} states compared"
        )
    return "\n".join(lines)
