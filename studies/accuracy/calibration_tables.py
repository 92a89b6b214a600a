"""What a calibration found, as the paper's Tables 2 to 5: text for the terminal, CSV, and JSON with all trials."""

import csv
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from rehearsal.result_files import rounded, spread, write_json
from scenes.atomic_files import atomic_write
from studies.accuracy.calibration import Calibration, CalibrationTrial, quartic

FIT, HELD_OUT = "fit", "held out"
Row = list[float | None]


@dataclass(frozen=True)
class Table:
    """Rows of names and one figure a radius; ``shares``, where given, are these as % of the probe's travel."""

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
        """Aligned columns under the title."""
        cells = self.cells()
        widths = [max(len(line[column]) for line in cells) for column in range(len(cells[0]))]
        lines = [
            "  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)) for line in cells
        ]
        return "\n".join([self.title, *(line.rstrip() for line in lines)])

    def write_csv(self, folder: Path) -> None:
        """``name``.csv: numbers alone in the columns of the radii, the shares in columns of their own."""
        columns = self.head + [f"{radius:g} mm" for radius in self.radii_mm]
        rows: list[list] = [names + figures for names, figures in zip(self.names, self.figures, strict=True)]
        if self.shares:
            columns += [f"{radius:g} mm, % of travel" for radius in self.radii_mm]
            rows = [row + shares for row, shares in zip(rows, self.shares, strict=True)]
        with (
            atomic_write(folder / f"{self.name}.csv") as partial,
            partial.open("w", newline="", encoding="utf-8") as file,
        ):
            csv.writer(file).writerows([columns, *rows])


def tables_of(calibration: Calibration) -> list[Table]:
    """The paper's Tables 2 to 5, each radius with the settings that fit best there."""
    best = [calibration.best(radius) for radius in calibration.trials]
    means = _bead_table(calibration, best, "table2", "Table 2: bead error, mean (mm)", np.mean)
    means.names.extend([["all", "mean", FIT], ["all", "mean", HELD_OUT]])
    means.figures.extend([[rounded(t.fit_mm) for t in best], [rounded(t.held_out_mm) for t in best]])
    means.shares.extend([[None for _ in best], [None for _ in best]])
    deviations = _bead_table(
        calibration, best, "table3", "Table 3: bead error, standard deviation (mm)", np.std
    )
    most = _bead_table(calibration, best, "table4", "Table 4: bead error, maximum (mm)", np.max)
    return [means, replace(deviations, shares=[]), replace(most, shares=[]), _times(calibration, best)]


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
    for place, stage, part, used in _rows(calibration):
        case = calibration.cases[place]
        depth = case.indentation_mm[stage]
        row = [float(figure(trial.measured[place].errors[stage][used])) for trial in best]
        names.append([case.name, f"{stage} ({depth:.2f} mm)", part])
        figures.append([rounded(value) for value in row])
        shares.append([rounded(100 * value / depth) if depth > 0 else None for value in row])
    return Table(name, title, ["case", "stage", "part"], list(calibration.trials), names, figures, shares)


def summary_of(calibration: Calibration) -> str:
    """For each radius what fitted best and what it is worth on what was held out."""
    split = calibration.split
    head = f"{'radius':8}{'stiffness':11}{'relaxation':12}{'iterations':12}{'fit':>9}{'held out':>13}"
    lines = [f"Fitted on {split.fitted_name}; held out: {split.held_out_name}.", head]
    for radius in calibration.trials:
        best = calibration.best(radius)
        lines.append(
            f"{f'{radius:g} mm':8}{best.setup.tissue.stiffness:<11.3f}{best.setup.relaxation_factor:<12.2f}"
            f"{best.setup.iterations:<12}{best.fit_mm:>6.2f} mm{best.held_out_mm:>10.2f} mm"
        )
    lines.append(f"Held out, beads left where stage 0 has them: {calibration.null_mm():.2f} mm.")
    return "\n".join([*lines, "The fit is no accuracy: what was not fitted on is the column held out."])


def write_calibration(calibration: Calibration, tables: list[Table], path: Path) -> None:
    """Everything in one file: the split, every trial, the fits and the tables."""
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
            coefficients=fit.polynomial.convert().coef.tolist(),
            stiffness=rounded(fit.stiffness),
            fit_mm=rounded(fit.error_mm),
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


def _rows(calibration: Calibration) -> Iterator[tuple[int, int, str, np.ndarray]]:
    """Case, stage, what its beads (n,) were used for and which of them were."""
    for place, fitted in enumerate(calibration.split.fitted):
        for stage, mask in enumerate(fitted):
            for part, used in ((FIT, mask), (HELD_OUT, ~mask)):
                if used.any():
                    yield place, stage, part, used


def _times(calibration: Calibration, best: list[CalibrationTrial]) -> Table:
    """Table 5; where several evaluations run at once, a time is that of one CPU thread among others."""
    spreads = [spread([ms for measured in trial.measured for ms in measured.step_ms]) for trial in best]
    rows = {"mean": "mean", "standard deviation": "sd", "minimum": "min", "maximum": "max"}
    title = "Table 5: time of a step in the calibration, on one CPU thread (ms)"
    figures: list[Row] = [[each[key] for each in spreads] for key in rows.values()]
    return Table("table5", title, [""], list(calibration.trials), [[name] for name in rows], figures)


def _cell(figure: float | None, share: float | None) -> str:
    text = "-" if figure is None else f"{figure:.2f}"
    return text if share is None else f"{text} ({share:.0f} %)"
