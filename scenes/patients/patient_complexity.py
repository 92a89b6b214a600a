"""Complexity of an imported patient's tumour."""

import numpy as np
import SimpleITK as sitk

from scenes.anatomy import Grid, LoadedAnatomy
from scenes.patients.patient_import import Patient
from scenes.patients.patient_scene import hilum
from scenes.tumour_complexity import Complexity, complexity
from scenes.volumes.voxel_grid import VoxelGrid


def complexity_of_patient(patient: Patient) -> Complexity | None:
    """The complexity of a patient's largest tumour; None without a tumour."""
    grid = VoxelGrid.of(patient.labels)
    mm_from_index = np.eye(4)
    mm_from_index[:3, :3] = grid.direction * grid.spacing
    mm_from_index[:3, 3] = grid.origin
    labels = Grid(sitk.GetArrayViewFromImage(patient.labels).transpose(2, 1, 0), np.linalg.inv(mm_from_index))
    anatomy = LoadedAnatomy(patient.organ, patient.tumour, None, (), labels, patient.tissues, patient.parts)
    return complexity(anatomy, hilum(patient.organ, patient.side))
