"""A cut surface as it is drawn: the cut subdivided and smoothed, with a sharp rim. Only the picture has it:
the tissue and the figures of a cut have the surface itself.
"""

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy import sparse
from scipy.spatial import cKDTree

# No point is drawn farther from the surface of the cut than this [mm], and so many times each is moved to the
# middle of its neighbours.
MOVED_MM, ROUNDS = 0.15, 12


@dataclass(frozen=True)
class DrawnCut:
    """Vertices (n, 3) [mm] and faces (m, 3), of which ``on_cut`` (m,) are of the cut.

    The cut has vertices of its own along the rim. ``source`` (n,) is the vertex of the surface that is
    nearest to each.
    """

    vertices: np.ndarray
    faces: np.ndarray
    on_cut: np.ndarray
    source: np.ndarray


def drawn_cut(surface: trimesh.Trimesh, on_cut: np.ndarray) -> DrawnCut:
    """A closed surface, of which the faces ``on_cut`` (f,) were cut, as it is drawn; no point is moved by
    more than MOVED_MM.
    """
    rest, faces = np.asarray(surface.vertices, float), np.asarray(surface.faces)
    cut = faces[on_cut]
    smooth = _smoothed(rest, rest, cut, is_rim_free=True)
    fine, divided = trimesh.remesh.subdivide(rest, cut)
    start, _ = trimesh.remesh.subdivide(smooth, cut)
    # The rim stays where it is also for the capsule, whose edges are not divided.
    fine_smooth = _smoothed(start, fine, divided, is_rim_free=False)
    of_capsule, capsule = np.unique(faces[~on_cut], return_inverse=True)
    of_cut, own = np.unique(divided, return_inverse=True)
    drawn = np.concatenate([capsule.reshape(-1, 3), own.reshape(-1, 3) + len(of_capsule)])
    return DrawnCut(
        vertices=np.concatenate([smooth[of_capsule], fine_smooth[of_cut]]),
        faces=drawn,
        on_cut=np.arange(len(drawn)) >= len(capsule.reshape(-1, 3)),
        source=np.concatenate([of_capsule, cKDTree(rest).query(fine[of_cut])[1]]),
    )


def _smoothed(start: np.ndarray, rest: np.ndarray, faces: np.ndarray, is_rim_free: bool) -> np.ndarray:
    """Points (n, 3) of faces (m, 3), from ``start`` moved to the middle of their neighbours, and no farther
    than MOVED_MM from ``rest``; those of the rim along it, or not at all.
    """
    edges, count = np.unique(
        np.sort(trimesh.geometry.faces_to_edges(faces), axis=1), axis=0, return_counts=True
    )
    rim_edges = edges[count == 1]
    rim = np.zeros(len(rest), bool)
    rim[rim_edges] = True
    inner = edges[~rim[edges].all(axis=1)]
    both = np.concatenate([inner, inner[:, ::-1]])
    # A point of the rim has the two beside it on the rim as neighbours, and no others.
    both = both[~rim[both[:, 0]]]
    if is_rim_free:
        both = np.concatenate([both, rim_edges, rim_edges[:, ::-1]])
    beside = sparse.csr_array((np.ones(len(both)), both.T), shape=(len(rest), len(rest)))
    number = beside.sum(axis=1)
    moves = number > 0
    points = start.copy()
    for _ in range(ROUNDS):
        middle = (beside @ points)[moves] / number[moves, None]
        offset = (points[moves] + middle) / 2 - rest[moves]
        length = np.linalg.norm(offset, axis=1, keepdims=True)
        points[moves] = rest[moves] + offset * np.minimum(1.0, MOVED_MM / np.maximum(length, 1e-9))
    return points
