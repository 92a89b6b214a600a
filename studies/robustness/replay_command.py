"""The command ``study replay``: is a recorded session, computed again, the same to the bit?"""

from pathlib import Path
from typing import Any

import click
from tqdm import tqdm

from rehearsal.commands.command_line import NumberRange, arch_option, load_patient, make_folder, start_taichi
from rehearsal.configuration import PRESETS
from rehearsal.result_files import write_json
from scenes.scene import EMBEDDED
from scenes.tissue import QUALITIES, TISSUES, USUAL


@click.command()
@click.argument("scene", type=click.Path(path_type=Path), default=EMBEDDED, required=False)
@click.option(
    "--out", type=click.Path(path_type=Path), required=True, help="Folder for the session and the figures."
)
@click.option(
    "--minutes", type=NumberRange(0.05, 600), default=10.0, show_default=True, help="Simulated minutes."
)
@click.option(
    "--model",
    type=click.Choice(list(TISSUES)),
    default=USUAL,
    show_default=True,
    help="Tissue model.",
)
@click.option(
    "--quality",
    type=click.Choice(QUALITIES),
    default="balanced",
    show_default=True,
    help="A preset of the model.",
)
@arch_option
def replay(scene: Path, out: Path, minutes: float, model: str, quality: str, arch: str) -> None:
    """Record a session in SCENE and compute it again.

    It is led by chance; from its file it is computed twice, and once from its middle.
    """
    make_folder(out)
    loaded, anatomy = load_patient(scene)
    used = start_taichi(arch)
    from studies.robustness.replay_study import measure

    setup = PRESETS[model][quality]
    total = round(3.5 * 60 * minutes / loaded.solver.time_step_s)
    with tqdm(total=total, desc="replay", unit="step") as bar:
        found = measure(loaded, anatomy, setup, minutes, used, out, bar.update)
    figures = dict(arch=used, model=model, quality=quality) | found
    write_json(figures, out / "replay.json")
    click.echo("\n".join(["", *lines_of(figures)]))
    click.echo(f"\nWrote {found['file']} and replay.json to {out}")


def lines_of(figures: dict[str, Any]) -> list[str]:
    """The figures in words."""
    lines = [
        f"recorded  {figures['minutes']:g} minutes, {figures['moments']} moments, {figures['ways_back']} of them undone, redone, reset or "
        f"gone back to a bookmark; {figures['megabytes']:.1f} MB; ends in state {figures['digest']}"
    ]
    for run in figures["replays"]:
        same = run["digest"] == figures["digest"] and run["differs_s"] is None
        verdict = "identical" if same else f"DIFFERS from {run['differs_s']} s on"
        lines.append(
            f"replayed  from {run['begins_s']:.0f} s: ends in state {run['digest']}, {verdict} in {run['compared']} states compared"
        )
    return lines
