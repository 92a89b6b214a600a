"""Open a recorded session at a time: the tissue, the settings, the measurements and the coverage until then."""

import click
from tqdm import tqdm

from rehearsal.inputs.input_source import set_settings
from rehearsal.measurements.live_measurements import LiveMeasurements
from rehearsal.open_window import probe_with_settings
from rehearsal.rehearsal import Rehearsal
from rehearsal.sessions.replay import Replay
from rehearsal.sessions.session_file import Log
from render.viewer import Settings


def open_session(
    log: Log, at_s: float, rehearsal: Rehearsal, settings: Settings, measurements: LiveMeasurements
) -> Replay:
    """Replay a session up to a time [s], from the last state recorded before it. Raises SessionError."""
    replay = Replay(rehearsal, log)
    begins, aim = replay.begin_at(at_s), log.step_at(at_s)
    set_settings(settings, replay.settings_until_now())
    if not measurements.recall(log, begins):
        click.echo(
            f"Warning: the session has no record of the coverage until {replay.time_s:.0f} s; coverage and summary begin there."
        )
    steps = tqdm(
        replay.go_to(at_s),
        desc=f"to {at_s:g} s",
        total=aim,
        initial=begins,
        unit="step",
        disable=aim == 0,
    )
    for pose, changed in steps:
        set_settings(settings, changed)
        probe = probe_with_settings(rehearsal.probe, settings)
        rehearsal.update_surfaces()
        rehearsal.find_plane(probe)
        measurements.watch(replay.session, probe, is_rollback=pose is None)
        measurements.count(pose, rehearsal.settings.time_step_s)
    return replay
