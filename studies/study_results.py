"""The table, the files and the figure that a study leaves."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click
from tabulate import tabulate

from rehearsal.result_files import save_figure, write_csv, write_json

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 130


def text_table(headers: Sequence[str], rows: Sequence[Sequence[Any]], formats: Sequence[str] = ()) -> str:
    """Aligned columns; ``formats`` are those of the columns' numbers, None is an empty cell."""
    return tabulate(rows, headers, tablefmt="plain", floatfmt=formats or "g", missingval="")


def table_of(columns: Collection[tuple[str, str]], rows: Iterable[Mapping[str, Any]]) -> str:
    """Aligned columns: under each header (first of a pair) a format of a row's values, such as "{ms:.2f}";
    empty where that value is None.
    """
    cells = [[_formatted(form, row) for _, form in columns] for row in rows]
    sides = ["right" if ":" in form else "left" for _, form in columns]
    return tabulate(
        cells, [header for header, _ in columns], tablefmt="plain", disable_numparse=True, colalign=sides
    )


def _formatted(form: str, row: Mapping[str, Any]) -> str:
    try:
        return form.format(**row)
    except TypeError:  # None has no format of numbers
        return ""


def finish_axes(
    axes: "Axes", legend: dict[str, Any] | None = None, grid: Literal["both", "x"] = "both", **settings: Any
) -> None:
    """Titles, labels and scales of a panel, as ``Axes.set`` takes them; its grid, and a legend with these
    options.
    """
    axes.set(**settings)
    axes.grid(alpha=0.3, which="both", axis=grid)
    if legend is not None:
        axes.legend(**legend)


def write_results(
    out: Path,
    name: str,
    report: dict[str, Any],
    text: str,
    rows: list[dict[str, Any]] | None = None,
    figure: "Figure | None" = None,
) -> None:
    """Write name.json and, where there are any, name.csv and name.png into a folder; print the text and
    their names.
    """
    files = [f"{name}.json"]
    write_json(report, out / files[0])
    if rows is not None:
        files.append(f"{name}.csv")
        write_csv(rows, out / files[-1])
    if figure is not None:
        files.append(f"{name}.png")
        save_figure(figure, out / files[-1], dpi=DPI)
    click.echo(f"\n{text}\n\nWrote {', '.join(files)} to {out}")
