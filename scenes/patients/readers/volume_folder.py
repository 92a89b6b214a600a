"""Choose the CT among the NIfTI, NRRD and MHA files of a folder."""

import re
from dataclasses import replace
from pathlib import Path

from errors import PatientError
from scenes.folder_files import files_below
from scenes.patient_space import Space
from scenes.patients.readers.label_maps import listed
from scenes.patients.readers.segment_names import is_understood
from scenes.volumes.lazy_volume import LazyVolume
from scenes.volumes.volume_files import file_volume, is_volume_file

# In the names of label maps, such as KiTS's segmentation.nii.gz; others are named as a structure.
LABEL_NAME = re.compile(
    r"(?i)(?<![a-z])(seg|segmentations?|labels?|labelmap|masks?|annotations?|rois?)(?![a-z])"
)
# In the names of CTs that would be structures.
CT_NAME = re.compile(r"(?i)(?<![a-z])(ct|image|arterial|(portal)?venous)(?![a-z])|phase")


def volume_files(path: Path) -> list[Path]:
    """The volume files of a folder and its subfolders; none of a file."""
    return sorted(filter(is_volume_file, files_below(path))) if path.is_dir() else []


def only_volume(folder: Path, files: list[Path], space: Space | None = None) -> LazyVolume:
    """The one volume file of a folder that is not named as labels.

    Raises PatientError where there are several, or labels alone.
    """
    images = [file for file in files if not _is_named_as_labels(file)] if len(files) > 1 else files
    if len(images) != 1:
        names = listed([str(file.relative_to(folder)) for file in images or files])
        raise PatientError(
            f"{folder}: has {len(images) or len(files)} files that may be the "
            f"CT{'' if images else ', all named as labels'}: {names}; "
            "expected one; give its path as CT"
        )
    volume = file_volume(images[0], space=space)
    chosen = f"of {len(files)} volume files, the one that is not named as labels was taken as the CT"
    return replace(volume, notes=(*volume.notes, *(chosen,) * (len(files) > 1)))


def _is_named_as_labels(file: Path) -> bool:
    name = file.name.partition(".")[0]
    if file.name.lower().endswith(".seg.nrrd") or LABEL_NAME.search(name):
        return True
    return is_understood(name) and not CT_NAME.search(name)
