"""Files of results: JSON, CSV and figures, numbered files, and the formats of numbers in them."""

import csv
import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scenes.atomic_files import atomic_write

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def rounded(value: float | None) -> float | None:
    """Round to 6 digits; None for NaN and infinity, which JSON does not have."""
    return None if value is None or not np.isfinite(value) else round(float(value), 6)


def spread(values: list[float]) -> dict[str, float]:
    """Mean, standard deviation, minimum, maximum and median."""
    v = np.array(values)
    figures = dict(mean=v.mean(), sd=v.std(), min=v.min(), max=v.max(), median=np.median(v))
    return {name: round(float(value), 4) for name, value in figures.items()}


def counted(number: int, name: str) -> str:
    """A number of things: "1 substep", "3 substeps", "2 presses"."""
    ending = "" if number == 1 else "es" if name.endswith("s") else "s"
    return f"{number} {name}{ending}"


def next_number(folder: Path, pattern: str) -> int:
    """One more than the highest number in a folder's file names that match a pattern in full; the number
    is its first group.
    """
    numbers = [int(matched[1]) for path in folder.glob("*") if (matched := re.fullmatch(pattern, path.name))]
    return 1 + max(numbers, default=0)


def write_json(figures: dict[str, Any], path: Path) -> None:
    """Write figures as JSON. Raises ValueError for NaN and infinity, OSError."""
    text = json.dumps(figures, indent=2, allow_nan=False) + "\n"
    with atomic_write(path) as partial:
        partial.write_text(text, "utf-8")


def write_csv(rows: list[dict[str, Any]], path: Path) -> None:
    """Write rows under the names that any of them has; missing values stay empty. Raises OSError."""
    names = dict.fromkeys(name for row in rows for name in row)
    with atomic_write(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        lines = csv.DictWriter(file, list(names))
        lines.writeheader()
        lines.writerows(rows)


def save_figure(figure: "Figure", path: Path, **options: Any) -> None:
    """Write a figure with Matplotlib's options. Raises OSError."""
    with atomic_write(path) as partial:
        figure.savefig(partial, **options)
