"""Cuts of the study, around a tumour and a margin and badly placed: margins and volumes by
``rehearsal/resection/judgement.py``, beside those of SimpleITK.
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import product
from typing import Any, get_args

import numpy as np
import trimesh

from rehearsal.resection.cut import Cut, CutSettings, cut_organ
from rehearsal.resection.judgement import Carried, Judgement, judge
from rehearsal.resection.proposal import line_around
from rehearsal.resection.score_line import ScoreLine, places_on, score_line
from render.viewer import Technique
from scenes.anatomy import LoadedAnatomy
from studies.resection.voxel_margins import BELOW_MM, MM3_OF_ML, CutFigures, figures_by_voxels

TECHNIQUES: tuple[Technique, ...] = get_args(Technique)
MARGINS_MM = (0.0, 3.0, 5.0)
# Badly placed lines: beside the tumour by this, drawn in to this share of the width, and a cut to this depth.
BESIDE_MM, DRAWN_IN, SHALLOW_MM = 10.0, 0.6, 12.0


def planned_cuts(organ: trimesh.Trimesh, tumour: trimesh.Trimesh) -> Iterator[tuple[str, CutSettings, Cut]]:
    """How its line is placed, settings and cut: all techniques and margins along lines around tumour and
    margin, then badly placed cuts that leave tumour. Raises ResectionError.
    """
    lines = {margin: line_over(organ, tumour, margin) for margin in MARGINS_MM}
    around = product(TECHNIQUES, lines.items())
    planned = [("around", line, CutSettings(technique, margin)) for technique, (margin, line) in around]
    points = np.asarray(tumour.vertices)
    for placed, line, settings in [*planned, *_badly_placed(organ, lines[3.0])]:
        yield placed, settings, cut_organ(organ, line, settings, points)


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


MARGIN_BAR_MM, VOLUME_BAR = 0.3, 0.02


@dataclass(frozen=True)
class MarginRow:
    """A cut of a patient: the figures of Nephron and of SimpleITK."""

    patient: str
    placed: str
    settings: CutSettings
    ours: CutFigures
    reference: CutFigures
    tumour_ml: float

    def _error(self, name: str) -> float:
        return abs(getattr(self.ours, name) - getattr(self.reference, name))

    @property
    def margin_error_mm(self) -> float:
        """The larger error of least and mean margin [mm]."""
        return max(self._error("margin_min_mm"), self._error("margin_mean_mm"))

    @property
    def volume_error(self) -> float:
        """The largest error of the volumes: of specimen and parenchyma as a share of each, of the tumour
        left as one of the tumour.
        """
        return max(
            self._error("specimen_ml") / self.reference.specimen_ml,
            self._error("tumour_left_ml") / self.tumour_ml,
            self._error("parenchyma_ml") / self.reference.parenchyma_ml,
        )

    @property
    def is_within(self) -> bool:
        """Whether the margins are within 0.3 mm, and the volumes within 2 %."""
        return self.margin_error_mm <= MARGIN_BAR_MM and self.volume_error <= VOLUME_BAR

    def described(self) -> dict[str, Any]:
        """The row of the JSON file, with values for the table."""
        settings, ours, reference = asdict(self.settings), asdict(self.ours), asdict(self.reference)
        pairs = {name: f"{value:.2f} / {reference[name]:.2f}" for name, value in ours.items()}
        pairs["below_5_mm2"] = f"{ours['below_5_mm2']:.0f} / {reference['below_5_mm2']:.0f}"
        depth_mm = self.settings.depth_mm
        return dict(
            patient=self.patient,
            placed=self.placed,
            technique=self.settings.technique,
            how=f"{self.settings.margin_mm:g} mm" if depth_mm is None else f"{depth_mm:g} mm deep",
            **pairs,
            margin_error_mm=round(self.margin_error_mm, 3),
            volume_error_percent=round(100 * self.volume_error, 2),
            within="yes" if self.is_within else "no",
            settings=settings,
            ours=ours,
            reference=reference,
        )


def margin_rows(patient: str, anatomy: LoadedAnatomy) -> Iterator[MarginRow]:
    """All cuts of the study on a patient; none without a tumour. Raises ResectionError, PatientError."""
    organ, tumour = anatomy.organ, anatomy.tumour
    if tumour is None:
        return
    for placed, settings, cut in planned_cuts(organ, tumour):
        # The tissue as it was segmented: the cut is judged at rest.
        at_rest = (organ, cut.specimen, cut.remnant, tumour)
        carried = Carried(*(np.asarray(surface.vertices) for surface in at_rest))
        ours = _figures(judge(cut, organ, tumour, anatomy.parts, carried))
        reference = figures_by_voxels(cut, organ, tumour, anatomy.parts)
        yield MarginRow(patient, placed, settings, ours, reference, tumour.volume / MM3_OF_ML)


def _figures(judgement: Judgement) -> CutFigures:
    margin = judgement.margin
    return CutFigures(
        margin_min_mm=float(margin.margin_mm.min()),
        margin_mean_mm=margin.mean_mm,
        below_5_mm2=margin.area_below(BELOW_MM),
        specimen_ml=float(judgement.specimen_ml),
        tumour_left_ml=judgement.tumour_left_ml,
        parenchyma_ml=judgement.parenchyma_removed_ml,
    )
