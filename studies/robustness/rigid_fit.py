"""Comparison of shapes, whatever their position and orientation."""

import numpy as np
from scipy.spatial.transform import Rotation


def distances_after_fit(points: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Distances (n,) [mm] of points (n, 3) from reference points after a rigid least-squares fit (Kabsch)."""
    points, reference = points - points.mean(axis=0), reference - reference.mean(axis=0)
    if len(reference) > 1:
        points = Rotation.align_vectors(reference, points)[0].apply(points)
    return np.linalg.norm(points - reference, axis=1)
