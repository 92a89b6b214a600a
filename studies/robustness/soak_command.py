"""The command ``study soak``: an hour of rehearsal, accelerated."""

from pathlib import Path
from typing import Any

import click
from tqdm import tqdm

from rehearsal.commands.command_line import WholeRange, arch_option, load_patient, make_folder, start_taichi
from rehearsal.configuration import PRESETS
from rehearsal.result_files import write_csv, write_json
from scenes.scene import PAPER

HOUR = 60


@click.command()
@click.argument("scene", type=click.Path(path_type=Path), default=PAPER, required=False)
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder for table and picture.")
@click.option(
    "--minutes", type=WholeRange(1, 6000), default=HOUR, show_default=True, help="Simulated minutes."
)
@click.option("--quick", is_flag=True, help="A quarter of a simulated minute of each model.")
@click.option("--model", type=click.Choice(list(PRESETS)), help="One tissue model [all].")
@arch_option
def soak(scene: Path, out: Path, minutes: int, quick: bool, model: str | None, arch: str) -> None:
    """Rehearse for an hour in SCENE, faster than real.

    Does the rest shape drift, memory grow, a replay differ?
    """
    make_folder(out)
    loaded, anatomy = load_patient(scene)
    used = start_taichi(arch)
    from studies.robustness import soak
    from studies.robustness.soak_figure import draw

    minutes, minute_s = (1, soak.QUICK_MINUTE_S) if quick else (minutes, soak.MINUTE_S)
    setups = [presets["fast"] for name, presets in PRESETS.items() if model in (None, name)]
    runs = []
    with tqdm(
        total=len(setups) * (minutes + min(minutes, soak.REPLAYED_MINUTES)), desc="soak", unit="min"
    ) as bar:
        for setup in setups:
            runs.append(soak.soak(loaded, anatomy, setup, minutes, minute_s, used, bar.update))
    write_json(dict(arch=used, runs=runs), out / "soak.json")
    write_csv([dict(model=run["model"]) | row for run in runs for row in run["minutes"]], out / "soak.csv")
    draw(runs, out / "soak.png")
    click.echo("\n".join(["", *table(runs)]))
    click.echo(f"\nWrote soak.json, soak.csv and soak.png to {out}")


def table(runs: list[dict[str, Any]]) -> list[str]:
    """The first and the last minute of each model, and what must be equal."""
    lines = ["model            minute  moved, mm  shape, mm  volume  ms a step  memory, MB"]
    for run in runs:
        for row in dict.fromkeys((0, len(run["minutes"]) // 2, len(run["minutes"]) - 1)):
            at = run["minutes"][row]
            lines.append(
                f"{run['model']:<17}{at['minute']:>6}{at['moved_mm']:>11.3f}{at['shape_mm']:>11.4f}{at['volume_ratio']:>8.4f}"
                f"{at['ms_median']:>11.2f}{at['memory_mb']:>12.1f}"
            )
    for run in runs:
        most = max(row["shape_mm"] for row in run["minutes"])
        lines.append(
            f"{run['model']}: shape at most {most:.4f} mm from the first rest; memory {run['memory_growth_mb']:+.1f} MB; replay "
            f"{'bit for bit the same' if run['replay_equal'] else 'DIFFERS'}; reset "
            f"{'bit for bit the same' if run['reset_equal'] else 'DIFFERS'}; put back {run['fallbacks']} times"
        )
    return lines
