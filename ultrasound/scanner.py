"""The scanner: CT slice and B-mode image on the same image plane of a probe."""

from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import trimesh

from sim.embedding import Embedding, Unmoved
from ultrasound.acoustics import check_tissues, properties
from ultrasound.bmode import BMode
from ultrasound.ct_slice import CtSlice
from ultrasound.ground_truth_labels import GroundTruthLabels
from ultrasound.image_plane import ImagePlane, PlaneInTissue
from ultrasound.probe import DetailLevel, Mode, Probe
from ultrasound.sampled_volume import SampledVolume, distance_volume

# Impedance around the organ where the image does not show the CT there [MRayl].
OUTSIDE_IMPEDANCE = {"background": None, "gel": 1.5, "air": 4e-4}
CT, B_MODE = "CT", "B-mode"
IMAGES_OF_MODE: dict[Mode, tuple[str, ...]] = {"ct": (CT,), "b-mode": (B_MODE,), "both": (B_MODE, CT)}


@dataclass(frozen=True)
class ScannedAnatomy:
    """The anatomy at rest, all in one coordinate system [mm].

    ``hu`` (nx, ny, nz) and ``labels`` on the same grid, with ``index_from_mm`` (4, 4); ``tissues`` are the tissues by label.
    """

    organ: trimesh.Trimesh
    hu: np.ndarray
    index_from_mm: np.ndarray
    labels: np.ndarray | None = None
    tissues: Mapping[int, str] = field(default_factory=dict)
    tumour: trimesh.Trimesh | None = None

    @property
    def voxel_mm(self) -> np.ndarray:
        """Distance of neighbouring voxels along each axis of the grid."""
        return np.linalg.norm(np.linalg.inv(self.index_from_mm[:3, :3]), axis=0)


def start_acoustics(anatomy: ScannedAnatomy) -> Future[np.ndarray]:
    """Start computing the acoustic properties that B-mode images need, on a thread of its own."""
    worker = ThreadPoolExecutor(1)
    values = worker.submit(properties, anatomy.hu, anatomy.labels, anatomy.tissues, anatomy.voxel_mm)
    worker.shutdown(wait=False)
    return values


class Scanner:
    """Images of ``pixels`` x ``pixels`` of an anatomy that an embedding deforms.

    ``outside`` see ``CtSlice``, ``contact`` and ``contact_gap_mm`` see ``BMode``. A mode is set up at its first image; ``acoustics``
    are properties whose computation has already been started. Raises TissueError.
    """

    def __init__(
        self,
        anatomy: ScannedAnatomy,
        embedding: Embedding | Unmoved,
        probe: Probe,
        pixels: int = 512,
        outside: str = "background",
        contact: str = "organ",
        contact_gap_mm: float = 1.5,
        acoustics: Future[np.ndarray] | None = None,
    ) -> None:
        check_tissues(anatomy.tissues)
        self.anatomy = anatomy
        self.embedding = embedding
        self.probe = probe
        self.plane = PlaneInTissue(embedding, pixels)
        self.outside, self.contact, self.contact_gap_mm = outside, contact, contact_gap_mm
        self._acoustics = acoustics

    @cached_property
    def slice(self) -> CtSlice:
        """The CT slice on the plane."""
        ct = SampledVolume(self.anatomy.hu, self.anatomy.index_from_mm)
        return CtSlice(ct, self._organ, self.plane, self.outside)

    @cached_property
    def bmode(self) -> BMode:
        """The B-mode image of the plane."""
        values, self._acoustics = (self._acoustics or start_acoustics(self.anatomy)).result(), None
        tissue = SampledVolume(values, self.anatomy.index_from_mm, outside=0.0)
        return BMode(
            tissue,
            self._organ,
            self.plane,
            self.probe,
            float(self.anatomy.voxel_mm.mean()),
            self.contact,
            self.contact_gap_mm,
            OUTSIDE_IMPEDANCE[self.outside],
        )

    @cached_property
    def ground_truth(self) -> GroundTruthLabels:
        """The ground-truth labels of the plane."""
        tumour = self.anatomy.tumour
        return GroundTruthLabels(
            self.plane, self._organ, None if tumour is None else distance_volume(tumour, 1.0)
        )

    @cached_property
    def _organ(self) -> SampledVolume:
        return distance_volume(self.anatomy.organ)

    def locate(self, plane: ImagePlane) -> None:
        """Find the tissue on a plane, without an image."""
        self.embedding.update()
        self.plane.locate(plane)

    def images(
        self,
        plane: ImagePlane,
        probe: Probe,
        mode: Mode,
        detail_level: DetailLevel,
        window_hu: float,
        level_hu: float,
    ) -> dict[str, np.ndarray]:
        """Return the images of a plane in a mode by name, grey values (pixels, pixels) uint8, the main one first."""
        self.locate(plane)
        render = {
            CT: lambda: self.slice.render(window_hu, level_hu),
            B_MODE: lambda: self.bmode.render(probe, detail_level),
        }
        return {name: render[name]() for name in IMAGES_OF_MODE[mode]}
