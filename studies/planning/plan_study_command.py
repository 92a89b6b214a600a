"""The command ``study plan``: planned sweeps against unplanned ones."""

from pathlib import Path
from typing import Any

import click
import numpy as np
from tqdm import tqdm

from rehearsal.commands.command_line import WholeRange, make_folder
from rehearsal.planning.plan_file import MOST_SWEEPS
from scenes.anatomy import load_anatomy
from scenes.scene import EMBEDDED, load_scene, scene_file, with_options
from studies.study_options import jobs_option, out_option
from studies.study_results import text_table, write_results

HEADERS = (
    "sweep",
    "covered, %",
    "compression, mean, mm",
    "maximum, mm",
    "contact, %",
    "incidence, deg",
    "path, mm",
    "reachable, %",
    "score",
)
FORMATS = ("", ".0f", ".1f", ".1f", ".0f", ".0f", ".0f", ".0f", ".1f")


@click.command("plan")
@click.argument("scenes", type=click.Path(path_type=Path), nargs=-1)
@out_option
@click.option(
    "--trials",
    type=WholeRange(MOST_SWEEPS, 100_000),
    default=96,
    show_default=True,
    help="Scans a search.",
)
@click.option("--probe", default="drop-in", show_default=True, help="Probe, by its name or as a file.")
@jobs_option
def plan_study(scenes: tuple[Path, ...], out: Path, trials: int, probe: str, jobs: int | None) -> None:
    """Compare planned sweeps with straight and random ones.

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
    write_results(out, "plan", dict(trials=trials, runs=runs), "\n".join(map(table, runs)))


def table(run: dict[str, Any]) -> str:
    """The figures of one patient."""
    rows = [
        [
            row["sweep"] if row["count"] == 1 else f"{row['sweep']} ({row['count']})",
            100 * row["seen"],
            row["compression_mean_mm"],
            row["compression_max_mm"],
            100 * row["contact"],
            row["incidence_deg"],
            row["path_mm"],
            100 * row["reachable"],
            row["score"],
        ]
        for row in run["rows"]
    ]
    return f"{run['patient']}, {run['probe']}: {run['plan']}\n{text_table(HEADERS, rows, FORMATS)}\n"
