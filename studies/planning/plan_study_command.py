"""The command ``study plan``: what planning a sweep is worth."""

from pathlib import Path
from typing import Any

import click
import numpy as np
from tqdm import tqdm

from rehearsal.commands.command_line import WholeRange, make_folder
from rehearsal.planning.plan_file import MOST_SWEEPS
from rehearsal.result_files import write_json
from scenes.anatomy import load_anatomy
from scenes.scene import EMBEDDED, load_scene, scene_file, with_options


@click.command("plan")
@click.argument("scenes", type=click.Path(path_type=Path), nargs=-1)
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder for the figures.")
@click.option(
    "--trials",
    type=WholeRange(MOST_SWEEPS, 100_000),
    default=96,
    show_default=True,
    help="Scans a search.",
)
@click.option("--probe", default="drop-in", show_default=True, help="Probe, by its name or as a file.")
@click.option("--jobs", type=WholeRange(1, 256), help="Processes [as many as there are processors].")
def plan_study(scenes: tuple[Path, ...], out: Path, trials: int, probe: str, jobs: int | None) -> None:
    """Compare planned sweeps with straight ones, and such by chance.

    Over the tumour and 5 mm around it, in SCENES [the embedded patient].
    A kidney without a tumour is given one.
    """
    make_folder(out)
    from studies.planning.plan_comparison import compare, count_of
    from studies.planning.virtual_tumour import with_tumour

    runs = []
    patients = scenes or (EMBEDDED,)
    with tqdm(total=len(patients) * count_of(trials), desc="plan", unit="trial") as bar:
        for number, each in enumerate(patients, 1):
            path = scene_file(each)
            scene = with_options(load_scene(path), {"transducer.probe": probe})
            anatomy = with_tumour(load_anatomy(scene, path.parent), np.array(scene.gravity.direction))
            run = compare(scene, anatomy, trials, jobs, bar.update)
            runs.append(dict(patient=scene.title or f"patient {number}") | run)
            bar.update(number * bar.total // len(patients) - bar.n)
    write_json(dict(trials=trials, runs=runs), out / "plan.json")
    click.echo("\n".join(["", *(line for run in runs for line in table(run))]))
    click.echo(f"\nWrote plan.json to {out}")


def table(run: dict[str, Any]) -> list[str]:
    """The figures of one patient."""
    lines = [
        f"{run['patient']}, {run['probe']}: {run['plan']}",
        f"{'sweep':<14}seen  squeezed, mean and most, mm  lines touching       off square  path, mm  reachable  points",
    ]
    for row in run["rows"]:
        name = row["sweep"] if row["count"] == 1 else f"{row['sweep']} ({row['count']})"
        lines.append(
            f"{name:<14}{100 * row['seen']:>3.0f} %{row['compression_mean_mm']:>20.1f}{row['compression_max_mm']:>10.1f}"
            f"{100 * row['contact']:>14.0f} %{row['incidence_deg']:>12.0f} deg{row['path_mm']:>10.0f}"
            f"{100 * row['reachable']:>9.0f} %{row['score']:>8.1f}"
        )
    return [*lines, ""]
