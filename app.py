"""The command line. ``python app.py --help`` lists what it does."""

import errno
import gc
import signal
import sys
import threading
from typing import Any

try:
    import click

except ModuleNotFoundError as missing:
    sys.exit(
        f"nephron: {missing.name} is not installed for this Python; run make run once, then use the Python of its environment: "
        ". .venv/bin/activate (Windows: .venv\\Scripts\\activate)"
    )
except KeyboardInterrupt:
    sys.stderr.write("Stopped.\n")
    sys.exit(130)

from errors import UserError
from rehearsal.commands.lazy_group import LazyGroup
from version import VERSION

# While modules are loaded and kernels built, much is allocated and almost nothing becomes garbage. Python would look for garbage so often
# that this took a tenth of the start.
gc.set_threshold(100_000)

# Where each command is, and what it does in a line.
COMMANDS = {
    "rehearse": (
        "rehearsal.commands.rehearse_command:rehearse",
        "Press the kidney of SCENE with the probe and see its ultrasound image.",
    ),
    "keys": (
        "rehearsal.commands.rehearse_command:keys_command",
        "Print the keys as a file to change, for rehearse --keys.",
    ),
    "import": (
        "scenes.patients.import_command:import_patient_command",
        "Make a patient's folder from a CT and its LABELS.",
    ),
    "acknowledge": (
        "scenes.acknowledge_command:acknowledge_command",
        "Mark the warnings of PATIENT's import as checked.",
    ),
    "plan": (
        "rehearsal.commands.plan_command:plan",
        "Plan a sweep over SCENE that covers the target, or a resection.",
    ),
    "export": (
        "rehearsal.commands.export_command:export",
        "Write surfaces, CT and labels of SCENE as files.",
    ),
    "scan": ("rehearsal.commands.scan_command:scan", "Make images of SCENE at a list of probe poses."),
    "reconstruct": (
        "rehearsal.commands.reconstruct_command:reconstruct",
        "Reconstruct a volume from SWEEP, a tracked sweep (.igs.mha, .igs.nrrd).",
    ),
    "validate": (
        "studies.accuracy.accuracy_commands:validate",
        "Compare with the bead experiment of CASE, a folder.",
    ),
    "calibrate": (
        "studies.accuracy.accuracy_commands:calibrate",
        "Fit a tissue model to bead experiments.",
    ),
    "beam": ("studies.beam.beam_command:beam", "Compare with the silicone beam of FOLDER (motion capture)."),
    "reference": (
        "studies.reference.reference_command:reference",
        "Make a bead experiment by finite elements, for `validate`.",
    ),
    "study": ("studies.study_command:study", "Measure on this machine: tables and figures in a folder."),
}


@click.group(
    cls=LazyGroup,
    commands_at=COMMANDS,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
)
@click.version_option(VERSION, prog_name="nephron")
def cli() -> None:
    """Nephron: rehearse ultrasound on a patient's own deformable kidney.

    Without a command it is `rehearse` on the embedded patient.
    """


def read_probe(name: str) -> Any:
    """The probe of a name or file, for ``import``, whose folder knows nothing of ultrasound. Raises UserError."""
    from ultrasound.probe import load_probe

    return load_probe(name)


def _stop_in_order() -> None:
    """On SIGTERM, clean up as after Ctrl-C, so that no incomplete patient's folder remains."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.default_int_handler)


def _file_error(error: OSError) -> str:
    """The message for an error of disk or file that no command has handled."""
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
        return cli.main(args=arguments, prog_name="app.py", standalone_mode=False, obj=read_probe) or 0
    except click.ClickException as error:
        message = error.format_message()
    except UserError as error:
        message = str(error)
    except OSError as error:
        message = _file_error(error)
    except MemoryError:
        message = "the memory is full: close other programs, or take a smaller volume, larger cells or particles, or fewer --jobs"
    except (click.Abort, KeyboardInterrupt):
        click.echo("Stopped.", err=True)
        return 130
    click.echo(f"nephron: {' '.join(message.split())}", err=True)
    return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
