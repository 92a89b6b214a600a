"""The command ``study replay``: is a recorded session, computed again, identical to the bit?"""

from pathlib import Path
from typing import Any

import click
from tqdm import tqdm

from rehearsal.commands.command_line import arch_option, load_patient, make_folder, start_taichi
from rehearsal.configuration import PRESETS
from scenes.scene import EMBEDDED
from scenes.tissue import TISSUES, USUAL
from studies.study_options import number_option, out_option, preset_option, scene_argument
from studies.study_results import write_results


@click.command()
@scene_argument(EMBEDDED)
@out_option
@number_option("--minutes", low=0.05, high=600, default=10.0, help="Simulated minutes.")
@click.option(
    "--model", type=click.Choice(list(TISSUES)), default=USUAL, show_default=True, help="Tissue model."
)
@preset_option
@arch_option
def replay(scene: Path, out: Path, minutes: float, model: str, quality: str, arch: str) -> None:
    """Record a session in SCENE and compute it again.

    Its input is random; from its file it is computed twice, and once from its middle.
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
    write_results(out, "replay", figures, summary(figures))


def summary(figures: dict[str, Any]) -> str:
    """The session and its replays, a line each."""
    lines = [
        f"recorded  {figures['minutes']:g} minutes, {figures['moments']} steps, {figures['ways_back']} of them undone, redone, reset or "
        f"returned to a bookmark; {figures['megabytes']:.1f} MB in {figures['file']}; final state {figures['digest']}"
    ]
    for run in figures["replays"]:
        same = run["digest"] == figures["digest"] and run["differs_s"] is None
        verdict = "identical" if same else f"DIFFERS from {run['differs_s']} s on"
        lines.append(
            f"replayed  from {run['begins_s']:.0f} s: final state {run['digest']}, {verdict} in {run['compared']} states compared"
        )
    return "\n".join(lines)
