"""The scanner: CT slice, B-mode image, Doppler, signals and ground-truth labels of an anatomy on the image plane of a probe.

CT slice: image plane -> deformed tetrahedra -> voxels at rest (the paper's method).
"""

from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import taichi as ti
import taichi.math as tm
import trimesh
from trimesh.intersections import mesh_plane

from sim.embedding import Embedding, Unmoved
from sim.kernels import kernel
from ultrasound.acoustics import TissueVoxels, check_tissues, stored_properties
from ultrasound.blood_flow import stored_flow
from ultrasound.bmode import BMode, Wavefront
from ultrasound.crater import Box, Crater
from ultrasound.doppler import Doppler
from ultrasound.ground_truth_labels import GroundTruthLabels
from ultrasound.iq_signal import IQSignal, iq_signal
from ultrasound.plane_in_tissue import PlaneInTissue
from ultrasound.probe import DetailLevel, DopplerMode, Mode, Probe
from ultrasound.probe_manipulator import ImagePlane
from ultrasound.propagation import Propagation
from ultrasound.sampled_volume import AIR_HU, LANES, SampledVolume, distance_volume

# HU and impedance [MRayl] around the organ where the image does not show the CT there.
OUTSIDE: dict[str, tuple[float, float | None]] = {
    "background": (0.0, None),
    "gel": (0.0, 1.5),
    "air": (AIR_HU, 4e-4),
    "fluid": (0.0, None),
}
CT, B_MODE, DOPPLER = "CT", "B-mode", "Doppler"
IMAGES_OF_MODE: dict[Mode, tuple[str, ...]] = {"ct": (CT,), "b-mode": (B_MODE,), "both": (B_MODE, CT)}


@dataclass(frozen=True)
class ScannedAnatomy:
    """The anatomy at rest, all in one coordinate system [mm].

    ``hu`` (nx, ny, nz) and ``labels`` on the same grid, with ``index_from_mm`` (4, 4); ``tissues`` are the tissues by label. ``classify``
    returns the tissue of every voxel, on a grid of its own; without it, what has no label has the acoustic properties of its HU.
    """

    organ: trimesh.Trimesh
    hu: np.ndarray
    index_from_mm: np.ndarray
    labels: np.ndarray | None = None
    tissues: Mapping[int, str] = field(default_factory=dict)
    tumour: trimesh.Trimesh | None = None
    classify: Callable[[], TissueVoxels] | None = None

    @cached_property
    def voxels(self) -> TissueVoxels:
        """The tissue of each voxel: classified, or as labelled."""
        if self.classify is not None:
            return self.classify()
        return TissueVoxels(self.hu, self.labels, self.tissues, self.index_from_mm)

    @property
    def voxel_mm(self) -> np.ndarray:
        """Distance of neighbouring voxels along each axis of the grid."""
        return np.linalg.norm(np.linalg.inv(self.index_from_mm[:3, :3]), axis=0)


def shows_ct(outside: str) -> bool:
    """Whether the CT is shown around the organ."""
    return OUTSIDE[outside][1] is None


def start_acoustics(anatomy: ScannedAnatomy) -> Future[np.ndarray]:
    """Start computing the acoustic properties that B-mode images need, on a thread of its own."""
    worker = ThreadPoolExecutor(1)
    values = worker.submit(lambda: stored_properties(anatomy.voxels))
    worker.shutdown(wait=False)
    return values


class Scanner:
    """Images of at most ``pixels`` x ``pixels`` of an anatomy that an embedding deforms.

    ``outside`` is what is shown outside the organ: ``background``, the CT around it, which deforms with the organ as far as the
    embedding reaches; ``gel`` (0 HU); ``air`` (-1000 HU); ``fluid``, the CT, and sound passes through irrigation fluid in the gap. ``contact`` and ``contact_gap_mm`` see ``Propagation``. A mode is set up at its
    first image; ``acoustics`` are properties whose computation has already been started. Raises TissueError.
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
        self.outside_hu, self.around = OUTSIDE[outside]
        self.show_background, self.has_fluid = shows_ct(outside), outside == "fluid"
        self.contact, self.contact_gap_mm = contact, contact_gap_mm
        self._acoustics = acoustics
        self.crater: Crater | None = None
        # Volumes with the crater, and what the voxels that it changed were before.
        self._changed: list[tuple[SampledVolume, Box, np.ndarray]] = []
        self._dopplers: dict[bool, Doppler] = {}
        self._steered: dict[float, BMode] = {}
        # The last B-mode image, for persistence.
        self._last: np.ndarray | None = None
        self._last_settings: dict[str, object] = {}

    @cached_property
    def ct(self) -> SampledVolume:
        """HU at rest."""
        return self._with_crater("ct", SampledVolume(self.anatomy.hu, self.anatomy.index_from_mm))

    @cached_property
    def organ(self) -> SampledVolume:
        """Signed distance from the organ's surface at rest [mm], negative inside; a crater with fluid counts as inside."""
        return self._with_crater("organ", distance_volume(self.anatomy.organ))

    @cached_property
    def bmode(self) -> BMode:
        """The B-mode image of the plane."""
        return BMode(self._propagation(), self.probe)

    @cached_property
    def tissue(self) -> SampledVolume:
        """Acoustic properties at rest."""
        values, self._acoustics = (self._acoustics or start_acoustics(self.anatomy)).result(), None
        to_index = self.anatomy.voxels.index_from_mm
        return self._with_crater("tissue", SampledVolume(values, to_index, outside=0.0))

    @cached_property
    def flow(self) -> SampledVolume:
        """Blood flow at rest, of ``blood_flow.CHANNELS``; no flow where the anatomy has no vessels."""
        voxels = self.anatomy.voxels
        low, values = stored_flow(voxels)
        values = values.astype(np.float32)
        axes = np.linalg.inv(voxels.index_from_mm[:3, :3]) / voxels.spacing_mm
        values[..., :3] = values[..., :3] @ axes.T.astype(np.float32)
        from_mm = voxels.index_from_mm.copy()
        from_mm[:3, 3] -= low
        return self._with_crater("flow", SampledVolume(values, from_mm, outside=0.0))

    def set_crater(self, crater: Crater | None) -> None:
        """Replace the tissue in a crater by what fills it, or with None restore all tissue."""
        for volume, box, values in self._changed:
            volume.set_values(box, values)
        self._changed.clear()
        self.crater, self._last = crater, None
        # Built anew when somebody asks for it.
        self.__dict__.pop("ground_truth", None)
        for name in ("ct", "organ", "tissue", "flow"):
            if name in self.__dict__:
                self._with_crater(name, self.__dict__[name])

    def _with_crater(self, name: str, volume: SampledVolume) -> SampledVolume:
        """A volume of this scanner, with the crater in it if there is one."""
        crater = self.crater
        if crater is None or (name == "organ" and crater.filling == "fluid"):
            return volume
        if name == "organ":
            box, values = crater.without(volume)
        else:
            content = {"ct": crater.hu, "tissue": crater.acoustics, "flow": lambda: np.zeros(1, np.float32)}
            box, values = crater.replaced(volume, content[name]())
        self._changed.append((volume, box, volume.values(box)))
        volume.set_values(box, values)
        return volume

    def _propagation(self) -> Propagation:
        voxel_mm = float(self.anatomy.voxels.spacing_mm.max())
        around = self.contact, self.contact_gap_mm, self.around, self.has_fluid
        return Propagation(self.tissue, self.organ, self.plane, self.probe, voxel_mm, *around)

    def iq(
        self,
        probe: Probe,
        plane: ImagePlane,
        before: ImagePlane | None,
        wavefront: Wavefront,
        phase_reference: int,
    ) -> IQSignal:
        """Return IQ and RF signals of the B-mode image of a plane that was made last, in tissue that has not moved.

        ``before`` is the plane of the image before, ``wavefront`` the reference of phases, with its number.
        """
        return iq_signal(*self.bmode.iq_of_last(probe, wavefront), probe, plane, before, phase_reference)

    def doppler(
        self, probe: Probe, grey: np.ndarray, mode: DopplerMode, time_s: float = 0.0, clamped: bool = False
    ) -> np.ndarray:
        """Return the B-mode image ``grey`` that was made last, with Doppler (rows, columns, 3) uint8: see ``Doppler.render``."""
        steered = probe.colour_steering_deg != 0.0
        if steered not in self._dopplers:
            sound = self._propagation() if steered else self.bmode.sound
            self._dopplers[steered] = Doppler(sound, self.bmode, self.flow)
        return self._dopplers[steered].render(probe, grey, mode, time_s, clamped)

    @cached_property
    def ground_truth(self) -> GroundTruthLabels:
        """The ground-truth labels of the plane."""
        tumour = self.anatomy.tumour
        return GroundTruthLabels(
            self.plane,
            self._without_crater(distance_volume(self.anatomy.organ)),
            None if tumour is None else self._without_crater(distance_volume(tumour, 1.0)),
        )

    def _without_crater(self, distance: SampledVolume) -> SampledVolume:
        """Signed distances from what remains, where there is a crater."""
        if self.crater is not None:
            distance.set_values(*self.crater.without(distance))
        return distance

    def locate(self, plane: ImagePlane, shape: tuple[int, int] | None = None) -> None:
        """Find the tissue on a plane, without an image; ``shape`` (rows, columns) is that of the next images."""
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
        persistence: float = 0.0,
    ) -> dict[str, np.ndarray]:
        """Return the images of a plane in a mode by name, grey values of a shape (rows, columns) uint8, the main one first.

        No row or column is beyond the scene's number of pixels, which is also the default. ``persistence`` is the share of the last B-mode
        image in the next.
        """
        self.locate(plane, shape)
        if mode == "ct":
            self._last = None
        render = {
            CT: lambda: self.ct_slice(window_hu, level_hu),
            B_MODE: lambda: self.b_mode_image(probe, detail_level, persistence),
        }
        return {name: render[name]() for name in IMAGES_OF_MODE[mode]}

    def b_mode_image(self, probe: Probe, detail_level: DetailLevel, persistence: float = 0.0) -> np.ndarray:
        """Return the B-mode image (rows, columns) uint8 of the plane located last, with compounding and persistence."""
        image = self._compounded(probe, detail_level)
        if persistence == 0.0:
            # An image of another shape is one that is saved beside those that are shown.
            if self._last is not None and self._last.shape == image.shape:
                self._last = None
            return image
        settings = probe.model_dump()
        if self._last is None or self._last.shape != image.shape or self._last_settings != settings:
            self._last, self._last_settings = image.astype(np.float32), settings
        self._last += (1 - persistence) * (image - self._last)
        return np.rint(self._last).astype(np.uint8)

    def _compounded(self, probe: Probe, detail_level: DetailLevel) -> np.ndarray:
        """Return the mean of images that are steered by different angles, where these reach."""
        angles = probe.compound_angles_deg[1:]
        self._steered = {angle: image for angle, image in self._steered.items() if angle in angles}
        first = self.bmode.render(probe, detail_level)
        if not angles:
            return first
        total, count = first.astype(np.float32), np.ones(first.shape, np.float32)
        for angle in angles:
            if angle not in self._steered:
                self._steered[angle] = BMode(self._propagation(), self.probe)
            steered = probe.model_copy(update={"steering_deg": angle})
            total += self._steered[angle].render(steered, detail_level)
            count += self._steered[angle].covered
        # The image is as wide as without compounding.
        return np.where(self.bmode.covered, np.rint(total / count), 0).astype(np.uint8)

    def ct_slice(self, window_hu: float, level_hu: float) -> np.ndarray:
        """Return grey values (rows, columns) uint8, 0 to 255 over the window, of the plane located last, at pixel centres."""
        image = np.empty(self.plane.shape, np.uint8)
        # Fields must exist before the kernel that reads them is compiled.
        _ = self.ct, self.organ
        self._window(*self.plane.grid_mm, window_hu, level_hu, image)
        return image

    @kernel
    def _window(
        self,
        pixel_mm: tm.vec2,
        first_mm: tm.vec2,
        window_hu: float,
        level_hu: float,
        image: ti.types.ndarray(ti.u8, ndim=2),
    ):
        columns = image.shape[1]
        for row, packet in ti.ndrange(image.shape[0], (columns + LANES - 1) // LANES):
            hu = self.hounsfield(row, packet * LANES, pixel_mm, first_mm, columns - 1)
            grey = ti.min(ti.max((hu - level_hu) / window_hu + 0.5, 0.0), 1.0) * 255.0 + 0.5
            for lane in ti.static(range(LANES)):
                if packet * LANES + lane < columns:
                    image[row, packet * LANES + lane] = ti.cast(grey[lane], ti.u8)

    @ti.func
    def hounsfield(self, row, first, pixel_mm, first_mm, last):
        """Return HU of LANES pixels of a row, whose last column is ``last``."""
        x, y, z, in_line = self.plane.rest_lanes(row, first, pixel_mm, first_mm, last)
        hu = self.ct.sample_lanes(x, y, z, in_line)
        if ti.static(not self.show_background):
            for lane in ti.static(range(LANES)):
                column = ti.min(first + lane, last)
                if not self.in_organ(row, column, ti.Vector([x[lane], y[lane], z[lane]])):
                    hu[lane] = self.outside_hu
        return hu

    @ti.func
    def in_organ(self, row, column, rest):
        """Whether the tissue of a pixel, at a rest position [mm], is of the organ."""
        return self.plane.is_tissue(row, column) and self.organ.sample(rest) <= 0.0


def plane_section(vertices: np.ndarray, faces: np.ndarray, plane_from_world: np.ndarray) -> np.ndarray:
    """Return the section of a closed surface (v, 3), (f, 3) [mm] with the plane w = 0: segments (n, 2, 2) of (u, v) [mm].

    ``plane_from_world`` (4, 4) is rigid: u to the marked side, v down into the tissue, w out of the plane.
    """
    in_plane = vertices @ plane_from_world[:3, :3].T + plane_from_world[:3, 3]
    surface = trimesh.Trimesh(in_plane, faces, process=False)
    return mesh_plane(surface, plane_normal=[0.0, 0.0, 1.0], plane_origin=[0.0, 0.0, 0.0])[..., :2]
