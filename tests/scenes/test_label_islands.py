"""What is labelled and connected to no kidney is named; islands of the other kidney are none of this
patient's.
"""

import re

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
        found = (
            rf"([\d.]+) ml of the {name}'s label touch no labelled kidney, (\d+) mm from this one at 70, "
            r"35, 7"
        )
        volume, gap = map(float, re.match(found, lines[0]).groups())
        # Of voxels of 0.025 ml at the surface half are in it, at random; each body ends up to a slice before
        # its surface.
        assert volume == pytest.approx(ml, abs=0.05 + 0.025 * 2 * np.sqrt(4 * np.pi * radius**2 / 2.5**2 / 4))
        assert 64 - 45 - radius - 0.5 <= gap <= 64 - 45 - radius + 2 * 4.0
    assert warnings_of(ct, image, "right") == []
