"""Directions in the patient in words."""

import numpy as np

# Against and along the axes of LPS.
TOWARDS = (
    ("to the patient's right", "to the patient's left"),
    ("to the front", "to the back"),
    ("to the feet", "to the head"),
)
NAMED_SHARE = 0.35  # of the whole length: smaller components are not named


def components(vector: np.ndarray) -> list[tuple[float, str]]:
    """Lengths and words of the main components of a vector (3,) in LPS, such as (4.0, "to the head")."""
    least = NAMED_SHARE * float(np.linalg.norm(vector))
    parts = zip(vector.tolist(), TOWARDS, strict=True)
    return [(abs(part), words[int(part > 0)]) for part, words in parts if abs(part) >= least > 0]
