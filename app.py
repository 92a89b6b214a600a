"""The command line. ``python app.py --help`` lists what it does."""

import errno
import signal
import sys
import threading
from importlib import import_module

try:
    import click

    from rehearsal.configuration import SetupError
    from rehearsal.planning.plan_file import PlanError
    from rehearsal.sessions.session_file import SessionError
    from rehearsal.tracking.pose_file import PoseError
    from render.keys import KeysError
    from scenes.patients.import_error import PatientError
    from scenes.scene import SceneError
    from sim.sampling import SamplingError
    from studies.accuracy.bead_case import CaseError
    from ultrasound.acoustics import TissueError
    from ultrasound.probe import ProbeError
    from ultrasound.sweep import SweepError
except ModuleNotFoundError as missing:
    sys.exit(
        f"nephron: {missing.name} is not installed for this Python; run make run once, then use the Python of its environment: "
        ". .venv/bin/activate (Windows: .venv\\Scripts\\activate)"
    )
except KeyboardInterrupt:
    sys.stderr.write("Stopped.\n")
    sys.exit(130)

from version import VERSION

# Where each command is; only the one that is called is imported, for the others' libraries take seconds to load.
COMMANDS = {
    "rehearse": "rehearsal.commands.rehearse_command:rehearse",
    "keys": "rehearsal.commands.rehearse_command:keys_command",
    "import": "scenes.patients.import_command:import_patient_command",
    "plan": "rehearsal.commands.plan_command:plan",
    "export": "rehearsal.commands.export_command:export",
    "scan": "rehearsal.commands.scan_command:scan",
    "reconstruct": "rehearsal.commands.reconstruct_command:reconstruct",
    "validate": "studies.accuracy.accuracy_commands:validate",
    "calibrate": "studies.accuracy.accuracy_commands:calibrate",
    "beam": "studies.beam.beam_command:beam",
    "reference": "studies.reference.reference_command:reference",
    "study": "studies.study_command:study",
}
# What is wrong with a file or a value, said in one line.
MENDED_BY_USER = (
    SceneError,
    PatientError,
    PoseError,
    PlanError,
    SessionError,
    SweepError,
    ProbeError,
    TissueError,
    SamplingError,
    CaseError,
    SetupError,
    KeysError,
)


class Commands(click.Group):
    """Commands that are imported when they are called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, name: str) -> click.Command:
        if name not in COMMANDS:
            # click's own error suggests of the commands that it holds, and it holds none.
            raise click.NoSuchCommand(name, possibilities=COMMANDS, ctx=ctx)
        module, command = COMMANDS[name].split(":")
        return getattr(import_module(module), command)


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(VERSION, prog_name="nephron")
def cli() -> None:
    """Nephron: rehearse ultrasound on a patient's own deformable kidney.

    Without a command it is `rehearse` on the embedded patient.
    """


def _stop_in_order() -> None:
    """Asked to end, clean up as after Ctrl-C: no half of a patient's folder stays."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.default_int_handler)


def _told(error: OSError) -> str:
    """What is wrong with a disk or a file, where no command had better words."""
    full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    advice = "free some space" if full else "check that it can be read and written"
    where = error.filename or "what was to be written"
    return f"{where}: {error.strerror or error}; {advice}, or choose another place"


def main(arguments: list[str]) -> int:
    """Run a command line; what the user must mend is one line, and the exit status 2."""
    if not arguments or (arguments[0].startswith("-") and arguments[0] not in ("-h", "--help", "--version")):
        arguments = ["rehearse", *arguments]
    _stop_in_order()
    try:
        return cli.main(args=arguments, prog_name="app.py", standalone_mode=False) or 0
    except click.ClickException as error:
        message = error.format_message()
    except MENDED_BY_USER as error:
        message = str(error)
    except OSError as error:
        message = _told(error)
    except MemoryError:
        message = "the memory is full: close other programs, or take a smaller volume, larger cells or particles, or fewer --jobs"
    except (click.Abort, KeyboardInterrupt):
        click.echo("Stopped.", err=True)
        return 130
    click.echo(f"nephron: {' '.join(message.split())}", err=True)
    return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
