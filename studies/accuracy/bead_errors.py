"""Errors of simulated beads (the paper's Tables 2 to 4), and those of predicting no motion."""

from typing import Any

import numpy as np

from rehearsal.configuration import Setup
from rehearsal.result_files import counted, rounded, spread
from sim.surface_contact import SLIPS
from studies.accuracy.bead_case import BeadCase
from studies.accuracy.bead_experiment import BeadExperiment, BeadRun
from studies.harness import step_of
from studies.reference.smooth_obstacles import RoundedBox
from studies.tables_and_panels import table_of

DISTANCE_BANDS = 4
# Shares of smaller forces say nothing.
LEAST_FORCE_N = 0.05
COLUMNS = {
    "stage": "{stage}",
    "indentation, mm": "{indentation_mm:.2f}",
    "mean": "{mean_mm:.2f}",
    "% of travel": "{percent_of_travel:.0f}",
    "SD": "{sd_mm:.2f}",
    "max": "{max_mm:.2f}",
    "unmoved": "{null_mean_mm:.2f}",
    "ratio": "{ratio:.2f}",
    "r(distance)": "{related:.2f}",
}
SLIP = "Most of the contact slides at stage {}: beads and force from there on depend on the grid."
FORCE_COLUMNS = {
    "stage": "{stage}",
    "force on the probe x, y, z, N": "{simulated}",
    "measured": "{measured}",
    "difference, N": "{apart:.3f}",
    "%": "{percent:.1f}",
    "contact sliding, %": "{sliding:.0f}",
    "tangential / normal": "{friction_ratio:.2f}",
}


def bead_errors(case: BeadCase, beads: np.ndarray) -> np.ndarray:
    """Distances (stages, n) [mm] between beads (stages, n, 3) [mm] and where they were measured."""
    return np.linalg.norm(beads - case.measured, axis=2)


def null_errors(case: BeadCase) -> np.ndarray:
    """Errors (stages, n) [mm] of predicting no motion: of beads that stay where they are at stage 0."""
    return np.linalg.norm(case.measured - case.measured[0], axis=2)


def probe_distances(case: BeadCase) -> np.ndarray:
    """Distances (stages, n) [mm] of the measured beads from the probe's surface, negative inside it."""
    box = RoundedBox(case.size_mm, case.edge_radius_mm)
    placed = zip(case.measured, case.poses, strict=True)
    return np.stack([box.gap((beads - pose[:3, 3]) @ pose[:3, :3]) for beads, pose in placed])


def stage_figures(
    indentation_mm: np.ndarray, errors: np.ndarray, null: np.ndarray
) -> list[dict[str, float | None]]:
    """Each stage's mean, standard deviation (population), maximum and share of the probe's travel, if there
    is any.

    ``indentation_mm`` (stages,), ``errors`` and ``null`` (stages, n) [mm].
    """
    return [
        dict(
            indentation_mm=float(depth),
            mean_mm=rounded(error.mean()),
            sd_mm=rounded(error.std()),
            max_mm=rounded(error.max()),
            percent_of_travel=rounded(100 * error.mean() / depth) if depth > 0 else None,
            null_mean_mm=rounded(unmoved.mean()),
        )
        for depth, error, unmoved in zip(indentation_mm, errors, null, strict=True)
    ]


def force_figures(case: BeadCase, run: BeadRun) -> list[dict[str, Any]]:
    """Each stage's force of the tissue on the probe, simulated and measured, x, y, z [N], None where unknown;
    how much of the contact slides; and the centroids of the parts [mm].
    """
    return [
        dict(
            probe_force_N=_vector(simulated),
            measured_probe_force_N=_vector(measured),
            sliding_share=rounded(sliding),
            friction_ratio=rounded(ratio),
            part_centroids_mm=[_vector(part) for part in parts],
        )
        for simulated, measured, sliding, ratio, parts in zip(
            run.force_n,
            case.probe_force_n,
            run.sliding_share,
            run.friction_ratio,
            run.parts_mm,
            strict=True,
        )
    ]


def _vector(values: np.ndarray) -> list[float] | None:
    return None if np.isnan(values).any() else [round(v, 4) + 0.0 for v in values.tolist()]


def correlation(first: np.ndarray, second: np.ndarray) -> float | None:
    """Pearson's correlation of two arrays of one shape; None where one of them is the same everywhere."""
    a, b = first.ravel() - first.mean(), second.ravel() - second.mean()
    scale = np.linalg.norm(a) * np.linalg.norm(b)
    return rounded(a @ b / scale) if scale > 1e-12 else None


def report(experiment: BeadExperiment, setup: Setup, run: BeadRun) -> dict:
    """The figures of ``validate --json``; the correlation is over all beads at stages with indentation."""
    case = experiment.case
    errors = bead_errors(case, run.beads)
    return dict(
        case=case.name,
        model=setup.model,
        **experiment.size(setup),
        **step_of(setup),
        parts=[part.name for part in case.parts],
        stages=[
            figures | forces
            for figures, forces in zip(
                stage_figures(case.indentation_mm, errors, null_errors(case)),
                force_figures(case, run),
                strict=True,
            )
        ],
        overall_mean_mm=rounded(errors.mean()),
        ms_per_step=spread(run.step_ms),
        distance_correlation=correlation(probe_distances(case)[1:], errors[1:]),
        finite=run.finite,
    )


def summary(report: dict, model: str) -> str:
    """Model and speed in a few lines; ``model`` is from ``BeadExperiment.describe``."""
    time = report["ms_per_step"]
    lines = [
        f"case   {report['case']}",
        f"model  {model}",
        f"step   1/{1 / report['time_step_s']:.0f} s in {counted(report['substeps'], 'substep')} of "
        f"{counted(report['iterations'], 'iteration')}",
        f"speed  {time['median']:.1f} ms a step (median), {time['max']:.1f} at most",
    ]
    return "\n".join(lines if report["finite"] else [*lines, "NOT FINITE: the figures below are not valid"])


def table(case: BeadCase, beads: np.ndarray) -> str:
    """The paper's Tables 2 to 4 for one run's beads (stages, n, 3) [mm], beside the errors of predicting no
    motion.

    The last column is the correlation of error and distance from the probe at that stage; below are the
    errors by distance.
    """
    errors, null, distances = bead_errors(case, beads), null_errors(case), probe_distances(case)
    rows: list[dict[str, Any]] = []
    for stage, row in enumerate(stage_figures(case.indentation_mm, errors, null)):
        mean, unmoved = row["mean_mm"], row["null_mean_mm"]
        ratio = mean / unmoved if mean is not None and unmoved else None
        related = correlation(distances[stage], errors[stage])
        rows.append(row | dict(stage=stage, ratio=ratio, related=related))
    overall = dict.fromkeys(rows[0]) | dict(stage="all", mean_mm=errors.mean(), max_mm=errors.max())
    rows.append(overall | dict(null_mean_mm=null.mean(), ratio=errors.mean() / null.mean()))
    related = correlation(distances[1:], errors[1:])
    shown = "-" if related is None else f"{related:.2f}"
    title = f"Error by distance from the probe, stages pressed; correlation {shown}:"
    bands = _bands(distances[1:].ravel(), errors[1:].ravel())
    return "\n".join([table_of(COLUMNS, rows), "", title, *bands])


def force_table(case: BeadCase, run: BeadRun) -> str:
    """The tissue's force on the probe at each stage beside the measured one, and where the probe slips."""
    rows: list[dict[str, Any]] = []
    for stage, (simulated, measured) in enumerate(zip(run.force_n, case.probe_force_n, strict=True)):
        apart, size = np.linalg.norm(simulated - measured), np.linalg.norm(measured)
        rows.append(
            dict(
                stage=stage,
                simulated=_in_words(simulated),
                measured=_in_words(measured),
                apart=None if np.isnan(apart) else apart,
                percent=100 * apart / size if size > LEAST_FORCE_N else None,
                sliding=100 * run.sliding_share[stage],
                friction_ratio=run.friction_ratio[stage],
            )
        )
    slips = [str(stage) for stage in np.flatnonzero(run.sliding_share > SLIPS)]
    return "\n".join([table_of(FORCE_COLUMNS, rows), *([SLIP.format(", ".join(slips))] if slips else [])])


def _in_words(force_n: np.ndarray) -> str:
    return "not known" if np.isnan(force_n).any() else " ".join(f"{v + 0.0:6.3f}" for v in force_n.round(3))


def _bands(distances: np.ndarray, errors: np.ndarray) -> list[str]:
    """Mean errors in bands of distance that hold equally many beads."""
    order = np.argsort(distances, kind="stable")
    return [
        f"  {distances[band].min():5.1f} to {distances[band].max():5.1f} mm  {errors[band].mean():5.2f} mm "
        f"on average, {errors[band].max():5.2f} at most ({len(band)} bead positions)"
        for band in np.array_split(order, DISTANCE_BANDS)
        if len(band)
    ]
