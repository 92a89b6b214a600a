"""Images of a patient's standard planes with a probe, each with its truth."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage

from rehearsal.deformed_anatomy import scanned_anatomy
from scenes.anatomy import LoadedAnatomy
from scenes.scene import Scene
from sim.embedding import Unmoved
from studies.patient_images.patient_truth import PatientTruth
from studies.patient_images.picture_truth import PictureTruth, picture_truth
from studies.patient_images.scanline_truth import ScanlineTruth, scanline_truth
from studies.patient_images.standard_planes import standard_planes
from ultrasound.acoustics import TissueVoxels
from ultrasound.probe import Probe
from ultrasound.probe_manipulator import ImagePlane
from ultrasound.scanned_anatomy import ScannedAnatomy
from ultrasound.scanner import B_MODE, CT, Scanner

PIXELS = 512
# Side of the square over which speckle is averaged.
AVERAGED_MM = 3.0


@dataclass(frozen=True)
class PlaneScan:
    """One standard plane: CT and B-mode image (rows, columns) uint8, and the truth.

    ``covered`` says whether the scanlines reach a pixel.
    """

    name: str
    pose: np.ndarray
    ct: np.ndarray
    b_mode: np.ndarray
    covered: np.ndarray
    truth: PictureTruth
    scanlines: ScanlineTruth
    probe: Probe

    @property
    def pixel_mm(self) -> tuple[float, float]:
        """Height and width of a pixel."""
        matrix = self.probe.image_to_probe(*self.b_mode.shape)
        return float(matrix[1, 1]), float(matrix[0, 0])

    @cached_property
    def averaged(self) -> np.ndarray:
        """The B-mode image, averaged over a square of AVERAGED_MM, of pixels that the scanlines reach."""
        size = [max(1, round(AVERAGED_MM / mm)) for mm in self.pixel_mm]
        total = ndimage.uniform_filter(np.where(self.covered, self.b_mode, 0).astype(np.float32), size)
        return total / np.maximum(ndimage.uniform_filter(self.covered.astype(np.float32), size), 1e-6)


@dataclass(frozen=True)
class ImagedPatient:
    """A patient in LPS, as scanned, with the truth."""

    scene: Scene
    anatomy: ScannedAnatomy
    truth: PatientTruth

    @classmethod
    def of(cls, scene: Scene, anatomy: LoadedAnatomy) -> "ImagedPatient":
        """Return a patient with a CT whose kidney is labelled."""
        assert anatomy.ct is not None
        scanned = scanned_anatomy(anatomy.organ, anatomy.ct, anatomy, np.zeros(3), scene.image.atlas)
        return cls(scene, scanned, PatientTruth.of(scanned))

    @property
    def voxels(self) -> TissueVoxels:
        """The tissue of each voxel, as classified."""
        return self.anatomy.voxels

    def scans(self, probe: Probe) -> Iterator[PlaneScan]:
        """Yield the scans of the standard planes, at rest, with default settings."""
        scanner = Scanner(self.anatomy, Unmoved(), probe, PIXELS, "background", "tissue")
        planes = standard_planes(self.anatomy.organ, self.scene.attachment.at_mm, probe)
        for name, pose in planes.items():
            yield self._scan(scanner, probe, name, pose)

    def _scan(self, scanner: Scanner, probe: Probe, name: str, pose: np.ndarray) -> PlaneScan:
        plane, image = ImagePlane(pose, *probe.extent_mm), self.scene.image
        shown = image.detail_level, image.window_hu, image.level_hu
        images = scanner.images(plane, probe, "both", *shown).by_name
        return PlaneScan(
            name,
            pose,
            images[CT],
            images[B_MODE],
            scanner.bmode.covered.copy(),
            picture_truth(self.truth, probe, pose, images[B_MODE].shape),
            scanline_truth(self.truth, probe, pose, scanner.bmode),
            probe,
        )
