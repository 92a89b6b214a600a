"""The command ``study resection``: margins, balance, random cuts and times of the resection."""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click
import numpy as np
from tqdm import tqdm

from rehearsal.commands.command_line import CommandError, WholeRange, load_patient, make_folder
from rehearsal.result_files import rounded
from scenes.anatomy import LoadedAnatomy
from scenes.scene import EMBEDDED, Scene
from sim.device import start
from studies.harness import rehearsal_of, without_images
from studies.resection.cut_balance import BALANCE_BAR_MM, COARSER_MM, EDGE_MM, balance_rows
from studies.resection.cut_times import REPEATS, ROUNDS, STEPS, cut_times
from studies.resection.planned_cuts import MARGIN_BAR_MM, VOLUME_BAR, margin_rows
from studies.resection.random_cuts import random_results, summary
from studies.study_options import out_option
from studies.study_results import table_of, text_table, write_results

MARGIN_COLUMNS = (
    ("patient", "{patient}"),
    ("line", "{placed}"),
    ("technique", "{technique}"),
    ("to", "{how}"),
    ("least, mm", "{margin_min_mm}"),
    ("mean, mm", "{margin_mean_mm}"),
    ("below 5 mm, mm2", "{below_5_mm2}"),
    ("specimen, ml", "{specimen_ml}"),
    ("tumour left, ml", "{tumour_left_ml}"),
    ("parenchyma, ml", "{parenchyma_ml}"),
    ("error, mm", "{margin_error_mm:.2f}"),
    ("%", "{volume_error_percent:.1f}"),
    ("within", "{within}"),
)
BALANCE_COLUMNS = (
    ("kidney", "{organ}"),
    ("beads", "{beads:d}"),
    ("indentation, mm", "{depths}"),
    ("mean error, mm", "{mean_mm}"),
    ("largest, mm", "{max_mm}"),
    ("unmoved, mm", "{moved_mm}"),
    ("within", "{within}"),
)
Patient = tuple[str, Scene, LoadedAnatomy]
Part = tuple[str, dict[str, Any]]


@click.command()
@click.argument("patients", metavar="[FOLDER]...", type=click.Path(path_type=Path), nargs=-1)
@out_option
@click.option(
    "--part",
    "chosen",
    type=click.Choice(["margins", "balance", "random", "times"]),
    multiple=True,
    help="Only this part; can be repeated [all].",
)
@click.option(
    "--cuts",
    type=WholeRange(1, 100_000),
    default=40,
    show_default=True,
    help="Random scores of each patient.",
)
@click.option(
    "--seed", type=WholeRange(0, 10**9), default=0, show_default=True, help="That of the first random score."
)
def resection(patients: tuple[Path, ...], out: Path, chosen: tuple[str, ...], cuts: int, seed: int) -> None:
    """Measure margins, balance, random cuts and times of the resection.

    Of the embedded patient, and of further patients' folders. The finite elements of the balance take
    ten minutes the first time.
    """
    make_folder(out)
    loaded: list[Patient] = [("embedded", *load_patient(EMBEDDED))]
    loaded += [(folder.name, *load_patient(folder)) for folder in patients]
    parts: dict[str, Callable[[], Part]] = dict(
        margins=lambda: _margins(loaded),
        balance=_balance,
        random=lambda: _random(loaded, range(seed, seed + cuts)),
        times=lambda: _times(loaded),
    )
    found = {name: part() for name, part in parts.items() if name in (chosen or parts)}
    text = "\n\n".join(part[0] for part in found.values())
    write_results(out, "resection", {name: part[1] for name, part in found.items()}, text)


def _margins(patients: Sequence[Patient]) -> Part:
    rows = [row for name, _, anatomy in patients for row in margin_rows(name, anatomy)]
    within = sum(row.is_within for row in rows)
    text = (
        "Margins and volumes, Nephron / SimpleITK\n"
        f"{table_of(MARGIN_COLUMNS, [row.described() for row in rows])}\n"
        f"{within} of {len(rows)} within {MARGIN_BAR_MM:g} mm and {100 * VOLUME_BAR:g} %"
    )
    return text, dict(margin_bar_mm=MARGIN_BAR_MM, volume_bar=VOLUME_BAR, rows=[row.report() for row in rows])


def _balance() -> Part:
    try:
        import mmgpy  # noqa: F401
        import skfem  # noqa: F401
    except ImportError as error:
        raise CommandError(
            f"the balance needs {error.name}, which is not installed: pip install -r requirements-dev.txt, "
            "or leave --part balance out"
        ) from None
    from studies.reference.equilibrium import NotConvergedError
    from studies.reference.fem_solid import MeshError

    start("cpu")
    try:
        rows, to_coarser = balance_rows()
    except (MeshError, NotConvergedError) as error:
        raise CommandError(
            f"no finite elements of the cut kidney: {error}; leave --part balance out"
        ) from None
    setup = rows[0].setup
    apart = " / ".join(f"{value:.2f}" for value in to_coarser.mean(axis=1))
    text = (
        f"Balance after the cut: beads, Nephron beside finite elements (elements of {setup.size_mm:g} "
        "mm, steps of "
        f"1/{1 / setup.solver.time_step_s:.0f} s, {setup.substeps} x {setup.iterations} iterations)\n"
        f"{table_of(BALANCE_COLUMNS, [row.described() for row in rows])}\n"
        f"{sum(row.is_within for row in rows)} of {len(rows)} within {BALANCE_BAR_MM:g} mm; the finite "
        "elements of the cut kidney, "
        f"{EDGE_MM:g} mm and {COARSER_MM:g} mm at crater and probe, differ by {apart} mm"
    )
    report = dict(
        bar_mm=BALANCE_BAR_MM,
        cell_mm=setup.size_mm,
        time_step_s=setup.solver.time_step_s,
        substeps=setup.substeps,
        iterations=setup.iterations,
        rows=[row.described() for row in rows],
        to_coarser_mm=[rounded(value) for value in to_coarser.mean(axis=1)],
    )
    return text, report


def _random(patients: Sequence[Patient], seeds: range) -> Part:
    results = []
    for name, scene, anatomy in patients:
        start("cpu")
        rehearsal = rehearsal_of(scene, without_images(anatomy))
        made = random_results(name, rehearsal, seeds)
        results += tqdm(made, desc=f"random scores, {name}", total=len(seeds), unit="score")
    change = [abs(each.volume_change_percent) for each in results if each.volume_change_percent is not None]
    most = max(change, default=np.nan)
    text = f"{summary(results)}\n  volume of remnant and specimen changed by {most:.2f} % at most"
    return text, dict(results=[asdict(each) for each in results])


def _times(patients: Sequence[Patient]) -> Part:
    medians = {}
    for name, scene, anatomy in patients:
        if anatomy.tumour is not None and anatomy.ct is not None:
            start("cpu")
            medians[name] = cut_times(rehearsal_of(scene, anatomy)).medians()
    names = list(next(iter(medians.values())))
    table = [[name, *(each[name] for each in medians.values())] for name in names]
    text = (
        f"Times, median in ms ({REPEATS} cuts; {ROUNDS} x {STEPS} steps before and after, in turn)\n"
        f"{text_table(['', *medians], table, ['', *['.1f'] * len(medians)])}"
    )
    return text, dict(medians_ms=medians)
