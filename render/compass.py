"""The compass: the patient's axes as seen by the camera. Lengths in fractions of its box."""

import numpy as np
from PIL import Image, ImageDraw

from render.text import font
from render.ultrasound_panel import FINDINGS, LINE, QUIET, TEXT
from render.window_layout import WindowLayout

# Patient coordinates are LPS: towards the patient's left, back and head; and the other way.
LETTERS = (("R", "L"), ("A", "P"), ("I", "S"))
ARM, BEYOND = 0.27, 0.11
LETTER_PX, LINE_PX = 14, 2
# A shorter projected axis has no letters.
LEAST_LENGTH = 0.3


def ends_of(axes: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """Return the letters of the patient's axes and their directions on the screen (2,), right and up, the farthest first.

    ``axes`` (3, 3) are the camera's right, up and ahead, in the patient.
    """
    ends = [
        (letters[side > 0], side * axes[:, axis])
        for axis, letters in enumerate(LETTERS)
        for side in (-1, 1)
        if np.hypot(*axes[:2, axis]) > LEAST_LENGTH
    ]
    return [(letter, end[:2]) for letter, end in sorted(ends, key=lambda end: -end[1][2])]


def compass_picture(layout: WindowLayout, axes: np.ndarray) -> np.ndarray:
    """Return the compass for a camera's axes (3, 3), uint8, shape of layout.compass."""
    size = layout.compass.width
    image = Image.new("RGB", (size, size), FINDINGS)
    draw = ImageDraw.Draw(image)
    draw.rectangle([0, 0, size - 1, size - 1], outline=LINE)
    middle = np.array([size, size]) / 2
    ends = ends_of(axes)
    for place, (letter, axis) in enumerate(ends):
        near = place >= len(ends) / 2
        colour, down = TEXT if near else QUIET, axis * [1, -1]
        tip = middle + size * ARM * down
        end = tip + size * BEYOND * down / np.linalg.norm(down)
        draw.line([*middle, *tip], fill=colour, width=layout.px(LINE_PX))
        draw.text(tuple(end), letter, font=font(layout.px(LETTER_PX)), fill=colour, anchor="mm")
    return np.asarray(image)
