"""Read a CT: DICOM folders, DICOMDIR, zip archives, NIfTI, NRRD, MetaImage."""

from pathlib import Path

from errors import PatientError
from scenes.patients.readers.dicom_series import read_dicom_headers, series_volume
from scenes.terminal import Progress, silent
from scenes.volumes.lazy_volume import LazyVolume
from scenes.volumes.volume_files import file_volume, is_volume_file


def open_ct(
    path: Path, series: str | None = None, referenced: str = "", progress: Progress = silent
) -> LazyVolume:
    """Find a CT and read its headers; voxels are read on demand.

    Args:
        path: a folder with DICOM files, in subfolders too; a DICOMDIR; a zip archive of DICOM files; an enhanced CT;
            a .nii, .nii.gz, .nrrd, .nhdr, .mha or .mhd file.
        series: number or UID (or its end) of one of several series.
        referenced: UID of the series that the labels refer to, which is preferred.

    Raises:
        PatientError: not readable, or not one complete CT.
    """
    if not path.exists():
        raise PatientError(f"{path}: no such file or folder; check the path")
    if path.is_file() and is_volume_file(path):
        if series is not None:
            raise PatientError(f"{path}: has no series; leave --series out")
        return file_volume(path)
    return series_volume(path, read_dicom_headers(path, progress), series, referenced, progress)
