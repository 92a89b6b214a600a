"""Volumes as files, and in words what keeps them from being written."""

import errno
from pathlib import Path

import SimpleITK as sitk


def save_image(image: sitk.Image, path: Path) -> None:
    """Write an image, compressed, as NRRD or MetaImage as the suffix says. Raises OSError: a full disk, a folder that is not there."""
    try:
        sitk.WriteImage(image, str(path), useCompression=True)
        sitk.ReadImage(str(path))  # as ITK does not notice a disk that is full from the last bytes on
    except RuntimeError:  # all that ITK tells, in many lines
        reason = "cannot be written whole (is the disk full?)"
        raise OSError(errno.EIO, reason, str(path)) from None
