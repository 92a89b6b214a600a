"""Figures of a B-mode image against the truth: whether the kidney's border can be seen, grey levels, and an outline by a segmenter."""

from collections.abc import Sequence

import numpy as np
from scipy import ndimage
from scipy.stats import mannwhitneyu

from studies.patient_images.picture_truth import PictureTruth

# Side of the square over which speckle is averaged.
AVERAGED_MM = 3.0
LEAST_PIXELS = 200


def averaged(image: np.ndarray, covered: np.ndarray, pixel_mm: Sequence[float]) -> np.ndarray:
    """Return an image averaged over a square of AVERAGED_MM, of pixels that the scanlines reach."""
    size = [max(1, round(AVERAGED_MM / each)) for each in pixel_mm]
    total = ndimage.uniform_filter(np.where(covered, image, 0).astype(np.float32), size)
    return total / np.maximum(ndimage.uniform_filter(covered.astype(np.float32), size), 1e-6)


def roc_area(brighter: np.ndarray, darker: np.ndarray) -> float:
    """Return the area under the ROC curve of "brighter" (n,) above "darker" (m,); NaN of too few pixels."""
    if min(len(brighter), len(darker)) < LEAST_PIXELS:
        return float("nan")
    return float(mannwhitneyu(brighter, darker).statistic / (len(brighter) * len(darker)))


def contrast(images: Sequence[np.ndarray], truths: Sequence[PictureTruth]) -> dict[str, float]:
    """Return areas under the ROC curve over several averaged images: fat, and all surroundings, brighter than kidney."""
    kidney = np.concatenate([image[truth.kidney] for image, truth in zip(images, truths, strict=True)])
    fat = np.concatenate([image[truth.fat] for image, truth in zip(images, truths, strict=True)])
    around = np.concatenate([image[truth.surroundings] for image, truth in zip(images, truths, strict=True)])
    return {"fat_auc": roc_area(fat, kidney), "surroundings_auc": roc_area(around, kidney)}


def grey_levels(images: Sequence[np.ndarray], covered: np.ndarray) -> dict[str, float]:
    """Return median and 90th percentile of the grey values of images that the scanlines reach."""
    values = np.concatenate([image[covered] for image in images])
    return {"grey_median": float(np.median(values)), "grey_p90": float(np.percentile(values, 90))}
