"""Images of an anatomy at rest for a list of probe poses, and their files."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter

import numpy as np

from rehearsal.deformed_anatomy import scanned_anatomy
from rehearsal.image_and_surface_files import save_images
from scenes.anatomy import Grid, LoadedAnatomy
from scenes.atomic_files import atomic_write
from scenes.scene import Image
from sim.embedding import Unmoved
from ultrasound.blood_flow import SYSTOLE_S
from ultrasound.bmode import Wavefront
from ultrasound.iq_signal import save_iq
from ultrasound.probe import DopplerMode, Probe
from ultrasound.probe_manipulator import ImagePlane
from ultrasound.scanner import DOPPLER, PlaneImages, Scanner
from ultrasound.sweep_file import LabelledSweep

FRAMES_PER_SECOND = 30
# A pose that turns further from the wavefront by which phases are compared begins another one.
MOST_TURNED_DEG = 3.0


class PoseScans:
    """Images of one probe at poses, in the order of the calls: first ``images``, then the others of the same
    pose.

    ``rows`` describe the images that were saved, ``ms`` are the times of each pose, ``empty`` counts poses
    that show nothing of the organ.
    """

    def __init__(
        self,
        anatomy: LoadedAnatomy,
        ct: Grid,
        probe: Probe,
        settings: Image,
        contact: str,
        out: Path,
    ) -> None:
        self.probe, self.settings, self.out = probe, settings, out
        scanned = scanned_anatomy(anatomy.organ, ct, anatomy, np.zeros(3), settings.atlas)
        # Through the organ alone sound enters as in a rehearsal, perhaps through fluid.
        wet = contact == "organ" and settings.outside == "fluid"
        outside, gap_mm = (
            ("fluid", settings.coupling_gap_mm) if wet else ("background", settings.contact_gap_mm)
        )
        self.scanner = Scanner(scanned, Unmoved(), probe, settings.pixels, outside, contact, gap_mm)
        self.rows: list[dict] = []
        self.ms: list[float] = []
        self.empty = 0
        self._planes: list[ImagePlane] = []
        self._wavefronts: list[Wavefront] = []
        self._sweep: LabelledSweep | None = None

    @contextmanager
    def recording(self, records: bool) -> Iterator[None]:
        """Record the images as a tracked sweep meanwhile, if asked to."""
        self._sweep = LabelledSweep(self.out, "sweep", self.probe) if records else None
        yield
        if self._sweep is not None:
            self._sweep.close()

    def images(self, pose: np.ndarray) -> PlaneImages:
        """The images of a pose (4, 4)."""
        began = perf_counter()
        self._planes.append(ImagePlane(pose, *self.probe.extent_mm))
        shown = (
            self.settings.mode,
            self.settings.detail_level,
            self.settings.window_hu,
            self.settings.level_hu,
        )
        images = self.scanner.images(self._planes[-1], self.probe, *shown)
        self.ms.append(1000 * (perf_counter() - began))
        labels = self.scanner.ground_truth.render()
        self.empty += not labels.any()
        if self._sweep is not None:
            grey = next(iter(images.by_name.values()))
            self._sweep.add(grey, labels, self.probe, pose, self._sweep.count / FRAMES_PER_SECOND)
        return images

    def save_iq(self, name: str, images: PlaneImages, suffix: str) -> None:
        """Write the IQ and RF signals of the last pose's B-mode image. Raises OSError."""
        before = self._planes[-2] if len(self._planes) > 1 else None
        world = np.asarray(images.plane.world_from_plane, float)
        if not self._wavefronts or self._wavefronts[-1].angle_deg(self.probe, world) > MOST_TURNED_DEG:
            self._wavefronts.append(Wavefront.of(self.probe, world))
        reference = self._wavefronts[-1], len(self._wavefronts) - 1
        signals = self.scanner.iq(images, before, *reference)
        with atomic_write(self.out / f"{name}-iq.{suffix}") as partial:
            save_iq(signals, partial, suffix)

    def with_doppler(
        self, images: PlaneImages, mode: DopplerMode, clamped: bool = False
    ) -> dict[str, np.ndarray]:
        """The last pose's images by their names, with Doppler at the peak of systole."""
        return images.by_name | {DOPPLER: self.scanner.doppler(images, mode, SYSTOLE_S, clamped)}

    def save(self, name: str, images: dict[str, np.ndarray], dicom: bool) -> None:
        """Write the last pose's images by their names, and note them in ``rows``. Raises OSError."""
        prefix = self.out / name
        for saved in save_images(images, *self.probe.extent_mm[:2], self.probe, prefix, dicom):
            self.rows.append(
                dict(
                    pose=name,
                    probe_to_patient=self._planes[-1].world_from_plane.tolist(),
                    picture=saved.kind,
                    file=saved.path.name,
                    row_mm=saved.spacing_mm[0],
                    column_mm=saved.spacing_mm[1],
                    image_to_probe=self.probe.image_to_probe(*saved.shape).tolist(),
                )
            )
