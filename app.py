"""The command line. ``python app.py --help`` lists what it does."""

import signal
import sys
import threading

import click

from render.keys import KeysError
from scenes.command import import_patient_command
from scenes.reading.error import PatientError
from scenes.scene import SceneError
from sim.sampling import SamplingError
from studies.beam.command import beam
from studies.case import CaseError
from studies.commands import calibrate, validate
from studies.export.command import export
from studies.freehand.command import reconstruct
from studies.plan.command import plan
from studies.plan.file import PlanError
from studies.reference.command import reference
from studies.rehearse.command import keys_command, rehearse
from studies.scan.command import scan
from studies.scan.poses import PoseError
from studies.session.file import SessionError
from studies.setup import SetupError
from studies.study import study
from ultrasound.acoustics import TissueError
from ultrasound.array import ProbeError
from ultrasound.sweep import SweepError
from version import VERSION

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


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(VERSION, prog_name="nephron")
def cli() -> None:
    """Nephron: rehearse ultrasound on a patient's own deformable kidney.

    Without a command it is `rehearse` on the embedded patient.
    """


for command in (
    rehearse,
    keys_command,
    import_patient_command,
    plan,
    export,
    scan,
    reconstruct,
    validate,
    calibrate,
    beam,
    reference,
    study,
):
    cli.add_command(command)


def _stop_in_order() -> None:
    """Asked to end, clean up as after Ctrl-C: no half of a patient's folder stays."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.default_int_handler)


def main(arguments: list[str]) -> int:
    """Run a command line; what the user must mend is one line, and the exit status 2."""
    if not arguments or (arguments[0].startswith("-") and arguments[0] not in ("-h", "--help", "--version")):
        arguments = ["rehearse", *arguments]
    _stop_in_order()
    try:
        cli.main(args=arguments, prog_name="app.py", standalone_mode=False)
        return 0
    except click.ClickException as error:
        message = error.format_message()
    except MENDED_BY_USER as error:
        message = str(error)
    except OSError as error:
        # A disk that is full or a file that is in the way, where no command had better words.
        message = f"{error.filename or 'a file'}: {error.strerror or error}"
    except (click.Abort, KeyboardInterrupt):
        click.echo("Stopped.", err=True)
        return 130
    click.echo(f"nephron: {' '.join(message.split())}", err=True)
    return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
