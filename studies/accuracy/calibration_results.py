"""Results of a calibration: the paper's Tables 2 to 5 and Figures 4 and 5, the course of a search, and
JSON with all trials.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import accumulate
from pathlib import Path

import click
import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox
from tabulate import tabulate

from rehearsal.result_files import rounded, save_figure, spread, write_csv, write_json
from studies.accuracy.calibration import MOST_ERROR, Calibration, CalibrationTrial, quartic
from studies.study import DPI
from studies.tables_and_panels import Curve, draw_panel, panels_of, table_of

FIT, HELD_OUT = "fit", "held out"
SUMMARY = {
    "radius, mm": "{radius_mm:g}",
    "stiffness": "{stiffness:.3f}",
    "relaxation": "{relaxation_factor:.2f}",
    "iterations": "{iterations:g}",
    "fit, mm": "{fit_mm:.2f}",
    "held out, mm": "{held_out_mm:.2f}",
}
_save = partial(save_figure, dpi=DPI, bbox_inches="tight")
Row = list[float | None]


@dataclass(frozen=True)
class Table:
    """Rows of names and one figure a radius; ``shares``, if any, are those in % of the probe's travel."""

    name: str
    title: str
    head: list[str]
    radii_mm: list[float]
    names: list[list[str]]
    figures: list[Row]
    shares: list[Row] = field(default_factory=list)

    def columns(self) -> list[str]:
        """The head, and each radius."""
        return self.head + [f"{radius:g} mm" for radius in self.radii_mm]

    def cells(self) -> list[list[str]]:
        """All rows as text."""
        shares = self.shares or [[None] * len(self.radii_mm)] * len(self.names)
        lines = zip(self.names, self.figures, shares, strict=True)
        return [names + [_cell(*pair) for pair in zip(*values, strict=True)] for names, *values in lines]

    def text(self) -> str:
        """Title and aligned columns."""
        return f"{self.title}\n{tabulate(self.cells(), self.columns(), tablefmt='plain')}"

    def write_csv(self, folder: Path) -> None:
        """``name``.csv: a column of numbers a radius, and of its shares."""
        shares = self.shares or [[]] * len(self.names)
        columns = self.columns() + [f"{radius:g} mm, % of travel" for radius in self.radii_mm if self.shares]
        parts = zip(self.names, self.figures, shares, strict=True)
        lines = [[*names, *figures, *share] for names, figures, share in parts]
        write_csv([dict(zip(columns, line, strict=True)) for line in lines], folder / f"{self.name}.csv")

    def write_png(self, folder: Path) -> None:
        """``name``.png: the table as an image."""
        columns, cells = self.columns(), self.cells()
        wide = [max(map(len, column)) + 3 for column in zip(columns, *cells, strict=True)]
        figure = Figure(figsize=(0.085 * sum(wide) + 0.4, 0.26 * (len(cells) + 2.5)))
        axes = figure.subplots()
        axes.axis("off")
        widths = [width / sum(wide) for width in wide]
        drawn = axes.table(cells, colLabels=columns, colWidths=widths, bbox=Bbox.unit())
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
    return [means, *(replace(table, shares=[]) for table in others), _times(calibration, best)]


def write(calibration: Calibration, out: Path, searched: bool) -> None:
    """Write tables, figures and calibration.json into a folder, and print the tables. Raises OSError."""
    tables = tables_of(calibration)
    for table in tables:
        table.write_csv(out)
        table.write_png(out)
        click.echo(f"\n{table.text()}")
    write_calibration(calibration, tables, out / "calibration.json")
    write_figure5(calibration, out / "figure5.png")
    if searched:
        write_search(calibration, out / "search.png")
    else:
        write_figure4(calibration, out / "figure4.png")
    click.echo(f"\n{summary_of(calibration)}\nWrote tables, figures and calibration.json to {out}")


def _bead_table(
    calibration: Calibration,
    best: list[CalibrationTrial],
    name: str,
    title: str,
    figure: Callable[[np.ndarray], float],
) -> Table:
    """One figure of the errors of each stage's beads; the stiffness is the first row."""
    head, stiffness = ["case", "stage", "part"], [trial.setup.tissue.stiffness for trial in best]
    table = Table(name, title, head, list(calibration.trials), [["", "", "stiffness"]], [stiffness])
    table.shares.append([None for _ in best])
    for place, (case, fitted) in enumerate(zip(calibration.cases, calibration.split.fitted, strict=True)):
        for stage, depth in enumerate(case.indentation_mm):
            for part, used in ((FIT, fitted[stage]), (HELD_OUT, ~fitted[stage])):
                if not used.any():
                    continue
                row = [float(figure(trial.measured[place].errors[stage][used])) for trial in best]
                table.names.append([case.name, f"{stage} ({depth:.2f} mm)", part])
                table.figures.append([rounded(value) for value in row])
                table.shares.append([rounded(100 * v / depth) if depth > 0 else None for v in row])
    return table


def summary_of(calibration: Calibration) -> str:
    """The best settings of each radius, and their errors on the fitted and the held-out data."""
    split = calibration.split
    rows = [dict(radius_mm=radius) | _trial(calibration.best(radius)) for radius in calibration.trials]
    lines = [
        f"Fitted on {split.fitted_name}; held out: {split.held_out_name}.",
        table_of(SUMMARY, rows),
        f"Held out, no motion after stage 0: {calibration.null_mm():.2f} mm.",
        "The column fit is no measure of accuracy; the column held out is, on data that was not fitted.",
    ]
    return "\n".join(lines)


def write_calibration(calibration: Calibration, tables: list[Table], path: Path) -> None:
    """Write the split, all trials, the fits and the tables. Raises OSError."""
    split = calibration.split
    report = dict(
        cases=[case.name for case in calibration.cases],
        fitted_on=split.fitted_name,
        held_out=split.held_out_name,
        null_held_out_mm=rounded(calibration.null_mm()),
        radii=[_radius(calibration, radius) for radius in calibration.trials],
        tables=[asdict(table) for table in tables],
    )
    write_json(report, path)


def _radius(calibration: Calibration, radius: float) -> dict:
    trials, best = calibration.trials[radius], calibration.best(radius)
    fit = quartic(trials)
    coefficients = fit and fit[0].convert().coef.tolist()
    return dict(
        radius_mm=radius,
        particles=[measured.particles for measured in best.measured],
        clusters=[measured.clusters for measured in best.measured],
        best=_trial(best),
        quartic=fit
        and dict(coefficients=coefficients, stiffness=rounded(fit[1]), fit_mm=rounded(fit[0](fit[1]))),
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
    figures: list[Row] = [[ms[key] for ms in spreads] for key in rows.values()]
    return Table("table5", title, [""], list(calibration.trials), [[name] for name in rows], figures)


def _cell(figure: float | None, share: float | None) -> str:
    text = "-" if figure is None else f"{figure:.2f}"
    return text if share is None else f"{text} ({share:.0f} %)"


def write_figure4(calibration: Calibration, path: Path) -> None:
    """Mean error over the stiffness for each radius, fitted and held out; quartics, a ring at the least."""
    fitted, held_out = [], []
    for colour, radius in zip(_colours(calibration), calibration.trials, strict=True):
        trials = sorted(calibration.trials[radius], key=lambda trial: trial.setup.tissue.stiffness)
        at = [trial.setup.tissue.stiffness for trial in trials]
        name, thin = f"{radius:g} mm", dict(color=colour, linewidth=0.8)
        fitted.append(Curve(at, [trial.fit_mm for trial in trials], ".", name, dict(color=colour)))
        held_out.append(Curve(at, [trial.held_out_mm for trial in trials], ".-", None, thin))
        fit = quartic(trials)
        if fit is not None:
            curve, best = fit
            ring = dict(color=colour, markersize=9, fillstyle="none")
            fitted.append(Curve(*curve.linspace(200), "-", None, dict(color=colour, linewidth=1)))
            fitted.append(Curve([best], [curve(best)], "o", None, ring))
    _write_panels(calibration, fitted, held_out, "stiffness α", path)


def write_search(calibration: Calibration, path: Path) -> None:
    """Error of the best setup so far over the evaluations, fitted and held out."""
    fitted, held_out = [], []
    for colour, (radius, trials) in zip(_colours(calibration), calibration.trials.items(), strict=True):
        best, at = best_so_far(trials), range(len(trials))
        faint = dict(color=colour, alpha=0.35, markersize=4)
        steps = dict(color=colour, drawstyle="steps-post")
        fitted.append(Curve(at, [trial.fit_mm for trial in trials], ".", None, faint))
        fitted.append(Curve(at, [trial.fit_mm for trial in best], "-", f"{radius:g} mm", steps))
        held_out.append(Curve(at, [trial.held_out_mm for trial in best], "-", None, steps))
    _write_panels(calibration, fitted, held_out, "setups tried", path)


def best_so_far(trials: list[CalibrationTrial]) -> list[CalibrationTrial]:
    """The best trial so far, after each trial."""
    return list(accumulate(trials, lambda *pair: min(pair, key=lambda trial: trial.fit_mm)))


def write_figure5(calibration: Calibration, path: Path) -> None:
    """Particles and clusters over the radius, for each case."""
    figure, panels = panels_of((9, 4), 1, 2)
    first = {radius: trials[0].measured for radius, trials in calibration.trials.items()}
    for axes, what in zip(panels[0], ("particles", "clusters"), strict=True):
        counts = [[getattr(measured, what) for measured in of_cases] for of_cases in first.values()]
        curves = [
            Curve(list(first), count, "o-", case.name)
            for case, count in zip(calibration.cases, zip(*counts, strict=True), strict=True)
        ]
        draw_panel(axes, curves, {}, xlabel="particle radius (mm)", ylabel=what, ylim=(0, None))
    _save(figure, path)


def _write_panels(
    calibration: Calibration, fitted: list[Curve], held_out: list[Curve], x_label: str, path: Path
) -> None:
    """A panel of errors on the fitted data beside one on the held-out data."""
    split, null_mm = calibration.split, calibration.null_mm()
    figure, ((left, right),) = panels_of((11, 4.6), 1, 2, sharey=True)
    right.axhline(null_mm, color="0.4", linestyle="--", label="no motion")
    left.set(title=f"Fit: {split.fitted_name}", ylabel="mean bead error (mm)")
    draw_panel(left, fitted, dict(title="particle radius"), xlabel=x_label)
    draw_panel(right, held_out, {}, xlabel=x_label, title=f"Held out: {split.held_out_name}")
    trials = [trial for trials in calibration.trials.values() for trial in trials]
    errors = [error for trial in trials for error in (trial.fit_mm, trial.held_out_mm)]
    most = max(filter(np.isfinite, errors), default=1.0)
    least = min(trial.fit_mm for trial in trials)
    left.set_ylim(0, min(1.05 * most, MOST_ERROR * max(least, null_mm)))
    _save(figure, path)


def _colours(calibration: Calibration) -> list:
    return [colormaps["viridis"](at) for at in np.linspace(0, 0.85, len(calibration.trials))]
