"""The scanner: what a probe at a pose shows of tissue, as CT, as echo, or both on the same plane."""

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

# What is around the organ where the picture shows no CT there [MRayl].
AROUND = {"background": None, "gel": 1.5, "air": 4e-4}
CT, B_MODE = "CT", "B-mode"
SHOWN: dict[Mode, tuple[str, ...]] = {"ct": (CT,), "b-mode": (B_MODE,), "both": (B_MODE, CT)}


@dataclass(frozen=True)
class ScannedAnatomy:
    """What is scanned, all in one frame [mm] in which it is at rest.

    ``hu`` (nx, ny, nz) and ``labels``, on the same grid, with ``index_from_mm`` (4, 4); ``tissues`` says which tissue a label is.
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
    """Begin with what an echo of an anatomy needs, on a thread of its own, while other things are made."""
    worker = ThreadPoolExecutor(1)
    values = worker.submit(properties, anatomy.hu, anatomy.labels, anatomy.tissues, anatomy.voxel_mm)
    worker.shutdown(wait=False)
    return values


class Scanner:
    """Pictures of ``pixels`` x ``pixels`` of an anatomy that an embedding carries along.

    ``outside`` (see ``CtSlice``), ``contact`` and ``contact_gap_mm`` (see ``BMode``) say what lies around the organ and what lets
    sound in. What a mode needs is made when it is first asked for, but for an ``echo`` begun before. Raises TissueError.
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
        echo: Future[np.ndarray] | None = None,
    ) -> None:
        check_tissues(anatomy.tissues)
        self.anatomy = anatomy
        self.embedding = embedding
        self.probe = probe
        self.plane = PlaneInTissue(embedding, pixels)
        self.outside, self.contact, self.contact_gap_mm = outside, contact, contact_gap_mm
        self._echo = echo

    @cached_property
    def slice(self) -> CtSlice:
        """The CT's side of the scanner."""
        ct = SampledVolume(self.anatomy.hu, self.anatomy.index_from_mm)
        return CtSlice(ct, self._organ, self.plane, self.outside)

    @cached_property
    def bmode(self) -> BMode:
        """The echo's side of the scanner."""
        values, self._echo = (self._echo or start_acoustics(self.anatomy)).result(), None
        tissue = SampledVolume(values, self.anatomy.index_from_mm, outside=0.0)
        return BMode(
            tissue,
            self._organ,
            self.plane,
            self.probe,
            float(self.anatomy.voxel_mm.mean()),
            self.contact,
            self.contact_gap_mm,
            AROUND[self.outside],
        )

    @cached_property
    def ground_truth(self) -> GroundTruthLabels:
        """What the pictures show, in truth."""
        tumour = self.anatomy.tumour
        return GroundTruthLabels(
            self.plane, self._organ, None if tumour is None else distance_volume(tumour, 1.0)
        )

    @cached_property
    def _organ(self) -> SampledVolume:
        return distance_volume(self.anatomy.organ)

    def locate(self, plane: ImagePlane) -> None:
        """Find the tissue on a plane, of which there is no picture yet."""
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
        """Grey values (pixels, pixels) uint8 of what a mode shows of a plane, by name, the first the one that matters."""
        self.locate(plane)
        show = {
            CT: lambda: self.slice.render(window_hu, level_hu),
            B_MODE: lambda: self.bmode.render(probe, detail_level),
        }
        return {name: show[name]() for name in SHOWN[mode]}
