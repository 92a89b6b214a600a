"""Coordinate systems of files in the patient, named by where their axes point: LPS, DICOM's, or RAS,
NIfTI's.
"""

from typing import Literal, get_args

import numpy as np

# Where +x, +y and +z point: to the patient's left or right, posterior or anterior, superior (to the head) or
# inferior.
Space = Literal["LPS", "LPI", "LAS", "LAI", "RPS", "RPI", "RAS", "RAI"]
SPACES: tuple[Space, ...] = get_args(Space)
WORDS = {"L": "left", "R": "right", "P": "back", "A": "front", "S": "head", "I": "feet"}


def signs_to_lps(space: Space) -> np.ndarray:
    """Factors (3,) of the coordinates of a space that give those in LPS."""
    return np.array([1.0 if letter in "LPS" else -1.0 for letter in space])


def in_words(space: Space) -> str:
    """Where the axes of a space point."""
    return ", ".join(
        f"+{axis} to the patient's {WORDS[letter]}" for axis, letter in zip("xyz", space, strict=True)
    )
