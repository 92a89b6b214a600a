"""Shapes compared whatever their place and turn."""

import numpy as np
from scipy.spatial.transform import Rotation


def apart_after_fit(points: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Distances (n,) [mm] of points (n, 3) from wanted ones, after they were moved and turned to fit (Kabsch, least squares)."""
    points, wanted = points - points.mean(axis=0), wanted - wanted.mean(axis=0)
    if len(wanted) > 1:
        points = Rotation.align_vectors(wanted, points)[0].apply(points)
    return np.linalg.norm(points - wanted, axis=1)
