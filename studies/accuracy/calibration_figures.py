"""Figures of a calibration: the paper's Figures 4 and 5, its tables as images, and the course of a search."""

from functools import partial
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from rehearsal.result_files import save_figure
from studies.accuracy.calibration import MOST_ERROR, Calibration, CalibrationTrial, quartic
from studies.accuracy.calibration_tables import Table
from studies.study_results import DPI, finish_axes

_save = partial(save_figure, dpi=DPI, bbox_inches="tight")


def write_figure4(calibration: Calibration, path: Path) -> None:
    """Mean error over the stiffness for each radius, fitted and held out; quartics with a ring at the minimum."""
    figure, left, right = _two_panels(calibration)
    for colour, radius in zip(_colours(calibration), calibration.trials, strict=True):
        trials = sorted(calibration.trials[radius], key=lambda trial: trial.setup.tissue.stiffness)
        at = [trial.setup.tissue.stiffness for trial in trials]
        left.plot(at, [trial.fit_mm for trial in trials], ".", color=colour, label=f"{radius:g} mm")
        right.plot(at, [trial.held_out_mm for trial in trials], ".-", color=colour, linewidth=0.8)
        fit = quartic(trials)
        if fit is not None:
            smooth = np.linspace(*fit.range, 200)
            left.plot(smooth, fit.polynomial(smooth), "-", color=colour, linewidth=1)
            left.plot(fit.stiffness, fit.error_mm, "o", color=colour, markersize=9, fillstyle="none")
    _finish(calibration, left, right, "stiffness α")
    _save(figure, path)


def write_search(calibration: Calibration, path: Path) -> None:
    """Error of the best setup so far over the evaluations, fitted and held out."""
    figure, left, right = _two_panels(calibration)
    for colour, (radius, trials) in zip(_colours(calibration), calibration.trials.items(), strict=True):
        best = best_so_far(trials)
        left.plot([trial.fit_mm for trial in trials], ".", color=colour, alpha=0.35, markersize=4)
        left.plot(
            [trial.fit_mm for trial in best], color=colour, drawstyle="steps-post", label=f"{radius:g} mm"
        )
        right.plot([trial.held_out_mm for trial in best], color=colour, drawstyle="steps-post")
    _finish(calibration, left, right, "setups tried")
    _save(figure, path)


def best_so_far(trials: list[CalibrationTrial]) -> list[CalibrationTrial]:
    """The best trial so far, after each trial."""
    best: list[CalibrationTrial] = []
    for trial in trials:
        best.append(trial if not best or trial.fit_mm < best[-1].fit_mm else best[-1])
    return best


def write_figure5(calibration: Calibration, path: Path) -> None:
    """Particles and clusters over the radius, for each case."""
    figure = Figure(figsize=(9, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    radii = list(calibration.trials)
    for place, case in enumerate(calibration.cases):
        measured = [calibration.trials[radius][0].measured[place] for radius in radii]
        left.plot(radii, [each.particles for each in measured], "o-", label=case.name)
        right.plot(radii, [each.clusters for each in measured], "o-", label=case.name)
    for axes, what in ((left, "particles"), (right, "clusters")):
        finish_axes(axes, {}, xlabel="particle radius (mm)", ylabel=what, ylim=(0, None))
    _save(figure, path)


def write_table(table: Table, path: Path) -> None:
    """A table as an image."""
    cells = table.cells()
    wide = [max(len(line[column]) for line in cells) + 3 for column in range(len(cells[0]))]
    figure = Figure(figsize=(0.085 * sum(wide) + 0.4, 0.26 * (len(cells) + 1.5)))
    axes = figure.subplots()
    axes.axis("off")
    drawn = axes.table(
        cells[1:], colLabels=cells[0], colWidths=[w / sum(wide) for w in wide], bbox=Bbox.unit()
    )
    drawn.auto_set_font_size(False)
    drawn.set_fontsize(9)
    for (row, _), cell in drawn.get_celld().items():
        cell.set_linewidth(0.3)
        cell.set_text_props(ha="left", weight="bold" if row == 0 else "normal")
    axes.set_title(table.title, fontsize=10)
    _save(figure, path)


def _two_panels(calibration: Calibration) -> tuple[Figure, Axes, Axes]:
    """A figure with a panel of errors on the fitted data and one on the held-out data."""
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    left.set(title=f"Fit: {calibration.split.fitted_name}", ylabel="mean bead error (mm)")
    right.set(title=f"Held out: {calibration.split.held_out_name}")
    right.axhline(calibration.null_mm(), color="0.4", linestyle="--", label="no motion")
    return figure, left, right


def _finish(calibration: Calibration, left: Axes, right: Axes, x_label: str) -> None:
    """Limits, legends and grids of both panels, once their curves are drawn."""
    least = min(calibration.best(radius).fit_mm for radius in calibration.trials)
    errors = [
        error for trials in calibration.trials.values() for t in trials for error in (t.fit_mm, t.held_out_mm)
    ]
    most = max(filter(np.isfinite, errors), default=1.0)
    left.set_ylim(0, min(1.05 * most, MOST_ERROR * max(least, calibration.null_mm())))
    finish_axes(left, dict(title="particle radius"), xlabel=x_label)
    finish_axes(right, {}, xlabel=x_label)


def _colours(calibration: Calibration) -> list:
    return [colormaps["viridis"](at) for at in np.linspace(0, 0.85, len(calibration.trials))]
