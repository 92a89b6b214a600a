"""Read and write one volume in one file: NIfTI, NRRD, MetaImage."""

import errno
from pathlib import Path

import SimpleITK as sitk

from scenes.atomic_files import atomic_write, plain_path
from scenes.patient_space import Space
from scenes.volumes.file_kind import check_kind
from scenes.volumes.itk_files import META, NRRD, itk_volume
from scenes.volumes.lazy_volume import LazyVolume

NIFTI = (".nii", ".nii.gz")
ENDINGS = (*NIFTI, *NRRD, *META)


def is_volume_file(path: Path) -> bool:
    """Whether a file name ends like that of a volume."""
    return path.name.lower().endswith(ENDINGS)


def file_volume(path: Path, vectors: bool = False, space: Space | None = None) -> LazyVolume:
    """Read the header of a NIfTI, NRRD or MetaImage file; voxels are read on demand.

    With ``vectors`` an NRRD or MetaImage may have several numbers per voxel: the layers of a segmentation.
    ``space`` is that of the axes of a file that does not name it; a file's own counts before it. Raises
    PatientError where the file is of another format than its name says, damaged, not 3D, sheared, or without
    an orientation where there is no ``space``.
    """
    check_kind(path)
    if not path.name.lower().endswith(NIFTI):
        return itk_volume(path, vectors, space)
    # nibabel takes 0.2 s to import.
    from scenes.volumes.nifti_files import nifti_volume

    return nifti_volume(path, space)


def save_image(image: sitk.Image, path: Path) -> None:
    """Write an image, compressed, as NRRD or MetaImage by the suffix. Raises OSError."""
    with atomic_write(path) as partial, plain_path(partial) as name:
        try:
            sitk.WriteImage(image, name, useCompression=True)
            sitk.ReadImage(name)  # ITK does not report a disk that is full at the last bytes
        except RuntimeError:  # ITK's message has many lines and no cause
            raise OSError(errno.EIO, "cannot be written completely (is the disk full?)") from None
