"""Ground-truth labels of an image: organ, tumour and beads at each pixel."""

import numpy as np
import taichi as ti

from sim.fields import field_of
from sim.kernels import kernel
from ultrasound.plane_in_tissue import PlaneInTissue
from ultrasound.sampled_volume import SampledVolume
from ultrasound.sweep import PixelLabel

MAX_BEADS = 255 // PixelLabel.BEAD


class GroundTruthLabels:
    """``PixelLabel`` values of the plane located last, by the rest position of its tissue.

    ``organ`` and ``tumour`` are signed distances [mm], negative inside; ``beads`` (n, 3) are centres of balls
    of a radius [mm]. Raises ValueError for more than MAX_BEADS beads.
    """

    def __init__(
        self,
        plane: PlaneInTissue,
        organ: SampledVolume,
        tumour: SampledVolume | None = None,
        beads: np.ndarray | None = None,
        radius_mm: float = 2.0,
    ) -> None:
        self.plane, self.organ, self.radius_mm = plane, organ, radius_mm
        # Without a tumour, no kernel reads its distances.
        self.tumour, self.has_tumour = tumour or organ, tumour is not None
        self.beads, self.has_beads = 0 if beads is None else len(beads), beads is not None
        if self.beads > MAX_BEADS:
            raise ValueError(f"{self.beads} beads: at most {MAX_BEADS} fit into 8-bit labels")
        if beads is not None:
            self.bead = field_of(np.asarray(beads, float), 1)

    def render(self) -> np.ndarray:
        """Labels (rows, columns) uint8."""
        image = np.empty(self.plane.shape, np.uint8)
        self._render(image)
        return image

    @kernel
    def _render(self, image: ti.types.ndarray(ti.u8, ndim=2)):
        for row, column in ti.ndrange(image.shape[0], image.shape[1]):
            rest = self.plane.rest_at(row, column, self.plane.grid[0], self.plane.grid[1])
            label = ti.cast(PixelLabel.OUTSIDE, ti.i32)
            if self.plane.is_tissue(row, column):
                if self.organ.sample(rest) < 0.0:
                    label = PixelLabel.ORGAN
                if ti.static(self.has_tumour):
                    if self.tumour.sample(rest) < 0.0:
                        label = PixelLabel.TUMOUR
                if ti.static(self.has_beads):
                    for k in range(self.beads):
                        if (rest - self.bead[k]).norm_sqr() < self.radius_mm**2:
                            label = label % PixelLabel.BEAD + PixelLabel.BEAD * (k + 1)
            image[row, column] = ti.cast(label, ti.u8)
