"""Files that are numbered in the order in which they were made."""

import re
from pathlib import Path


def next_number(folder: Path, name: str) -> int:
    """One more than the highest number of a folder's files whose whole names match a pattern, in which it is the first group."""
    numbers = [int(found[1]) for path in folder.glob("*") if (found := re.fullmatch(name, path.name))]
    return 1 + max(numbers, default=0)
