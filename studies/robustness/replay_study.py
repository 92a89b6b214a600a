"""The command ``study replay``: is a random session, computed again from its file, identical to the bit?"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import numpy as np
from tqdm import tqdm

from rehearsal.configuration import PRESETS
from rehearsal.live_settings import initial_settings
from rehearsal.loop.command import Checkpoint, Follow
from rehearsal.notices import Notices
from rehearsal.real_time.pace import Pace
from rehearsal.rehearsal import Rehearsal
from rehearsal.sessions.recorder import SessionRecorder, header_of, next_path
from rehearsal.sessions.replay import Replay, ReplayCheck
from rehearsal.sessions.session_file import Log, read_log
from rehearsal.sources.user import UserSource
from render.viewer import Controls
from scenes.anatomy import LoadedAnatomy
from scenes.scene import EMBEDDED
from scenes.tissue import TISSUES, USUAL
from settings import Value, with_values
from studies.harness import build
from studies.study import CHOSEN, Results, Study, number_option, preset_option, study_command

SEED = 20161130
# Time between two changes of the input, and distance of the mouse ray's origin from the organ.
CHANGE_S, FROM_MM = 0.7, 60.0
# Standard deviation of the moves in a frame, and probability of each action at a change of the input.
MOVES = {"push_mm": 0.05, "rotate_deg": 0.3, "rock_deg": 0.2, "tilt_deg": 0.2}
PROBABILITY = {"undo": 0.06, "redo": 0.03, "bookmark": 0.03, "to_bookmark": 0.02, "reset": 0.01}
# Probability of another length or number of iterations at a step.
PACE_PROBABILITY = 0.02


@study_command(
    "replay",
    number_option("--minutes", low=0.05, high=600, default=10.0, help="Simulated minutes."),
    click.option(
        "--model", type=click.Choice(list(TISSUES)), default=USUAL, show_default=True, help="Tissue model."
    ),
    preset_option,
    scene=EMBEDDED,
    arch=CHOSEN,
)
def replay(study: Study, minutes: float, model: str, quality: str) -> Results:
    """Record a session in SCENE and compute it again.

    Its input is random; from its file it is computed twice, and once from its middle.
    """
    scene, anatomy = study.scene
    steps = round(60 * minutes / scene.solver.time_step_s)

    def rehearsal() -> Rehearsal:
        return build(scene, anatomy, PRESETS[model][quality], study.backend)

    with study.progress(round(3.5 * steps), "step") as bar:
        path, digest = recorded(rehearsal(), anatomy, study, steps, bar)
        log = read_log(path)
        runs = [replayed(rehearsal(), log, from_s, bar) for from_s in (0.0, 0.0, log.length_s / 2)]
    report = dict(
        arch=study.backend,
        model=model,
        quality=quality,
        file=path.name,
        minutes=minutes,
        moments=log.last_number,
        ways_back=len(log.restored()),
        megabytes=round(path.stat().st_size / 1e6, 3),
        digest=digest,
        replays=runs,
    )
    return Results(report, summary(report))


def recorded(
    rehearsal: Rehearsal, anatomy: LoadedAnatomy, study: Study, steps: int, bar: tqdm
) -> tuple[Path, str]:
    """Record a restless user for so many steps; the session's file, and a hash of the tissue at its end."""
    case, timeline = rehearsal.case, rehearsal.timeline
    step_s, notices = case.scene.solver.time_step_s, Notices()
    header = header_of(case, anatomy, study.backend, rehearsal.organ.model.serial, step_s, begins=None)
    recorder = SessionRecorder(next_path(study.out), header, notices)
    user = UserSource(rehearsal.anatomy, rehearsal.manipulator, notices)
    pace, random = Pace(step_s), np.random.default_rng(SEED)
    for controls in restless_controls(rehearsal, steps):
        for command in user.commands(rehearsal.frame, controls, step_s):
            if isinstance(command, Follow):
                # As on a machine whose load changes.
                if random.random() < PACE_PROBABILITY:
                    pace.level = int(random.integers(len(pace.levels)))
                timeline.aim(command)
                timeline.step(
                    command.pose, pace.length_s, pace.iterations(rehearsal.organ.settings.iterations)
                )
            else:
                timeline.submit(command)
        recorder.observe(rehearsal.do())
        bar.update()
    recorder.observe(rehearsal.do(Checkpoint()))
    recorder.close({})
    return recorder.path, rehearsal.organ.digest()


def restless_controls(rehearsal: Rehearsal, steps: int) -> Iterator[Controls]:
    """The controls at each step of a restless user, who also undoes, redoes and resets; always the same."""
    random, settings = np.random.default_rng(SEED), initial_settings(rehearsal.case)
    manipulator = rehearsal.manipulator
    above = np.flatnonzero(manipulator.normals @ rehearsal.case.gravity_direction < -0.5)
    every = round(CHANGE_S / rehearsal.case.scene.solver.time_step_s)
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
            changes: dict[str, Value] = {}
            if settings.tissue.model == "neo-hookean" and random.random() < 0.1:
                changes["tissue.young_kpa"] = float(random.uniform(8, 25))
            if random.random() < 0.1:
                changes["solver.iterations"] = int(random.integers(3, 7))
            controls.settings = settings = with_values(settings, changes)
        for name, value in lasting.items():
            setattr(controls, name, value)
        yield controls


def replayed(rehearsal: Rehearsal, log: Log, from_s: float, bar: tqdm) -> dict[str, Any]:
    """Compute a session again from the last stored state before a time [s]."""
    replay, check = Replay(log), ReplayCheck(log, Notices())
    rehearsal.do(*replay.begin(rehearsal.frame.positions, from_s))
    begins_s = replay.time_s
    # The steps from there to the time itself are not counted.
    bar.update(-replay.frames_until(log.place_at(from_s)))
    for commands in replay.until(log.length_s):
        frame = rehearsal.do(*commands)
        replay.check(frame)
        check.observe(frame, rehearsal.case.probe)
        bar.update()
    return dict(
        begins_s=begins_s,
        digest=rehearsal.organ.digest(),
        compared=check.compared,
        differs_s=check.differs_s,
    )


def summary(figures: dict[str, Any]) -> str:
    """The session and its replays, a line each."""
    lines = [
        f"recorded  {figures['minutes']:g} minutes, {figures['moments']} steps, {figures['ways_back']} of "
        f"them undone, redone, reset or returned to a bookmark; {figures['megabytes']:.1f} MB "
        f"in {figures['file']}; final state {figures['digest']}"
    ]
    for run in figures["replays"]:
        same = run["digest"] == figures["digest"] and run["differs_s"] is None
        verdict = "identical" if same else f"DIFFERS from {run['differs_s']} s on"
        lines.append(
            f"replayed  from {run['begins_s']:.0f} s: final state {run['digest']}, {verdict} "
            f"in {run['compared']} states compared"
        )
    return "\n".join(lines)
