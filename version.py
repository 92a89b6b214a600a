"""The version of Nephron, and of the files that it writes.

``pyproject.toml`` states it; it is read from there, for the program runs from its folder uninstalled.
"""

import tomllib
from pathlib import Path
from typing import Any

PROJECT = tomllib.loads((Path(__file__).parent / "pyproject.toml").read_text("utf-8"))["project"]
VERSION: str = PROJECT["version"]
# The format of scenes, sessions and plans: a new major version does not read those of the one before.
FORMAT = int(VERSION.partition(".")[0])


def of_this_format(values: Any, key: str) -> Any:
    """The values of a file, as they are.

    Raises ValueError where ``key`` states the format of another version.
    """
    found = values.get(key, FORMAT) if isinstance(values, dict) else FORMAT
    if isinstance(found, bool) or not isinstance(found, int) or not 0 < found < 1000:
        raise ValueError(f"{key} = {str(found)[:20]!r}: expected {FORMAT}")
    if found != FORMAT:
        raise ValueError(
            f"{key} = {found}: written by Nephron {found}, and this is Nephron {VERSION}; use Nephron "
            f"{found}, or make the file anew"
        )
    return values
