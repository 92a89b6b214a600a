"""Tables of numbers in CSV files, which studies read."""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from errors import UserError
from text_files import read_text, table_rows


def read_numbers(path: Path, columns: Sequence[str], error_type: type[UserError]) -> np.ndarray:
    """Values (rows, columns) of the named columns. Raises ``error_type`` for a file, a column or a value that is not valid."""
    try:
        heads, *lines = table_rows(read_text(path)) or [[]]
        rows = [dict(zip(heads, line, strict=False)) for line in lines]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise error_type(f"{path}: cannot be read ({error}); expected a table in CSV") from None
    if not rows:
        raise error_type(f"{path}: has no rows; expected a header and one line a row")
    missing = [name for name in columns if name not in heads]
    if missing:
        raise error_type(
            f"{path}: column {missing[0]} is missing; expected {len(columns)} columns, {columns[0]} to {columns[-1]}"
        )
    values = [[_number(row.get(name)) for name in columns] for row in rows]
    numbers = np.array(values)
    for row, column in np.argwhere(~np.isfinite(numbers)):
        text = rows[row].get(columns[column])
        raise error_type(f"{path}: line {row + 2}, {columns[column]} is {text!r}: expected a finite number")
    return numbers


def _number(text: str | None) -> float:
    try:
        return float(text or "nan")
    except ValueError:
        return np.nan
