"""Between the patient's coordinates (LPS, mm) and a rehearsal's, whose origin is the middle of the organ."""

import numpy as np

from rehearsal.rehearsal import Rehearsal
from ultrasound.probe_manipulator import image_plane, pose_of_image_plane


def probe_in_patient(rehearsal: Rehearsal, pose: np.ndarray | None = None) -> np.ndarray:
    """The pose (4, 4) of the probe, in PLUS's axes, in the patient: now, or with the transducer at another pose (4, 4)."""
    plane = rehearsal.image_plane() if pose is None else image_plane(pose, rehearsal.size_mm[2], 1.0, 1.0)
    return shifted(plane.world_from_plane, rehearsal.origin)


def transducer_at(rehearsal: Rehearsal, probe: np.ndarray) -> np.ndarray:
    """The transducer's pose (4, 4) where the probe, in PLUS's axes, is at a pose (4, 4) in the patient."""
    return pose_of_image_plane(shifted(probe, -rehearsal.origin), rehearsal.size_mm[2])


def shifted(pose: np.ndarray, by_mm: np.ndarray) -> np.ndarray:
    """A pose (4, 4) moved by (3,) [mm]."""
    moved = pose.copy()
    moved[:3, 3] += by_mm
    return moved
