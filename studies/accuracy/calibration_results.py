"""Results of a calibration: the paper's Tables 2 to 5 and Figures 4 and 5, the course of a search, and
JSON with all trials.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import accumulate
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from rehearsal.result_files import rounded, save_figure, spread, write_csv, write_json
from studies.accuracy.calibration import MOST_ERROR, Calibration, CalibrationTrial, quartic
from studies.study_results import DPI, finish_axes, text_table

FIT, HELD_OUT = "fit", "held out"
SUMMARY_HEADERS = ("radius, mm", "stiffness", "relaxation", "iterations", "fit, mm", "held out, mm")
_save = partial(save_figure, dpi=DPI, bbox_inches="tight")
Row = list[float | None]


@dataclass(frozen=True)
class Table:
    """Rows of names and one figure a radius; ``shares``, where given, are the figures as % of the probe's
    travel.
    """

    name: str
    title: str
    head: list[str]
    radii_mm: list[float]
    names: list[list[str]]
    figures: list[Row]
    shares: list[Row] = field(default_factory=list)

    def cells(self) -> list[list[str]]:
        """All lines as text, the head first."""
        lines = [self.head + [f"{radius:g} mm" for radius in self.radii_mm]]
        for row, (names, figures) in enumerate(zip(self.names, self.figures, strict=True)):
            shares = self.shares[row] if self.shares else [None] * len(figures)
            lines.append(names + [_cell(*pair) for pair in zip(figures, shares, strict=True)])
        return lines

    def text(self) -> str:
        """Title and aligned columns."""
        head, *rows = self.cells()
        return f"{self.title}\n{text_table(head, rows)}"

    def write_csv(self, folder: Path) -> None:
        """``name``.csv: a column of numbers a radius, and of its shares."""
        columns = self.head + [f"{radius:g} mm" for radius in self.radii_mm]
        rows: list[list] = [names + figures for names, figures in zip(self.names, self.figures, strict=True)]
        if self.shares:
            columns += [f"{radius:g} mm, % of travel" for radius in self.radii_mm]
            rows = [row + shares for row, shares in zip(rows, self.shares, strict=True)]
        write_csv([dict(zip(columns, row, strict=True)) for row in rows], folder / f"{self.name}.csv")

    def write_png(self, folder: Path) -> None:
        """``name``.png: the table as an image."""
        cells = self.cells()
        wide = [max(len(line[column]) for line in cells) + 3 for column in range(len(cells[0]))]
        figure = Figure(figsize=(0.085 * sum(wide) + 0.4, 0.26 * (len(cells) + 1.5)))
        axes = figure.subplots()
        axes.axis("off")
        widths = [w / sum(wide) for w in wide]
        drawn = axes.table(cells[1:], colLabels=cells[0], colWidths=widths, bbox=Bbox.unit())
        drawn.auto_set_font_size(False)
        drawn.set_fontsize(9)
        for (row, _), cell in drawn.get_celld().items():
            cell.set_linewidth(0.3)
            cell.set_text_props(ha="left", weight="bold" if row == 0 else "normal")
        axes.set_title(self.title, fontsize=10)
        _save(figure, folder / f"{self.name}.png")


def tables_of(calibration: Calibration) -> list[Table]:
    """The paper's Tables 2 to 5, each radius with the settings that fit best there."""
    best = [calibration.best(radius) for radius in calibration.trials]
    means = _bead_table(calibration, best, "table2", "Table 2: bead error, mean (mm)", np.mean)
    means.names.extend([["all", "mean", FIT], ["all", "mean", HELD_OUT]])
    means.figures.extend([[rounded(t.fit_mm) for t in best], [rounded(t.held_out_mm) for t in best]])
    means.shares.extend([[None] * len(best)] * 2)
    others = [
        _bead_table(calibration, best, "table3", "Table 3: bead error, standard deviation (mm)", np.std),
        _bead_table(calibration, best, "table4", "Table 4: bead error, maximum (mm)", np.max),
    ]
    return [means, *(replace(each, shares=[]) for each in others), _times(calibration, best)]


def _bead_table(
    calibration: Calibration,
    best: list[CalibrationTrial],
    name: str,
    title: str,
    figure: Callable[[np.ndarray], float],
) -> Table:
    """One figure of the errors of each stage's beads; the stiffness is the first row."""
    names = [["", "", "stiffness"]]
    figures: list[Row] = [[trial.setup.tissue.stiffness for trial in best]]
    shares: list[Row] = [[None for _ in best]]
    for place, (case, fitted) in enumerate(zip(calibration.cases, calibration.split.fitted, strict=True)):
        for stage, depth in enumerate(case.indentation_mm):
            for part, used in ((FIT, fitted[stage]), (HELD_OUT, ~fitted[stage])):
                if not used.any():
                    continue
                row = [float(figure(trial.measured[place].errors[stage][used])) for trial in best]
                names.append([case.name, f"{stage} ({depth:.2f} mm)", part])
                figures.append([rounded(value) for value in row])
                shares.append([rounded(100 * value / depth) if depth > 0 else None for value in row])
    return Table(name, title, ["case", "stage", "part"], list(calibration.trials), names, figures, shares)


def summary_of(calibration: Calibration) -> str:
    """The best settings of each radius, and their errors on the fitted and the held-out data."""
    rows = []
    for radius in calibration.trials:
        best = calibration.best(radius)
        setup = best.setup
        settings = (setup.tissue.stiffness, setup.relaxation_factor, setup.iterations)
        rows.append([radius, *settings, best.fit_mm, best.held_out_mm])
    split = calibration.split
    lines = [
        f"Fitted on {split.fitted_name}; held out: {split.held_out_name}.",
        text_table(SUMMARY_HEADERS, rows, ("g", ".3f", ".2f", "g", ".2f", ".2f")),
        f"Held out, no motion after stage 0: {calibration.null_mm():.2f} mm.",
        "The column fit is no measure of accuracy; the column held out is, on data that was not fitted.",
    ]
    return "\n".join(lines)


def write_calibration(calibration: Calibration, tables: list[Table], path: Path) -> None:
    """Write the split, all trials, the fits and the tables. Raises OSError."""
    split = calibration.split
    found = dict(
        cases=[case.name for case in calibration.cases],
        fitted_on=split.fitted_name,
        held_out=split.held_out_name,
        null_held_out_mm=rounded(calibration.null_mm()),
        radii=[_radius(calibration, radius) for radius in calibration.trials],
        tables=[asdict(table) for table in tables],
    )
    write_json(found, path)


def _radius(calibration: Calibration, radius: float) -> dict:
    trials, best = calibration.trials[radius], calibration.best(radius)
    fit = quartic(trials)
    return dict(
        radius_mm=radius,
        particles=[measured.particles for measured in best.measured],
        clusters=[measured.clusters for measured in best.measured],
        best=_trial(best),
        quartic=fit
        and dict(
            coefficients=fit[0].convert().coef.tolist(),
            stiffness=rounded(fit[1]),
            fit_mm=rounded(fit[0](fit[1])),
        ),
        trials=[_trial(trial) for trial in trials],
    )


def _trial(trial: CalibrationTrial) -> dict:
    setup = trial.setup
    return dict(
        stiffness=setup.tissue.stiffness,
        relaxation_factor=setup.relaxation_factor,
        iterations=setup.iterations,
        fit_mm=rounded(trial.fit_mm),
        held_out_mm=rounded(trial.held_out_mm),
    )


def _times(calibration: Calibration, best: list[CalibrationTrial]) -> Table:
    """Table 5; several evaluations may run at once, each on one CPU thread."""
    spreads = [spread([ms for measured in trial.measured for ms in measured.step_ms]) for trial in best]
    rows = {"mean": "mean", "standard deviation": "sd", "minimum": "min", "maximum": "max"}
    title = "Table 5: time of a step in the calibration, on one CPU thread (ms)"
    figures: list[Row] = [[each[key] for each in spreads] for key in rows.values()]
    return Table("table5", title, [""], list(calibration.trials), [[name] for name in rows], figures)


def _cell(figure: float | None, share: float | None) -> str:
    text = "-" if figure is None else f"{figure:.2f}"
    return text if share is None else f"{text} ({share:.0f} %)"


def write_figure4(calibration: Calibration, path: Path) -> None:
    """Mean error over the stiffness for each radius, fitted and held out; quartics with a ring at the
    minimum.
    """
    figure, left, right = _two_panels(calibration)
    for colour, radius in zip(_colours(calibration), calibration.trials, strict=True):
        trials = sorted(calibration.trials[radius], key=lambda trial: trial.setup.tissue.stiffness)
        at = [trial.setup.tissue.stiffness for trial in trials]
        left.plot(at, [trial.fit_mm for trial in trials], ".", color=colour, label=f"{radius:g} mm")
        right.plot(at, [trial.held_out_mm for trial in trials], ".-", color=colour, linewidth=0.8)
        fit = quartic(trials)
        if fit is not None:
            curve, best = fit
            left.plot(*curve.linspace(200), "-", color=colour, linewidth=1)
            left.plot(best, curve(best), "o", color=colour, markersize=9, fillstyle="none")
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
    return list(accumulate(trials, lambda *pair: min(pair, key=lambda trial: trial.fit_mm)))


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
