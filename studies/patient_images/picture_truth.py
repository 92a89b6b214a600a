"""What is at each pixel of a B-mode image of a patient."""

from dataclasses import dataclass

import numpy as np

from studies.patient_images.patient_truth import PatientTruth
from ultrasound.probe import Probe

# The kidney's surroundings are what is so near to it; fat has these HU.
NEAR_MM = 12.0
FAT_HU = -150.0, -30.0
# Nearer to the array is its own vibration, deeper no longer the kidney.
DEPTHS_MM = 4.0, 45.0


@dataclass(frozen=True)
class PictureTruth:
    """Masks (rows, columns) of an image's pixels.

    ``kidney``: labelled as kidney, its sinus or lesion, at whatever depth, seen or not. ``seen``: reached by
    the scanlines, not behind gas, bone or stones. The others are what of the seen at DEPTHS_MM, without
    contrast agent, is parenchyma (``judged_kidney``), not kidney but within NEAR_MM of it (``surroundings``),
    and of these has FAT_HU (``fat``).
    """

    kidney: np.ndarray
    seen: np.ndarray
    judged_kidney: np.ndarray
    surroundings: np.ndarray
    fat: np.ndarray


def picture_truth(
    patient: PatientTruth, probe: Probe, world_from_plane: np.ndarray, shape: tuple[int, int]
) -> PictureTruth:
    """Return the truth of an image of a shape (rows, columns) at a pose (4, 4)."""
    place = pixel_places(probe, shape)
    world = place @ world_from_plane[:3, :2].T + world_from_plane[:3, 3]
    hu, distance = patient.hu.at(world), patient.kidney_mm.at(world)
    line, depth = probe.beam_coordinates(*np.moveaxis(place, -1, 0))
    nearest = np.clip(np.rint(line), 0, probe.number_of_scanlines - 1).astype(int)
    reached = (line >= -0.5) & (line <= probe.number_of_scanlines - 0.5) & (depth >= 0)
    seen = reached & (depth < patient.hidden_from_mm(probe, world_from_plane)[nearest])
    judged = seen & (depth >= DEPTHS_MM[0]) & (depth <= DEPTHS_MM[1]) & (patient.agent_mm.at(world) > 0)
    kidney = distance < 0
    surroundings = judged & ~kidney & (distance <= NEAR_MM)
    fat = surroundings & (hu >= FAT_HU[0]) & (hu <= FAT_HU[1])
    parenchyma = judged & (patient.parenchyma_mm.at(world) < 0)
    return PictureTruth(kidney, seen, parenchyma, surroundings, fat)


def pixel_places(probe: Probe, shape: tuple[int, int]) -> np.ndarray:
    """Return places (rows, columns, 2) (u, v) [mm] of the centres of an image's pixels."""
    to_probe = probe.image_to_probe(*shape)
    u = np.arange(shape[1]) * to_probe[0, 0] + to_probe[0, 3]
    v = np.arange(shape[0]) * to_probe[1, 1] + to_probe[1, 3]
    return np.stack(np.meshgrid(u, v), axis=-1)
