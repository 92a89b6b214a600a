"""Volumes in one file, by what its name ends in."""

from __future__ import annotations

from pathlib import Path

from scenes.patients.readers.itk_files import META, NRRD, itk_volume
from scenes.patients.readers.lazy_volume import LazyVolume

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
    from scenes.patients.readers.nifti import nifti_volume

    return nifti_volume(path)
