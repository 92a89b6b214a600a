"""What a way of the probe is worth, part by part."""

from dataclasses import dataclass

import numpy as np

from ultrasound.probe_manipulator import ProbeManipulator


@dataclass(frozen=True)
class ScoreTerms:
    """What a way was worth. Means are over its poses; a way that touches nothing has none."""

    seen: float
    """Share of the target that was in the picture, 0 to 1."""
    compression_mean_mm: float
    compression_max_mm: float
    over_limit: float
    """Share of poses at which the tissue is squeezed by more than the scene's warning, or had to be put right."""
    contact: float
    """Share of the picture's lines that touch."""
    incidence_deg: float
    """Angle between the probe's axis and the settled surface's normal."""
    path_mm: float
    """Of the face's middle, between passes too."""
    time_s: float
    reachable: float
    """Share of poses that the trocar lets an instrument hold."""

    @classmethod
    def nothing(cls) -> "ScoreTerms":
        """Of a way that has no pass."""
        return cls(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def faces_of(manipulator: ProbeManipulator, poses: np.ndarray) -> np.ndarray:
    """The middles (n, 3) of the face at poses (n, 4, 4) [mm]."""
    return poses[:, :3, 3] - manipulator.size_mm[2] / 2 * poses[:, :3, 2]


def path_mm(manipulator: ProbeManipulator, poses: np.ndarray) -> float:
    """How far the face's middle goes from pose to pose."""
    return float(np.linalg.norm(np.diff(faces_of(manipulator, poses), axis=0), axis=1).sum())


def incidence_deg(manipulator: ProbeManipulator, poses: np.ndarray) -> float:
    """The mean angle between the probe's axis and the settled surface's normal."""
    normals = np.stack([manipulator.surface_normal(face) for face in faces_of(manipulator, poses)])
    cosine = np.einsum("ij,ij->i", normals, poses[:, :3, 2])
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).mean())
