"""A recorded session opened at a time: the tissue as it was, and what had been set, seen and done until then."""

import click
from tqdm import tqdm

from rehearsal.frame_view import probe_as_set
from rehearsal.inputs.input_source import set_settings
from rehearsal.measurements.live_measurements import LiveMeasurements
from rehearsal.rehearsal import Rehearsal
from rehearsal.sessions.replay import Replay
from rehearsal.sessions.session_file import Log
from render.viewer import Settings


def opened(
    log: Log, at_s: float, rehearsal: Rehearsal, settings: Settings, instruments: LiveMeasurements
) -> Replay:
    """A replay that has come to a time, by way of the last state before it. Raises SessionError."""
    replay = Replay(rehearsal, log)
    begins, aim = replay.begin_at(at_s), replay.moment_at(at_s)
    set_settings(settings, replay.settings_until_now())
    if not instruments.recall(log, begins):
        click.echo(
            f"Mind: the session does not hold what was seen until {replay.time_s:.0f} s; what was seen and done counts from there."
        )
    way = tqdm(
        replay.go_to(at_s),
        desc=f"to {at_s:g} s",
        total=aim,
        initial=begins,
        unit="step",
        disable=aim == 0,
    )
    for pose, changed in way:
        set_settings(settings, changed)
        probe = probe_as_set(rehearsal.probe, settings)
        rehearsal.update_surfaces()
        rehearsal.find_plane(probe)
        instruments.watch(replay.session, probe, pose)
    return replay
