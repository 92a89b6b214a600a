"""Text, JSON, TOML and tables that users edit, as editors and spreadsheets save them; used by all folders."""

import codecs
import csv
import json
import re
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from errors import UserError

UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
# Suffixes of tables; Excel saves text separated by tabs as .txt.
TABLES = (".csv", ".tsv", ".txt")
# Lines of tables that are no rows, also as Excel quotes them.
NO_ROW = re.compile(r'\s*"?(#|sep=)', re.IGNORECASE)
# In tables that do not separate their cells by it.
DECIMAL_COMMA = re.compile(r"\s*([-+]?\d*),(\d+(?:[eE][-+]?\d+)?)\s*")
# Among decimal commas: points of thousands, or decimal points with three digits.
THOUSANDS = re.compile(r"\s*[-+]?[1-9]\d{0,2}(\.\d{3})+\s*")


class TextError(UserError):
    """A text that cannot be read as what it should be; the message is the cause in words, without the
    file.
    """


def read_text(path: Path) -> str:
    """The text of a file in UTF-8 or UTF-16, with or without a byte-order mark.

    Raises FileNotFoundError, NotADirectoryError; TextError for any other reason.
    """
    try:
        content = path.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        raise
    except OSError as error:
        raise TextError((error.strerror or "the disk does not read it").lower()) from None
    with _in_words("text"):
        if content.startswith(UTF_16):
            text = content.decode("utf-16")
        elif content[:2].count(0) == 1:  # without a mark: all these files begin with a letter of ASCII
            text = content.decode("utf-16-be" if content[0] == 0 else "utf-16-le")
        else:
            text = content.decode("utf-8-sig")
    return text.replace("\r\n", "\n")


def read_json(path: Path) -> Any:
    """The value of a JSON file. Raises as ``read_text``."""
    return json_value(read_text(path))


def read_toml(path: Path) -> dict[str, Any]:
    """The values of a TOML file. Raises as ``read_text``."""
    text = read_text(path)
    with _in_words("TOML"):
        return tomllib.loads(text)


def json_value(text: str | bytes) -> Any:
    """The value of a JSON text. Raises TextError."""
    with _in_words("JSON"):
        return json.loads(text)


def table_rows(text: str) -> dict[int, list[str]]:
    """Line number -> cells of a table, without empty lines, those that begin with #, and columns that are
    empty at the end.

    They are separated by commas, or by semicolons or tabs, as Excel does in countries with a decimal comma,
    which becomes a point. Raises TextError.
    """
    lines = {
        number: line
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip() and not NO_ROW.match(line)
    }
    first, numbers = next(iter(lines.values()), ""), list(lines)
    separator = next((mark for mark in ";\t" if mark in first), ",")
    reader = csv.reader(lines.values(), delimiter=separator, skipinitialspace=True)
    rows: dict[int, list[str]] = {}
    with _in_words("CSV"):
        for row in reader:
            rows[numbers[reader.line_num - 1]] = row
    width = max((len(_without_empty_end(row)) for row in rows.values()), default=0)
    rows = {number: row[:width] for number, row in rows.items() if _without_empty_end(row)}
    return rows if separator == "," else _with_points(rows)


def _without_empty_end(row: list[str]) -> list[str]:
    filled = [place for place, cell in enumerate(row, 1) if cell.strip()]
    return row[: max(filled, default=0)]


def _with_points(rows: dict[int, list[str]]) -> dict[int, list[str]]:
    """The rows with decimal points instead of commas.

    Raises TextError for a number that may be a thousand times another.
    """
    if not any(DECIMAL_COMMA.fullmatch(cell) for row in rows.values() for cell in row):
        return rows
    for number, row in rows.items():
        for cell in filter(THOUSANDS.fullmatch, row):
            raise TextError(
                f"line {number}: {cell.strip()} may be thousands or a decimal point, and other numbers have "
                "decimal commas: "
                "write it without the point"
            )
    return {
        number: [DECIMAL_COMMA.sub(r"\1.\2", cell) if DECIMAL_COMMA.fullmatch(cell) else cell for cell in row]
        for number, row in rows.items()
    }


@contextmanager
def _in_words(form: str) -> Iterator[None]:
    """Raise what a parser of text raises as TextError."""
    try:
        yield
    except UnicodeDecodeError:
        words = "not text in UTF-8"
    except RecursionError:
        words = f"not valid {form}: nested too deeply"
    except json.JSONDecodeError as error:
        words = f"not valid {form} at line {error.lineno}, column {error.colno}"
    except (tomllib.TOMLDecodeError, csv.Error) as error:
        words = f"not valid {form}: {str(error).splitlines()[0]}"
    except ValueError:
        words = f"not valid {form}: a number with thousands of digits"
    else:
        return
    raise TextError(words) from None
