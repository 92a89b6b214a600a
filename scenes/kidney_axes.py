"""The axes of a kidney for nephrometry: contour without lesions, polar axis, hilum, polar lines and sinus
lines.

Polar lines: between them, the medial lip of the parenchyma is interrupted by renal sinus, vessels or
collecting system (Kutikov & Uzzo 2009, J Urol 182, 844). Sinus lines: the upper and lower end of the renal
sinus (Ficarra et al. 2009, Eur Urol 56, 786). Both papers read them from axial and coronal images. Here they
are planes across the polar axis.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import trimesh
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from scenes.surfaces import signed_distance_from

# Vertices of the organ this near to a lesion are the lesion's own surface.
LESION_MM = 2.0
# Tissue this deep under the organ's surface decides whether the surface is parenchyma or opens into the
# sinus.
UNDER_SURFACE_MM = 1.0
# The hilar concavity is where the contour is farther from the organ than this share of the greatest distance.
# Without a distance of
# LEAST_CONCAVITY_MM near the hilum there is none. The contour is sampled every MOUTH_MM.
CONCAVITY_SHARE, LEAST_CONCAVITY_MM = 0.5, 2.0
NEAR_HILUM_MM, MOUTH_MM = 30.0, 3.0
OPENING = ("sinus", "urine", "vessel")


@dataclass(frozen=True)
class KidneyAxes:
    """Directions (3,) are unit vectors in LPS; heights [mm] are along ``polar`` from ``centre``, to the
    head positive.
    """

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
    def length_mm(self) -> float:
        """From pole to pole, along the polar axis, without lesions."""
        return float(np.ptp(self.heights(self.contour.vertices)))

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
    """The axes of a kidney, whose surface ``organ`` [mm, LPS] includes its tumours and cysts.

    The polar axis is the axis of least inertia of the contour. The hilum is the surface that opens into the
    labelled sinus, or else the mouth of the concavity near ``hilum_mm`` (3,). ``lesions`` are surfaces of
    tumours and cysts; their part of the organ's surface is left out. ``parts`` are the surfaces of sinus,
    collecting system ("urine") and vessels ("vessel"), where labelled.
    """
    own = _off_lesions(organ, lesions)
    contour = trimesh.convex.convex_hull(organ.vertices[own])
    centre, polar = contour.center_mass, contour.principal_inertia_vectors[0]
    polar = polar * (-1.0 if polar[2] < 0 else 1.0)
    hilum = _sinus_opening(organ, parts, own) if "sinus" in parts else np.empty((0, 3))
    measured = len(hilum) > 0
    if not measured and hilum_mm is not None:
        hilum = _concavity(organ, contour, np.asarray(hilum_mm, float))
    polar_lines = _ends(hilum, centre, polar)
    return KidneyAxes(
        contour,
        centre,
        polar,
        hilar=_across(hilum, centre, polar),
        polar_lines=polar_lines,
        sinus_lines=_ends(parts["sinus"].vertices, centre, polar) if "sinus" in parts else polar_lines,
        estimated=not measured,
    )


def _off_lesions(organ: trimesh.Trimesh, lesions: Sequence[trimesh.Trimesh]) -> np.ndarray:
    """Which vertices (n,) of an organ are not the surface of a lesion; all, where the organ is nothing but
    lesions.
    """
    own = np.ones(len(organ.vertices), bool)
    for lesion in lesions:
        own &= signed_distance_from(lesion, organ.vertices) > LESION_MM
    return own if own.mean() > 0.01 else np.ones_like(own)


def _sinus_opening(organ: trimesh.Trimesh, parts: dict[str, trimesh.Trimesh], own: np.ndarray) -> np.ndarray:
    """Vertices (n, 3) with sinus, collecting system or a vessel under them instead of parenchyma: the
    largest piece of such surface.
    """
    under = organ.vertices - UNDER_SURFACE_MM * organ.vertex_normals
    inside = [signed_distance_from(parts[tissue], under) < 0 for tissue in OPENING if tissue in parts]
    opens = own & np.any(inside, axis=0)
    if not opens.any():
        return np.empty((0, 3))
    piece = _pieces(organ, opens)
    # A vessel in thin parenchyma is a piece by itself.
    return organ.vertices[piece == np.bincount(piece[opens]).argmax()]


def _concavity(organ: trimesh.Trimesh, contour: trimesh.Trimesh, hilum_mm: np.ndarray) -> np.ndarray:
    """Points (n, 3) of the contour over the hilar concavity: the mouth of the hilum between the lips of
    the parenchyma.
    """
    fine = cast(trimesh.Trimesh, contour.subdivide_to_size(MOUTH_MM))
    gap = signed_distance_from(organ, fine.vertices)
    near = np.linalg.norm(fine.vertices - hilum_mm, axis=1) <= NEAR_HILUM_MM
    middle = int(np.argmax(np.where(near, gap, 0.0)))
    if gap[middle] < LEAST_CONCAVITY_MM or not near[middle]:
        return np.empty((0, 3))
    piece = _pieces(fine, gap >= CONCAVITY_SHARE * gap[middle])
    return fine.vertices[piece == piece[middle]]


def _pieces(surface: trimesh.Trimesh, chosen: np.ndarray) -> np.ndarray:
    """The number (n,) of the connected piece of each vertex, along edges between chosen vertices."""
    edges = surface.edges_unique[chosen[surface.edges_unique].all(axis=1)]
    graph = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(len(chosen), len(chosen)))
    return connected_components(graph, directed=False)[1]


def _ends(points: np.ndarray, centre: np.ndarray, polar: np.ndarray) -> tuple[float, float] | None:
    if len(points) == 0:
        return None
    heights = (points - centre) @ polar
    return float(heights.min()), float(heights.max())


def _across(hilum: np.ndarray, centre: np.ndarray, polar: np.ndarray) -> np.ndarray | None:
    """Unit vector (3,) from the polar axis to the middle of the hilum's points (n, 3); None without
    points.
    """
    if len(hilum) == 0:
        return None
    to_hilum = hilum.mean(axis=0) - centre
    to_hilum -= polar * (to_hilum @ polar)
    return to_hilum / np.linalg.norm(to_hilum)
