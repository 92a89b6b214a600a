"""What is at each sample of the scanlines of a patient's B-mode image, and how strong its echo is."""

from dataclasses import dataclass

import numpy as np

from sim.fields import array_of
from studies.patient_images.patient_truth import PatientTruth, sample_depths
from ultrasound.bmode import BMode
from ultrasound.probe import Probe


@dataclass(frozen=True)
class ScanlineTruth:
    """Arrays (scanlines, samples) of one image, before the grey map, with gain and TGC.

    ``power`` is the mean square of the echo, linear. ``surface_mm`` is the signed distance of the sample's
    tissue from the organ's surface, negative inside, ``incidence_deg`` the angle between scanline and normal
    of that surface. ``parenchyma_mm`` and ``agent_mm`` as ``PatientTruth``; ``seen`` is not behind gas, bone
    or stones. ``depth_mm`` (samples,).
    """

    power: np.ndarray
    depth_mm: np.ndarray
    surface_mm: np.ndarray
    incidence_deg: np.ndarray
    parenchyma_mm: np.ndarray
    agent_mm: np.ndarray
    hu: np.ndarray
    seen: np.ndarray


def scanline_truth(
    patient: PatientTruth, probe: Probe, world_from_plane: np.ndarray, bmode: BMode
) -> ScanlineTruth:
    """Return the truth of the image that was rendered last, at a pose (4, 4)."""
    depth, place = sample_depths(probe), rest_of_samples(bmode, probe)
    along = probe.scanlines()[1] @ world_from_plane[:3, :2].T
    return ScanlineTruth(
        10 ** (array_of(bmode.decibel).astype(float) / 10),
        depth,
        patient.surface_mm.at(place),
        incidence_deg(patient, place, along),
        patient.parenchyma_mm.at(place),
        patient.agent_mm.at(place),
        patient.hu.at(place),
        depth < patient.hidden_from_mm(probe, world_from_plane)[:, None],
    )


def rest_of_samples(bmode: BMode, probe: Probe) -> np.ndarray:
    """Return where the tissue of each sample is at rest (scanlines, samples, 3) [mm]: the speed of sound
    displaces what is shown.
    """
    at = (np.arange(bmode.samples) + 0.5) / bmode.sound.stride_of(probe)
    first = at.astype(int)
    rest, share = array_of(bmode.sound.rest), (at - first)[:, None]
    return rest[:, first] * (1 - share) + rest[:, first + 1] * share


def incidence_deg(patient: PatientTruth, place: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Return angles (scanlines, samples) between scanlines of directions (scanlines, 3) and the normal of
    the organ's surface at places.
    """
    half = np.eye(3)
    normal = np.stack(
        [patient.surface_mm.at(place + step) - patient.surface_mm.at(place - step) for step in half], axis=-1
    )
    length = np.maximum(np.linalg.norm(normal, axis=-1), 1e-9)
    cosine = np.abs(np.einsum("lsk,lk->ls", normal, along)) / length
    return np.degrees(np.arccos(np.minimum(cosine, 1.0)))
