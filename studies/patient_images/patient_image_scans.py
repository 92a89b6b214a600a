"""Images of a patient's standard planes with a probe, each with its truth."""

from dataclasses import dataclass

import numpy as np

from rehearsal.rehearsal import scanned_anatomy
from scenes.anatomy import LoadedAnatomy
from scenes.scene import Scene
from sim.embedding import Unmoved
from studies.patient_images.picture_truth import PictureTruth, TruthVolumes, picture_truth
from studies.patient_images.standard_planes import standard_planes
from ultrasound.probe import Probe
from ultrasound.probe_manipulator import ImagePlane
from ultrasound.scanner import B_MODE, CT, Scanner

PIXELS = 512


@dataclass(frozen=True)
class PlaneScan:
    """One standard plane: CT and B-mode image (rows, columns) uint8, whether the scanlines reach a pixel, and the truth."""

    name: str
    pose: np.ndarray
    ct: np.ndarray
    b_mode: np.ndarray
    covered: np.ndarray
    truth: PictureTruth
    probe: Probe

    @property
    def pixel_mm(self) -> tuple[float, float]:
        """Height and width of a pixel."""
        matrix = self.probe.image_to_probe(*self.b_mode.shape)
        return float(matrix[1, 1]), float(matrix[0, 0])


def scan_patient(scene: Scene, anatomy: LoadedAnatomy, probe: Probe) -> list[PlaneScan]:
    """Return the scans of the standard planes of a patient whose kidney is labelled, at rest, with default settings."""
    assert anatomy.ct is not None
    scanned = scanned_anatomy(anatomy.organ, anatomy.ct, anatomy, np.zeros(3), scene.image.atlas)
    volumes = TruthVolumes.of(scanned)
    scanner = Scanner(scanned, Unmoved(), probe, PIXELS, "background", "tissue")
    scans = []
    for name, pose in standard_planes(anatomy.organ, scene, probe).items():
        plane = ImagePlane(pose, *probe.extent_mm)
        images = scanner.images(plane, probe, "both", "speckle", scene.image.window_hu, scene.image.level_hu)
        truth = picture_truth(volumes, probe, pose, images[B_MODE].shape)
        covered = scanner.bmode.covered.copy()
        scans.append(PlaneScan(name, pose, images[CT], images[B_MODE], covered, truth, probe))
    return scans
