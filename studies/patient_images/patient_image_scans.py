"""Images of a patient's standard planes with a probe, each with its truth."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh
from scipy import ndimage

from rehearsal.deformed_anatomy import scanned_anatomy
from scenes.anatomy import LoadedAnatomy
from scenes.kidney_axes import KidneyAxes, kidney_axes
from scenes.scene import Scene
from sim.embedding import Unmoved
from studies.patient_images.patient_truth import (
    PatientTruth,
    PictureTruth,
    ScanlineTruth,
    picture_truth,
    scanline_truth,
)
from ultrasound.probe import Probe
from ultrasound.probe_manipulator import ImagePlane
from ultrasound.scanned_anatomy import ScannedAnatomy
from ultrasound.scanner import B_MODE, CT, Scanner

# Where no hilum is known, the front is towards the patient's.
ANTERIOR = np.array([0.0, -1.0, 0.0])
# Width of the band of surface that the array's face rests on, across the image plane [mm].
BAND_MM = 4.0


def standard_planes(
    organ: trimesh.Trimesh, hilum_mm: Sequence[float] | None, probe: Probe
) -> dict[str, np.ndarray]:
    """Poses (4, 4) by name, PLUS's axes of a probe to patient (LPS, mm); the face touches the organ at rest.

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
    """Unit vectors (3,) to the upper pole, to the hilum and to the front."""
    if axes.hilar is not None and axes.anterior is not None:
        return axes.polar, axes.hilar, axes.anterior
    front = ANTERIOR - (ANTERIOR @ axes.polar) * axes.polar
    front /= np.linalg.norm(front)
    return axes.polar, np.cross(axes.polar, front), front


def _touching(
    organ: trimesh.Trimesh, probe: Probe, beam: np.ndarray, lateral: np.ndarray, through: np.ndarray
) -> np.ndarray:
    """Pose (4, 4) whose face touches the organ and whose central scanline meets a point (3,)."""
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([lateral, beam, np.cross(lateral, beam)])
    surface = (np.concatenate([organ.vertices, organ.triangles_center]) - through) @ pose[:3, :3]
    near = (np.abs(surface[:, 0]) <= probe.array_width_mm / 2) & (np.abs(surface[:, 2]) <= BAND_MM / 2)
    # A curved face bulges towards the tissue at its middle.
    radius = probe.radius_mm
    behind = radius - np.sqrt(np.maximum(radius**2 - surface[near, 0] ** 2, 0.0))
    pose[:3, 3] = through + (surface[near, 1] + behind).min() * beam
    return pose


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
        """A patient with a CT whose kidney is labelled."""
        assert anatomy.ct is not None
        scanned = scanned_anatomy(anatomy.organ, anatomy.ct, anatomy, np.zeros(3), scene.image.atlas)
        return cls(scene, scanned, PatientTruth.of(scanned))

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
