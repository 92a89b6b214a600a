"""The surgeon's actions of a resection: where marks of the score are on the capsule, and what a cut is
given.
"""

import base64
from collections.abc import Callable
from dataclasses import asdict

import igl
import numpy as np
import trimesh
from scipy.spatial import ConvexHull

from rehearsal.case import Case
from rehearsal.deformed_anatomy import DeformedAnatomy
from rehearsal.loop.command import CutOut
from rehearsal.resection.cut import CutSettings
from rehearsal.resection.score_line import ResectionError, ScoreLine, places_on
from ultrasound.scanner import plane_section

# Which of points at rest (n, 3) [mm] the images have shown so far.
IsSeen = Callable[[np.ndarray], np.ndarray]
# A cut by less of the tumour's surface is warned of: it may go through the rest.
LEAST_SEEN = 0.8


def cut_command(anatomy: DeformedAnatomy, settings: CutSettings, is_seen: IsSeen | None) -> CutOut:
    """A cut along the score. Without ``is_seen`` all of the tumour counts as seen."""
    tumour = anatomy.case.tumour
    points = np.zeros((0, 3)) if tumour is None else np.asarray(tumour.vertices)
    seen = np.ones(len(points), bool) if is_seen is None else is_seen(points)
    return CutOut(**asdict(settings), seen=base64.b64encode(np.packbits(seen).tobytes()).decode("ascii"))


def seen_share(anatomy: DeformedAnatomy) -> float:
    """The share of the tumour's surface that the images had shown when it was cut; 1 without a cut or a
    tumour.
    """
    request, tumour = anatomy.frame.resection.cut, anatomy.case.tumour
    if request is None or tumour is None:
        return 1.0
    return float(request.seen_of(len(tumour.vertices)).mean())


def places_at_rest(case: Case, points: np.ndarray) -> np.ndarray:
    """Places (n, 3) of the organ's surface at rest that are nearest to points (n, 3) of the patient (LPS,
    mm).
    """
    return places_on(case.organ, points - case.origin)[0]


def mark_under(anatomy: DeformedAnatomy, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """The place (1, 3) at rest [mm] of the organ's surface where a ray first meets it.

    Raises ResectionError where it does not.
    """
    now, faces = _surface_now(anatomy)
    hits = igl.ray_mesh_intersect(origin.astype(float), direction.astype(float), now, faces)
    if len(hits) == 0:
        raise ResectionError("the mark is not on the organ; click on its surface")
    return rest_places(anatomy, (origin + hits[0][1] * direction)[None])


def marks_of_image(anatomy: DeformedAnatomy, margin_mm: float) -> np.ndarray:
    """The places (1 or 2, 3) at rest [mm] of the organ's surface in the image plane, a margin beside the
    lateral edges of the tumour that the image shows.

    It is the place nearest to the probe. Raises ResectionError where the image shows no edge, or the organ
    ends before the place.
    """
    outline = anatomy.tumour_outline()
    plane = anatomy.image_plane()
    shown_mm = plane.width_mm / 2
    edges = []
    if outline is not None and len(outline):
        left, right = float(outline[..., 0].min()), float(outline[..., 0].max())
        edges = [
            at + beside for at, beside in ((left, -margin_mm), (right, margin_mm)) if abs(at) <= shown_mm
        ]
    if not edges:
        raise ResectionError("the image shows no lateral edge of the tumour; move the probe over one")
    surface = plane_section(*_surface_now(anatomy), np.linalg.inv(plane.world_from_plane))
    places = np.array([[*_nearest_to_probe(surface, edge), 0.0, 1.0] for edge in edges])
    return rest_places(anatomy, (places @ plane.world_from_plane.T)[:, :3])


def _nearest_to_probe(section: np.ndarray, across_mm: float) -> tuple[float, float]:
    """The place (u, v) of a section (n, 2, 2) [mm] at a lateral position that is nearest to the probe.

    Raises ResectionError.
    """
    start, end = section[:, 0], section[:, 1]
    crossing = (start[:, 0] <= across_mm) != (end[:, 0] <= across_mm)
    if not crossing.any():
        raise ResectionError(
            "the organ ends before the edge of tumour and margin; move the probe, or click on the surface"
        )
    start, end = start[crossing], end[crossing]
    share = (across_mm - start[:, 0]) / (end[:, 0] - start[:, 0])
    return across_mm, float((start[:, 1] + share * (end[:, 1] - start[:, 1])).min())


def rest_places(anatomy: DeformedAnatomy, points: np.ndarray) -> np.ndarray:
    """The places at rest (n, 3) [mm] of the organ's surface that are now nearest to points (n, 3)."""
    now, faces = _surface_now(anatomy)
    _, face, near = igl.point_mesh_squared_distance(points, now, faces)
    corners = faces[np.atleast_1d(face)]
    share = igl.barycentric_coordinates(np.atleast_2d(near), *(now[corners[:, k]] for k in range(3)))
    return np.einsum("nk,nka->na", share, np.asarray(anatomy.organ.vertices)[corners])


def _surface_now(anatomy: DeformedAnatomy) -> tuple[np.ndarray, np.ndarray]:
    return anatomy.vertices, np.asarray(anatomy.organ.faces, np.int64)


def distance_to_tumour(line: ScoreLine | None, tumour: trimesh.Trimesh | None) -> np.ndarray:
    """Distance (k,) [mm] of each point of a score at rest from the outline of a tumour, both seen along the
    score's direction; negative over the tumour. Empty without a score or a tumour.
    """
    if line is None or tumour is None:
        return np.zeros(0)
    axes = line.frame()[:2]
    seen_along = np.asarray(tumour.vertices) @ axes.T
    outline = seen_along[ConvexHull(seen_along).vertices]
    points = line.points @ axes.T
    start, run = outline, np.roll(outline, -1, axis=0) - outline
    normal = np.column_stack([run[:, 1], -run[:, 0]]) / np.linalg.norm(run, axis=1, keepdims=True)
    beyond = np.einsum("pea,ea->pe", points[:, None] - start, normal)
    along = np.clip(np.einsum("pea,ea->pe", points[:, None] - start, run) / (run**2).sum(axis=1), 0, 1)
    apart = np.linalg.norm(points[:, None] - start - along[..., None] * run, axis=2).min(axis=1)
    return np.where((beyond <= 0).all(axis=1), -apart, apart)
