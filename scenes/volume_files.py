"""Volumes as files, and in words what keeps them from being written."""

import errno
from pathlib import Path

import SimpleITK as sitk

from scenes.atomic_files import whole


def save_image(image: sitk.Image, path: Path) -> None:
    """Write an image, compressed, as NRRD or MetaImage as the suffix says. Raises OSError: a full disk, a folder that is not there."""
    with whole(path) as partial:
        try:
            sitk.WriteImage(image, str(partial), useCompression=True)
            sitk.ReadImage(str(partial))  # as ITK does not notice a disk that is full from the last bytes on
        except RuntimeError:  # all that ITK tells, in many lines
            raise OSError(errno.EIO, "cannot be written whole (is the disk full?)") from None
