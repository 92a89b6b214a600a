"""The command ``acknowledge``: marks the warnings of an import as checked by the user."""

import sys
from pathlib import Path

import click

from scenes.import_findings import acknowledge, read_findings
from scenes.scene import SceneError, scene_file
from scenes.terminal import shell_command


@click.command("acknowledge")
@click.argument("patient", type=click.Path(path_type=Path))
@click.option("--yes", is_flag=True, help="Do not ask.")
def acknowledge_command(patient: Path, yes: bool) -> None:
    """Mark the warnings of PATIENT's import as checked.

    PATIENT is the folder that import made. Its warnings are then no longer shown in the window; terminal and
    reports still name them.
    """
    folder = scene_file(patient).parent
    findings = read_findings(folder)
    if findings is None:
        raise SceneError(f"{folder}: has no import.json; expected a patient's folder, made by app.py import")
    if not findings.open_warnings:
        click.echo("There is no warning to acknowledge.")
        return
    for text in findings.open_warnings:
        click.echo(f"WARNING of the import: {text}")
    if not yes:
        _ask(folder)
    acknowledge(folder, findings.open_warnings)
    click.echo("Acknowledged: no longer shown in the window; terminal and reports still name it.")


def _ask(folder: Path) -> None:
    """Raises SceneError where nobody can answer, Abort for a no."""
    if not sys.stdin.isatty():
        raise SceneError(
            f"not acknowledged: there is no terminal to ask in; check {folder / 'check.png'}, then: "
            f"{shell_command('acknowledge', folder, '--yes')}"
        )
    click.confirm(f"Did you check this in {folder / 'check.png'}?", abort=True)
