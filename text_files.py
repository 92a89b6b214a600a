"""Text and tables that users edit, as editors and spreadsheets save them; used by all folders."""

import codecs
import csv
import re
from pathlib import Path

UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
# In tables that do not separate their cells by it.
DECIMAL_COMMA = re.compile(r"\s*([-+]?\d*),(\d+(?:[eE][-+]?\d+)?)\s*")


def read_text(path: Path) -> str:
    """The text of a file in UTF-8 or UTF-16, with or without a byte-order mark. Raises OSError, UnicodeDecodeError."""
    content = path.read_bytes()
    if content.startswith(UTF_16):
        text = content.decode("utf-16")
    elif content[:2].count(0) == 1:  # without a mark: all these files begin with a letter of ASCII
        text = content.decode("utf-16-be" if content[0] == 0 else "utf-16-le")
    else:
        text = content.decode("utf-8-sig")
    return text.replace("\r\n", "\n")


def table_rows(text: str) -> list[list[str]]:
    """The cells of a table, without empty lines and those that begin with #.

    They are separated by commas, or by semicolons or tabs, as Excel does in countries with a decimal comma, which becomes a point. Raises
    csv.Error.
    """
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith(("#", "sep="))]
    separator = next((mark for mark in ";\t" if lines and mark in lines[0]), ",")
    rows = list(csv.reader(lines, delimiter=separator, skipinitialspace=True))
    if separator == ",":
        return rows
    return [[DECIMAL_COMMA.sub(r"\1.\2", cell) for cell in row] for row in rows]
