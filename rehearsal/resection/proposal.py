"""A proposal of a score: the line on the capsule around tumour and margin, for a direction of the cut."""

import numpy as np
import trimesh
from scipy.spatial import ConvexHull

from rehearsal.resection.cut import grown
from rehearsal.resection.score_line import places_on
from scenes.solids import solid_of

MARKS = 16
# The line is this much wider than tumour and margin, so that the walls of the cut are not in the margin.
SLACK_MM = 0.5


def marks_around(
    organ: trimesh.Trimesh, tumour: trimesh.Trimesh, margin_mm: float, direction: np.ndarray
) -> np.ndarray:
    """Marks (n, 3) [mm] on an organ's surface around a tumour and a margin, seen along a direction (3,) out of the organ."""
    axes = np.vstack([np.linalg.svd(direction[None])[2][1:], direction])
    points = grown(np.asarray(tumour.vertices), margin_mm + SLACK_MM) @ axes.T
    outline = ConvexHull(points[:, :2])
    middle = outline.points[outline.vertices].mean(axis=0)
    # Distance of the middle from each side of the outline, with the side's normal.
    normals, apart = outline.equations[:, :2], -outline.equations[:, :2] @ middle - outline.equations[:, 2]
    height = float((np.asarray(tumour.vertices) @ direction).mean())
    solid = solid_of(organ, "organ")
    above = float((np.asarray(organ.vertices) @ direction).max()) + 1.0
    below = float((np.asarray(organ.vertices) @ direction).min()) - 1.0
    marks = []
    for angle in 2 * np.pi * np.arange(MARKS) / MARKS:
        ray = np.array([np.cos(angle), np.sin(angle)])
        ahead = normals @ ray > 1e-9
        edge = middle + ray * float((apart[ahead] / (normals[ahead] @ ray)).min())
        start, end = np.array([*edge, above]) @ axes, np.array([*edge, below]) @ axes
        hits = solid.ray_cast(start, end)
        # Beside the organ: its nearest place.
        marks.append(hits[0].position if hits else np.array([*edge, height]) @ axes)
    return places_on(organ, np.array(marks))[0]
