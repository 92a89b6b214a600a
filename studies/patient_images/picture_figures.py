"""Figures of B-mode images against the truth of their pixels: whether the kidney's border can be seen,
grey levels, outlines.
"""

from collections.abc import Sequence

import numpy as np
from scipy.stats import mannwhitneyu

from studies.image_quality import grey_figures
from studies.patient_images.kidney_outline import (
    GOOD_DICE,
    dice,
    kidney_contour,
    outline_by_place,
    outlined_kidney,
)
from studies.patient_images.patient_image_scans import PlaneScan

LEAST_PIXELS = 200


def picture_figures(scans: Sequence[PlaneScan]) -> dict[str, float]:
    """Return figures pooled over the planes of a patient and a probe.

    ``fat_auc`` and ``surroundings_auc``: areas under the ROC curve of "brighter than kidney"
    (``PictureTruth``) of the averaged picture. ``grey_median`` and ``grey_p90`` of all that the scanlines
    reach. ``outlined``: the share of planes that show kidney and whose outline has a Dice of GOOD_DICE or
    more; ``outlined_by_place``: the same of an outline that sees no picture.
    """
    kidney = _pooled([scan.averaged[scan.truth.judged_kidney] for scan in scans])
    fat = _pooled([scan.averaged[scan.truth.fat] for scan in scans])
    surroundings = _pooled([scan.averaged[scan.truth.surroundings] for scan in scans])
    median, most = grey_figures(_pooled([scan.b_mode[scan.covered] for scan in scans]))
    outlines = [outline_dice(scan) for scan in scans if (scan.truth.kidney & scan.truth.seen).any()]
    good, by_place = np.mean(np.array(outlines).reshape(-1, 2) >= GOOD_DICE, axis=0)
    return dict(
        fat_auc=roc_area(fat, kidney),
        surroundings_auc=roc_area(surroundings, kidney),
        grey_median=median,
        grey_p90=most,
        outlined=float(good),
        outlined_by_place=float(by_place),
    )


def outline_dice(scan: PlaneScan) -> tuple[float, float]:
    """Return Dice of the segmenter's outline of the kidney, and of one that sees no picture, in what is
    seen.
    """
    seen = scan.truth.seen
    contour = kidney_contour(scan.truth.kidney & scan.covered, scan.pixel_mm) & scan.covered
    centre = np.argwhere(contour & seen).mean(axis=0)
    outline = outlined_kidney(scan.averaged, scan.covered, centre, scan.pixel_mm)
    by_place = outline_by_place(scan.covered, centre, scan.pixel_mm)
    return dice(outline[seen], contour[seen]), dice(by_place[seen], contour[seen])


def roc_area(brighter: np.ndarray, darker: np.ndarray) -> float:
    """Return the area under the ROC curve of "brighter" (n,) above "darker" (m,), ties one half; NaN of
    fewer than LEAST_PIXELS.
    """
    if min(len(brighter), len(darker)) < LEAST_PIXELS:
        return float("nan")
    return float(mannwhitneyu(brighter, darker).statistic / (len(brighter) * len(darker)))


def _pooled(parts: Sequence[np.ndarray]) -> np.ndarray:
    return np.concatenate(list(parts))
