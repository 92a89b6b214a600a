"""Score lines and cuts of the study: around a tumour and a margin, and badly placed."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import get_args

import numpy as np
import trimesh

from rehearsal.resection.cut import Cut, CutSettings, cut_organ
from rehearsal.resection.proposal import line_around
from rehearsal.resection.score_line import ScoreLine, places_on, score_line
from render.viewer import Technique

TECHNIQUES: tuple[Technique, ...] = get_args(Technique)
MARGINS_MM = (0.0, 3.0, 5.0)
# Badly placed lines: beside the tumour by this, drawn in to this share of the width, and a cut to this depth.
BESIDE_MM, DRAWN_IN, SHALLOW_MM = 10.0, 0.6, 12.0


@dataclass(frozen=True)
class StudyCut:
    """A cut of the study, and how its line is placed."""

    placed: str
    settings: CutSettings
    cut: Cut


def planned_cuts(organ: trimesh.Trimesh, tumour: trimesh.Trimesh) -> Iterator[StudyCut]:
    """All techniques and margins along lines around tumour and margin, then badly placed cuts that leave
    tumour. Raises ResectionError.
    """
    lines = {margin: line_over(organ, tumour, margin) for margin in MARGINS_MM}
    points = np.asarray(tumour.vertices)
    for technique in TECHNIQUES:
        for margin, line in lines.items():
            settings = CutSettings(technique, margin)
            yield StudyCut("around", settings, cut_organ(organ, line, settings, points))
    for placed, line, settings in _badly_placed(organ, lines[3.0]):
        yield StudyCut(placed, settings, cut_organ(organ, line, settings, points))


def line_over(organ: trimesh.Trimesh, tumour: trimesh.Trimesh, margin_mm: float) -> ScoreLine:
    """The line around a tumour and a margin where the tumour is nearest to the organ's surface.

    Raises ResectionError.
    """
    middle = np.asarray(tumour.center_mass)
    direction = places_on(organ, middle)[0][0] - middle
    return line_around(organ, tumour, margin_mm, direction / np.linalg.norm(direction))


def _badly_placed(organ: trimesh.Trimesh, line: ScoreLine) -> Iterator[tuple[str, ScoreLine, CutSettings]]:
    middle = line.marks.mean(axis=0)
    beside = score_line(organ, line.marks + BESIDE_MM * line.frame()[1])
    narrow = score_line(organ, middle + DRAWN_IN * (line.marks - middle))
    yield "beside", beside, CutSettings("enucleoresection", 3.0)
    yield "narrow", narrow, CutSettings("wedge", 3.0)
    yield "shallow", line, CutSettings("enucleoresection", depth_mm=SHALLOW_MM)
