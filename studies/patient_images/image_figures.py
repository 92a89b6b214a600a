"""Figures of B-mode images against the truth: of pixels, whether the kidney's border can be seen, grey levels
and outlines; of scanlines before the grey map, the kidney's capsule and contrast agent in its collecting
system.
"""

from collections.abc import Callable, Sequence

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
from studies.patient_images.patient_truth import DEPTHS_MM, PatientTruth, ScanlineTruth

LEAST_PIXELS = 200


def picture_figures(scans: Sequence[PlaneScan]) -> dict[str, float]:
    """Figures pooled over the planes of a patient and a probe.

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
    """Dice of the segmenter's outline of the kidney, and of one that sees no picture, in what is seen."""
    seen = scan.truth.seen
    contour = kidney_contour(scan.truth.kidney & scan.covered, scan.pixel_mm) & scan.covered
    centre = np.argwhere(contour & seen).mean(axis=0)
    outline = outlined_kidney(scan.averaged, scan.covered, centre, scan.pixel_mm)
    by_place = outline_by_place(scan.covered, centre, scan.pixel_mm)
    return dice(outline[seen], contour[seen]), dice(by_place[seen], contour[seen])


def roc_area(brighter: np.ndarray, darker: np.ndarray) -> float:
    """Area under the ROC curve of "brighter" (n,) above "darker" (m,), ties one half; NaN of fewer than
    LEAST_PIXELS.
    """
    if min(len(brighter), len(darker)) < LEAST_PIXELS:
        return float("nan")
    return float(mannwhitneyu(brighter, darker).statistic / (len(brighter) * len(darker)))


def _pooled(parts: Sequence[np.ndarray]) -> np.ndarray:
    return np.concatenate(list(parts))


# Incidence [degrees] of the beam on the capsule.
SQUARE_DEG, ASLANT_DEG = (0.0, 10.0), (15.0, 20.0)
# The capsule's echo is looked for so near to the organ's surface, and compared with the kidney from the first
# to the second distance inside.
CAPSULE_MM = 1.0
INSIDE_MM = 2.0, 6.0
CONTROL_MM = 4.0
LEAST_CROSSINGS = 40
# Parenchyma is deeper inside the label than the first, and of HU within the second of the kidney's median.
UNDER_MM, PARENCHYMA_HU = 2.0, 60.0
# Contrast agent is judged so far inside its border; enhancement from the first to the second distance behind
# it.
CORE_MM, BEHIND_MM = 1.0, (2.0, 8.0)
# Levels are compared in bins of depth.
BIN_MM, LEAST_SAMPLES = 2.0, 30


def decibel(power: float) -> float:
    """A power in dB; NaN of none."""
    return float(10 * np.log10(power)) if power > 0 else float("nan")


def capsule_figures(truths: Sequence[ScanlineTruth]) -> dict[str, float]:
    """How much the capsule's echo is above the kidney beneath it [dB], where the beam meets it within
    SQUARE_DEG and ASLANT_DEG.

    On each scanline that crosses the organ's surface into labelled kidney deeper than DEPTHS_MM[0]: the
    greatest power within CAPSULE_MM of the surface, and the mean power INSIDE_MM beneath it; the ratio is
    that of the means over all crossings. ``capsule_control_db`` is what the greatest of speckle alone makes:
    the same of a surface CONTROL_MM beneath the real one.
    """
    crossings = np.concatenate([_crossings(truth) for truth in truths])
    figures = {}
    for name, (least, most), column in (
        ("capsule_db", SQUARE_DEG, 1),
        ("capsule_aslant_db", ASLANT_DEG, 1),
        ("capsule_control_db", SQUARE_DEG, 2),
    ):
        chosen = crossings[(crossings[:, 0] >= least) & (crossings[:, 0] <= most)]
        enough = len(chosen) >= LEAST_CROSSINGS
        figures[name] = decibel(chosen[:, column].mean() / chosen[:, 3].mean()) if enough else float("nan")
    return figures


def _crossings(truth: ScanlineTruth) -> np.ndarray:
    """Of each crossing of the surface (n, 4) the incidence [degrees], and the powers: greatest, greatest of
    the control, mean inside.
    """
    rows = []
    inside = truth.surface_mm < 0
    for line, sample in np.argwhere(inside[:, 1:] != inside[:, :-1]):
        way = slice(sample + 1, None) if inside[line, sample + 1] else slice(sample, None, -1)
        deep = -truth.surface_mm[line, way]
        end = _first((deep > INSIDE_MM[1]) | (deep < 0))
        if end == len(deep) or deep[end] < 0:
            continue
        deep, power, depth = deep[:end], truth.power[line, way][:end], truth.depth_mm[way][:end]
        beneath, control = deep >= INSIDE_MM[0], np.abs(deep - CONTROL_MM) <= CAPSULE_MM
        is_kidney = (truth.parenchyma_mm[line, way][:end][beneath] < 0).all()
        first = min(depth[0] - CAPSULE_MM, depth[-1])
        if not is_kidney or first < DEPTHS_MM[0] or not truth.seen[line, way][:end].all():
            continue
        near = truth.power[line, np.abs(truth.depth_mm - truth.depth_mm[sample]) <= CAPSULE_MM]
        rows.append(
            (truth.incidence_deg[line, sample], near.max(), power[control].max(), power[beneath].mean())
        )
    return np.array(rows).reshape(-1, 4)


def _first(where: np.ndarray) -> int:
    """First index (n,) where something is, or n."""
    return int(where.argmax()) if where.any() else len(where)


def agent_figures(truths: Sequence[ScanlineTruth], patient: PatientTruth) -> dict[str, float]:
    """Levels [dB] of contrast agent in the collecting system, and of the parenchyma BEHIND_MM behind it, both
    against parenchyma at like depth that has none before it; NaN where there is none, as in a kidney that is
    not enhanced.

    ``agent_db`` is below 0 where the agent is fluid; ``behind_agent_db`` is below 0 in a shadow, above 0
    where fluid enhances.
    """
    pairs = [(truth, _behind_agent_mm(truth)) for truth in truths]

    def chosen(select: Callable[[ScanlineTruth, np.ndarray], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        masks = [select(truth, behind) & _is_judged(truth) for truth, behind in pairs]
        depths = [np.broadcast_to(truth.depth_mm, truth.power.shape) for truth in truths]
        return (
            np.concatenate([truth.power[mask] for truth, mask in zip(truths, masks, strict=True)]),
            np.concatenate([depth[mask] for depth, mask in zip(depths, masks, strict=True)]),
        )

    def parenchyma(truth: ScanlineTruth) -> np.ndarray:
        return (truth.parenchyma_mm < -UNDER_MM) & (np.abs(truth.hu - patient.median_hu) < PARENCHYMA_HU)

    elsewhere = chosen(lambda truth, behind: parenchyma(truth) & np.isinf(behind))
    agent = chosen(lambda truth, behind: (truth.agent_mm < -CORE_MM) & (truth.parenchyma_mm < 0))
    after = chosen(
        lambda truth, behind: parenchyma(truth) & (behind >= BEHIND_MM[0]) & (behind <= BEHIND_MM[1])
    )
    return {
        "agent_db": level_at_like_depth(*agent, *elsewhere),
        "behind_agent_db": level_at_like_depth(*after, *elsewhere),
    }


def _is_judged(truth: ScanlineTruth) -> np.ndarray:
    return truth.seen & (truth.depth_mm >= DEPTHS_MM[0]) & (truth.depth_mm <= DEPTHS_MM[1])


def _behind_agent_mm(truth: ScanlineTruth) -> np.ndarray:
    """How far behind contrast agent a sample is [mm] (scanlines, samples); infinite without agent."""
    last = np.where(truth.agent_mm < 0, truth.depth_mm, -np.inf)
    return truth.depth_mm - np.maximum.accumulate(last, axis=1)


def level_at_like_depth(
    power: np.ndarray, depth_mm: np.ndarray, other_power: np.ndarray, other_depth_mm: np.ndarray
) -> float:
    """Mean power (n,) of samples over that of others (m,) in the same bins of depth [dB], weighted as the
    first are; NaN where no bin has LEAST_SAMPLES of both.
    """
    bins = [(depth // BIN_MM).astype(int) for depth in (depth_mm, other_depth_mm)]
    length = max((int(of_depth.max()) + 1 for of_depth in bins if len(of_depth)), default=1)
    count, other_count = (np.bincount(of_depth, minlength=length) for of_depth in bins)
    total = np.bincount(bins[0], power, length)
    other_total = np.bincount(bins[1], other_power, length)
    both = (count >= LEAST_SAMPLES) & (other_count >= LEAST_SAMPLES)
    if not both.any():
        return float("nan")
    like = (other_total[both] / other_count[both] * count[both]).sum()
    return decibel(total[both].sum() / like)
