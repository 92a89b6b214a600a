"""Standard planes of a renal scan: long and short axis from the front, the side and the back, the hilum
and a pole.
"""

from collections.abc import Sequence

import numpy as np
import trimesh

from scenes.kidney_axes import KidneyAxes, kidney_axes
from ultrasound.probe import Probe

# Where no hilum is known, the front is towards the patient's.
ANTERIOR = np.array([0.0, -1.0, 0.0])
# Width of the band of surface that the array's face rests on, across the image plane [mm].
BAND_MM = 4.0


def standard_planes(
    organ: trimesh.Trimesh, hilum_mm: Sequence[float] | None, probe: Probe
) -> dict[str, np.ndarray]:
    """Return the poses (4, 4) by name, PLUS's axes of a probe to patient (LPS, mm); the face touches the
    organ at rest.

    Front and back are those of the kidney itself, across its polar axis and its hilum; the side is opposite
    the hilum. Where no hilum is known, which of the two sides it is is not known either, and the plane of the
    hilum passes through the centre.
    """
    axes = kidney_axes(organ, [], {}, hilum_mm)
    polar, hilar, front = _directions(axes)
    hilum = axes.centre if hilum_mm is None else np.asarray(hilum_mm, float)
    aslant = (front + hilar) / np.sqrt(2)
    beams = {
        "front, long axis": (-front, polar, axes.centre),
        "front, short axis": (-front, hilar, axes.centre),
        "side, long axis": (hilar, polar, axes.centre),
        "side, short axis": (hilar, front, axes.centre),
        "back, long axis": (front, polar, axes.centre),
        "back, short axis": (front, hilar, axes.centre),
        "hilum": (-aslant, polar, hilum),
        "lower pole": (polar, hilar, axes.centre),
    }
    return {name: _touching(organ, probe, *beam) for name, beam in beams.items()}


def _directions(axes: KidneyAxes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return unit vectors (3,) to the upper pole, to the hilum and to the front."""
    if axes.hilar is not None and axes.anterior is not None:
        return axes.polar, axes.hilar, axes.anterior
    front = ANTERIOR - (ANTERIOR @ axes.polar) * axes.polar
    front /= np.linalg.norm(front)
    return axes.polar, np.cross(axes.polar, front), front


def _touching(
    organ: trimesh.Trimesh, probe: Probe, beam: np.ndarray, lateral: np.ndarray, through: np.ndarray
) -> np.ndarray:
    """Return the pose (4, 4) whose face touches the organ, and whose central scanline passes through a
    point (3,).
    """
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([lateral, beam, np.cross(lateral, beam)])
    surface = (np.concatenate([organ.vertices, organ.triangles_center]) - through) @ pose[:3, :3]
    near = (np.abs(surface[:, 0]) <= probe.array_width_mm / 2) & (np.abs(surface[:, 2]) <= BAND_MM / 2)
    # A curved face bulges towards the tissue at its middle.
    radius = probe.radius_mm
    behind = radius - np.sqrt(np.maximum(radius**2 - surface[near, 0] ** 2, 0.0))
    pose[:3, 3] = through + (surface[near, 1] + behind).min() * beam
    return pose
