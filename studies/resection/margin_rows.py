"""Margins and volumes of cuts by ``rehearsal/resection/judgement.py``, beside those of SimpleITK."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass

import numpy as np

from rehearsal.resection.cut import CutSettings
from rehearsal.resection.judgement import Carried, Judgement, judge
from scenes.anatomy import LoadedAnatomy
from studies.resection.cut_lines import planned_cuts
from studies.resection.voxel_margins import BELOW_MM, MM3_OF_ML, CutFigures, figures_by_voxels

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

    @property
    def margin_error_mm(self) -> float:
        """The larger error of least and mean margin [mm]."""
        return max(
            abs(getattr(self.ours, name) - getattr(self.reference, name))
            for name in ("margin_min_mm", "margin_mean_mm")
        )

    @property
    def volume_error(self) -> float:
        """The largest error of the volumes: of specimen and parenchyma as a share of each, of the tumour
        left as one of the tumour.
        """
        wholes = dict(
            specimen_ml=self.reference.specimen_ml,
            tumour_left_ml=self.tumour_ml,
            parenchyma_ml=self.reference.parenchyma_ml,
        )
        return max(
            abs(getattr(self.ours, name) - getattr(self.reference, name)) / whole
            for name, whole in wholes.items()
        )

    @property
    def is_within(self) -> bool:
        """Whether the margins are within 0.3 mm, and the volumes within 2 %."""
        return self.margin_error_mm <= MARGIN_BAR_MM and self.volume_error <= VOLUME_BAR

    def described(self) -> dict[str, object]:
        """Values for the table and the files."""
        pairs = {
            name: f"{value:.2f} / {getattr(self.reference, name):.2f}"
            for name, value in asdict(self.ours).items()
        }
        pairs["below_5_mm2"] = f"{self.ours.below_5_mm2:.0f} / {self.reference.below_5_mm2:.0f}"
        how = f"{self.settings.margin_mm:g} mm"
        if self.settings.depth_mm is not None:
            how = f"{self.settings.depth_mm:g} mm deep"
        return dict(
            patient=self.patient,
            placed=self.placed,
            technique=self.settings.technique,
            how=how,
            **pairs,
            margin_error_mm=round(self.margin_error_mm, 3),
            volume_error_percent=round(100 * self.volume_error, 2),
            within="yes" if self.is_within else "no",
        )

    def report(self) -> dict[str, object]:
        """The row for the JSON file."""
        return dict(
            self.described(),
            settings=asdict(self.settings),
            ours=asdict(self.ours),
            reference=asdict(self.reference),
        )


def margin_rows(patient: str, anatomy: LoadedAnatomy) -> Iterator[MarginRow]:
    """All cuts of the study on a patient; none without a tumour. Raises ResectionError, PatientError."""
    organ, tumour = anatomy.organ, anatomy.tumour
    if tumour is None:
        return
    for planned in planned_cuts(organ, tumour):
        cut = planned.cut
        # The tissue as it was segmented: the cut is judged at rest.
        at_rest = (organ, cut.specimen, cut.remnant, tumour)
        carried = Carried(*(np.asarray(each.vertices) for each in at_rest))
        ours = _figures(judge(cut, organ, tumour, anatomy.parts, carried))
        reference = figures_by_voxels(cut, organ, tumour, anatomy.parts)
        yield MarginRow(patient, planned.placed, planned.settings, ours, reference, tumour.volume / MM3_OF_ML)


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
