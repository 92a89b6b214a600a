"""How far simulated beads are from measured ones: the paper's Tables 2 to 4, and what they must be read against."""

import numpy as np

from rehearsal.configuration import Setup
from rehearsal.result_files import counted, rounded, spread
from studies.accuracy.bead_case import BeadCase
from studies.accuracy.bead_experiment import BeadExperiment, BeadRun

DISTANCE_BANDS = 4


def bead_errors(case: BeadCase, beads: np.ndarray) -> np.ndarray:
    """Distances (stages, n) [mm] between beads (stages, n, 3) [mm] and where they were measured."""
    return np.linalg.norm(beads - case.measured, axis=2)


def null_errors(case: BeadCase) -> np.ndarray:
    """The errors (stages, n) [mm] of predicting no motion: beads that stay where they were measured at stage 0."""
    return np.linalg.norm(case.measured - case.measured[0], axis=2)


def probe_distances(case: BeadCase) -> np.ndarray:
    """Distances (stages, n) [mm] of the measured beads from the probe's surface at their stage; negative inside it."""
    core = case.size_mm / 2 - case.edge_radius_mm
    rotation, centre = case.poses[:, None, :3, :3], case.poses[:, None, :3, 3]
    local = np.einsum(
        "snij,sni->snj", np.broadcast_to(rotation, (*case.measured.shape, 3)), case.measured - centre
    )
    beyond = np.abs(local) - core
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=2)
    return outside + np.minimum(beyond.max(axis=2), 0.0) - case.edge_radius_mm


def stage_figures(
    indentation_mm: np.ndarray, errors: np.ndarray, null: np.ndarray
) -> list[dict[str, float | None]]:
    """Each stage's mean, standard deviation (of all beads, not of a sample), maximum and share of the probe's travel.

    ``indentation_mm`` (stages,), ``errors`` and ``null`` (stages, n) [mm]. Where the probe has not travelled there is no
    share.
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


def correlation(first: np.ndarray, second: np.ndarray) -> float | None:
    """Pearson's correlation of two arrays of one shape; None where one of them is the same everywhere."""
    a, b = first.ravel() - first.mean(), second.ravel() - second.mean()
    scale = np.linalg.norm(a) * np.linalg.norm(b)
    return rounded(a @ b / scale) if scale > 1e-12 else None


def report(experiment: BeadExperiment, setup: Setup, run: BeadRun) -> dict:
    """What ``validate --json`` writes; the correlation is over all beads at all stages at which the probe presses."""
    case = experiment.case
    errors = bead_errors(case, run.beads)
    return dict(
        case=case.name,
        model=setup.model,
        **experiment.size(setup),
        substeps=setup.substeps,
        iterations=setup.iterations,
        time_step_s=setup.solver.time_step_s,
        stages=stage_figures(case.indentation_mm, errors, null_errors(case)),
        overall_mean_mm=rounded(errors.mean()),
        ms_per_step=spread(run.step_ms),
        distance_correlation=correlation(probe_distances(case)[1:], errors[1:]),
        finite=run.finite,
    )


def summary(report: dict, model: str) -> str:
    """What was computed and how fast, in a few lines for the terminal; ``model`` is ``BeadExperiment.describe``'s."""
    time = report["ms_per_step"]
    lines = [
        f"case   {report['case']}",
        f"model  {model}",
        f"step   1/{1 / report['time_step_s']:.0f} s in {counted(report['substeps'], 'substep')} of "
        f"{counted(report['iterations'], 'iteration')}",
        f"speed  {time['median']:.1f} ms a step (median), {time['max']:.1f} at most",
    ]
    return "\n".join(lines if report["finite"] else [*lines, "NOT FINITE: the figures below mean nothing"])


def table(case: BeadCase, beads: np.ndarray) -> str:
    """The paper's Tables 2 to 4 for one run's beads (stages, n, 3) [mm], beside what predicting no motion gives.

    The last column is the correlation of error and distance from the probe at that stage; below are the errors by
    distance.
    """
    errors, null, distances = bead_errors(case, beads), null_errors(case), probe_distances(case)
    lines = ["stage  indentation   mean  of travel     SD    max  unmoved  ratio  r(distance)"]
    for stage, row in enumerate(stage_figures(case.indentation_mm, errors, null)):
        share = "-" if row["percent_of_travel"] is None else f"{row['percent_of_travel']:.0f} %"
        related = correlation(distances[stage], errors[stage])
        lines.append(
            f"{stage:<5}  {row['indentation_mm']:8.2f} mm  {_plain(row['mean_mm']):>5}  {share:>9}  "
            f"{_plain(row['sd_mm']):>5}  "
            f"{_plain(row['max_mm']):>5}  {_against(row['mean_mm'], row['null_mean_mm'])}  {_plain(related):>11}"
        )
    overall = _against(errors.mean(), null.mean())
    lines.append(f"{'all':<5}  {'':11}  {errors.mean():5.2f}  {'':9}  {'':5}  {errors.max():5.2f}  {overall}")
    related = correlation(distances[1:], errors[1:])
    lines.append(f"\nError by distance from the probe, stages pressed; correlation {_plain(related)}:")
    return "\n".join(lines + _bands(distances[1:].ravel(), errors[1:].ravel()))


def _against(mean: float | None, null: float | None) -> str:
    """Two columns: the error of the null model, and the model's error as a multiple of it."""
    return f"{_plain(null):>7}  {_plain(mean / null if mean is not None and null else None):>5}"


def _plain(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _bands(distances: np.ndarray, errors: np.ndarray) -> list[str]:
    """Mean errors in bands of distance that hold equally many beads."""
    order = np.argsort(distances, kind="stable")
    return [
        f"  {distances[band].min():5.1f} to {distances[band].max():5.1f} mm  {errors[band].mean():5.2f} mm on average, "
        f"{errors[band].max():5.2f} at most ({len(band)} bead positions)"
        for band in np.array_split(order, DISTANCE_BANDS)
        if len(band)
    ]
