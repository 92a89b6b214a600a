"""The command ``study stability``: every tissue model at the extremes, and what is left when they are over."""

from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

import click
from joblib import Parallel, delayed
from tqdm import tqdm

from rehearsal.commands.command_line import WholeRange, make_folder
from rehearsal.result_files import write_csv, write_json
from rehearsal.worker_processes import processes
from studies.robustness.stress_cases import MODELS, StressCase, cases_of, quick_cases_of

# Cases of one body that a process takes at a time, by which the bar goes on; it keeps the body for the next ones.
BATCH = 4


@click.command()
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder for table and picture.")
@click.option("--quick", is_flag=True, help="One case of each kind, in one to two minutes.")
@click.option("--jobs", type=WholeRange(1, 1024), help="Processes on this machine [one a processor].")
def stability(out: Path, quick: bool, jobs: int | None) -> None:
    """Maltreat the tissue, let go, and see whether it recovers.

    What no scene should do to its tissue, to each model: extremes of settings, tool and state.
    """
    make_folder(out)
    from studies.robustness.stability_figure import draw

    given = {model: quick_cases_of(model) if quick else cases_of(model) for model in MODELS}
    rows: list[dict[str, Any]] = []
    with tqdm(total=sum(map(len, given.values())), desc="stability", unit="case") as bar:
        for found in _figures(given, jobs):
            rows += found
            bar.update(len(found))
    write_json(dict(cases=rows), out / "stability.json")
    write_csv(rows, out / "stability.csv")
    draw(rows, out / "stability.png")
    click.echo("\n".join(["", *table(rows), "", *summary(rows)]))
    click.echo(f"\nWrote stability.json, stability.csv and stability.png to {out}")


def _figures(given: dict[str, list[StressCase]], jobs: int | None) -> Iterator[list[dict[str, Any]]]:
    """Batches of figures in the order of the cases, as they are done."""
    tasks = []
    for model, cases in given.items():
        for _, alike in groupby(cases, key=lambda case: case.subject):
            same = list(alike)
            tasks += [(model, same[first : first + BATCH]) for first in range(0, len(same), BATCH)]
    with processes(jobs):
        yield from Parallel(return_as="generator", batch_size=1)(delayed(_run)(*task) for task in tasks)


def _run(model: str, cases: list[StressCase]) -> list[dict[str, Any]]:
    from studies.robustness.stress_test import run

    return [run(model, case) for case in cases]


def table(rows: list[dict[str, Any]]) -> list[str]:
    """A line a kind of case and model: how many, and how they ended."""
    lines = ["model            kind                cases finite recovered put back  worst rest error  volume"]
    for model in dict.fromkeys(row["model"] for row in rows):
        of_model = [row for row in rows if row["model"] == model]
        for kind in dict.fromkeys(row["kind"] for row in of_model):
            alike = [row for row in of_model if row["kind"] == kind]
            volumes = [row["volume_ratio"] for row in alike if row["volume_ratio"] is not None]
            worst = max((row["rest_error_mm"] or 0.0 for row in alike), default=0.0)
            lines.append(
                f"{model:<17}{kind:<20}{len(alike):>5}{_count(alike, 'finite'):>7}{_count(alike, 'recovered'):>10}"
                f"{_count(alike, 'fallback'):>9}{worst:>15.2f} mm  {min(volumes):.2f}-{max(volumes):.2f}"
            )
    return lines


def summary(rows: list[dict[str, Any]]) -> list[str]:
    """What became of all cases of a model, and the reasons of those that did not recover."""
    lines = []
    for model in dict.fromkeys(row["model"] for row in rows):
        of_model = [row for row in rows if row["model"] == model]
        lost = [row for row in of_model if not row["recovered"]]
        whole = [row for row in lost if row["shape_error_mm"] is not None and row["shape_error_mm"] <= 0.1]
        lines.append(
            f"{model}: {len(of_model)} cases, {_count(of_model, 'finite')} finite; {_count(of_model, 'recovered')} came back to "
            f"within 0.1 mm, {_count(of_model, 'fallback')} after the tissue was put back; {len(whole)} lie elsewhere, whole; "
            f"{len(lost) - len(whole)} keep a changed shape"
        )
        lines += [f"  {row['name']}: {row['reason']}" for row in lost if row not in whole]
    return lines


def _count(rows: list[dict[str, Any]], key: str) -> int:
    return sum(bool(row[key]) for row in rows)
