"""The command line. ``python app.py --help`` lists what it does."""

import _thread
import errno
import gc
import io
import os
import signal
import sys
import threading
from types import FrameType
from typing import Any

# After a signal within an import: this long until it is tried again [s].
IMPORT_S = 0.02


def _stop(signum: int, frame: FrameType | None) -> None:
    """Ctrl-C and SIGTERM: KeyboardInterrupt in a command, so that nothing incomplete remains; before and
    after it, the end.

    Within a command's imports it is raised a moment later: modules that try what is installed catch it there,
    and go on without it.
    """
    stack = set()
    while frame is not None:
        stack.add((frame.f_globals.get("__name__"), frame.f_code.co_name))
        frame = frame.f_back
    if (__name__, "main") not in stack or ("rehearsal.commands.lazy_group", "get_command") in stack:
        os.write(2, b"Stopped.\n")
        os._exit(130)
    if ("importlib._bootstrap", "_find_and_load") not in stack:
        raise KeyboardInterrupt
    later = threading.Timer(IMPORT_S, _thread.interrupt_main, [signum])
    later.daemon = True
    later.start()


if __name__ == "__main__":
    signal.signal(signal.SIGINT, _stop)
    signal.signal(signal.SIGTERM, _stop)

try:
    import click

except ModuleNotFoundError as missing:
    sys.exit(
        f"nephron: {missing.name} is not installed for this Python; run make run once, then use the "
        "Python of its environment: "
        ". .venv/bin/activate (Windows: .venv\\Scripts\\activate)"
    )

from errors import UserError
from rehearsal.commands.lazy_group import LazyGroup
from version import VERSION

# While modules are loaded and kernels built, much is allocated and almost nothing becomes garbage. Python
# would look for garbage so often that this took a tenth of the start.
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

    Without a command it is `rehearse`.
    """


def _open_streams() -> None:
    """Let output go nowhere where it is closed, as in a service or a Windows program without a console.

    A file that is opened later would get the number of a closed stream, and with it what libraries print.
    """
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(descriptor)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115


def _show_any_letter() -> None:
    """Let output show what its encoding lacks, or a path that is not UTF-8, as backslashes instead of an
    error.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def read_probe(name: str) -> Any:
    """The probe of a name or file, for ``import``, whose folder knows nothing of ultrasound.

    Raises UserError.
    """
    from ultrasound.probe import load_probe

    return load_probe(name)


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
    try:
        _open_streams()
        _show_any_letter()
        return cli.main(args=arguments, prog_name="app.py", standalone_mode=False, obj=read_probe) or 0
    except click.ClickException as error:
        message = error.format_message()
    except UserError as error:
        message = str(error)
    except OSError as error:
        message = _file_error(error)
    except MemoryError:
        message = (
            "the memory is full: close other programs, or take a smaller volume, larger cells or "
            "particles, or fewer --jobs"
        )
    except (click.Abort, KeyboardInterrupt):
        click.echo("Stopped.", err=True)
        return 130
    click.echo(f"nephron: {' '.join(message.split())}", err=True)
    return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
