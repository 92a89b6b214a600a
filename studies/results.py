"""Figures as files: JSON and CSV."""

import csv
import json
from pathlib import Path
from typing import Any


def write_json(figures: dict[str, Any], path: Path) -> None:
    """Write figures as JSON. Raises ValueError for a number that JSON has none for, OSError."""
    path.write_text(json.dumps(figures, indent=2, allow_nan=False) + "\n", "utf-8")


def write_csv(rows: list[dict[str, Any]], path: Path) -> None:
    """Write a line a row under all names that rows have, in their order; a row without one leaves it empty. Raises OSError."""
    names = dict.fromkeys(name for row in rows for name in row)
    with path.open("w", newline="", encoding="utf-8") as file:
        lines = csv.DictWriter(file, list(names))
        lines.writeheader()
        lines.writerows(rows)
