"""The scanner: CT slice, B-mode image, Doppler, signals and labels of an anatomy on a probe's image plane."""

from concurrent.futures import Future
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh
from trimesh.intersections import mesh_plane

from sim.embedding import Embedding, Unmoved
from ultrasound.acoustics import check_tissues
from ultrasound.anatomy_volumes import AnatomyVolumes
from ultrasound.bmode import BMode, Wavefront
from ultrasound.compounding import Compounding
from ultrasound.ct_slice import CTSlice
from ultrasound.doppler import Doppler
from ultrasound.ground_truth_labels import GroundTruthLabels
from ultrasound.iq_signal import IQSignal, iq_signal
from ultrasound.plane_in_tissue import PlaneInTissue
from ultrasound.probe import DetailLevel, DopplerMode, Mode, Probe
from ultrasound.probe_manipulator import ImagePlane
from ultrasound.propagation import Propagation
from ultrasound.sampled_volume import AIR_HU
from ultrasound.scanned_anatomy import ScannedAnatomy

# HU and impedance [MRayl] around the organ; None where the CT is shown there.
OUTSIDE: dict[str, tuple[float | None, float | None]] = {
    "background": (None, None),
    "gel": (0.0, 1.5),
    "air": (AIR_HU, 4e-4),
    "fluid": (None, None),
}
CT, B_MODE, DOPPLER = "CT", "B-mode", "Doppler"
IMAGES_OF_MODE: dict[Mode, tuple[str, ...]] = {"ct": (CT,), "b-mode": (B_MODE,), "both": (B_MODE, CT)}


@dataclass(frozen=True, eq=False)
class PlaneImages:
    """The images of one plane, and what they show.

    ``by_name`` has grey values (rows, columns) uint8, the main image first. ``version`` is that of the
    ``AnatomyVolumes``, ``location`` the number of the plane's location (``PlaneInTissue``).
    """

    by_name: dict[str, np.ndarray]
    plane: ImagePlane
    probe: Probe
    version: int
    location: int


def shows_ct(outside: str) -> bool:
    """Whether the CT is shown around the organ."""
    return OUTSIDE[outside][0] is None


class Scanner:
    """Images of at most ``pixels`` x ``pixels`` of an anatomy that an embedding deforms.

    An image depends on its arguments, the volumes and the present embedding alone, on no image before it: all
    else that is held are tables and memory of the modes. A mode is set up at its first image.

    ``outside`` is what is shown outside the organ: ``background``, the CT around it, which deforms with the
    organ as far as the embedding reaches; ``gel`` (0 HU); ``air`` (-1000 HU); ``fluid``, the CT, and sound
    passes through irrigation fluid in the gap. ``contact`` and ``contact_gap_mm`` see ``Propagation``.
    ``acoustics`` are properties whose computation has already been started. Raises TissueError.
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
        self.volumes = AnatomyVolumes(anatomy, acoustics)
        self.embedding = embedding
        self.probe = probe
        self.plane = PlaneInTissue(embedding, pixels)
        self.outside_hu, self.around = OUTSIDE[outside]
        self.has_fluid = outside == "fluid"
        self.contact, self.contact_gap_mm = contact, contact_gap_mm

    @cached_property
    def ct_slice(self) -> CTSlice:
        """The CT of the plane."""
        return CTSlice(self.plane, self.volumes.ct, self.volumes.organ, self.outside_hu)

    @cached_property
    def bmode(self) -> BMode:
        """The B-mode image of the plane, not compounded."""
        return self._new_bmode()

    @cached_property
    def compounding(self) -> Compounding:
        """The B-mode image of the plane, compounded as a probe is set."""
        return Compounding(self.bmode, self._new_bmode)

    @cached_property
    def straight_doppler(self) -> Doppler:
        """Doppler along the scanlines of the B-mode image."""
        return Doppler(self.bmode.sound, self.bmode, self.volumes.flow)

    @cached_property
    def steered_doppler(self) -> Doppler:
        """Doppler along scanlines of its own."""
        return Doppler(self._new_propagation(), self.bmode, self.volumes.flow)

    @cached_property
    def ground_truth(self) -> GroundTruthLabels:
        """The ground-truth labels of the plane."""
        return GroundTruthLabels(self.plane, self.volumes.remnant, self.volumes.tumour)

    def _new_bmode(self) -> BMode:
        return BMode(self._new_propagation(), self.probe)

    def _new_propagation(self) -> Propagation:
        volumes, around = self.volumes, (self.contact, self.contact_gap_mm, self.around, self.has_fluid)
        voxel_mm = float(volumes.anatomy.voxels.spacing_mm.max())
        return Propagation(volumes.tissue, volumes.organ, self.plane, self.probe, voxel_mm, *around)

    def locate(self, plane: ImagePlane, shape: tuple[int, int] | None = None) -> None:
        """Find the tissue on a plane, without an image; ``shape`` (rows, columns) is that of its labels."""
        self.embedding.update()
        self.plane.locate(plane, shape)

    def images(
        self,
        plane: ImagePlane,
        probe: Probe,
        mode: Mode,
        detail_level: DetailLevel,
        window_hu: float,
        level_hu: float,
        shape: tuple[int, int] | None = None,
    ) -> PlaneImages:
        """The images of a plane in a mode, of a shape (rows, columns).

        No row or column is beyond the scene's number of pixels, which is also the default.
        """
        self.locate(plane, shape)
        render = {
            CT: lambda: self.ct_slice.render(window_hu, level_hu),
            B_MODE: lambda: self.compounding.render(probe, detail_level),
        }
        by_name = {name: render[name]() for name in IMAGES_OF_MODE[mode]}
        return PlaneImages(by_name, plane, probe, self.volumes.version, self.plane.location)

    def doppler(
        self, images: PlaneImages, mode: DopplerMode, time_s: float = 0.0, clamped: bool = False
    ) -> np.ndarray:
        """The B-mode image of the plane located last with Doppler over it, (rows, columns, 3) uint8.

        See ``Doppler.render``. Raises ValueError for images of another plane.
        """
        grey = self._b_mode_of(images)
        steered = images.probe.colour_steering_deg != 0.0
        doppler = self.steered_doppler if steered else self.straight_doppler
        return doppler.render(images.probe, grey, mode, time_s, clamped)

    def iq(
        self, images: PlaneImages, before: ImagePlane | None, wavefront: Wavefront, phase_reference: int
    ) -> IQSignal:
        """IQ and RF signals of the B-mode image of the plane located last.

        ``before`` is the plane of the image before, ``wavefront`` the reference of phases, with its number.
        Raises ValueError for images of another plane.
        """
        self._b_mode_of(images)
        probe = images.probe
        signals = self.bmode.iq_of_last(probe, wavefront)
        return iq_signal(*signals, probe, images.plane, before, phase_reference)

    def _b_mode_of(self, images: PlaneImages) -> np.ndarray:
        """The B-mode image, whose scanlines the scanner still has."""
        if images.location != self.plane.location or B_MODE not in images.by_name:
            raise ValueError("no B-mode image of the plane located last: expected the images made last")
        return images.by_name[B_MODE]


def plane_section(vertices: np.ndarray, faces: np.ndarray, plane_from_world: np.ndarray) -> np.ndarray:
    """The section of a closed surface (v, 3), (f, 3) [mm] with the plane w = 0: segments (n, 2, 2) of (u, v)
    [mm].

    ``plane_from_world`` (4, 4) is rigid: u to the marked side, v down into the tissue, w out of the plane.
    """
    in_plane = vertices @ plane_from_world[:3, :3].T + plane_from_world[:3, 3]
    surface = trimesh.Trimesh(in_plane, faces, process=False)
    return mesh_plane(surface, plane_normal=[0.0, 0.0, 1.0], plane_origin=[0.0, 0.0, 0.0])[..., :2]
