"""What a command of a study says when it refuses, and what it has written."""

import csv
import json
from pathlib import Path

import pytest

import app


def refusal(capsys: pytest.CaptureFixture, *arguments: object) -> str:
    """The one line that the command line prints when it refuses arguments."""
    assert app.main([str(argument) for argument in arguments]) == 2
    line = capsys.readouterr().err.strip()
    assert line.startswith("nephron: ") and "\n" not in line
    return line


def written(out: Path, name: str) -> tuple[dict, list[dict[str, str]]]:
    """The report of a study in JSON, and its rows in CSV; its figure is a picture of some size."""
    picture = (out / f"{name}.png").read_bytes()
    assert picture.startswith(b"\x89PNG") and len(picture) > 10_000
    with (out / f"{name}.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return json.loads((out / f"{name}.json").read_text()), rows
