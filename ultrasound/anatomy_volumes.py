"""The volumes of an anatomy at rest that images are sampled from, and the crater in them."""

from collections.abc import Callable
from concurrent.futures import Future
from functools import cached_property

import numpy as np

from ultrasound.acoustics import TissueVoxels
from ultrasound.blood_flow import stored_flow
from ultrasound.crater import Box, Crater
from ultrasound.sampled_volume import SampledVolume, distance_volume
from ultrasound.scanned_anatomy import ScannedAnatomy, start_acoustics

# The voxels of a volume that a crater changes, and their values with it; None for no change.
Change = Callable[[Crater, SampledVolume], tuple[Box, np.ndarray] | None]
TUMOUR_SPACING_MM = 1.0
# Distances from the organ are known so far around it: more than the highest layer of fluid on it.
ORGAN_REACH_MM = 11.0


class AnatomyVolumes:
    """The volumes of an anatomy at rest, each computed at its first use; ``set_crater`` alone changes them.

    ``acoustics`` are properties whose computation has already been started. ``version`` counts the changes.
    """

    def __init__(self, anatomy: ScannedAnatomy, acoustics: Future[np.ndarray] | None = None) -> None:
        self.anatomy = anatomy
        self.crater: Crater | None = None
        self.version = 0
        self._acoustics = acoustics
        self._volumes: list[tuple[SampledVolume, Change]] = []
        # What the voxels that the crater changed were before.
        self._replaced: list[tuple[SampledVolume, Box, np.ndarray]] = []

    @cached_property
    def ct(self) -> SampledVolume:
        """HU."""
        volume = SampledVolume(self.anatomy.hu, self.anatomy.index_from_mm)
        return self._with_crater(volume, lambda crater, whole: crater.replaced(whole, crater.hu()))

    @cached_property
    def tissue(self) -> SampledVolume:
        """Acoustic properties (.., 4), see ``acoustics.properties``."""
        values, self._acoustics = (self._acoustics or start_acoustics(self.anatomy)).result(), None
        volume = SampledVolume(values, self.anatomy.voxels.index_from_mm, outside=0.0)
        return self._with_crater(volume, lambda crater, whole: crater.replaced(whole, crater.acoustics()))

    @cached_property
    def flow(self) -> SampledVolume:
        """Blood flow, see ``flow_volume``."""
        nothing = np.zeros(1, np.float32)
        return self._with_crater(
            flow_volume(self.anatomy.voxels), lambda crater, whole: crater.replaced(whole, nothing)
        )

    @cached_property
    def organ(self) -> SampledVolume:
        """Signed distance [mm] from the organ's surface, negative inside; a crater with fluid is inside."""
        return self._with_crater(distance_volume(self.anatomy.organ, reach_mm=ORGAN_REACH_MM), _without_air)

    @cached_property
    def remnant(self) -> SampledVolume:
        """Signed distance [mm] from what remains of the organ, negative inside."""
        return self._with_crater(distance_volume(self.anatomy.organ), Crater.without)

    @cached_property
    def tumour(self) -> SampledVolume | None:
        """Signed distance [mm] from what remains of the tumour, negative inside; None without a tumour."""
        if self.anatomy.tumour is None:
            return None
        return self._with_crater(distance_volume(self.anatomy.tumour, TUMOUR_SPACING_MM), Crater.without)

    def set_crater(self, crater: Crater | None) -> None:
        """Replace the tissue in a crater by what fills it, or with None restore all tissue."""
        for volume, box, values in self._replaced:
            volume.set_values(box, values)
        self._replaced.clear()
        self.crater, self.version = crater, self.version + 1
        for volume, change in self._volumes:
            self._apply(change, volume)

    def _with_crater(self, volume: SampledVolume, change: Change) -> SampledVolume:
        """Own a new volume: with the crater in it, if there is one, now and later."""
        self._volumes.append((volume, change))
        self._apply(change, volume)
        return volume

    def _apply(self, change: Change, volume: SampledVolume) -> None:
        """Put the present crater into a volume without one."""
        changed = None if self.crater is None else change(self.crater, volume)
        if changed is not None:
            box, values = changed
            self._replaced.append((volume, box, volume.values(box)))
            volume.set_values(box, values)


def flow_volume(voxels: TissueVoxels) -> SampledVolume:
    """The blood flow, of ``blood_flow.CHANNELS``, along the axes in mm; zero without vessels."""
    low, values = stored_flow(voxels)
    values = values.astype(np.float32)
    axes = np.linalg.inv(voxels.index_from_mm[:3, :3]) / voxels.spacing_mm
    values[..., :3] = values[..., :3] @ axes.T.astype(np.float32)
    index_from_mm = voxels.index_from_mm.copy()
    index_from_mm[:3, 3] -= low
    return SampledVolume(values, index_from_mm, outside=0.0)


def _without_air(crater: Crater, volume: SampledVolume) -> tuple[Box, np.ndarray] | None:
    """Signed distances without a crater of air; fluid changes none."""
    return crater.without(volume) if crater.filling == "air" else None
