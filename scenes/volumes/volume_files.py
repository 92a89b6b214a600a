"""Read and write one volume in one file: NIfTI, NRRD, MetaImage."""

from __future__ import annotations

import errno
from pathlib import Path

import SimpleITK as sitk

from scenes.atomic_files import atomic_write
from scenes.volumes.itk_files import META, NRRD, itk_volume
from scenes.volumes.lazy_volume import LazyVolume

NIFTI = (".nii", ".nii.gz")
ENDINGS = (*NIFTI, *NRRD, *META)


def is_volume_file(path: Path) -> bool:
    """Whether a file's name ends as a volume's does."""
    return path.name.lower().endswith(ENDINGS)


def file_volume(path: Path) -> LazyVolume:
    """The volume of a file. Raises PatientError: damaged, not 3D, sheared, or without its place in the patient."""
    if not path.name.lower().endswith(NIFTI):
        return itk_volume(path)
    # What reads NIfTI takes a fifth of a second to import, which a rehearsal need not wait for.
    from scenes.volumes.nifti_files import nifti_volume

    return nifti_volume(path)


def save_image(image: sitk.Image, path: Path) -> None:
    """Write an image, compressed, as NRRD or MetaImage as the suffix says. Raises OSError: a full disk, a folder that is not there."""
    with atomic_write(path) as partial:
        try:
            sitk.WriteImage(image, str(partial), useCompression=True)
            sitk.ReadImage(str(partial))  # as ITK does not notice a disk that is full from the last bytes on
        except RuntimeError:  # all that ITK tells, in many lines
            raise OSError(errno.EIO, "cannot be written whole (is the disk full?)") from None
