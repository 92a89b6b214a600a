"""Tables of numbers in CSV files, which studies read."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from errors import FOUND, UserError
from text_files import TextError, read_text, table_rows


def read_numbers(
    path: Path, columns: Sequence[str], error_type: type[UserError]
) -> tuple[np.ndarray, list[int]]:
    """Values (rows, columns) of the named columns, and the rows' lines in the file (rows,).

    Raises ``error_type`` for a file, a column or a value that is not valid.
    """
    try:
        table = table_rows(read_text(path))
    except (FileNotFoundError, NotADirectoryError):
        raise error_type(f"{path}: no such file; expected a table in CSV") from None
    except TextError as error:
        raise error_type(f"{path}: cannot be read ({error}); expected a table in CSV") from None
    heads, *cells = table.values() or [[]]
    rows, lines = [dict(zip(heads, row, strict=False)) for row in cells], list(table)[1:]
    if not rows:
        raise error_type(f"{path}: has no rows; expected a header and one line a row")
    missing = [name for name in columns if name not in heads]
    if missing:
        raise error_type(
            f"{path}: column {missing[0]} is missing; expected {len(columns)} columns, {columns[0]} to "
            f"{columns[-1]}"
        )
    values = [[_number(row.get(name)) for name in columns] for row in rows]
    numbers = np.array(values)
    for row, column in np.argwhere(~np.isfinite(numbers)):
        text = rows[row].get(columns[column])
        what = "missing" if text is None else FOUND.repr(text)
        raise error_type(f"{path}: line {lines[row]}, {columns[column]} is {what}: expected a finite number")
    return numbers, lines


def _number(text: str | None) -> float:
    try:
        return float(text or "nan")
    except ValueError:
        return np.nan
