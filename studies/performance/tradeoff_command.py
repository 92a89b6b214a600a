"""The command ``study trade``: the speed-accuracy trade-off of settings, and their Pareto front."""

from pathlib import Path
from typing import Any

import click
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from tqdm import tqdm

from rehearsal.commands.command_line import arch_option, make_folder, start_taichi
from rehearsal.speed_accuracy.pareto_front import preset_of, setup_of_row
from studies.accuracy.bead_case import load_case
from studies.performance.tradeoff_settings import PAPER, setups
from studies.study_options import out_option
from studies.study_results import text_table, write_results

EMBEDDED_CASE = Path(__file__).parents[1] / "reference" / "embedded"
FRAME_MS = 1000 / 60
HEADERS = ("model", "size, mm", "substeps x iterations", "relax.", "ms a step", "error, mm", "arriving", "")
FORMATS = ("", "g", "", "g", ".2f", ".3f", ".3f")


@click.command()
@click.argument("cases", metavar="[CASE]...", type=click.Path(path_type=Path), nargs=-1)
@out_option
@click.option(
    "--quick", is_flag=True, help="A handful of settings on the embedded case, in less than a minute."
)
@arch_option
def trade(cases: tuple[Path, ...], out: Path, quick: bool, arch: str) -> None:
    """Measure the error of beads against the time of a step.

    Over model, resolution, substeps, iterations and relaxation.
    The error is the mean over the embedded patient's bead experiment and those of CASE..., folders as `validate` takes them.
    """
    make_folder(out)
    loaded = [load_case(EMBEDDED_CASE), *(load_case(case) for case in cases)]
    used = start_taichi(arch)
    from studies.performance import tradeoff_points

    tried, rounds = setups(quick), 0 if quick else tradeoff_points.ROUNDS
    with tqdm(total=tradeoff_points.count(loaded, tried, rounds), desc="trade", unit="run") as bar:
        points = tradeoff_points.points(loaded, tried, used, rounds, bar.update)
    report = dict(arch=used, cases=[case.name for case in loaded], points=points)
    rows = [_flat(point) for point in points]
    write_results(out, "trade", report, table(points), rows, figure_of(points))


def _flat(point: dict[str, Any]) -> dict[str, Any]:
    """A point with the errors of single cases in columns of their own."""
    errors = {f"error_{name}_mm": value for name, value in point["errors_mm"].items()}
    return {name: value for name, value in point.items() if name != "errors_mm"} | errors


def _size(point: dict[str, Any]) -> float:
    return point["cell_mm"] or point["radius_mm"]


def table(points: list[dict[str, Any]]) -> str:
    """All points, fastest first; those on the front, the presets and the paper's are marked."""
    rows = []
    for point in sorted(points, key=lambda point: point["ms_median"]):
        setup = setup_of_row(point)
        stiffness = "" if point["stiffness"] is None else f"alpha {point['stiffness']:g}"
        front = "front" if point["pareto"] else ""
        name = preset_of(setup) or ("the paper's" if setup in PAPER else "")
        rows.append(
            [
                point["model"],
                _size(point),
                f"{point['substeps']} x {point['iterations']}",
                point["relaxation_factor"],
                point["ms_median"],
                point["error_mean_mm"],
                point["error_arriving_mm"],
                ", ".join(filter(None, (stiffness, front, name))),
            ]
        )
    return text_table(HEADERS, rows, FORMATS)


def figure_of(points: list[dict[str, Any]]) -> Figure:
    """Every point by its time and its error, the Pareto front, the presets and the paper's settings."""
    points = [point for point in points if point["error_mean_mm"] is not None]
    figure = Figure(figsize=(11, 7), layout="constrained")
    axes = figure.subplots()
    for model in sorted({point["model"] for point in points}):
        _scatter(axes, [point for point in points if point["model"] == model], model)
    front = sorted(_place(point) for point in points if point["pareto"])
    ms, error = [place[0] for place in front], [place[1] for place in front]
    axes.plot(ms, error, color="black", linewidth=1.2, label="Pareto front", drawstyle="steps-post")
    axes.axvline(FRAME_MS, color="0.5", linestyle="--", linewidth=0.8)
    axes.annotate(" a frame at 60 Hz", (FRAME_MS, axes.get_ylim()[1]), color="0.4", va="top")
    labels = dict(xlabel="time of a step (ms, median)", ylabel="mean error of the beads (mm)")
    axes.set(xscale="log", yscale="log", title="Speed-accuracy trade-off", **labels)
    axes.grid(alpha=0.3, which="both")
    axes.legend(loc="center right")
    return figure


def _place(point: dict[str, Any]) -> tuple[float, float]:
    return point["ms_median"], point["error_mean_mm"]


def _scatter(axes: Axes, points: list[dict[str, Any]], model: str) -> None:
    ms, error = np.array([_place(point) for point in points]).T
    size = np.array([_size(point) for point in points])
    axes.scatter(ms, error, s=7 * size, alpha=0.55, label=f"{model} (area: size of cells or particles)")
    for k, point in enumerate(point for point in points if setup_of_row(point) in PAPER):
        label = "the paper's radii (mm), with its best stiffness" if k == 0 else None
        axes.scatter(*_place(point), marker="x", color="tab:red", zorder=3, label=label)
        _annotate(axes, point, f"{point['radius_mm']:g}", 6, fontsize=9, color="tab:red")
    for point in points:
        name = preset_of(setup_of_row(point))
        # The presets of shape matching have the paper's particles, and finer ones are not more accurate.
        if name and point["pareto"]:
            axes.scatter(*_place(point), marker="D", facecolors="none", edgecolors="black", zorder=3)
            _annotate(axes, point, name, -15, fontsize=10, weight="bold")


def _annotate(axes: Axes, point: dict[str, Any], text: str, up: int, **style: Any) -> None:
    axes.annotate(text, _place(point), xytext=(0, up), textcoords="offset points", ha="center", **style)
