"""The axes of a kidney for nephrometry: contour without lesions, polar axis, hilum, polar lines and sinus lines.

Polar lines: between them, the medial lip of the parenchyma is interrupted by renal sinus, vessels or collecting system
(Kutikov & Uzzo 2009, J Urol 182, 844). Sinus lines: the upper and lower end of the renal sinus (Ficarra et al. 2009, Eur Urol 56,
786). Both papers read them from axial and coronal images. Here they are planes across the polar axis.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from scenes.surfaces import signed_distance_from

# Vertices of the organ this near to a lesion are the lesion's own surface.
LESION_MM = 2.0
# Tissue this deep under the organ's surface decides whether the surface is parenchyma or opens into the sinus.
UNDER_SURFACE_MM = 1.0
# The hilar concavity: deeper than this share of its greatest depth; a kidney without one of this depth shows no hilum.
CONCAVITY_SHARE, LEAST_CONCAVITY_MM = 0.5, 2.0
OPENING = ("sinus", "urine", "vessel")


@dataclass(frozen=True)
class KidneyAxes:
    """Directions (3,) are unit vectors in LPS; heights [mm] are along ``polar`` from ``centre``, to the head positive."""

    contour: trimesh.Trimesh
    """Convex hull [mm] of the organ's surface without its lesions: the kidney's contour before the tumour."""
    centre: np.ndarray
    """Centre of mass (3,) of the contour [mm]."""
    polar: np.ndarray
    """The long axis, to the upper pole."""
    hilar: np.ndarray | None
    """Across the polar axis, to the hilum; None where the hilum is not known."""
    polar_lines: tuple[float, float] | None
    """Heights of the lower and upper polar line; None where neither sinus nor hilum is known."""
    sinus_lines: tuple[float, float] | None
    estimated: bool
    """Whether both pairs of lines come from the hilar concavity, because no sinus is labelled."""

    @property
    def anterior(self) -> np.ndarray | None:
        """Normal of the kidney's own coronal plane, through polar axis and hilum; to the front."""
        if self.hilar is None:
            return None
        normal = np.cross(self.polar, self.hilar)
        return normal * (-1.0 if normal[1] > 0 else 1.0)

    def heights(self, points: np.ndarray) -> np.ndarray:
        """Heights [mm] of points (n, 3); shape (n,)."""
        return (points - self.centre) @ self.polar


def kidney_axes(
    organ: trimesh.Trimesh,
    lesions: Sequence[trimesh.Trimesh],
    parts: dict[str, trimesh.Trimesh],
    hilum_mm: Sequence[float] | None = None,
) -> KidneyAxes:
    """The axes of a kidney.

    The polar axis is the axis of least inertia of the contour. The hilum is the centre of the surface that opens into the labelled
    sinus, or else ``hilum_mm``.

    Args:
        organ: surface [mm, LPS] with its tumours and cysts.
        lesions: surfaces of tumours and cysts; their part of the organ's surface is left out.
        parts: surfaces of sinus, collecting system ("urine") and vessels ("vessel"), where labelled.
        hilum_mm: a point (3,) at the hilum.
    """
    own = _off_lesions(organ, lesions)
    contour = trimesh.convex.convex_hull(organ.vertices[own])
    centre, polar = contour.center_mass, contour.principal_inertia_vectors[0]
    polar = polar * (-1.0 if polar[2] < 0 else 1.0)
    opening = _sinus_opening(organ, parts, own) if "sinus" in parts else np.zeros(len(own), bool)
    measured = bool(opening.any())
    if measured:
        hilum_mm = organ.vertices[opening].mean(axis=0)
    elif hilum_mm is not None:
        opening = _concavity(organ, contour, own, np.asarray(hilum_mm, float))
    polar_lines = _ends(organ.vertices[opening], centre, polar)
    sinus_lines = _ends(parts["sinus"].vertices, centre, polar) if "sinus" in parts else polar_lines
    return KidneyAxes(
        contour, centre, polar, _across(hilum_mm, centre, polar), polar_lines, sinus_lines, not measured
    )


def _off_lesions(organ: trimesh.Trimesh, lesions: Sequence[trimesh.Trimesh]) -> np.ndarray:
    """Which vertices (n,) of an organ are not the surface of a lesion; all, where too few are left for a contour."""
    own = np.ones(len(organ.vertices), bool)
    for lesion in lesions:
        own &= signed_distance_from(lesion, organ.vertices) > LESION_MM
    return own if own.mean() > 0.1 else np.ones_like(own)


def _sinus_opening(organ: trimesh.Trimesh, parts: dict[str, trimesh.Trimesh], own: np.ndarray) -> np.ndarray:
    """Which vertices (n,) have sinus, collecting system or a vessel under them instead of parenchyma: the largest such piece."""
    under = organ.vertices - UNDER_SURFACE_MM * organ.vertex_normals
    inside = [signed_distance_from(parts[tissue], under) < 0 for tissue in OPENING if tissue in parts]
    opens = own & np.any(inside, axis=0)
    if not opens.any():
        return opens
    piece = _pieces(organ, opens)
    # A vessel in thin parenchyma is a piece by itself.
    return opens & (piece == np.bincount(piece[opens]).argmax())


def _concavity(
    organ: trimesh.Trimesh, contour: trimesh.Trimesh, own: np.ndarray, hilum_mm: np.ndarray
) -> np.ndarray:
    """Which vertices (n,) are in the hilar concavity: deep below the contour, and connected to the hilum."""
    depth = np.where(own, -signed_distance_from(contour, organ.vertices), 0.0)
    nearest = int(np.argmin(np.linalg.norm(organ.vertices - hilum_mm, axis=1)))
    if depth[nearest] < LEAST_CONCAVITY_MM:
        return np.zeros(len(own), bool)
    piece = _pieces(organ, depth >= CONCAVITY_SHARE * depth[nearest])
    return piece == piece[nearest]


def _pieces(organ: trimesh.Trimesh, chosen: np.ndarray) -> np.ndarray:
    """The number (n,) of the connected piece of each vertex, along edges between chosen vertices."""
    edges = organ.edges_unique[chosen[organ.edges_unique].all(axis=1)]
    graph = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(len(chosen), len(chosen)))
    return connected_components(graph, directed=False)[1]


def _ends(points: np.ndarray, centre: np.ndarray, polar: np.ndarray) -> tuple[float, float] | None:
    if len(points) == 0:
        return None
    heights = (points - centre) @ polar
    return float(heights.min()), float(heights.max())


def _across(hilum_mm: Sequence[float] | None, centre: np.ndarray, polar: np.ndarray) -> np.ndarray | None:
    if hilum_mm is None:
        return None
    to_hilum = np.asarray(hilum_mm) - centre
    to_hilum -= polar * (to_hilum @ polar)
    length = np.linalg.norm(to_hilum)
    return to_hilum / length if length > 0 else None
