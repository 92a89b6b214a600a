"""The command ``study resection``: margins, balance, random cuts and times of the resection."""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np
from tqdm import tqdm

from rehearsal.commands.command_line import CommandError, load_patient
from rehearsal.result_files import rounded
from scenes.anatomy import LoadedAnatomy
from scenes.scene import EMBEDDED, Scene
from sim.device import start
from studies.harness import rehearsal_of, step_of, without_images
from studies.resection.cut_balance import BALANCE_BAR_MM, COARSER_MM, EDGE_MM, balance_rows, joined
from studies.resection.cut_times import REPEATS, ROUNDS, STEPS, cut_times
from studies.resection.planned_cuts import MARGIN_BAR_MM, VOLUME_BAR, margin_rows
from studies.resection.random_cuts import random_results, summary
from studies.study import Results, Study, paths_argument, study_command, whole_option
from studies.tables_and_panels import table_of

MARGIN_COLUMNS = {
    "patient": "{patient}",
    "line": "{placed}",
    "technique": "{technique}",
    "to": "{how}",
    "least, mm": "{margin_min_mm}",
    "mean, mm": "{margin_mean_mm}",
    "below 5 mm, mm2": "{below_5_mm2}",
    "specimen, ml": "{specimen_ml}",
    "tumour left, ml": "{tumour_left_ml}",
    "parenchyma, ml": "{parenchyma_ml}",
    "error, mm": "{margin_error_mm:.2f}",
    "%": "{volume_error_percent:.1f}",
    "within": "{within}",
}
BALANCE_COLUMNS = {
    "kidney": "{organ}",
    "beads": "{beads:d}",
    "indentation, mm": "{depths}",
    "mean error, mm": "{mean_mm}",
    "largest, mm": "{max_mm}",
    "unmoved, mm": "{moved_mm}",
    "within": "{within}",
}
Patient = tuple[str, Scene, LoadedAnatomy]
Part = tuple[str, dict[str, Any]]


@study_command(
    "resection",
    paths_argument("patients", "[FOLDER]..."),
    click.option(
        "--part",
        "chosen",
        type=click.Choice(["margins", "balance", "random", "times"]),
        multiple=True,
        help="Only this part; can be repeated [all].",
    ),
    whole_option("--cuts", 1, 100_000, 40, "Random scores of each patient."),
    whole_option("--seed", 0, 10**9, 0, "That of the first random score."),
)
def resection(
    study: Study, patients: tuple[Path, ...], chosen: tuple[str, ...], cuts: int, seed: int
) -> Results:
    """Measure margins, balance, random cuts and times of the resection.

    Of the embedded patient, and of further patients' folders. The finite elements of the balance take
    ten minutes the first time.
    """
    loaded: list[Patient] = [("embedded", *load_patient(EMBEDDED))]
    loaded += [(folder.name, *load_patient(folder)) for folder in patients]
    parts: dict[str, Callable[[], Part]] = dict(
        margins=partial(_margins, loaded),
        balance=_balance,
        random=partial(_random, loaded, range(seed, seed + cuts)),
        times=partial(_times, loaded),
    )
    results = {name: part() for name, part in parts.items() if name in (chosen or parts)}
    text = "\n\n".join(part[0] for part in results.values())
    return Results({name: part[1] for name, part in results.items()}, text)


def _margins(patients: Sequence[Patient]) -> Part:
    rows = [row for name, _, anatomy in patients for row in margin_rows(name, anatomy)]
    described = [row.described() for row in rows]
    text = (
        f"Margins and volumes, Nephron / SimpleITK\n{table_of(MARGIN_COLUMNS, described)}\n"
        f"{sum(row.is_within for row in rows)} of {len(rows)} within {MARGIN_BAR_MM:g} mm and "
        f"{100 * VOLUME_BAR:g} %"
    )
    return text, dict(margin_bar_mm=MARGIN_BAR_MM, volume_bar=VOLUME_BAR, rows=described)


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
    setup, described, apart = rows[0].setup, [row.described() for row in rows], to_coarser.mean(axis=1)
    step_s, passes = setup.solver.time_step_s, f"{setup.substeps} x {setup.iterations} iterations"
    text = (
        f"Balance after the cut: beads, Nephron beside finite elements (elements of {setup.size_mm:g} "
        f"mm, steps of 1/{1 / step_s:.0f} s, {passes})\n"
        f"{table_of(BALANCE_COLUMNS, described)}\n"
        f"{sum(row.is_within for row in rows)} of {len(rows)} within {BALANCE_BAR_MM:g} mm; the finite "
        f"elements of the cut kidney, {EDGE_MM:g} mm and {COARSER_MM:g} mm at crater and probe, differ by "
        f"{joined(apart)} mm"
    )
    report = dict(
        bar_mm=BALANCE_BAR_MM,
        cell_mm=setup.size_mm,
        **step_of(setup),
        rows=described,
        to_coarser_mm=[rounded(value) for value in apart],
    )
    return text, report


def _random(patients: Sequence[Patient], seeds: range) -> Part:
    results = []
    for name, scene, anatomy in patients:
        start("cpu")
        rehearsal = rehearsal_of(scene, without_images(anatomy))
        made = random_results(name, rehearsal, seeds)
        results += tqdm(made, desc=f"random scores, {name}", total=len(seeds), unit="score")
    changes = [result.volume_change_percent for result in results]
    most = max((abs(change) for change in changes if change is not None), default=np.nan)
    text = f"{summary(results)}\n  volume of remnant and specimen changed by {most:.2f} % at most"
    return text, dict(results=[asdict(result) for result in results])


def _times(patients: Sequence[Patient]) -> Part:
    medians = {}
    for name, scene, anatomy in patients:
        if anatomy.tumour is not None and anatomy.ct is not None:
            start("cpu")
            times = cut_times(rehearsal_of(scene, anatomy))
            medians[name] = {work: round(float(np.median(ms)), 2) for work, ms in times.items()}
    columns = {"": "{work}"} | {name: f"{{ms[{n}]:.1f}}" for n, name in enumerate(medians)}
    of_all = zip(*medians.values(), strict=True)
    rows = [dict(work=work, ms=[ms[work] for ms in medians.values()]) for work, *_ in of_all]
    head = f"Times, median in ms ({REPEATS} cuts; {ROUNDS} x {STEPS} steps before and after, in turn)"
    return f"{head}\n{table_of(columns, rows)}", dict(medians_ms=medians)
