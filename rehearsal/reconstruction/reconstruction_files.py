"""What a reconstruction leaves: volumes in NRRD (LPS)."""

from pathlib import Path

import numpy as np
import SimpleITK as sitk

from rehearsal.reconstruction.sweep_volumes import Rebuilt
from scenes.volume_files import save_image
from ultrasound.reconstruction import VoxelBox
from ultrasound.sweep import PixelLabel


def save_volumes(rebuilt: Rebuilt, out: Path) -> None:
    """Write volume.nrrd and, where there are regions, labels.nrrd with ``PixelLabel`` values."""
    grey = np.clip(np.rint(rebuilt.grey), 0, 255).astype(np.uint8)
    save_volume(grey, rebuilt.box, out / "volume.nrrd")
    if "organ" in rebuilt.regions:
        labels = np.where(rebuilt.regions["organ"], np.uint8(PixelLabel.ORGAN), np.uint8(PixelLabel.OUTSIDE))
        if "tumour" in rebuilt.regions:
            labels[rebuilt.regions["tumour"]] = PixelLabel.TUMOUR
        save_volume(labels, rebuilt.box, out / "labels.nrrd")


def save_volume(voxels: np.ndarray, box: VoxelBox, path: Path) -> None:
    """Write voxels (x, y, z) on a box along the axes of LPS [mm], compressed; the suffix says the format. Raises OSError."""
    image = sitk.GetImageFromArray(np.ascontiguousarray(voxels.transpose(2, 1, 0)))
    image.SetOrigin([float(each) for each in box.origin_mm])
    image.SetSpacing([box.spacing_mm] * 3)
    save_image(image, path)
