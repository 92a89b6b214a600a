"""Which part of the vessels' surface is artery and which is vein, as the labels say."""

from collections.abc import Mapping

import numpy as np
from scipy.spatial import cKDTree

from scenes.anatomy import Grid

# As ``tissues`` of a scene calls them; "vessel" where nobody has said which of both it is.
KINDS = ("artery", "vein", "vessel")


def vessel_kinds(points: np.ndarray, labels: Grid | None, tissues: Mapping[int, str]) -> np.ndarray:
    """One of KINDS for each of points (n, 3) [mm] on the vessels, shape (n,): that of the nearest labelled
    voxel; ``labels`` are in the coordinates of the points.
    """
    values = [label for label, tissue in tissues.items() if tissue in KINDS]
    at = np.empty((0, 3), int) if labels is None else np.argwhere(np.isin(labels.voxels, values))
    if labels is None or len(at) == 0:
        return np.full(len(points), "vessel")
    mm_from_index = np.linalg.inv(labels.index_from_mm)
    centres = at @ mm_from_index[:3, :3].T + mm_from_index[:3, 3]
    nearest = cKDTree(centres).query(points)[1]
    return np.array([tissues[int(value)] for value in labels.voxels[tuple(at[nearest].T)]], dtype=str)


def unlabelled_in_words(kinds: np.ndarray | None) -> str:
    """What the labels do not say of the vessels, of kinds (n,), None where there are none; empty where they
    say all.
    """
    if kinds is None:
        return "Vessels are not labelled: none are drawn in the kidney."
    if (kinds == "vessel").any():
        return "The labels do not say which vessels are arteries and which are veins: those are violet."
    return ""
