"""Colours that must be told apart, also by those who do not see all of them."""

from collections.abc import Iterable
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from skimage.color import rgb2lab

from rehearsal.resection.resection_page import CAPSULE, COLOURS
from render.cut_face import FLESH
from render.scene_view import DONE, NEAR, PARTS, SCORED, SUPPORT, TO_GO, TUMOUR
from render.surface_shading import ORGAN, TINT
from render.ultrasound_panel import (
    ALERT,
    CALIPER,
    MARK,
    OUTLINE,
    OUTLINE_AT_REST,
    QUIET,
    RESECTION_LINE,
    TEXT,
)
from scenes.ct_slices import COLOUR
from scenes.patients.check_picture import LEAST_DIFFERENCE
from ultrasound.doppler import AWAY, TOWARDS

# Machado, Oliveira & Fernandes 2009, severity 1, on linear RGB.
VISIONS = {
    "usual": np.eye(3),
    "no red": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "no green": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "no blue": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}
LINES = (TO_GO, DONE, SCORED, NEAR)
TOLD_APART = {
    "surfaces": list(combinations([ORGAN, TUMOUR, SUPPORT, *PARTS.values()], 2)),
    "cut open": [(FLESH, part) for part in (TUMOUR, *PARTS.values())],
    "coverage": [(TINT, ORGAN), (TINT, TUMOUR)],
    "lines on the organ": [
        *combinations(LINES, 2),
        *((line, under) for line in LINES for under in (ORGAN, TUMOUR)),
    ],
    "lines over an image": list(combinations([OUTLINE, OUTLINE_AT_REST, RESECTION_LINE, CALIPER], 2)),
    "texts": list(combinations([TEXT, QUIET, ALERT, MARK], 2)),
    "Doppler": [(towards, away) for towards, away in zip(TOWARDS, AWAY, strict=True)],
    "check.png": list(combinations(COLOUR.values(), 2)),
    "resection.png": list(combinations([*COLOURS, CAPSULE], 2)),
}


def as_seen(colour: Any, vision: Any) -> np.ndarray:
    """A colour in CIELAB, as someone sees it."""
    rgb = np.array(to_rgb(colour) if isinstance(colour, str) else colour, float)
    rgb = rgb / 255 if rgb.max() > 1 else rgb
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(np.array(vision) @ linear, 0, 1)
    return rgb2lab(np.where(seen <= 0.0031308, 12.92 * seen, 1.055 * seen ** (1 / 2.4) - 0.055))


@pytest.mark.parametrize("pairs", TOLD_APART.values(), ids=TOLD_APART.keys())
def test_colours_differ_for_everyone(pairs: Iterable[tuple[Any, Any]]):
    for pair in pairs:
        for name, vision in VISIONS.items():
            one, other = (as_seen(colour, vision) for colour in pair)
            assert np.linalg.norm(one - other) >= LEAST_DIFFERENCE, f"{pair} look alike: {name}"
