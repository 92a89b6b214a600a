"""Output files of a reconstruction: volumes in NRRD (LPS), and a figure of three slices."""

from pathlib import Path

import numpy as np
import SimpleITK as sitk
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rehearsal.reconstruction.sweep_volumes import SweepVolumes
from rehearsal.result_files import save_figure
from scenes.volumes.volume_files import save_image
from ultrasound.reconstruction import VoxelBox
from ultrasound.sweep import PixelLabel

COLOUR = {"organ": "#ff8c69", "tumour": "#ffe14d"}
AXES = "xyz"


def save_volumes(volumes: SweepVolumes, out: Path) -> None:
    """Write volume.nrrd and, where there are regions, labels.nrrd with ``PixelLabel`` values."""
    grey = np.clip(np.rint(volumes.grey), 0, 255).astype(np.uint8)
    save_volume(grey, volumes.box, out / "volume.nrrd")
    if "organ" in volumes.regions:
        labels = np.where(volumes.regions["organ"], np.uint8(PixelLabel.ORGAN), np.uint8(PixelLabel.OUTSIDE))
        if "tumour" in volumes.regions:
            labels[volumes.regions["tumour"]] = PixelLabel.TUMOUR
        save_volume(labels, volumes.box, out / "labels.nrrd")


def save_volume(voxels: np.ndarray, box: VoxelBox, path: Path) -> None:
    """Write voxels (x, y, z) on a box along the axes of LPS [mm], compressed, in the format of the suffix.

    Raises OSError.
    """
    image = sitk.GetImageFromArray(np.ascontiguousarray(voxels.transpose(2, 1, 0)))
    image.SetOrigin([float(coordinate) for coordinate in box.origin_mm])
    image.SetSpacing([box.spacing_mm] * 3)
    save_image(image, path)


def save_slices_figure(volumes: SweepVolumes, path: Path) -> None:
    """Write three orthogonal slices as PNG, through the centre of the tumour, or else of the scanned
    volume.
    """
    centred_on = volumes.regions.get("tumour", volumes.known)
    where = np.argwhere(centred_on if centred_on.any() else volumes.known)
    centre = where.mean(axis=0).round().astype(int) if len(where) else np.array(volumes.box.shape) // 2
    figure = Figure(figsize=(12, 4.4), facecolor="#101014", layout="constrained")
    for axis, (across, down) in enumerate(((1, 2), (0, 2), (0, 1))):
        _draw_slice(figure.add_subplot(1, 3, axis + 1), volumes, axis, across, down, int(centre[axis]))
    save_figure(figure, path, dpi=110)


def _draw_slice(axes: Axes, volumes: SweepVolumes, axis: int, across: int, down: int, index: int) -> None:
    low, high = (volumes.box.origin_mm + volumes.box.spacing_mm * np.array([[0], [1]]) * volumes.box.shape)[:]
    extent = (low[across], high[across], low[down], high[down])
    grey = volumes.grey.take(index, axis).T
    axes.imshow(grey, cmap="gray", vmin=0, vmax=255, origin="lower", extent=extent, interpolation="nearest")
    for name, region in volumes.regions.items():
        part = region.take(index, axis).T
        if part.any() and not part.all():
            axes.contour(part.astype(float), [0.5], colors=COLOUR[name], linewidths=0.9, extent=extent)
    place = volumes.box.origin_mm[axis] + volumes.box.spacing_mm * index
    axes.set_title(f"{AXES[axis]} = {place:.1f} mm", color="white", fontsize=10)
    axes.set_xlabel(f"{AXES[across]}, mm", color="white", fontsize=9)
    axes.set_ylabel(f"{AXES[down]}, mm", color="white", fontsize=9)
    if axis == 2:
        # The radiological convention: anterior is up.
        axes.invert_yaxis()
    axes.tick_params(colors="white", labelsize=8)
    axes.set_facecolor("black")
