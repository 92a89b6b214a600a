"""Where voxels are in the patient: LPS [mm], the origin in the middle of voxel 0."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import SimpleITK as sitk

from errors import PatientError

Box = tuple[slice, slice, slice]

# A voxel of a CT, or of labels on one.
SPACING_MM = (0.05, 15.0)
# Largest cosine between two axes that rounding in files leaves.
SQUARE = 2e-3
# A CT of the whole body has a third of a billion.
MOST_VOXELS = 1_200_000_000


@dataclass(frozen=True)
class VoxelGrid:
    """Size, spacing, origin and direction of voxels, in the order x, y, z of their indices."""

    size: tuple[int, int, int]
    spacing: np.ndarray  # (3,) [mm]
    origin: np.ndarray  # (3,) [mm], LPS
    direction: np.ndarray  # (3, 3), columns are the axes, LPS

    @classmethod
    def of(cls, image: sitk.Image | sitk.ImageFileReader) -> VoxelGrid:
        """The grid of an image, or of a file whose header was read."""
        return cls(
            tuple(image.GetSize()),
            np.array(image.GetSpacing()),
            np.array(image.GetOrigin()),
            np.array(image.GetDirection()).reshape(3, 3),
        )

    def checked(self, name: str) -> VoxelGrid:
        """This grid, once it is one that voxels of a patient can have. Raises PatientError, which begins with a name."""
        size = " x ".join(map(str, self.size))
        if min(self.size) < 2:
            raise PatientError(
                f"{name}: the image has {size} voxels; expected one 3D volume; export one volume"
            )
        if float(np.prod(np.array(self.size, float))) > MOST_VOXELS:
            raise PatientError(
                f"{name}: its header claims {size} voxels; expected at most {MOST_VOXELS / 1e9:.1f} billion; "
                "crop the volume or export it again"
            )
        least, most = SPACING_MM
        if not np.isfinite(np.concatenate([self.spacing, self.origin, self.direction.ravel()])).all():
            raise PatientError(f"{name}: its place in the patient is not a number; export the volume again")
        if not ((self.spacing >= least) & (self.spacing <= most)).all():
            voxel = " x ".join(f"{s:g}" for s in self.spacing)
            raise PatientError(
                f"{name}: voxels of {voxel} mm; expected {least:g} to {most:g} mm each way; export the volume again in mm"
            )
        if np.abs(self.direction.T @ self.direction - np.eye(3)).max() > SQUARE:
            raise PatientError(
                f"{name}: the axes are sheared; expected axes at right angles; resample the volume, for example in 3D Slicer"
            )
        return self

    def place(self, indices: npt.ArrayLike) -> np.ndarray:
        """LPS [mm] of voxel indices (n, 3) in the order x, y, z."""
        return np.asarray(indices) * self.spacing @ self.direction.T + self.origin

    def index(self, places: npt.ArrayLike) -> np.ndarray:
        """Voxel indices (n, 3), with fractions, of places in LPS [mm]."""
        return (np.asarray(places) - self.origin) @ self.direction / self.spacing

    def corners(self, box: Box | None = None) -> np.ndarray:
        """LPS of the outermost voxel centres (8, 3) of the grid or a part of it."""
        box = box or self.whole()
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

    def whole(self) -> Box:
        """The box of all voxels."""
        x, y, z = (slice(0, n) for n in self.size)
        return x, y, z

    def box_around(self, low: np.ndarray, high: np.ndarray) -> Box:
        """The smallest box of voxels that covers places between two corners in LPS [mm]; it may be empty."""
        corners = np.array(np.meshgrid(*zip(low, high, strict=True), indexing="ij")).reshape(3, -1).T
        found = self.index(corners)
        first = np.clip(np.floor(found.min(axis=0)).astype(int), 0, self.size)
        last = np.clip(np.ceil(found.max(axis=0)).astype(int) + 1, 0, self.size)
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
        """What an image holds at these voxels (z, y, x), and beyond it a value."""
        found = sitk.Resample(
            image,
            list(self.size),
            sitk.Transform(),
            interpolator,
            self.origin.tolist(),
            self.spacing.tolist(),
            self.direction.ravel().tolist(),
            beyond,
        )
        return sitk.GetArrayFromImage(found)

    def same_as(self, other: VoxelGrid) -> bool:
        """Whether size and, to a hundredth of a voxel, all corners agree: files round their geometry."""
        if self.size != other.size:
            return False
        apart = np.abs(self.corners() - other.corners()).max()
        return bool(apart <= 0.01 * min(self.spacing.min(), other.spacing.min()))
