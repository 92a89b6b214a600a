"""Measurements for a partial nephrectomy: compression, contact, and the tumour's distance, depth, shift,
visibility and margin.
"""

from dataclasses import dataclass
from typing import Any

import igl
import numpy as np

from rehearsal.deformed_anatomy import DeformedAnatomy
from ultrasound.array_contact import depth_in, face_points, footprint, measure_contact
from ultrasound.probe import Probe

# Around the probe, as far as this, its penetration is measured in the fine surface.
AROUND_MM = 5.0


@dataclass(frozen=True)
class Measurement:
    """Lengths in mm, forces in N; None where there is no tumour, or none on the image plane."""

    compression_mm: float
    """Greatest compression of the tissue in front of the array face
    (``ultrasound.array_contact.ArrayContact``).
    """
    contact_mm2: float
    """Area of the array face in contact."""
    to_tumour_mm: float | None = None
    """Distance from the array face to the nearest point of the tumour."""
    tumour_depth_mm: float | None = None
    """Distance from the organ's deformed surface to the nearest point of the tumour; 0 if that is outside."""
    tumour_shift_mm: float | None = None
    """Displacement of the tumour's centroid from the CT."""
    in_view: float | None = None
    """Share of the tumour's outline on the image plane that is in the image, 0 to 1."""
    margin_mm: float | None = None
    """Least width of tissue that the image shows beside and below that outline; negative if it is cut off."""
    force_n: float | None = None
    """Force [N] of the tissue on the probe."""
    torque_n_mm: float | None = None
    """Torque [N mm] of that force about the centre of the array face."""
    sliding_share: float | None = None
    """Share of the contact with the probe that slides, by its normal force, 0 to 1."""
    friction_ratio: float | None = None
    """Tangential over normal force on the probe, summed over the contact points."""
    penetration_mm: float = 0.0
    """Depth of the array face in the deformed organ, at its centre, edges and corners."""
    lag_mm: float = 0.0
    """How far the probe is behind the hand."""


def measure(anatomy: DeformedAnatomy, probe: Probe, touches: np.ndarray) -> Measurement:
    """Measure an anatomy as it is shown; ``touches`` (n,): which scanlines are in contact."""
    organ, now = anatomy.organ, anatomy.vertices
    pressed = measure_contact(
        anatomy.pose, anatomy.case.size_mm, probe.radius_mm, now, np.asarray(organ.vertices), organ.faces
    )
    always: dict[str, Any] = dict(
        compression_mm=pressed.compression_mm,
        contact_mm2=pressed.area_mm2,
        penetration_mm=penetration_of(anatomy),
        lag_mm=anatomy.frame.lag_mm,
    )
    wrench = anatomy.frame.wrench
    if wrench is not None:
        always |= dict(
            force_n=float(np.linalg.norm(wrench[:3])),
            torque_n_mm=float(np.linalg.norm(wrench[3:])),
            sliding_share=anatomy.frame.sliding_share,
            friction_ratio=anatomy.frame.friction_ratio,
        )
    outline = anatomy.tumour_outline()
    if outline is None or anatomy.tumour is None:
        return Measurement(**always)
    tumour = anatomy.tumour_vertices
    middle, before = tumour.mean(axis=0), np.asarray(anatomy.tumour.vertices).mean(axis=0)
    return Measurement(
        **always,
        to_tumour_mm=_to_tumour_mm(anatomy, probe, tumour),
        tumour_depth_mm=_depth_mm(tumour, now, organ.faces),
        tumour_shift_mm=float(np.linalg.norm(middle - before)),
        **_in_image(outline, probe, touches),
    )


def penetration_of(anatomy: DeformedAnatomy) -> float:
    """Depth [mm] of the array face in the deformed organ: of its centre, edges and corners; 0 outside."""
    points = footprint(anatomy.case.probe)
    places = points @ anatomy.pose[:3, :3].T + anatomy.pose[:3, 3]
    fine, vertices = anatomy.fine_organ()
    coarse = vertices[: fine.coarse_count]
    local = np.abs((coarse - anatomy.pose[:3, 3]) @ anatomy.pose[:3, :3])
    is_near = (local < np.array(anatomy.case.size_mm) / 2 + AROUND_MM).all(axis=1)
    return depth_in(places, vertices, fine.faces_where(is_near))


def _to_tumour_mm(anatomy: DeformedAnatomy, probe: Probe, tumour: np.ndarray) -> float:
    points = face_points(anatomy.case.size_mm, probe.radius_mm)[0]
    places = points @ anatomy.pose[:3, :3].T + anatomy.pose[:3, 3]
    return float(np.sqrt(_nearest(places, tumour, anatomy.tumour.faces)[0].min()))  # type: ignore[union-attr]


def _depth_mm(tumour: np.ndarray, organ: np.ndarray, faces: np.ndarray) -> float:
    """Depth of the tumour's nearest vertex under the organ's surface."""
    squared, face, near = _nearest(tumour, organ, faces)
    a, b, c = np.moveaxis(organ[faces[face]], 1, 0)
    outside = np.einsum("ij,ij->i", tumour - near, np.cross(b - a, c - a)) > 0
    return float(np.sqrt(np.where(outside, 0.0, squared).min()))


def _nearest(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, ...]:
    """Squared distances of points (n, 3) to a surface, the nearest faces and the nearest points."""
    return igl.point_mesh_squared_distance(
        np.ascontiguousarray(points), np.ascontiguousarray(vertices), np.ascontiguousarray(faces, np.int64)
    )


def _in_image(outline_mm: np.ndarray, probe: Probe, touches: np.ndarray) -> dict[str, Any]:
    """Share of an outline (n, 2, 2) in the image, and the margin that the image shows around it."""
    if len(outline_mm) == 0:
        return dict(in_view=None, margin_mm=None)
    middle, length = outline_mm.mean(axis=1), np.linalg.norm(outline_mm[:, 1] - outline_mm[:, 0], axis=1)
    line, depth = probe.beam_coordinates(*middle.T)
    last = probe.number_of_scanlines - 1
    aside = np.minimum(line + 0.5, last + 0.5 - line) * probe.line_spacing_mm(np.maximum(depth, 0.0))
    margin = np.minimum(aside, probe.depth_mm - depth)
    shown = (margin >= 0) & (depth >= 0) & touches[np.clip(np.rint(line).astype(int), 0, last)]
    return dict(in_view=float(length[shown].sum() / length.sum()), margin_mm=float(margin.min()))
