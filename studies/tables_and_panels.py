"""What a study shows of its rows: a table in text, and the panels of a figure."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from tabulate import tabulate

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Columns = Mapping[str, str] | Collection[tuple[str, str]]
Row = Mapping[str, Any]


def table_of(columns: Columns, rows: Iterable[Row]) -> str:
    """Aligned columns: under each header a format of a row's values, such as "{ms:.2f}"; None is empty."""
    pairs = columns.items() if isinstance(columns, Mapping) else columns
    cells = [[_formatted(form, row) for _, form in pairs] for row in rows]
    sides = ["right" if ":" in form else "left" for _, form in pairs]
    headers = [header for header, _ in pairs]
    return tabulate(cells, headers, tablefmt="plain", disable_numparse=True, colalign=sides)


def _formatted(form: str, row: Row) -> str:
    try:
        return form.format(**row)
    except TypeError:  # None has no format of numbers
        return ""


@dataclass(frozen=True)
class Curve:
    """Values y over x, with a style such as "o-", a label and other options of ``Axes.plot``."""

    x: Sequence[Any] | np.ndarray
    y: Sequence[Any] | np.ndarray
    style: str = "o-"
    label: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)


def curves_by(rows: Iterable[Row], x: str, y: str, by: str, style: str = "o-") -> list[Curve]:
    """A curve of the values under one name over those under another, for each value of ``by``, its label."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(row[by], []).append(row)
    return [
        Curve([row[x] for row in group], [row[y] for row in group], style, label)
        for label, group in groups.items()
    ]


def panels_of(
    size: tuple[float, float], rows: int = 1, columns: int = 1, **options: Any
) -> "tuple[Figure, np.ndarray]":
    """A figure of a size [inches], and its panels (rows, columns)."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def draw_panel(
    axes: "Axes",
    curves: Iterable[Curve] = (),
    legend: Mapping[str, Any] | None = None,
    grid: Literal["both", "x"] = "both",
    **settings: Any,
) -> None:
    """Draw curves; titles, labels and scales as ``Axes.set`` takes them; a grid, a legend with options."""
    for curve in curves:
        axes.plot(curve.x, curve.y, curve.style, label=curve.label, **curve.options)
    axes.set(**settings)
    axes.grid(alpha=0.3, which="both", axis=grid)
    if legend is not None:
        axes.legend(**legend)
