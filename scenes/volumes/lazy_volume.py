"""A volume whose header is known and whose voxels are read on demand, and checks of headers and voxels."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import psutil
import SimpleITK as sitk

from errors import PatientError
from scenes.patient_space import SPACES, Space
from scenes.volumes.dicom_references import NO_REFERENCES, DicomReferences
from scenes.volumes.voxel_grid import Box, VoxelGrid

AIR_HU = -1000
PADDING_BELOW_HU = -1024
LEAST_HU, MOST_HU = -32768, 32767
# Memory per voxel until the CT is cropped: 4.8 bytes were measured on a label map and its CT.
VOXEL_BYTES = 5
MOST_BYTES = 8 * 2**30
# The highest compression ratio of deflate.
MOST_COMPRESSION = 1040


@dataclass(frozen=True)
class LazyVolume:
    """A volume in patient coordinates, on disk or in memory."""

    name: str  # for errors: the file or folder
    grid: VoxelGrid
    read_box: Callable[[Box], np.ndarray]  # voxels (z, y, x) of a box
    notes: tuple[str, ...] = ()  # for the user: what was chosen, left out or resampled
    references: DicomReferences = NO_REFERENCES  # the DICOM objects that it consists of
    series: str = ""  # number of the DICOM series
    space: Space | None = None  # of the axes, by the user, where the file names none
    patient_position: str = ""  # DICOM's term, such as HFS, where there is one
    # Of a file's header, with the names of its labels.
    metadata: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, image: sitk.Image, name: str = "the image") -> LazyVolume:
        """A volume in memory."""
        # A view does not keep its image alive.
        return cls(
            name,
            VoxelGrid.of(image),
            lambda box: np.array(sitk.GetArrayViewFromImage(image)[box[::-1]]),
        )

    def read(self, box: Box | None = None) -> np.ndarray:
        """Voxels (z, y, x) of a box, or all. Raises PatientError where they do not fit in memory, or are not
        finite.
        """
        box = box or self.grid.full_box()
        needed = VOXEL_BYTES * float(np.prod([float(a.stop - a.start) for a in box]))
        free = psutil.virtual_memory().available
        if needed > free:
            raise PatientError(
                f"{self.name}: takes {needed / 1e9:.1f} GB to read, and {free / 1e9:.1f} GB are free; close "
                "other programs, or "
                "crop the volume around the kidney"
            )
        voxels = self.read_box(box)
        count = int((~np.isfinite(voxels)).sum()) if voxels.dtype.kind == "f" else 0
        if count:
            raise PatientError(f"{self.name}: {count} voxels are not finite numbers; export the volume again")
        return voxels

    def hounsfield(self, box: Box | None = None) -> np.ndarray:
        """HU (z, y, x) of a box as int16; padding outside the field of view becomes air."""
        voxels = self.read(box)
        if voxels.dtype != np.int16:
            voxels = np.clip(np.rint(voxels), LEAST_HU, MOST_HU).astype(np.int16)
        voxels[voxels < PADDING_BELOW_HU] = AIR_HU
        return voxels

    def image(self, box: Box | None = None) -> sitk.Image:
        """The voxels of a box as an image, without metadata."""
        return self.grid.part(box or self.grid.full_box()).image(self.read(box))


def check_size(path: Path, grid: VoxelGrid, voxel_bytes: int, held_bytes: int, compressed: bool) -> None:
    """Check the size that a header claims against the file's and against 8 GiB. Raises PatientError."""
    claimed = float(np.prod(np.array(grid.size, float))) * voxel_bytes
    if claimed > min(held_bytes * (MOST_COMPRESSION if compressed else 1), MOST_BYTES):
        size = " x ".join(map(str, grid.size))
        raise PatientError(
            f"{path}: its header claims {size} voxels, more than the file can hold; copy or export it again"
        )


def no_orientation(path: Path, what: str) -> PatientError:
    """The error for a file that does not say where its axes point in the patient."""
    return PatientError(
        f"{path}: {what}, so left and right may be exchanged; export it again with its orientation, for "
        "example from 3D Slicer; if you know "
        f"where its axes point, give --space, one of {', '.join(SPACES)}"
    )


def no_scalar(path: Path, kind: object) -> PatientError:
    """The error for voxels that are colours, vectors or complex numbers."""
    return PatientError(f"{path}: each voxel is a {kind}; expected one number; export a scalar volume")
