"""What is labelled and connected to no kidney is named; islands of the other kidney are none of this patient's."""

import numpy as np
import pytest
import SimpleITK as sitk
from synthetic_body import LEFT, RIGHT, TUMOUR, body, coarsely, drawn

from scenes.patients.patient_import import import_patient
from scenes.patients.readers.label_maps import LabelMap
from scenes.volumes.lazy_volume import LazyVolume
from scenes.volumes.voxel_grid import VoxelGrid

NAMES = {1: "kidney_right", 2: "kidney_left", 3: "tumour", 4: "cyst"}


def warnings_of(ct, image, side):
    voxels = sitk.GetArrayFromImage(image).astype(np.uint8)
    labels = LabelMap.valued(VoxelGrid.of(image), voxels, NAMES)
    patient = import_patient(LazyVolume.of(ct), labels, [1, 2], side, margin_mm=10.0)
    return [line for line in patient.warnings if "touch no labelled kidney" in line]


@pytest.mark.parametrize(("name", "value", "ml", "is_named"), [
    ("organ", 2, 0.5, False), ("organ", 2, 4.0, True), ("tumour", 3, 0.5, True), ("cyst", 4, 2.0, True),
])  # fmt: skip
def test_an_island_is_named_with_volume_and_place(monkeypatch, name, value, ml, is_named):
    coarsely(monkeypatch)
    ct, labels = body(spacing=(2.5, 2.5, 4.0))
    radius = np.cbrt(ml * 1000 * 3 / (4 * np.pi))
    island = LEFT[0] + [0, 0, 64.0], np.full(3, radius)
    image = drawn(labels, (1, RIGHT), (2, LEFT), (3, TUMOUR), (value, island))
    lines = warnings_of(ct, image, "left")
    assert len(lines) == is_named
    if is_named:
        assert f"ml of the {name}'s label" in lines[0] and "at 70, 35, 7" in lines[0]
    assert warnings_of(ct, image, "right") == []
