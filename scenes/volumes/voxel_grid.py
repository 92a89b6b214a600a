"""Voxel grids in patient coordinates: LPS [mm], the origin at the centre of voxel 0."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import SimpleITK as sitk

from errors import PatientError
from scenes.patient_space import Space, signs_to_lps

Box = tuple[slice, slice, slice]

# Plausible voxel sizes of a CT.
SPACING_MM = (0.05, 15.0)
# Largest cosine between two axes; files round them.
MOST_SHEAR = 2e-3
# A whole-body CT has 0.3 billion voxels.
MOST_VOXELS = 1_200_000_000


def check_3d(name: str, shape: tuple[int, ...]) -> str:
    """The size of a volume in words. Raises PatientError where it is a picture, or several volumes."""
    size = " x ".join(map(str, shape))
    if len(shape) != 3 or min(shape) < 2:
        raise PatientError(f"{name}: the image has {size} voxels; expected one 3D volume; export one volume")
    return size


@dataclass(frozen=True)
class VoxelGrid:
    """Size, spacing, origin and direction; indices in the order x, y, z."""

    size: tuple[int, int, int]
    spacing: np.ndarray  # (3,) [mm]
    origin: np.ndarray  # (3,) [mm], LPS
    direction: np.ndarray  # (3, 3), columns are the axes, LPS

    @classmethod
    def of(cls, image: sitk.Image | sitk.ImageFileReader) -> VoxelGrid:
        """The grid of an image, or of a reader that has read a header."""
        return cls(
            tuple(image.GetSize()),
            np.array(image.GetSpacing()),
            np.array(image.GetOrigin()),
            np.array(image.GetDirection()).reshape(3, 3),
        )

    @classmethod
    def of_transform(cls, index_from_mm: np.ndarray, size: tuple[int, ...]) -> VoxelGrid:
        """The grid of a size whose indices an affine transform (4, 4) gives from LPS [mm]."""
        mm_from_index = np.linalg.inv(index_from_mm)
        spacing = np.linalg.norm(mm_from_index[:3, :3], axis=0)
        x, y, z = size
        return cls((x, y, z), spacing, mm_from_index[:3, 3], mm_from_index[:3, :3] / spacing)

    @property
    def index_from_mm(self) -> np.ndarray:
        """The affine transform (4, 4) from LPS [mm] to voxel indices."""
        mm_from_index = np.eye(4)
        mm_from_index[:3, :3] = self.direction * self.spacing
        mm_from_index[:3, 3] = self.origin
        return np.linalg.inv(mm_from_index)

    def checked(self, name: str) -> VoxelGrid:
        """This grid, if it is plausible. Raises PatientError that begins with ``name``."""
        size = check_3d(name, self.size)
        if float(np.prod(np.array(self.size, float))) > MOST_VOXELS:
            raise PatientError(
                f"{name}: its header claims {size} voxels; expected at most {MOST_VOXELS / 1e9:.1f} billion; "
                "crop the volume or export it again"
            )
        least, most = SPACING_MM
        if not np.isfinite(np.concatenate([self.spacing, self.origin, self.direction.ravel()])).all():
            raise PatientError(f"{name}: its position in the patient is not finite; export the volume again")
        if not ((self.spacing >= least) & (self.spacing <= most)).all():
            voxel = " x ".join(f"{s:g}" for s in self.spacing)
            raise PatientError(
                f"{name}: voxels of {voxel} mm; expected {least:g} to {most:g} mm along each axis; export "
                "the volume again in mm"
            )
        if np.abs(self.direction.T @ self.direction - np.eye(3)).max() > MOST_SHEAR:
            raise PatientError(
                f"{name}: the axes are sheared; expected axes at right angles; resample the volume, for "
                "example in 3D Slicer"
            )
        return self

    def in_lps(self, space: Space) -> VoxelGrid:
        """This grid, whose origin and axes are those of a space, in LPS."""
        signs = signs_to_lps(space)
        return replace(self, origin=signs * self.origin, direction=signs[:, None] * self.direction)

    def place(self, indices: npt.ArrayLike) -> np.ndarray:
        """LPS [mm] of voxel indices (n, 3) in the order x, y, z."""
        return np.asarray(indices) * self.spacing @ self.direction.T + self.origin

    def index(self, places: npt.ArrayLike) -> np.ndarray:
        """Voxel indices (n, 3), with fractions, of places in LPS [mm]."""
        return (np.asarray(places) - self.origin) @ self.direction / self.spacing

    def share_inside(self, places: npt.ArrayLike) -> float:
        """Share of places (n, 3) in LPS [mm] that are in a voxel of this grid."""
        indices = self.index(places)
        return float(((indices >= -0.5) & (indices <= np.array(self.size) - 0.5)).all(axis=1).mean())

    def corners(self, box: Box | None = None) -> np.ndarray:
        """LPS [mm] of the eight outermost voxel centres (8, 3) of the grid or of a box."""
        box = box or self.full_box()
        return self.place(
            np.array(np.meshgrid(*[(a.start, a.stop - 1) for a in box], indexing="ij")).reshape(3, -1).T
        )

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest LPS [mm] of voxel centres, (3,) each."""
        corners = self.corners()
        return corners.min(axis=0), corners.max(axis=0)

    @property
    def voxel_ml(self) -> float:
        """Volume of a voxel [ml]."""
        return float(np.prod(self.spacing)) / 1000

    def full_box(self) -> Box:
        """The box of all voxels."""
        x, y, z = (slice(0, n) for n in self.size)
        return x, y, z

    def box_around(self, low: np.ndarray, high: np.ndarray) -> Box:
        """The smallest box of voxels that covers an LPS box [mm] between two corners; it may be empty."""
        corners = np.array(np.meshgrid(*zip(low, high, strict=True), indexing="ij")).reshape(3, -1).T
        indices = self.index(corners)
        first = np.clip(np.floor(indices.min(axis=0)), 0, self.size)
        last = np.clip(np.ceil(indices.max(axis=0)) + 1, 0, self.size)
        x, y, z = (slice(int(a), int(max(a, b))) for a, b in zip(first, last, strict=True))
        return x, y, z

    def part(self, box: Box) -> VoxelGrid:
        """The grid of a box of this one's voxels."""
        size = tuple(a.stop - a.start for a in box)
        return replace(self, size=size, origin=self.place([a.start for a in box]))

    def image(self, voxels: np.ndarray) -> sitk.Image:
        """An image of voxels (z, y, x) on this grid, without metadata."""
        image = sitk.GetImageFromArray(voxels)
        image.SetSpacing(self.spacing.tolist())
        image.SetOrigin(self.origin.tolist())
        image.SetDirection(self.direction.ravel().tolist())
        return image

    def sampled(self, image: sitk.Image, interpolator: int, beyond: float) -> np.ndarray:
        """An image resampled at these voxels (z, y, x); ``beyond`` outside the image."""
        resampled = sitk.Resample(
            image,
            list(self.size),
            sitk.Transform(),
            interpolator,
            self.origin.tolist(),
            self.spacing.tolist(),
            self.direction.ravel().tolist(),
            beyond,
        )
        return sitk.GetArrayFromImage(resampled)

    def same_as(self, other: VoxelGrid) -> bool:
        """Whether the sizes are equal and the corners agree to 0.01 voxel; files round their geometry."""
        if self.size != other.size:
            return False
        apart = np.abs(self.corners() - other.corners()).max()
        return bool(apart <= 0.01 * min(self.spacing.min(), other.spacing.min()))
