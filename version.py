"""The version of Nephron. ``pyproject.toml`` states it; it is read from there, for the program runs from its folder uninstalled."""

import tomllib
from pathlib import Path

PROJECT = tomllib.loads((Path(__file__).parent / "pyproject.toml").read_text("utf-8"))["project"]
VERSION: str = PROJECT["version"]
