"""The command ``study trade``: what speed costs in accuracy, and which settings are worth their time."""

from pathlib import Path
from typing import Any

import click
from tqdm import tqdm

from rehearsal.commands.command_line import arch_option, make_folder, start_taichi
from rehearsal.result_files import write_csv, write_json
from rehearsal.speed_accuracy.pareto_front import preset_of, setup_of_row
from studies.accuracy.bead_case import load_case
from studies.performance.tradeoff_settings import PAPER, setups

EMBEDDED_CASE = Path(__file__).parents[1] / "reference" / "embedded"


@click.command()
@click.argument("cases", metavar="[CASE]...", type=click.Path(path_type=Path), nargs=-1)
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder for table and picture.")
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
    from studies.performance import tradeoff
    from studies.performance.tradeoff_figure import draw

    tried, rounds = setups(quick), 0 if quick else tradeoff.ROUNDS
    with tqdm(total=tradeoff.count(loaded, tried, rounds), desc="trade", unit="run") as bar:
        points = tradeoff.points(loaded, tried, used, rounds, bar.update)
    report = dict(arch=used, cases=[case.name for case in loaded], points=points)
    write_json(report, out / "trade.json")
    write_csv([_flat(point) for point in points], out / "trade.csv")
    draw(points, out / "trade.png")
    click.echo("\n".join(["", *table(points)]))
    click.echo(f"\nWrote trade.json, trade.csv and trade.png to {out}")


def _flat(point: dict[str, Any]) -> dict[str, Any]:
    """A point with the errors of single cases in columns of their own."""
    errors = {f"error_{name}_mm": value for name, value in point["errors_mm"].items()}
    return {name: value for name, value in point.items() if name != "errors_mm"} | errors


def table(points: list[dict[str, Any]]) -> list[str]:
    """All points, cheapest first: those on the front, the presets and the paper's are marked."""
    lines = ["model            size, mm  substeps x iterations  relax.  ms a step  error, mm  arriving"]
    for point in sorted(points, key=lambda point: point["ms_median"]):
        size = point["cell_mm"] or point["radius_mm"]
        marks = ["front"] * point["pareto"] + [name for name in (name_of(point),) if name]
        stiffness = "" if point["stiffness"] is None else f"alpha {point['stiffness']:g} "
        lines.append(
            f"{point['model']:15}{size:>10g}{point['substeps']:>14} x {point['iterations']:<6}"
            f"{point['relaxation_factor']:>8g}{point['ms_median']:>11.2f}{_plain(point['error_mean_mm']):>11}"
            f"{_plain(point['error_arriving_mm']):>10}  {stiffness}{', '.join(marks)}"
        )
    return lines


def name_of(point: dict[str, Any]) -> str:
    """The preset that a point is, or the paper's; empty where it is neither."""
    setup = setup_of_row(point)
    return preset_of(setup) or ("the paper's" if setup in PAPER else "")


def _plain(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
