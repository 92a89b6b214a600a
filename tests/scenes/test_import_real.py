"""Patient import: real CTs, and a support like that of a bead experiment."""

import igl
import numpy as np
import pytest
import SimpleITK as sitk
import trimesh
from conftest import DATA
from synthetic_body import assert_sound, coarsely, least_gap, voxels_to_boundary
from test_patient_import import label_map

from scenes.patients.kidney_plausibility import kidney_warnings
from scenes.patients.organ_selection import find_organs
from scenes.patients.organ_support import mould
from scenes.patients.part_surfaces import organ_surface
from scenes.patients.patient_import import import_patient
from scenes.patients.readers.ct_series import open_ct
from scenes.patients.readers.label_maps import LabelMap

# A kidney of the other CT there, crlm_1004, is imported in test_app.py.
CT, LABELS, VALUE, SIDE, VOLUME_ML = "totalseg/ct.nii.gz", "totalseg/kidneys.nii.gz", 2, "right", 188.8


@pytest.mark.skipif(not (DATA / "ct").is_dir(), reason="real data (../shared/data/ct) is not here")
def test_a_real_kidney():
    labels = open_ct(DATA / "ct" / LABELS).image()
    patient = import_patient(open_ct(DATA / "ct" / CT), *label_map(labels, [VALUE]))
    assert patient.side == SIDE
    (warning,) = patient.warnings  # it has stones
    assert "12 HU: unenhanced" in warning and "shown as stone" in warning
    assert patient.organ.volume / 1000 == pytest.approx(VOLUME_ML, rel=0.01)
    assert len(patient.organ.faces) == pytest.approx(5000, abs=20)
    assert_sound(patient.organ)
    assert_sound(patient.support)
    assert voxels_to_boundary(patient.organ, labels == VALUE).max() < 1
    assert least_gap(patient.support, patient.organ) > 0
    assert sitk.GetArrayViewFromImage(patient.ct).min() >= -1024


@pytest.mark.skipif(not (DATA / "ct").is_dir(), reason="real data (../shared/data/ct) is not here")
@pytest.mark.parametrize("name", [LABELS, "crlm_1004_labels/kidneys_provisional.nii.gz"])
def test_real_kidneys_are_plausible(name, monkeypatch):
    """Of labels of 3 and 5 mm."""
    coarsely(monkeypatch)
    labels = LabelMap.of(open_ct(DATA / "ct" / name).image())
    right, left = find_organs(labels)
    midline = 0.5 * (right.centre_x_mm + left.centre_x_mm)
    for piece, side in ((right, "right"), (left, "left")):
        assert kidney_warnings(piece, labels, organ_surface(piece), side, midline) == ()


@pytest.mark.skipif(
    not (DATA / "truth").is_dir(), reason="bead experiments (../shared/data/truth) are not here"
)
def test_support_like_that_of_a_bead_experiment():
    organ = trimesh.load(DATA / "truth" / "kits040" / "kidney.stl")
    expected = trimesh.load(DATA / "truth" / "kits040" / "support.stl")
    support = mould(organ, np.array([0.0, 0.0, -1.0]))
    assert_sound(support)
    np.testing.assert_allclose(support.bounds[:, 2], expected.bounds[:, 2], atol=0.1)
    # The mould itself: organ's underside, away from the rim, as far from our support as from theirs.
    low, high = organ.bounds[:, 2]
    under = organ.vertices[organ.vertices[:, 2] < low + 0.2 * (high - low)]
    gaps = [
        igl.signed_distance(
            np.ascontiguousarray(under), np.asarray(m.vertices), np.asarray(m.faces, np.int64)
        )[0]
        for m in (support, expected)
    ]
    assert np.abs(gaps[0] - gaps[1]).mean() < 0.1
