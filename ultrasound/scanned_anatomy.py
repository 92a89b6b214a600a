"""The anatomy that a scanner sees, at rest: CT, labels, and the surfaces of organ and tumour. NumPy."""

from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import trimesh

from ultrasound.acoustics import TissueVoxels, stored_properties


@dataclass(frozen=True)
class ScannedAnatomy:
    """The anatomy at rest, all in one coordinate system [mm].

    ``hu`` (nx, ny, nz) and ``labels`` on the same grid, with ``index_from_mm`` (4, 4); ``tissues`` are those
    by label. ``classify`` returns the tissue of every voxel, on a grid of its own; without it, what has no
    label has the acoustic properties of its HU.
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


def start_acoustics(anatomy: ScannedAnatomy) -> Future[np.ndarray]:
    """Start computing the acoustic properties that B-mode images need, on a thread of its own."""
    worker = ThreadPoolExecutor(1)
    values = worker.submit(lambda: stored_properties(anatomy.voxels))
    worker.shutdown(wait=False)
    return values
