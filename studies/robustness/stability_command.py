"""The command ``study stability``: a stress test of every tissue model, its table and its figure."""

from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

import click
from joblib import Parallel, delayed
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from tqdm import tqdm

from rehearsal.commands.command_line import make_folder
from rehearsal.worker_processes import processes
from studies.robustness.stress_cases import MODELS, RECOVERED_MM, StressCase, cases_of, quick_cases_of
from studies.study_options import jobs_option, out_option
from studies.study_results import text_table, write_results

# Cases of one body in a task, after which the progress bar advances; the process keeps the body for the next task.
BATCH = 4
# How a case may end, and its colour; good ends first.
OUTCOMES = {
    "recovered its position": "#2a7f4f",
    "recovered its position after the state was restored": "#8fce9d",
    "recovered its shape in another position": "#4f86c6",
    "recovered its shape in another position after the state was restored": "#a9c8ea",
    "shape changed": "#f0a030",
    "not finite": "#c0202a",
}
HEADERS = ("model", "kind", "cases", "finite", "recovered", "restored", "worst rest error, mm", "volume")


@click.command()
@out_option
@click.option("--quick", is_flag=True, help="One case of each kind, in one to two minutes.")
@jobs_option
def stability(out: Path, quick: bool, jobs: int | None) -> None:
    """Stress-test the tissue and see whether it recovers.

    Each model, under extremes of settings, tool and state.
    """
    make_folder(out)
    given = {model: quick_cases_of(model) if quick else cases_of(model) for model in MODELS}
    rows: list[dict[str, Any]] = []
    with tqdm(total=sum(map(len, given.values())), desc="stability", unit="case") as bar:
        for found in _figures(given, jobs):
            rows += found
            bar.update(len(found))
    text = f"{table(rows)}\n\n{summary(rows)}"
    write_results(out, "stability", dict(cases=rows), text, rows, figure_of(rows))


def _figures(given: dict[str, list[StressCase]], jobs: int | None) -> Iterator[list[dict[str, Any]]]:
    """Batches of figures in the order of the cases, as they are done."""
    tasks = []
    for model, cases in given.items():
        for _, group in groupby(cases, key=lambda case: case.subject):
            same = list(group)
            tasks += [(model, same[first : first + BATCH]) for first in range(0, len(same), BATCH)]
    with processes(jobs):
        yield from Parallel(return_as="generator", batch_size=1)(delayed(_run)(*task) for task in tasks)


def _run(model: str, cases: list[StressCase]) -> list[dict[str, Any]]:
    from studies.robustness.stress_test import run

    return [run(model, case) for case in cases]


def table(rows: list[dict[str, Any]]) -> str:
    """A line a model and kind of case: how many, and how they ended."""
    lines = []
    for model, kind in dict.fromkeys((row["model"], row["kind"]) for row in rows):
        cases = [row for row in rows if (row["model"], row["kind"]) == (model, kind)]
        volumes = [row["volume_ratio"] for row in cases if row["volume_ratio"] is not None]
        worst = max(row["rest_error_mm"] or 0.0 for row in cases)
        counts = [_count(cases, key) for key in ("finite", "recovered", "fallback")]
        volume = f"{min(volumes):.2f}-{max(volumes):.2f}"
        lines.append([model, kind, len(cases), *counts, f"{worst:.2f}", volume])
    return text_table(HEADERS, lines)


def summary(rows: list[dict[str, Any]]) -> str:
    """The outcome of all cases of a model, and the reasons of those that did not recover."""
    lines = []
    for model, group in groupby(rows, key=lambda row: row["model"]):
        cases = list(group)
        changed = [row for row in cases if outcome_of(row) in ("shape changed", "not finite")]
        elsewhere = len(cases) - len(changed) - _count(cases, "recovered")
        lines.append(
            f"{model}: {len(cases)} cases, {_count(cases, 'finite')} finite; {_count(cases, 'recovered')} recovered to "
            f"within {RECOVERED_MM:g} mm; the state was restored in {_count(cases, 'fallback')}; {elsewhere} recovered their "
            f"shape in another position; {len(changed)} did not"
        )
        lines += [f"  {row['name']}: {row['reason']}" for row in changed]
    return "\n".join(lines)


def _count(rows: list[dict[str, Any]], key: str) -> int:
    return sum(bool(row[key]) for row in rows)


def outcome_of(row: dict[str, Any]) -> str:
    """How a case ended: one of ``OUTCOMES``."""
    if not row["finite"]:
        return "not finite"
    if not row["recovered"] and (row["shape_error_mm"] is None or row["shape_error_mm"] > RECOVERED_MM):
        return "shape changed"
    position, restored, shape, shape_restored, *_ = OUTCOMES
    if row["recovered"]:
        return restored if row["fallback"] else position
    return shape_restored if row["fallback"] else shape


def figure_of(rows: list[dict[str, Any]]) -> Figure:
    """A panel a model, a bar a kind of case."""
    kinds = list(dict.fromkeys(row["kind"] for row in rows))
    models = list(dict.fromkeys(row["model"] for row in rows))
    figure = Figure(figsize=(12, 0.25 * len(kinds) + 2), layout="constrained")
    panels = figure.subplots(1, len(models), sharey=True, squeeze=False)[0]
    for axes, model in zip(panels, models, strict=True):
        _bars(axes, [row for row in rows if row["model"] == model], kinds)
        axes.set_title(model)
    panels[0].invert_yaxis()
    ends = [[outcome_of(row) for row in rows if row["model"] == model] for model in models]
    handles = [
        Patch(color=colour, label=f"{outcome}: {', '.join(str(each.count(outcome)) for each in ends)}")
        for outcome, colour in OUTCOMES.items()
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    figure.suptitle("How the tissue ended after the stress test")
    return figure


def _bars(axes: Axes, rows: list[dict[str, Any]], kinds: list[str]) -> None:
    ends = [(row["kind"], outcome_of(row)) for row in rows]
    begins = [0] * len(kinds)
    for outcome, colour in OUTCOMES.items():
        counts = [ends.count((kind, outcome)) for kind in kinds]
        axes.barh(kinds, counts, left=begins, color=colour)
        begins = [begin + count for begin, count in zip(begins, counts, strict=True)]
    axes.set_xlabel(f"cases, of {len(rows)}")
    axes.grid(alpha=0.3, axis="x")
    axes.set_axisbelow(True)
