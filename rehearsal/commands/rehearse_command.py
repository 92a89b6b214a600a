"""The command ``rehearse``: press a kidney, in a window or without one."""

import os

import click

from rehearsal.commands.command_line import CommandError, command
from rehearsal.commands.rehearse_options import RehearseOptions
from rehearsal.live_settings import DEFAULT_KEYS
from rehearsal.real_time.started_process import started_process
from render.display import display_available
from render.keys import keys_text


@command(RehearseOptions)
def rehearse(options: RehearseOptions) -> None:
    """Press the kidney of SCENE with the probe and see its ultrasound image.

    SCENE is a scene file or a patient's folder. Without one and without options for it, a start screen opens;
    else it is the embedded patient.
    """
    if not options.headless and not display_available():
        click.echo(f"No display ({why_no_display()}): running the scripted press without a window.")
        options.headless = True
    if options.seconds is not None and not options.headless:
        raise CommandError(
            "--seconds: a window stays open until it is closed; leave it out, or add --headless"
        )
    with started_process(not options.headless) as process:
        from rehearsal.opening import opened

        with opened(options, process) as run:
            if options.headless:
                run.headless()
            else:
                run.in_window()


@click.command("keys")
def keys_command() -> None:
    """Print the keys as a file to change, for rehearse --keys."""
    click.echo(keys_text(DEFAULT_KEYS), nl=False)


def why_no_display() -> str:
    """What is wrong with the screen."""
    display = os.environ.get("DISPLAY")
    return f"DISPLAY is {display}, which does not answer" if display else "DISPLAY is not set"
